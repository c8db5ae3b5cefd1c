import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax import weighted_svd
from tests.tolerances import ALIGNMENT, GRADIENT, ROUNDING

DIMS = pytest.mark.parametrize("dim", [2, 3])
SEEDS = pytest.mark.parametrize("seed", [0, 1, 2])


def align_in_numpy(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> np.ndarray:
    source, target, weights = (np.asarray(array, np.float64) for array in (source, target, weights))
    dim = source.shape[1]
    mean_source = (weights[:, None] * source).sum(0) / weights.sum()
    mean_target = (weights[:, None] * target).sum(0) / weights.sum()
    U, _, Vt = np.linalg.svd((weights[:, None] * (source - mean_source)).T @ (target - mean_target))
    sign = np.diag([*[1] * (dim - 1), np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    T = np.eye(dim + 1)
    T[:dim, :dim] = Vt.T @ sign @ U.T
    T[:dim, dim] = mean_target - T[:dim, :dim] @ mean_source
    return T


def random_pairs(seed: int, dim: int, n: int = 40, noise: float = 0.1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    axis = np.array([0, 0, 1]) if dim == 2 else rng.normal(size=3)
    R = Rotation.from_rotvec(rng.uniform(-2, 2) * axis).as_matrix()[:dim, :dim]
    source = rng.normal(size=(n, dim))
    target = source @ R.T + rng.normal(size=dim) + noise * rng.normal(size=(n, dim))
    weights = rng.uniform(0.1, 2, n)
    return source.astype(np.float32), target.astype(np.float32), weights.astype(np.float32)


def finite_differences(function, x: np.ndarray, step: float = 1e-6) -> np.ndarray:
    gradient = np.zeros(x.shape)
    for index in np.ndindex(x.shape):
        forward, backward = x.astype(np.float64), x.astype(np.float64)
        forward[index] += step
        backward[index] -= step
        gradient[index] = (function(forward) - function(backward)) / (2 * step)
    return gradient


def gradients(source, target, weights, probe=None) -> list[np.ndarray]:
    """Gradients of a fixed linear function of T; by default the sum of all entries, each with its own factor."""
    dim = np.shape(source)[1]
    probe = np.cos(np.arange((dim + 1) ** 2).reshape(dim + 1, dim + 1)) if probe is None else probe
    arrays = (jnp.asarray(array, jnp.float32) for array in (source, target, weights, probe))
    return [np.asarray(gradient) for gradient in _gradients(*arrays)]


@jax.jit
def _gradients(source, target, weights, probe):
    return jax.grad(lambda *pairs: jnp.sum(weighted_svd(*pairs) * probe), argnums=(0, 1, 2))(source, target, weights)


@DIMS
@SEEDS
def test_alignment_equals_numpy(dim: int, seed: int) -> None:
    pairs = random_pairs(seed, dim)
    np.testing.assert_allclose(weighted_svd(*pairs), align_in_numpy(*pairs), **ALIGNMENT)


@DIMS
def test_alignment_recovers_an_exact_motion_far_from_the_origin(dim: int) -> None:
    source, target, weights = random_pairs(3, dim, noise=0)
    offset = np.float32(1000)
    T = np.asarray(weighted_svd(source + offset, target + offset, weights), np.float64)
    moved = (source.astype(np.float64) + offset) @ T[:dim, :dim].T + T[:dim, dim]
    # float32 leaves 6e-5 of a coordinate at 1000.
    np.testing.assert_allclose(moved, target.astype(np.float64) + offset, atol=2e-3)


@DIMS
@SEEDS
def test_rotation_is_proper_for_mirrored_clouds(dim: int, seed: int) -> None:
    source, _, weights = random_pairs(seed, dim)
    target = source * np.array([-1.0, *[1.0] * (dim - 1)], np.float32)
    T = np.asarray(weighted_svd(source, target, weights), np.float64)
    np.testing.assert_allclose(np.linalg.det(T[:dim, :dim]), 1, **ROUNDING)
    np.testing.assert_allclose(T, align_in_numpy(source, target, weights), **ALIGNMENT)


@DIMS
@pytest.mark.parametrize("num_valid", [0, 1])
def test_without_two_pairs_only_a_translation_is_left(dim: int, num_valid: int) -> None:
    source, target, _ = random_pairs(7, dim)
    weights = np.zeros(len(source), np.float32)
    weights[3 : 3 + num_valid] = 0.3
    T = np.asarray(weighted_svd(source, target, weights))
    expected = np.eye(dim + 1)
    expected[:dim, dim] = (target[3] - source[3]) * num_valid
    np.testing.assert_allclose(T, expected, **ROUNDING)
    assert all(np.isfinite(gradient).all() for gradient in gradients(source, target, weights))


@DIMS
def test_no_pairs_at_all_give_the_identity(dim: int) -> None:
    empty = jnp.zeros((0, dim))
    np.testing.assert_array_equal(weighted_svd(empty, empty, jnp.zeros(0)), np.eye(dim + 1))


@DIMS
@SEEDS
def test_two_pairs_on_a_line_are_aligned_with_finite_gradient(dim: int, seed: int) -> None:
    source, target, weights = (array[:2] for array in random_pairs(seed, dim, noise=0))
    T = np.asarray(weighted_svd(source, target, weights), np.float64)
    np.testing.assert_allclose(np.linalg.det(T[:dim, :dim]), 1, **ROUNDING)
    np.testing.assert_allclose(source @ T[:dim, :dim].T + T[:dim, dim], target, atol=1e-4)
    assert all(np.abs(gradient).max() < 1e3 for gradient in gradients(source, target, weights))


def test_points_on_a_line_are_not_rolled_about_it() -> None:
    source = np.linspace(-1, 1, 9, dtype=np.float32)[:, None] * np.array([1, 0, 0], np.float32)
    T = weighted_svd(source, source + 2, np.ones(9, np.float32))
    np.testing.assert_allclose(T[:3, :3], np.eye(3), **ALIGNMENT)


@DIMS
def test_coincident_points_have_finite_gradients(dim: int) -> None:
    same = np.full((6, dim), 0.7, np.float32)
    T = weighted_svd(same, 2 * same, np.ones(6, np.float32))
    np.testing.assert_allclose(T[:dim, :dim], np.eye(dim), **ROUNDING)
    assert all(np.isfinite(gradient).all() for gradient in gradients(same, 2 * same, np.ones(6, np.float32)))


@pytest.mark.parametrize("scale", [(1, 1), (1, 1, 1), (1, 1, 0.5), (1, 1, -0.5)], ids=str)
def test_gradient_is_right_at_equal_singular_values(scale: tuple[float, ...]) -> None:
    # A cross has equal spread along all axes; the last scale mirrors it, so that the smallest value is negative.
    dim = len(scale)
    source = np.concatenate([np.eye(dim), -np.eye(dim)]).astype(np.float32)
    target = source * np.array(scale, np.float32)
    weights = np.ones(len(source), np.float32)
    probe = np.random.default_rng(0).normal(size=(dim + 1, dim + 1))

    def loss(x: np.ndarray) -> float:
        return float(np.sum(align_in_numpy(source, x, weights) * probe))

    found = gradients(source, target, weights, probe)[1]
    np.testing.assert_allclose(found, finite_differences(loss, target), **GRADIENT)


@DIMS
def test_gradient_is_finite_where_the_rotation_is_open(dim: int) -> None:
    # A perfect mirror image with equal spread: every rotation of a family fits equally well.
    source = np.concatenate([np.eye(dim), -np.eye(dim)]).astype(np.float32)
    target = -source if dim == 3 else source * np.array([1, -1], np.float32)
    T = weighted_svd(source, target, np.ones(2 * dim))
    np.testing.assert_allclose(np.linalg.det(T[:dim, :dim]), 1, **ROUNDING)
    assert all(np.abs(g).max() < 1e3 for g in gradients(source, target, np.ones(2 * dim, np.float32)))
