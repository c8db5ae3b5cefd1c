"""The suite and the limits: what they run, and that a killed run goes on."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from experiments._resumable_rows import do_row, row_path

from experiments import deepmapping_limits, deepmapping_suite
from experiments._deepmapping_methods import make_problem


def test_suite_is_that_of_the_paper() -> None:
    entries = deepmapping_suite.list_trajectories()
    assert len(entries) == 75
    assert len({tuple(entry.values()) for entry in entries}) == 75
    assert Counter(entry["num_scans"] for entry in entries) == {128: 50, 256: 25}
    assert {entry["world"] for entry in entries[:6]} == {0, 1, 2}


def test_row_is_done_once(tmp_path) -> None:
    calls = []

    def work():
        calls.append(1)
        return {"ate_px": 1.5}

    case = {"method": "icp", "walk": 3, "noise_px": 0.5}
    assert do_row(tmp_path, case, work) == do_row(tmp_path, case, work) == {**case, "ate_px": 1.5}
    assert len(calls) == 1
    assert row_path(tmp_path, case) != row_path(tmp_path, {**case, "walk": 4})


def test_failed_row_leaves_no_file(tmp_path) -> None:
    def work():
        raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        do_row(tmp_path, {"method": "x"}, work)
    assert not list(tmp_path.rglob("*.json"))


def test_shuffled_problem_keeps_scans_with_their_truth() -> None:
    from dpmjax.simulation import simulate_sequence

    sequence = simulate_sequence(1, 6, num_beams=32, seed=0)
    problem = make_problem(sequence, is_ordered=False, steps=2, seed=0)
    order = [
        int(np.flatnonzero((sequence.reference_poses == pose).all(1))[0]) for pose in problem.sequence.reference_poses
    ]
    assert sorted(order) == list(range(6)) != order
    np.testing.assert_array_equal(problem.sequence.points, sequence.points[order])


def test_success_grid_leaves_open_what_was_not_run() -> None:
    config = deepmapping_limits.Config(strides=(8, 4), noises_px=(0.0, 1.0))
    row = {"method": "m", "order": "ordered", "stride": 8, "noise_px": 1.0}
    grid = deepmapping_limits.success_grid(
        [{**row, "success": True}, {**row, "success": False}], "m", "ordered", config
    )
    np.testing.assert_array_equal(grid, [[np.nan, np.nan], [np.nan, 0.5]])


@pytest.mark.parametrize(
    "options", [{"methods": ("nonsense",)}, {"methods": ()}, {"limit": 0}, {"steps": 1}, {"orders": ("sideways",)}]
)
def test_bad_options_are_named(options) -> None:
    with pytest.raises(ValueError, match="--"):
        deepmapping_limits.Config(**options)
