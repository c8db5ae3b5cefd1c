"""Laws of re-localisation, with a matcher that knows the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from dpmjax import localize
from dpmjax.geometry import rigid
from dpmjax.slam import SlamConfig, SlamMethods, localize_each, run_slam
from dpmjax.slam.interfaces import Match
from dpmjax.slam.keyframe_map import KeyframeMap, thin_map
from dpmjax.types import Verification
from tests.slam.truth import EMPTY, TruthGeometry, TruthMatcher, laps, number_of, pose, scans_of

# The second half of the poses is beside the first, and the last ten are far away.
ROUND = laps(1, side_m=40.0, step_m=2.0)
OTHERS = np.array([T @ pose(0.7, 0.5, 0.3) for T in ROUND[::4]])
FAR = np.array([pose(500.0 + 9 * number, 0, 0) for number in range(10)])
TRUTH = np.concatenate([ROUND, OTHERS, FAR])
QUERIES = range(len(ROUND), len(ROUND) + len(OTHERS))
STRANGERS = range(len(ROUND) + len(OTHERS), len(TRUTH))


def methods(gross_share: float, seed: int = 0) -> SlamMethods:
    matcher = TruthMatcher(TRUTH, gross_share=gross_share, seed=seed, least_probability=0.98)
    return SlamMethods(matcher, TruthGeometry(TRUTH), SlamConfig())


@pytest.fixture(scope="module")
def slam_map() -> KeyframeMap:
    return run_slam(methods(0.0), scans_of(range(len(ROUND)))).map


@pytest.mark.parametrize(("gross_share", "least"), [(0.0, 1.0), (0.3, 0.9)])
def test_scans_are_found_where_they_are(slam_map, gross_share, least) -> None:
    found = list(localize_each(methods(gross_share), slam_map, scans_of(QUERIES)))
    is_found = [one.is_in_map for one in found]
    assert np.mean(is_found) >= least
    for number, one in zip(QUERIES, found, strict=True):
        if one.is_in_map:
            true = rigid.inverse(TRUTH[0]) @ TRUTH[number]
            assert np.linalg.norm(one.T_world_scan[:3, 3] - true[:3, 3]) < 1.0
            assert 0 < one.probability <= 1
            assert one.keyframe is not None
        else:
            assert one.T_world_scan is None
            assert one.probability == 0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_scans_of_another_place_are_not_found(slam_map, seed) -> None:
    # Each registration is grossly wrong, with a probability as high as a right one.
    found = list(localize_each(methods(1.0, seed), slam_map, scans_of(STRANGERS)))
    assert [one.status for one in found] == ["not in this map"] * len(STRANGERS)
    assert all(one.reason and one.evidence for one in found)


@dataclass(frozen=True)
class SeeingMatcher(TruthMatcher):
    """The share of points that meet planes falls with the distance of the two scans."""

    probability: float = 0.99
    nearest_share: float = 0.6
    share_per_m: float = 0.03

    def _match(self, source: int, target: int) -> Match:
        apart_m = np.linalg.norm(self.T_world_scan[source][:3, 3] - self.T_world_scan[target][:3, 3])
        matched = max(self.nearest_share - self.share_per_m * float(apart_m), 0.0)
        found = super()._match(source, target)
        return found._replace(probability=self.probability, verification=Verification(1.0, matched, 0.0, matched))


@pytest.mark.parametrize(
    ("nearest_share", "probability", "is_found"), [(0.6, 0.99, True), (0.3, 0.99, False), (0.6, 0.97, False)]
)
def test_a_clear_registration_whose_scans_agree_is_supported_by_those_farther_off(
    slam_map, nearest_share, probability, is_found
) -> None:
    thin = thin_map(slam_map, spacing_share=0.8)
    matcher = SeeingMatcher(TRUTH, gross_share=0.0, nearest_share=nearest_share, probability=probability)
    found = list(localize_each(SlamMethods(matcher, TruthGeometry(TRUTH), SlamConfig()), thin, scans_of(QUERIES)))
    assert [one.is_in_map for one in found] == [is_found] * len(QUERIES)
    assert any(not evidence.do_scans_agree for one in found for evidence in one.evidence)


def test_no_keyframe_is_registered_twice(slam_map) -> None:
    matcher = SeeingMatcher(TRUTH, gross_share=0.5, nearest_share=0.4)
    for one in localize_each(SlamMethods(matcher, TruthGeometry(TRUTH), SlamConfig()), slam_map, scans_of(QUERIES)):
        rows = [evidence.keyframe for evidence in one.evidence]
        assert len(set(rows)) == len(rows)


@dataclass(frozen=True)
class OneSureMatcher(TruthMatcher):
    """One keyframe is matched surely and wrongly, beside the street; all others are not matched."""

    side_m: float = 0.0

    def _match(self, source: int, target: int) -> Match:
        found, is_sure = super()._match(source, target), target == 30
        shares = Verification(1.0, 0.6, 0.0, 2.0) if is_sure else Verification(1.0, 0.1, 0.3, -5.0)
        T = pose(0.0, self.side_m if is_sure else 0.0, 0.0)
        return found._replace(T_target_source=T, probability=0.99 if is_sure else 0.01, verification=shares)


STREET = np.array([pose(2.0 * step, 0, 0) for step in range(60)])


@pytest.mark.parametrize("side_m", [1.0, 9.0, 12.0, 19.0])
def test_one_registration_is_not_enough_where_other_keyframes_are_near(side_m: float) -> None:
    truth = np.concatenate([STREET, [pose(60.0, 0, 0)]])
    geometry = TruthGeometry(truth)
    street = run_slam(SlamMethods(TruthMatcher(truth, gross_share=0.0), geometry, SlamConfig()), scans_of(range(60)))
    matcher = OneSureMatcher(truth, gross_share=0.0, side_m=side_m)
    (scan,) = scans_of([60])
    assert not localize(SlamMethods(matcher, geometry, SlamConfig()), street.map, scan).is_in_map


def test_a_scan_of_a_part_that_no_loop_joins_is_placed_in_that_part() -> None:
    """The second street is driven somewhere else, from an unknown pose."""
    far = np.array([pose(0, 1000.0, 0) @ T for T in STREET])
    truth = np.concatenate([STREET, far, [pose(60.3, 0.2, 0), pose(60.3, 1000.2, 0)]])
    both = SlamMethods(TruthMatcher(truth, gross_share=0.0, least_probability=0.98), TruthGeometry(truth), SlamConfig())
    slam_map = run_slam(both, scans_of(range(60))).map
    slam_map = run_slam(both, scans_of(range(60, 120)), slam_map=slam_map).map
    near, away = localize_each(both, slam_map, scans_of([120, 121]))
    assert (near.part, away.part) == (0, 1)
    for number, found in ((120, near), (121, away)):
        keyframe = number_of(slam_map.keyframes[found.keyframe].compact)
        T = rigid.inverse(slam_map.T_world_keyframe[found.keyframe]) @ found.T_world_scan
        np.testing.assert_allclose(T, rigid.inverse(truth[keyframe]) @ truth[number], atol=0.5)


def test_an_empty_scan_is_said_to_be_empty(slam_map) -> None:
    found = localize(methods(0.0), slam_map, EMPTY)
    assert (found.status, found.T_world_scan, found.evidence) == ("empty", None, ())


def test_wrong_input_is_refused(as_user, slam_map) -> None:
    with pytest.raises(ValueError, match="scan: expected shape"):
        localize(methods(0.0), slam_map, np.zeros((4, 2)))
    with pytest.raises(ValueError, match="slam_map: expected keyframes, got an empty map"):
        localize(methods(0.0), KeyframeMap(), EMPTY)
    other = TruthMatcher(TRUTH, fingerprint="other")
    with pytest.raises(ValueError, match="slam_map: made with weights truth, these are other"):
        localize(SlamMethods(other, TruthGeometry(TRUTH), SlamConfig()), slam_map, EMPTY)
