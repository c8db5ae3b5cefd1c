import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.deeppointmap import MatchConfig, merge_clouds
from dpmjax.deeppointmap.matching import best_pairs, thin_merged
from dpmjax.geometry import ConsensusConfig, rigid
from dpmjax.types import DescriptorCloud
from tests.deeppointmap import toy
from tests.tolerances import ACCUMULATED

T = np.asarray(rigid.exp(np.array([5.0, -3.0, 0.5, 0.02, -0.05, 1.2], np.float32)))
CONFIG = MatchConfig()


def no_offsets(source: jax.Array, target: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jnp.zeros((len(source), 3)), jnp.zeros((len(target), 3))


def match_clouds(source, target, similarity, offsets=no_offsets, masks=(None, None), config: MatchConfig = CONFIG):
    pair = (toy.cloud(points, mask) for points, mask in zip((source, target), masks, strict=True))
    return toy.best_match(*pair, jnp.asarray(similarity), offsets, config=config)


def clouds(seed: int, n: int = 80, num_outliers: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions in both frames, in different orders, and a similarity that knows which belong together."""
    rng = np.random.default_rng(seed)
    source = (20 * rng.normal(size=(n, 3))).astype(np.float32)
    order = rng.permutation(n)
    target = np.asarray(rigid.transform_points(T, source))[order]
    similarity = rng.uniform(-0.2, 0.2, size=(n, n)).astype(np.float32)
    similarity[order, np.arange(n)] = 0.95
    target[:num_outliers] = 20 * rng.normal(size=(num_outliers, 3))
    return source, target, similarity


def dual_softmax_in_numpy(similarity: np.ndarray, temperature: float) -> np.ndarray:
    powers = np.exp(similarity.astype(np.float64) / temperature)
    return powers / powers.sum(axis=0) * (powers / powers.sum(axis=1, keepdims=True))


@pytest.mark.parametrize("shape", [(30, 30), (20, 50)])
def test_best_pairs_have_the_highest_dual_softmax(shape: tuple[int, int]) -> None:
    similarity = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    best = best_pairs(similarity, jnp.ones(shape[0], bool), jnp.ones(shape[1], bool), config=CONFIG)
    scores = dual_softmax_in_numpy(similarity, 0.1)
    count = sum(shape) // 4
    assert best.mask.all()
    assert len(best.scores) == count
    np.testing.assert_allclose(best.scores, np.sort(scores.ravel())[::-1][:count], **ACCUMULATED)
    np.testing.assert_allclose(best.scores, scores[best.source_indices, best.target_indices], **ACCUMULATED)


def test_one_far_outlier_is_dropped_in_rounds() -> None:
    source, target, similarity = clouds(2)
    target[0] += np.float32(100)
    match = match_clouds(source, target, similarity, config=MatchConfig(pair_ratio=1.0))
    moved = np.asarray(rigid.transform_points(T, source[match.source_indices]))
    is_wrong = np.linalg.norm(moved - target[match.target_indices], axis=1) > 1
    assert is_wrong.sum() == 2
    assert not np.any(np.asarray(match.is_inlier)[is_wrong])
    np.testing.assert_allclose(match.T_target_source, T, atol=5e-4)


def test_offsets_of_both_directions_move_points_onto_each_other() -> None:
    # Eq. 1 and 2: each descriptor lies up to a metre from its partner, and the offsets tell exactly where.
    rng = np.random.default_rng(3)
    source, target, similarity = clouds(3)
    shift = rng.uniform(-1, 1, size=target.shape).astype(np.float32)
    target = target + shift
    source_in_target = np.asarray(rigid.transform_points(T, source))
    target_in_source = np.asarray(rigid.transform_points(np.linalg.inv(T), target))

    def true_offsets(i: jax.Array, j: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.asarray(target_in_source)[j] - source[i], jnp.asarray(source_in_target)[i] - target[j]

    with_offsets = match_clouds(source, target, similarity, true_offsets)
    without = match_clouds(source, target, similarity)
    np.testing.assert_allclose(with_offsets.T_target_source, T, atol=5e-4)
    assert with_offsets.rmse < 1e-3 < 0.1 < without.rmse


def test_pairs_with_long_offsets_are_dropped() -> None:
    source, target, similarity = clouds(4)

    def offsets(i: jax.Array, j: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.full((len(i), 3), 2.0), jnp.zeros((len(j), 3))

    match = match_clouds(source, target, similarity, offsets)
    assert 30 <= match.num_inliers <= 40
    assert not np.any(match.is_inlier[:40])
    np.testing.assert_allclose(match.T_target_source, T, atol=2e-4)


@pytest.mark.parametrize("num", [0, 1, 2, 3])
def test_a_motion_that_rests_on_fewer_than_three_points_has_an_infinite_error(num: int) -> None:
    source, target, similarity = clouds(1)
    partners = np.argmax(similarity[:num], axis=1)
    masks = np.arange(80) < num, np.isin(np.arange(80), partners)
    match = match_clouds(source, target, similarity, masks=masks, config=MatchConfig(pair_ratio=1.0))
    assert np.isinf(match.rmse) == (num < 3)
    assert match.num_inliers == 2 * num


@pytest.mark.parametrize(("num_source", "num_target"), [(0, 0), (0, 80), (1, 1), (3, 3)])
def test_too_few_descriptors_are_told_by_the_result(num_source: int, num_target: int) -> None:
    source, target, similarity = clouds(7)
    masks = np.arange(80) < num_source, np.arange(80) < num_target
    match = jax.device_get(match_clouds(source, target, similarity, masks=masks))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(match.replace(rmse=0.0)))
    assert match.num_inliers <= 2 * min(num_source, num_target)
    if num_source == 0:
        np.testing.assert_array_equal(match.T_target_source, np.eye(4))
        assert match.confidence == 0
        assert np.isinf(match.rmse)


def test_gradient_is_finite() -> None:
    source, target, similarity = clouds(8)

    @jax.jit
    @jax.grad
    def gradient(offset: jax.Array, mask: jax.Array) -> jax.Array:
        def offsets(i: jax.Array, j: jax.Array) -> tuple[jax.Array, jax.Array]:
            return jnp.tile(offset, (len(i), 1)), jnp.tile(offset, (len(j), 1))

        match = match_clouds(source, target, similarity, offsets, (mask, None))
        return jnp.sum(match.T_target_source**2) + jnp.where(jnp.isfinite(match.rmse), match.rmse, 0)

    for num_valid in (0, 1, 80):
        assert np.isfinite(gradient(jnp.full(3, 0.1), np.arange(80) < num_valid)).all()


def test_merging_turns_elements_and_leaves_those_with_features_in_front() -> None:
    rng = np.random.default_rng(0)
    positions, normals = rng.normal(size=(2, 2, 5, 3)).astype(np.float32)
    features = rng.normal(size=(2, 3, 4)).astype(np.float32)
    mask = np.array([[True] * 5, [True, False, True, True, False]])
    positions[~mask] = np.nan
    planarity = rng.random((2, 5)).astype(np.float32)
    clouds = DescriptorCloud(positions, features, mask, normals=normals, planarity=planarity)
    poses = np.stack([np.eye(4), np.asarray(T)])
    merged = merge_clouds(clouds, poses)
    described = [(cloud, row) for cloud in range(2) for row in range(3)]
    others = [(cloud, row) for cloud in range(2) for row in range(3, 5)]
    for place, (cloud, row) in enumerate([*described, *others]):
        turn, is_there = poses[cloud, :3, :3], mask[cloud, row]
        assert merged.mask[place] == is_there
        assert merged.planarity[place] == clouds.planarity[cloud, row]
        expected = turn @ positions[cloud, row] + poses[cloud, :3, 3] if is_there else np.zeros(3)
        np.testing.assert_allclose(merged.positions[place], expected, atol=1e-5)
        np.testing.assert_allclose(merged.normals[place], is_there * (turn @ normals[cloud, row]), atol=1e-5)
    np.testing.assert_array_equal(merged.features, features.reshape(6, 4))
    assert merged.directions.shape == (6, 2)
    bare = jax.vmap(lambda cloud: cloud.described)(clouds)
    # Sums of another order round differently.
    close = functools.partial(np.testing.assert_allclose, atol=1e-6)
    jax.tree.map(close, merge_clouds(bare, poses), merged.described)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_union_describes_no_place_twice(seed: int) -> None:
    """The oracle goes through the descriptors cloud by cloud and compares all distances."""
    rng, num = np.random.default_rng(seed), 30
    positions = rng.uniform(0, 20, (4, num, 3)).astype(np.float32)
    positions[1, :10] = positions[0, :10] + 0.01
    mask = rng.random((4, num)) > 0.2
    mask[3] = seed != 1
    merged = merge_clouds(DescriptorCloud(positions, rng.normal(size=(4, num, 5)), mask), np.tile(np.eye(4), (4, 1, 1)))
    thin = thin_merged(merged, num)
    first = positions[0][mask[0]].astype(np.float64)
    apart = np.linalg.norm(first[:, None] - first, axis=2) + np.diag(np.full(len(first), np.inf))
    spacing_m, kept, expected = np.median(apart.min(axis=1)), [], []
    for number in range(4):
        earlier = np.array(kept).reshape(-1, 3)
        for point, is_there in zip(positions[number], mask[number], strict=True):
            is_new = is_there and (number == 0 or np.linalg.norm(earlier - point, axis=1).min() > spacing_m)
            expected.append(is_new)
            kept += [point] if is_new else []
    np.testing.assert_array_equal(thin.mask, expected)
    assert mask[0].sum() < sum(expected) < mask.sum()
    for name in ("positions", "features", "directions"):
        np.testing.assert_array_equal(getattr(thin, name), getattr(merged, name))


@pytest.mark.parametrize("num_valid", [0, 1, 6])
def test_copies_of_a_cloud_are_left_out(num_valid: int) -> None:
    positions = np.random.default_rng(0).normal(0, 10, (1, 6, 3)).repeat(3, axis=0)
    mask = np.tile(np.arange(6) < num_valid, (3, 1))
    clouds = DescriptorCloud(positions.astype(np.float32), np.ones((3, 6, 2), np.float32), mask)
    thin = thin_merged(merge_clouds(clouds, np.tile(np.eye(4), (3, 1, 1))), 6)
    # A single descriptor has no spacing, and all of its copies stay.
    expected = mask if num_valid < 2 else mask & (np.arange(3) == 0)[:, None]
    np.testing.assert_array_equal(thin.mask, expected.ravel())


def test_wrong_arguments_are_named(as_user) -> None:
    with pytest.raises(ValueError, match="^T_map_cloud: expected shape"):
        merge_clouds(DescriptorCloud(jnp.ones((2, 3, 3)), jnp.ones((2, 3, 5)), jnp.ones((2, 3), bool)), np.eye(4))


@pytest.mark.slow
def test_consensus_finds_the_motion_where_scores_mislead() -> None:
    """A fifth of the pairs is right, and those are not the ones with the best scores."""
    rng = np.random.default_rng(3)
    source, target, _ = clouds(4, n=128)
    right = np.linalg.norm(np.asarray(rigid.transform_points(T, source))[:, None] - target, axis=2) < 1e-3
    similarity = rng.uniform(-0.2, 0.2, right.shape).astype(np.float32)
    wrong = rng.permutation(128)
    similarity[wrong, np.arange(128)] = 0.9
    similarity[np.where(right & (rng.random(128) < 0.4)[:, None])] = 0.92
    by_score = match_clouds(source, target, similarity, config=MatchConfig(pair_ratio=1.0))
    config = MatchConfig(pair_ratio=1.0, consensus=ConsensusConfig())
    by_consensus = match_clouds(source, target, similarity, config=config)
    np.testing.assert_allclose(by_consensus.T_target_source, T, atol=0.1)
    assert np.abs(by_score.T_target_source - T).max() > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.29, 0.35, 0.58, 0.7, 1.16])
def test_padding_changes_no_number_of_pairs(ratio: float) -> None:
    config = MatchConfig(pair_ratio=ratio)
    similarity = jax.random.uniform(jax.random.key(0), (60, 60))
    plain = best_pairs(similarity[:50, :50], jnp.ones(50, bool), jnp.ones(50, bool), config=config)
    padded = best_pairs(similarity, jnp.arange(60) < 50, jnp.arange(60) < 50, config=config)
    assert padded.mask.sum() == plain.mask.sum()
