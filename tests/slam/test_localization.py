"""Laws of re-localisation, with a matcher that knows the truth."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax import localize
from dpmjax.geometry import rigid
from dpmjax.slam import SlamConfig, SlamMethods, localize_each, run_slam
from dpmjax.slam.keyframes import KeyframeMap
from tests.slam.truth import EMPTY, TruthGeometry, TruthMatcher, laps, pose, scans_of

# The second half of the poses is beside the first, and the last ten are far away.
ROUND = laps(1, side_m=40.0, step_m=2.0)
OTHERS = np.array([T @ pose(0.7, 0.5, 0.3) for T in ROUND[::4]])
FAR = np.array([pose(500.0 + 9 * number, 0, 0) for number in range(10)])
TRUTH = np.concatenate([ROUND, OTHERS, FAR])
QUERIES = range(len(ROUND), len(ROUND) + len(OTHERS))
STRANGERS = range(len(ROUND) + len(OTHERS), len(TRUTH))


def methods(gross_share: float, seed: int = 0) -> SlamMethods:
    matcher = TruthMatcher(TRUTH, gross_share=gross_share, seed=seed)
    return SlamMethods(matcher, TruthGeometry(TRUTH), SlamConfig())


@pytest.fixture(scope="module")
def map_() -> KeyframeMap:
    return run_slam(scans_of(range(len(ROUND))), methods(0.0)).state.slam_map


@pytest.mark.parametrize(("gross_share", "least"), [(0.0, 1.0), (0.3, 0.9)])
def test_scans_are_found_where_they_are(map_, gross_share, least) -> None:
    found = list(localize_each(map_, scans_of(QUERIES), methods(gross_share)))
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
def test_scans_of_another_place_are_not_found(map_, seed) -> None:
    # Each registration is grossly wrong, with a probability as high as a right one.
    found = list(localize_each(map_, scans_of(STRANGERS), methods(1.0, seed)))
    assert [one.status for one in found] == ["not in this map"] * len(STRANGERS)
    assert all(one.reason and one.evidence for one in found)


def test_an_empty_scan_is_said_to_be_empty(map_) -> None:
    found = localize(map_, EMPTY, methods(0.0))
    assert (found.status, found.T_world_scan, found.evidence) == ("empty", None, ())


def test_wrong_input_is_refused(as_user, map_) -> None:
    with pytest.raises(ValueError, match="points: expected shape"):
        localize(map_, np.zeros((4, 2)), methods(0.0))
    with pytest.raises(ValueError, match="map_: expected keyframes, got an empty map"):
        localize(KeyframeMap(), EMPTY, methods(0.0))
    other = TruthMatcher(TRUTH, fingerprint="other")
    with pytest.raises(ValueError, match="map_: made with weights truth, these are other"):
        localize(map_, EMPTY, SlamMethods(other, TruthGeometry(TRUTH), SlamConfig()))
