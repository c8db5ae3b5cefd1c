"""Laws of thinned maps, with a matcher that knows the truth."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.geometry import rigid
from dpmjax.slam import SlamConfig, SlamMethods, run_slam
from dpmjax.slam.keyframe_map import KeyframeMap, connected_parts, thin_map
from dpmjax.slam.loops import loops_of_map
from tests.slam.truth import TruthGeometry, TruthMatcher, laps, scans_of

TRUTH = laps(2, side_m=40.0, step_m=2.0)


@pytest.fixture(scope="module")
def whole() -> KeyframeMap:
    methods = SlamMethods(TruthMatcher(TRUTH, gross_share=0.0), TruthGeometry(TRUTH), SlamConfig())
    return run_slam(methods, scans_of(range(len(TRUTH)))).map


@pytest.mark.parametrize("spacing_share", [0.001, 0.8, 1.5])
def test_keyframes_that_are_left_cover_the_others(whole, spacing_share) -> None:
    thin = thin_map(whole, spacing_share=spacing_share)
    spacing_m = 10.0 * spacing_share
    positions, left = whole.T_world_keyframe[:, :3, 3], thin.T_world_keyframe[:, :3, 3]
    apart = np.linalg.norm(positions[:, None] - left, axis=2)
    assert (apart.min(axis=1) < spacing_m).all()
    between = np.linalg.norm(left[:, None] - left, axis=2) + 1e9 * np.eye(len(left))
    assert between.min() >= spacing_m
    assert thin.origin == whole.origin
    assert thin.vectors.shape == (len(thin), whole.vectors.shape[1])
    assert len(thin) == len(whole) if spacing_share == 0.001 else len(thin) < len(whole) / 2


def test_edges_join_what_they_joined(whole, as_user) -> None:
    thin = thin_map(whole)
    assert connected_parts(len(thin), thin.edges).max() == 0
    rows = [keyframe.scan for keyframe in thin.keyframes]
    for edge in thin.edges:
        true = rigid.inverse(TRUTH[rows[edge.target]]) @ TRUTH[rows[edge.source]]
        assert np.linalg.norm((rigid.inverse(true) @ edge.T_target_source)[:3, 3]) < 1.0
        np.testing.assert_allclose(edge.information, edge.information.T, rtol=1e-9)
        assert np.linalg.eigvalsh(edge.information).min() > 0
    assert len(thin_map(KeyframeMap())) == 0
    with pytest.raises(ValueError, match="spacing_share: expected"):
        thin_map(whole, spacing_share=0.0)


def test_loops_of_a_thinned_map_are_in_the_order_of_their_sources(whole) -> None:
    for spacing_share in (0.2, 0.8, 1.5):
        sources = [loop.source for loop in loops_of_map(thin_map(whole, spacing_share=spacing_share)).loops]
        assert len(sources) > 1
        assert sources == sorted(sources)
