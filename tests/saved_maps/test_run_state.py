"""Laws of the state of a run: a run that is cut off at any keyframe goes on as if it had never stopped."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.io import InputError
from dpmjax.saved_maps import load_state, save_map, save_state
from dpmjax.slam import ScanReport, SlamConfig, SlamMethods, SlamState, init_slam, make_methods, step_slam
from tests.deeppointmap import toy
from tests.saved_maps.comparison import assert_damage_is_refused, assert_same
from tests.slam.test_odometry import motion, planes, seen_from
from tests.slam.truth import EMPTY, TruthGeometry, TruthMatcher, laps, scans_of

CONFIG = SlamConfig()


class Whole(NamedTuple):
    """A run that nothing has stopped.

    Attributes:
        methods: of the run.
        scans: all scans.
        states: the state after each scan.
        reports: of all scans.
    """

    methods: SlamMethods
    scans: list
    states: list[SlamState]
    reports: list[ScanReport]


def run(methods: SlamMethods, scans: list, start: SlamState | None = None) -> tuple[list[SlamState], list[ScanReport]]:
    state, states, reports = start or init_slam(), [], []
    for scan in scans:
        state, report = step_slam(methods, state, scan)
        states.append(state)
        reports.append(report)
    return states, reports


def assert_goes_on_like_the_unbroken_one(whole: Whole, path: Path, stops: list[int]) -> None:
    for stop in stops:
        save_state(path, whole.states[stop], whole.reports[: stop + 1])
        state, reports = load_state(path)
        assert_same(state, whole.states[stop])
        assert_same(reports, tuple(whole.reports[: stop + 1]))
        states, rest = run(whole.methods, whole.scans[stop + 1 :], state)
        assert_same(tuple(rest), tuple(whole.reports[stop + 1 :]))
        assert_same(states[-1] if states else state, whole.states[-1])


def run_of_truth(num_scans: int) -> Whole:
    """Two rounds with loops, some empty scans and a kidnapping; or the first scans of them."""
    truth = laps(2, side_m=60.0, step_m=2.0)
    scans = scans_of([*range(200), *range(40, 90)])
    scans[17] = scans[170] = EMPTY
    methods = SlamMethods(TruthMatcher(truth), TruthGeometry(truth, sigma_m=0.03), CONFIG, "some weights")
    return Whole(methods, scans[:num_scans], *run(methods, scans[:num_scans]))


@pytest.fixture(scope="module")
def truth_run() -> Whole:
    return run_of_truth(250)


@pytest.fixture(scope="module")
def short_run() -> Whole:
    return run_of_truth(60)


def stops_of(whole: Whole) -> list[int]:
    return [report.scan for report in whole.reports if report.is_keyframe]


@pytest.mark.slow
def test_a_run_that_is_cut_off_anywhere_goes_on_like_an_unbroken_one(truth_run, tmp_path) -> None:
    loops = truth_run.states[-1].loops.loops
    assert any(loop.status == "accepted" for loop in loops)
    assert any(loop.T_target_source is None for loop in loops)
    assert "restarted" in {report.status for report in truth_run.reports}
    stops = stops_of(truth_run)
    chosen = [stops[0], stops[-1], *np.random.default_rng(0).choice(stops, 3, replace=False)]
    assert_goes_on_like_the_unbroken_one(truth_run, tmp_path / "state.npz", chosen)


@pytest.mark.slow
def test_a_drive_that_extends_a_map_goes_on_like_an_unbroken_one(truth_run, tmp_path) -> None:
    start = init_slam(truth_run.states[80].slam_map)
    scans = scans_of(range(120, 160))
    whole = Whole(truth_run.methods, scans, *run(truth_run.methods, scans, start))
    stops = [row for row, report in enumerate(whole.reports) if report.is_keyframe]
    assert_goes_on_like_the_unbroken_one(whole, tmp_path / "state.npz", [stops[0], stops[len(stops) // 2]])


@pytest.mark.slow
def test_a_run_of_networks_goes_on_like_an_unbroken_one(tmp_path) -> None:
    world = planes(np.random.default_rng(0))
    scans = [seen_from(world, motion(0.5 * step, 0.0, 3.0 * step)) for step in range(20)]
    methods = make_methods(dpmjax.init_model(jax.random.key(0), toy.SLAM_MODEL), CONFIG)
    whole = Whole(methods, scans, *run(methods, scans))
    stops = stops_of(whole)
    assert len(stops) > 2
    # Scans since the last keyframe are in the local map, which the file does not hold.
    assert whole.states[-1].front_end.local_map is not None or stops[-1] == len(scans) - 1
    assert_goes_on_like_the_unbroken_one(whole, tmp_path / "state.npz", [stops[0], stops[len(stops) // 2], stops[-1]])


def test_a_state_between_keyframes_is_refused(as_user, short_run, tmp_path) -> None:
    between = next(scan for scan in range(30, 60) if not short_run.reports[scan].is_keyframe)
    with pytest.raises(ValueError, match="state: expected the state after a keyframe"):
        save_state(tmp_path / "state.npz", short_run.states[between], short_run.reports[: between + 1])
    with pytest.raises(ValueError, match="got an empty map"):
        save_state(tmp_path / "state.npz", init_slam(), [])
    assert not list(tmp_path.iterdir())


def test_a_map_is_no_state(as_user, short_run, tmp_path) -> None:
    path = save_map(tmp_path / "map.npz", short_run.states[-1].slam_map)
    with pytest.raises(InputError, match="no state of a run"):
        load_state(path)


@pytest.mark.parametrize("name", ["report.status", "report.T_keyframe_scan", "loops", "scores", "front_end.num_scans"])
def test_a_state_without_a_part_is_refused(as_user, short_run, tmp_path, name) -> None:
    path, stop = tmp_path / "state.npz", stops_of(short_run)[-1]
    save_state(path, short_run.states[stop], short_run.reports[: stop + 1])
    with np.load(path) as archive:
        arrays = {key: archive[key] for key in archive.files}
    del arrays[name]
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="damaged"):
        load_state(path)


def test_what_is_loaded_is_the_state_and_damaged_files_are_refused(short_run, tmp_path) -> None:
    path, stop = tmp_path / "state.npz", stops_of(short_run)[-1]
    save_state(path, short_run.states[stop], short_run.reports[: stop + 1])
    assert_same(tuple(load_state(path)), (short_run.states[stop], tuple(short_run.reports[: stop + 1])))
    assert_damage_is_refused(path, path.read_bytes(), load_state, 60)
