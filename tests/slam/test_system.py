"""Laws of the whole system, with a matcher and a geometry that know the truth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import pytest

from dpmjax import encode
from dpmjax.geometry import rigid
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.scan import Scan
from dpmjax.slam import (
    Alignment,
    LocalMap,
    Proposal,
    SlamConfig,
    SlamMethods,
    SlamResult,
    finish_slam,
    init_slam,
    localize,
    merge_maps,
    run_slam,
    slam_preset,
    step_slam,
)
from tests.slam.truth import (
    EMPTY,
    MistakenMatcher,
    TruthGeometry,
    TruthMatcher,
    laps,
    number_of,
    number_of_scan,
    pose,
    scans_of,
)

CONFIG = SlamConfig()


def run(T_world_scan: np.ndarray, numbers=None, *, geometry=None, matcher=None, config=CONFIG) -> SlamResult:
    scans = scans_of(range(len(T_world_scan)) if numbers is None else numbers)
    methods = SlamMethods(matcher or TruthMatcher(T_world_scan), geometry or TruthGeometry(T_world_scan), config)
    return run_slam(methods, scans)


def without_loops() -> SlamConfig:
    return replace(CONFIG, loops=replace(CONFIG.loops, is_on=False))


def errors_of_loops(result: SlamResult, T_world_scan: np.ndarray) -> np.ndarray:
    accepted = [loop for loop in result.loops if loop.status == "accepted"]
    found = np.array([loop.T_target_source for loop in accepted]).reshape(-1, 4, 4)
    source, target = (T_world_scan[result.keyframes[[loop[end] for loop in accepted]]] for end in (0, 1))
    true = rigid.inverse(target) @ source
    return np.linalg.norm((rigid.inverse(true) @ found)[:, :3, 3], axis=1)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_streets_that_are_driven_back_are_recognised(seed) -> None:
    there = laps(1, side_m=80.0, step_m=2.0)
    truth = np.concatenate([there, there[::-1] @ pose(0.0, 3.0, np.pi)])
    geometry = TruthGeometry(truth, sigma_m=0.03, sigma_rad=0.004, seed=seed)
    closed = run(truth, geometry=geometry, matcher=MistakenMatcher(truth, seed=seed))
    errors = errors_of_loops(closed, truth)
    assert len(errors) >= 20
    assert errors.max() < 1.0
    # Each keyframe of the way back has an accepted loop nearby.
    found = closed.keyframes[[loop.source for loop in closed.loops if loop.status == "accepted"]]
    back = closed.keyframes[closed.keyframes > len(there) + 25]
    is_found = np.abs(back[:, None] - found).min(axis=1) <= 5
    assert is_found.mean() > 0.8
    assert absolute_trajectory_error(closed.T_world_scan[:, :3, 3], truth[:, :3, 3]) < 1.0


def test_exact_parts_give_the_exact_trajectory() -> None:
    truth = laps(1, side_m=20.0)
    exact = TruthMatcher(truth, gross_share=0.0, sigma_m=0.0, sigma_rad=0.0)
    result = run(truth, geometry=TruthGeometry(truth, sigma_m=0.0, sigma_rad=0.0), matcher=exact)
    np.testing.assert_allclose(result.T_world_scan, rigid.inverse(truth[0]) @ truth, atol=1e-6)
    assert result.reports[0].status == "first"
    assert {report.status for report in result.reports[1:]} == {"tracked"}


@pytest.mark.parametrize("proposer", ["prediction", "network"])
def test_scans_prepared_ahead_make_the_same_map(proposer) -> None:
    config = replace(CONFIG, odometry=replace(CONFIG.odometry, proposer=proposer))
    truth = laps(1, side_m=20.0)
    methods = SlamMethods(TruthMatcher(truth), TruthGeometry(truth), config)
    scans = [*scans_of(range(30)), EMPTY, *scans_of(range(30, len(truth)))]
    state, reports = init_slam(), []
    for scan in scans:
        state, report = step_slam(methods, state, scan)
        reports.append(report)
    result, expected = run_slam(methods, scans), finish_slam(state, reports, config)
    np.testing.assert_array_equal(result.T_world_scan, expected.T_world_scan)
    assert [report.num_points for report in result.reports] == [len(scan) for scan in scans]
    assert repr(result.reports) == repr(expected.reports)


def test_every_scan_gets_a_pose_and_empty_ones_are_flagged() -> None:
    truth = laps(1, side_m=20.0)
    scans = scans_of(range(len(truth)))
    for number in (0, 10, 11, 40):
        scans[number] = EMPTY
    methods = SlamMethods(TruthMatcher(truth), TruthGeometry(truth), CONFIG)
    result = run_slam(methods, scans)
    assert result.T_world_scan.shape == (len(truth), 4, 4)
    assert [report.scan for report in result.reports if report.status == "empty"] == [0, 10, 11, 40]
    assert absolute_trajectory_error(result.T_world_scan[2:, :3, 3], truth[2:, :3, 3]) < 0.5


def test_only_empty_scans_stay_at_the_origin() -> None:
    methods = SlamMethods(TruthMatcher(np.eye(4)[None]), TruthGeometry(np.eye(4)[None]), CONFIG)
    result = run_slam(methods, [EMPTY, EMPTY])
    np.testing.assert_array_equal(result.T_world_scan, np.tile(np.eye(4), (2, 1, 1)))
    assert result.graph is None
    assert run_slam(methods, []).T_world_scan.shape == (0, 4, 4)


def test_standing_still_makes_one_keyframe() -> None:
    truth = np.tile(pose(3.0, 4.0, 1.0), (50, 1, 1))
    result = run(truth, geometry=TruthGeometry(truth, sigma_m=0.003, sigma_rad=1e-4))
    assert len(result.keyframes) == 1
    assert np.abs(result.T_world_scan[:, :3, 3]).max() < 0.5


def test_a_kidnapped_robot_is_found_again() -> None:
    truth = laps(1, side_m=60.0)
    # Half way round, then it is put back to a place that it knows, and drives on from there.
    numbers = [*range(120), *range(20, 70)]
    result = run(truth, numbers)
    assert "restarted" in {report.status for report in result.reports}
    expected = (rigid.inverse(truth[0]) @ truth[numbers])[:, :3, 3]
    apart = np.linalg.norm(result.T_world_scan[:, :3, 3] - expected, axis=1)
    assert np.median(apart[125:]) < 1.0
    assert apart[:120].max() < 1.0
    # Until it restarts, a lost scan has only the predicted motion; it says so.
    assert all(result.reports[row].status == "predicted" for row in np.flatnonzero(apart > 2.0))


@dataclass(frozen=True)
class DoorwayGeometry(TruthGeometry):
    """Scans behind a door meet the planes of other scans behind it, and no others."""

    door: int = 0

    def search(self, local_map: LocalMap, scan: Scan, T_map_scan: np.ndarray) -> Alignment:
        number, last = number_of_scan(scan), round(float(local_map.keyframes[0].positions[0, 0]))
        T_map_before = rigid.inverse(self.T_world_scan[last]) @ self.T_world_scan[number - 1]
        element = T_map_before[:3, :3] @ [number - 1, 0, 0] + T_map_before[:3, 3]
        apart_m = np.linalg.norm(local_map.surface.points - element, axis=1).min()
        found = super().search(local_map, scan, T_map_scan)
        if number < self.door or last >= self.door or (number > self.door and apart_m < 1.0):
            return found
        return Alignment(T_map_scan[0], 0.0, 0.0, 0.0, found.information)


def test_lost_scans_that_see_the_same_room_keep_their_relative_poses() -> None:
    # A robot drives straight through a door, and turns behind it, which no motion of before predicts.
    headings = 0.12 * np.clip(np.arange(50) - 30, 0, None)
    positions = np.cumsum(np.column_stack([np.cos(headings), np.sin(headings)]), axis=0)
    truth = np.array([pose(*position, heading) for position, heading in zip(positions, headings, strict=True)])
    result = run(truth, geometry=DoorwayGeometry(truth, door=30), matcher=TruthMatcher(truth, gross_share=1.0))
    assert [report.status for report in result.reports[30:37]] == [*["predicted"] * 5, "restarted", "tracked"]
    expected = (rigid.inverse(truth[0]) @ truth)[:, :3, 3]
    assert np.linalg.norm(result.T_world_scan[:, :3, 3] - expected, axis=1).max() < 0.5


@dataclass(frozen=True)
class CorridorGeometry(TruthGeometry):
    """In a corridor without an end, alignments are 0.3 m off along its axis, and know it."""

    corridor: range = range(0)

    def thin(self, points: np.ndarray) -> Scan | None:
        scan = super().thin(points)
        assert scan is not None
        is_in_corridor = number_of_scan(scan) in self.corridor
        return scan._replace(weak_axis=np.array([1.0, 0.0, 0.0])) if is_in_corridor else scan

    def search(self, local_map: LocalMap, scan: Scan, T_map_scan: np.ndarray) -> Alignment:
        found = super().search(local_map, scan, T_map_scan)
        if scan.weak_axis is None:
            return found
        information = found.information.copy()
        information[0, 0] = 0.01
        return found._replace(T_map_scan=found.T_map_scan @ pose(0.3, 0, 0), information=information)


def test_behind_a_corridor_the_speed_is_the_mean_since_the_way_was_known() -> None:
    # Twice as fast in the corridor, which ends before the next keyframe.
    x = np.concatenate([0.1 * np.arange(20), 1.9 + 0.2 * np.arange(1, 10)])
    truth = np.array([pose(place, 0.0, 0.0) for place in x])
    result = run(truth, geometry=CorridorGeometry(truth, sigma_m=1e-4, sigma_rad=1e-5, corridor=range(20, 28)))
    np.testing.assert_allclose(result.T_world_scan[-1][:3, 3], truth[-1][:3, 3], atol=0.01)
    np.testing.assert_allclose(result.state.front_end.T_before_last[:3, 3], [0.2, 0, 0], atol=0.01)


def test_in_a_corridor_without_an_end_the_last_speed_goes_on() -> None:
    truth = np.array([pose(float(x), 0.0, 0.0) for x in range(60)])
    corridor = range(20, 40)
    result = run(truth, geometry=CorridorGeometry(truth, sigma_m=1e-4, sigma_rad=1e-5, corridor=corridor))
    np.testing.assert_allclose(result.T_world_scan[:, :3, 3], truth[:, :3, 3], atol=0.1)
    assert [report.scan for report in result.reports if report.status == "coasting"] == list(corridor)
    assert all((report.weak_sigma_m is None) == (report.scan not in corridor) for report in result.reports)
    # A loop may stretch such edges.
    sigmas_m = [np.linalg.inv(edge.information)[0, 0] ** 0.5 for edge in result.map.edges]
    assert max(sigmas_m) == pytest.approx(10, rel=0.01)


def test_in_a_corridor_odometry_knows_the_way() -> None:
    # The robot slows down to a quarter, which the last motion does not know.
    steps = np.full(60, 1.0)
    steps[20:40] = 0.25
    truth = np.array([pose(x, 0.0, 0.0) for x in np.cumsum(steps)])
    geometry = CorridorGeometry(truth, sigma_m=1e-4, sigma_rad=1e-5, corridor=range(20, 40))
    methods = SlamMethods(TruthMatcher(truth), geometry, without_loops())
    ways_m = [
        run_slam(methods, scans_of(range(60)), odometry=odometry).T_world_scan[39, 0, 3]
        for odometry in (pose(5.0, 3.0, 1.0) @ truth, None)
    ]
    np.testing.assert_allclose(ways_m, [24.0, 39.0], atol=0.5)


def by_network(**changes) -> SlamConfig:
    return replace(CONFIG, odometry=replace(CONFIG.odometry, proposer="network", **changes))


def test_the_network_places_every_scan_where_it_is_the_proposer() -> None:
    truth = laps(1, side_m=20.0)
    exact = TruthMatcher(truth, gross_share=0.0)
    result = run(truth, matcher=exact, config=by_network())
    assert {report.status for report in result.reports[1:]} == {"network"}
    assert all(report.probability is not None for report in result.reports[1:])
    assert absolute_trajectory_error(result.T_world_scan[:, :3, 3], truth[:, :3, 3]) < 0.5
    # Where the network is grossly wrong, the prediction takes its place.
    result = run(truth, matcher=TruthMatcher(truth, gross_share=0.3), config=by_network())
    assert {report.status for report in result.reports[1:]} == {"network", "tracked"}
    assert absolute_trajectory_error(result.T_world_scan[:, :3, 3], truth[:, :3, 3]) < 0.5


def test_the_second_scan_of_a_drive_is_placed_by_the_network() -> None:
    # No motion is known yet, and the identity is farther off than geometry can do.
    truth = np.array([pose(8.0 * number, 0.0, 0.0) for number in range(12)])
    result = run(truth, matcher=TruthMatcher(truth, gross_share=0.0))
    assert [report.status for report in result.reports] == ["first", "network", *["tracked"] * 10]
    assert absolute_trajectory_error(result.T_world_scan[:, :3, 3], truth[:, :3, 3]) < 0.5


class CountingMatcher(TruthMatcher):
    """Notes the scans that it encodes and those that it proposes motions for."""

    encoded: ClassVar[list[int]] = []
    proposed: ClassVar[list[int]] = []

    def encode(self, scan):
        compact = super().encode(scan)
        self.encoded.append(number_of(compact))
        return compact

    def propose(self, source, target, num_motions):
        self.proposed.append(number_of(source))
        return super().propose(source, target, num_motions)


def test_networks_run_for_the_first_scans_and_keyframes_alone_where_the_prediction_is_right() -> None:
    truth = np.array([pose(float(number), 0.0, 0.0) for number in range(40)])
    result = run(truth, matcher=CountingMatcher(truth, gross_share=0.0), config=without_loops())
    assert CountingMatcher.proposed == [*range(1, 11)]
    assert CountingMatcher.encoded == sorted({*range(1, 11), *result.keyframes.tolist()})


class SparseGeometry(TruthGeometry):
    """Scans of so few points that a right pose never scores high."""

    def search(self, local_map, scan, T_map_scan):
        return super().search(local_map, scan, T_map_scan)._replace(score=0.4)


def test_sparse_scans_are_tracked_from_the_first_one_on() -> None:
    truth = laps(1, side_m=20.0)
    result = run(truth, geometry=SparseGeometry(truth))
    assert {report.status for report in result.reports[1:]} == {"tracked"}


class UnsureMatcher(TruthMatcher):
    """Proposals are right, but the network does not know."""

    def propose(self, source, target, num_motions):
        return super().propose(source, target, num_motions)._replace(probability=0.1)


def test_a_fast_drive_of_sparse_scans_starts_though_the_network_is_unsure() -> None:
    # Steps of 3 m: no score is usual yet, and the motion of before is not known.
    truth = laps(1, side_m=60.0, step_m=3.0)[:12]
    matcher = UnsureMatcher(truth, gross_share=0.0)
    result = run(truth, matcher=matcher, geometry=SparseGeometry(truth))
    assert "predicted" not in {report.status for report in result.reports}


@dataclass(frozen=True)
class LookAlikeMatcher(TruthMatcher):
    """Proposes a pose that only looks like the place, and knows that it may be wrong."""

    T_true_found: np.ndarray = field(default_factory=lambda: np.eye(4))
    probability: float = 0.3
    is_calibrated: bool = True

    def propose(self, source, target, num_motions):
        T = rigid.inverse(self.T_world_scan[number_of(target)]) @ self.T_world_scan[number_of(source)]
        # The second scan has nothing but the decoder.
        T = T if number_of(source) == 1 else T @ self.T_true_found
        return Proposal(T[None], self.probability, self.is_calibrated)


@dataclass(frozen=True)
class LookAlikeGeometry(TruthGeometry):
    """A scan fits everywhere, and best at the pose that looks alike; from one scan on, it does not fit at the truth."""

    first_low: int = 99
    alike_score: float = 0.8

    def search(self, local_map, scan, T_map_scan):
        found = super().search(local_map, scan, T_map_scan)
        off = rigid.inverse(found.T_map_scan) @ T_map_scan[0]
        is_other = bool(np.linalg.norm(off[:3, 3]) > 2.0 or off[0, 0] < 0.0)
        score = 0.6 if number_of_scan(scan) < self.first_low else 0.1
        return (
            found._replace(T_map_scan=T_map_scan[0], score=self.alike_score)
            if is_other
            else found._replace(score=score)
        )


TURNED, ELSEWHERE = pose(0.0, 0.0, np.pi), pose(3.0, 2.0, 0.0)


@pytest.mark.parametrize(
    ("T_true_found", "probability", "score", "first_low", "is_moved"),
    [
        pytest.param(TURNED, 0.9, 0.65, 99, False, id="no lead"),
        pytest.param(TURNED, 0.3, 0.8, 99, True, id="turned on the spot"),
        pytest.param(ELSEWHERE, 0.3, 0.8, 99, False, id="unsure"),
        pytest.param(ELSEWHERE, 0.9, 0.8, 99, True, id="sure"),
        pytest.param(ELSEWHERE, 0.3, 0.8, 5, True, id="the prediction fails"),
    ],
)
def test_a_scan_that_is_tracked_moves_to_another_place_by_a_lead_in_score(
    T_true_found, probability, score, first_low, is_moved
) -> None:
    truth = np.array([pose(0.5 * number, 0.0, 0.0) for number in range(8)])
    matcher = LookAlikeMatcher(truth, T_true_found=T_true_found, probability=probability)
    geometry = LookAlikeGeometry(truth, first_low=first_low, alike_score=score)
    result = run(truth, matcher=matcher, geometry=geometry, config=without_loops())
    off = np.linalg.norm(result.T_world_scan - truth, axis=(1, 2)).max()
    assert (off > 1.5) == is_moved


class ReliefGeometry(TruthGeometry):
    """A corridor that looks alike 1.2 m ahead, with a score that is higher by chance."""

    def thin(self, points: np.ndarray) -> Scan | None:
        scan = super().thin(points)
        return scan and scan._replace(weak_axis=np.array([1.0, 0.0, 0.0]))

    def search(self, local_map, scan, T_map_scan):
        found = super().search(local_map, scan, T_map_scan)
        is_other = np.linalg.norm((found.T_map_scan - T_map_scan[0])[:3, 3]) > 0.6
        return found._replace(T_map_scan=T_map_scan[0], score=0.61) if is_other else found._replace(score=0.6)


def test_the_network_moves_no_scan_along_a_corridor_where_both_places_fit() -> None:
    truth = np.array([pose(0.5 * number, 0.0, 0.0) for number in range(8)])
    matcher = LookAlikeMatcher(truth, T_true_found=pose(1.2, 0.0, 0.0), probability=0.9)
    result = run(truth, matcher=matcher, geometry=ReliefGeometry(truth), config=without_loops())
    np.testing.assert_allclose(result.T_world_scan, truth, atol=0.2)


class StuckGeometry(LookAlikeGeometry):
    """From one scan on, the alignment from the prediction ends at a low score, and a search finds the truth."""

    def align(self, local_map, scan, T_map_scan):
        found = super().align(local_map, scan, T_map_scan)
        return found if number_of_scan(scan) < 5 else found._replace(score=0.1)


def test_a_pose_elsewhere_competes_with_those_of_other_motions() -> None:
    truth = np.array([pose(0.5 * number, 0.0, 0.0) for number in range(8)])
    matcher = LookAlikeMatcher(truth, T_true_found=ELSEWHERE, probability=0.9)
    geometry = StuckGeometry(truth, alike_score=0.55)
    result = run(truth, matcher=matcher, geometry=geometry, config=without_loops())
    np.testing.assert_allclose(result.T_world_scan, truth, atol=0.2)


class HollowGeometry(TruthGeometry):
    """Scans of so few walls that a right pose meets no plane."""

    def search(self, local_map, scan, T_map_scan):
        return super().search(local_map, scan, T_map_scan)._replace(score=-0.1)


@pytest.mark.parametrize(
    ("probability", "is_calibrated", "turn_rad", "is_placed"),
    [
        (0.95, True, 0.0, True),
        (0.85, True, 0.0, False),
        (0.95, False, 0.0, False),
        (0.95, True, 0.05, True),
        (0.95, True, 0.2, False),
    ],
)
def test_only_a_sure_decoder_places_scans_that_meet_no_plane(probability, is_calibrated, turn_rad, is_placed) -> None:
    truth = laps(1, side_m=20.0)
    matcher = LookAlikeMatcher(
        truth, T_true_found=pose(0.0, 0.0, turn_rad), probability=probability, is_calibrated=is_calibrated
    )
    result = run(truth, range(30), matcher=matcher, geometry=HollowGeometry(truth), config=without_loops())
    assert ("predicted" not in {report.status for report in result.reports}) == is_placed


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda methods, _: step_slam(methods, init_slam(), np.zeros((5, 4))), "scan: expected shape"),
        (lambda methods, _: run_slam(methods, [], CONFIG), "config: expected None"),
        (
            lambda methods, other: run_slam(other, scans_of([0]), slam_map=run_slam(methods, scans_of([0])).map),
            "slam_map: made with weights truth, these are other",
        ),
        (lambda methods, _: run_slam("dpm_small", []), "model: expected one from load_model, got str"),
        (lambda methods, _: encode("dpm_small", EMPTY), "model: expected one from load_model, got str"),
        (lambda methods, _: run_slam(methods, [], slam_map="map.npz"), "map.npz: no such file; check the path."),
        (lambda methods, _: localize(methods, "map.npz", EMPTY), "map.npz: no such file; check the path."),
        (lambda methods, _: merge_maps(methods, "a.npz", "b.npz"), "a.npz: no such file; check the path."),
        (lambda *_: slam_preset("fast"), "name: expected one of"),
    ],
)
def test_bad_input_is_named(as_user, call, message) -> None:
    truth = np.eye(4)[None]
    methods, other = (
        SlamMethods(TruthMatcher(truth, fingerprint=name), TruthGeometry(truth), CONFIG) for name in ("truth", "other")
    )
    with pytest.raises(ValueError, match=message):
        call(methods, other)
