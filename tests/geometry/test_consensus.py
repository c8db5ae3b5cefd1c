import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.geometry import ConsensusConfig, find_consensus, rigid
from dpmjax.geometry.consensus import DISTINCT_M


def pairs_with_outliers(seed: int, num_right: int, num_wrong: int, noise_m: float = 0.2) -> tuple[np.ndarray, ...]:
    """Source, target, the true motion, and who is right; positions as of descriptors in a street."""
    rng = np.random.default_rng(seed)
    extent = np.array([30.0, 30.0, 3.0])
    source = rng.uniform(-extent, extent, (num_right + num_wrong, 3))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", rng.uniform(-180, 180), degrees=True).as_matrix()
    T[:3, 3] = rng.uniform(-8, 8, 3)
    target = source @ T[:3, :3].T + T[:3, 3] + noise_m * rng.normal(size=source.shape)
    target[num_right:] = rng.uniform(-extent, extent, (num_wrong, 3))
    order = rng.permutation(len(source))
    return source[order].astype(np.float32), target[order].astype(np.float32), T, order < num_right


def errors(T: jax.Array, T_true: np.ndarray) -> tuple[float, float]:
    difference = np.asarray(T, np.float64) @ np.linalg.inv(T_true)
    angle = np.degrees(np.linalg.norm(Rotation.from_matrix(difference[:3, :3]).as_rotvec()))
    return float(np.linalg.norm(np.asarray(T)[:3, 3] - T_true[:3, 3])), float(angle)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("num_right", "num_wrong"), [(12, 0), (12, 116), (40, 88)])
def test_motion_is_found_among_wrong_pairs(seed: int, num_right: int, num_wrong: int) -> None:
    source, target, T, is_right = pairs_with_outliers(seed, num_right, num_wrong)
    found = find_consensus(source, target)
    metres, degrees = errors(found.T_target_source[0], T)
    assert metres < 0.5
    assert degrees < 1.0
    assert np.asarray(found.is_inlier)[0][is_right].all()
    assert not num_wrong or found.is_inlier[0][~is_right].mean() < 0.1


def test_without_a_right_pair_support_is_that_of_chance() -> None:
    chance = [float(find_consensus(*pairs_with_outliers(seed, 0, 128)[:2]).support[0]) for seed in range(4)]
    right = [float(find_consensus(*pairs_with_outliers(seed, 20, 108)[:2]).support[0]) for seed in range(4)]
    assert max(chance) < min(right)


def test_moving_both_frames_moves_the_motion() -> None:
    source, target, _, _ = pairs_with_outliers(2, 20, 40)
    motions = [np.eye(4, dtype=np.float32) for _ in range(2)]
    for T, angle in zip(motions, (70.0, -25.0), strict=True):
        T[:3, :3] = Rotation.from_euler("xyz", [3, -2, angle], degrees=True).as_matrix()
        T[:3, 3] = (4, -7, 1)
    plain = np.asarray(find_consensus(source, target).T_target_source[0])
    sides = (rigid.transform_points(T, side) for T, side in zip(motions, (source, target), strict=True))
    moved = find_consensus(*sides).T_target_source[0]
    np.testing.assert_allclose(moved, motions[1] @ plain @ np.linalg.inv(motions[0]), atol=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_two_motions_are_both_found_in_the_order_of_their_support(seed: int) -> None:
    """Two sets of pairs agree with two motions, as in repetitive places."""
    many, few = pairs_with_outliers(seed, 40, 0), pairs_with_outliers(100 + seed, 20, 0)
    noise = pairs_with_outliers(200 + seed, 0, 40)
    sides = (np.concatenate([part[side] for part in (few, noise, many)]) for side in (0, 1))
    found = find_consensus(*sides, config=ConsensusConfig(num_motions=4))
    for number, true in enumerate((many[2], few[2])):
        assert errors(found.T_target_source[number], true)[0] < 0.5
    support = np.asarray(found.support)
    assert (np.diff(support) <= 0).all()
    assert support[1] > 2 * support[2]


def test_near_equal_motions_are_suppressed() -> None:
    source, target, _, _ = pairs_with_outliers(0, 40, 40)
    found = find_consensus(source, target, config=ConsensusConfig(num_motions=8))
    motions = np.asarray(found.T_target_source)[np.asarray(found.support) > 0]
    moved = np.einsum("hij,nj->hni", motions[:, :3, :3], source) + motions[:, None, :3, 3]
    apart = np.linalg.norm(moved[:, None] - moved[None], axis=-1).mean(axis=-1)
    assert (apart[~np.eye(len(apart), dtype=bool)] > DISTINCT_M - 1e-3).all()


def test_missing_motions_repeat_the_first_without_support() -> None:
    source, target, _, _ = pairs_with_outliers(0, 20, 0, noise_m=0.01)
    found = find_consensus(source, target)
    assert found.support[0] > 15
    np.testing.assert_array_equal(found.support[1:], 0)
    assert (found.T_target_source[1:] == found.T_target_source[0]).all()
    assert not found.is_inlier[1:].any()


@pytest.mark.parametrize("num_pairs", [0, 1, 2])
def test_too_few_pairs_give_a_finite_motion_with_little_support(num_pairs: int) -> None:
    source, target, _, _ = pairs_with_outliers(3, num_pairs, 0)
    found = find_consensus(source, target)
    assert np.isfinite(found.T_target_source).all()
    assert found.support[0] <= num_pairs
    assert found.is_inlier.shape == (len(found.support), num_pairs)


def test_pairs_of_one_point_tell_nothing() -> None:
    """Many pairs of one descriptor agree in all distances, which are 0. They must not outvote the true pairs."""
    source, target, T, _ = pairs_with_outliers(4, 12, 20)
    crowd = np.tile(source[:1], (40, 1)), np.tile(target[:1] + 15, (40, 1))
    found = find_consensus(np.concatenate([source, crowd[0]]), np.concatenate([target, crowd[1]]))
    assert errors(found.T_target_source[0], T)[0] < 0.5
