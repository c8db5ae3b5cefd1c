"""Laws of the matcher of networks, on a network that compiles in seconds: its keyframes are those of odometry."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.deeppointmap.compact_scans import expand_elements
from dpmjax.deeppointmap.matching import MatchConfig
from dpmjax.deeppointmap.registration import match_clouds
from dpmjax.scan import Scan
from dpmjax.slam import NetworkMatcher, Submap, SurfaceGeometry
from dpmjax.slam.model_methods import union_of
from tests.deeppointmap import toy
from tests.slam.test_odometry import motion, planes, seen_from

POSES = [motion(1.5 * number, 0.1, 10.0 * number) for number in range(3)]


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    geometry, rng = SurfaceGeometry(toy.SLAM_MODEL), np.random.default_rng(0)
    return [geometry.thin(seen_from(planes(rng), T)) for T in POSES]


@pytest.fixture(scope="module")
def matcher() -> NetworkMatcher:
    return NetworkMatcher(dpmjax.init_model(jax.random.key(0), toy.SLAM_MODEL))


def test_a_keyframe_holds_the_elements_that_odometry_aligns(matcher, scans) -> None:
    for scan in scans:
        compact = matcher.encode(scan)
        elements, surface = expand_elements(compact.elements), scan.surface
        apart_m, rows = surface.tree.nearest(elements.positions[elements.mask], 1)[::-1]
        is_both = apart_m[:, 0] < compact.elements.unit_m
        assert is_both.mean() > 0.1
        # Where both are planes, they are the same plane.
        is_flat = is_both & (elements.planarity[elements.mask] > 0.5) & (surface.flatness[rows[:, 0]] > 0.5)
        cosines = (elements.normals[elements.mask] * surface.normals[rows[:, 0]]).sum(axis=1)[is_flat]
        assert np.quantile(np.abs(cosines), 0.1) > 0.95
        num, channels = toy.SLAM_MODEL.num_descriptors, toy.SLAM_MODEL.encoder.output_channels
        assert compact.features.shape == (num, channels)
        assert len(compact.elements.mask) == toy.SLAM_MODEL.pyramid.stages[0].num_points
        vector = matcher.vector(compact)
        assert vector.shape == matcher.vector(matcher.encode(scans[0])).shape
        assert np.isfinite(vector).all()


@pytest.mark.parametrize("num_motions", [1, 3])
def test_proposed_motions_are_rigid_and_few(matcher, scans, num_motions) -> None:
    source, target = map(matcher.encode, scans[:2])
    found = matcher.propose(source, target, num_motions)
    T = found.T_target_source
    assert 1 <= len(T) <= num_motions
    np.testing.assert_allclose(
        T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1), np.eye(3)[None].repeat(len(T), 0), atol=1e-5
    )
    assert 0 <= found.probability <= 1
    np.testing.assert_array_equal(T, matcher.propose(source, target, num_motions).T_target_source)


@pytest.mark.slow
def test_a_pair_has_a_match_and_a_target_an_overlap(matcher, scans, assert_compiles_nothing) -> None:
    first, *others = map(matcher.encode, scans)
    one = Submap((first,), np.eye(4)[None])
    three, two = (
        Submap(
            (others[0], first, others[1])[:num],
            np.linalg.inv(POSES[1]) @ np.array([POSES[1], POSES[0], POSES[2]][:num]),
        )
        for num in (3, 2)
    )
    matches = matcher.register([(one, three), (one, two)])
    assert len(matches) == 2
    for match in matches:
        assert 0 <= match.probability <= 1
        assert match.verification is not None
        np.testing.assert_allclose(match.information, match.information.T, rtol=1e-6)
        assert np.linalg.eigvalsh(match.information).min() > 0
    overlaps = matcher.overlaps(first, others)
    assert overlaps.shape == (2,)
    assert ((overlaps >= 0) & (overlaps <= 1)).all()
    # The number of scans is filled up: a submap of four needs no new program.
    four = Submap((*three.scans, first), np.concatenate([three.T_submap_keyframe, three.T_submap_keyframe[1:2]]))
    with assert_compiles_nothing():
        matcher.register([(one, four)])


@pytest.mark.slow
def test_submaps_are_matched_as_published_by_their_plain_unions(matcher, scans, assert_compiles_nothing) -> None:
    first, second, third = map(matcher.encode, scans)
    one, three = (Submap((first,), np.eye(4)[None]), Submap((second, first, third), np.linalg.inv(POSES[1]) @ POSES))
    found = matcher.match(one, three)
    model = dpmjax.init_model(jax.random.key(0), toy.SLAM_MODEL)
    clouds = one.scans[0].cloud.described, union_of(three)
    assert int(clouds[1].mask.sum()) == sum(int(scan.cloud.described.mask.sum()) for scan in three.scans)
    expected = match_clouds(model, *clouds, config=MatchConfig())
    np.testing.assert_allclose(found.T_target_source, expected.T_target_source[0], atol=1e-4)
    assert found.probability == pytest.approx(float(expected.mean_score[0]))
    assert found.rmse == pytest.approx(float(expected.rmse[0]))
    assert np.linalg.eigvalsh(found.information).min() > 0
    assert found.verification is None
    # The number of scans is filled up: a submap of four needs no new program.
    four = Submap((*three.scans, first), np.concatenate([three.T_submap_keyframe, three.T_submap_keyframe[1:2]]))
    with assert_compiles_nothing():
        matcher.match(one, four)
