import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from dpmjax import estimate_normals
from dpmjax.geometry import image_normals
from tests.tolerances import ACCUMULATED

DIMS = pytest.mark.parametrize("dim", [2, 3])


def surface(seed: int, dim: int, n: int = 120) -> np.ndarray:
    """A circle or a sphere about a sensor that is off its centre."""
    points = np.random.default_rng(seed).normal(size=(n, dim))
    points = 10 * points / np.linalg.norm(points, axis=1, keepdims=True)
    return (points + np.array([1, 2, 3])[:dim]).astype(np.float32)


def normals_in_numpy(points: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    points = points.astype(np.float64)
    normals, flatness = np.zeros_like(points), np.zeros(len(points))
    for i, neighbours in enumerate(cKDTree(points).query(points, k)[1]):
        values, vectors = np.linalg.eigh(np.cov(points[neighbours].T))
        normals[i] = vectors[:, 0] * (-1 if vectors[:, 0] @ points[i] > 0 else 1)
        flatness[i] = (values[1] - values[0]) / values[-1]
    return normals, flatness


@DIMS
def test_normals_are_those_of_numpy(dim: int) -> None:
    points = surface(0, dim)
    expected, flatness = normals_in_numpy(points, 8)
    result = jax.device_get(estimate_normals(points, 8))
    assert result.mask.all()
    # Where the two smallest spreads are close, the direction is loose in any arithmetic.
    is_firm = flatness > 0.1
    np.testing.assert_allclose(np.asarray(result.normals)[is_firm], expected[is_firm], rtol=0, atol=1e-3)
    np.testing.assert_allclose(result.flatness, flatness, **ACCUMULATED)


@DIMS
@pytest.mark.parametrize("num_valid", [0, 1])
def test_too_few_points_have_no_normals(dim: int, num_valid: int) -> None:
    result = jax.device_get(estimate_normals(surface(4, dim), 5, np.arange(120) < num_valid))
    assert not result.mask.any()
    assert (result.normals == 0).all()
    assert (result.flatness == 0).all()


@DIMS
def test_coincident_points_have_no_normals(dim: int) -> None:
    assert not estimate_normals(np.full((9, dim), 3.3, np.float32), 4).mask.any()


def test_points_on_a_line_in_space_get_a_normal_to_it() -> None:
    points = np.linspace(1, 5, 20, dtype=np.float32)[:, None] * np.array([1, 0, 0], np.float32)
    result = jax.device_get(estimate_normals(points, 5))
    np.testing.assert_allclose(result.normals[:, 0], 0, atol=1e-5)
    np.testing.assert_allclose(result.flatness, 0, atol=1e-5)


@DIMS
def test_gradient_is_zero_and_finite(dim: int) -> None:
    gradient = jax.jit(jax.grad(lambda p: jnp.sum(estimate_normals(p, 5).normals ** 3)))(jnp.asarray(surface(5, dim)))
    np.testing.assert_array_equal(gradient, 0)


def test_pixels_of_a_plane_have_its_normal_and_pixels_across_an_edge_none() -> None:
    rays = np.stack([*np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.3, 0.3, 7)), np.ones((7, 9))], axis=-1)
    normal = np.array([0.4, -0.2, -1.0]) / np.linalg.norm([0.4, -0.2, -1.0])
    points = rays * (-2.0 / (rays @ normal))[..., None]
    points[:, 5:] *= 2.0
    mask = np.ones((7, 9), bool)
    mask[0, 0], points[0, 0] = False, np.nan
    normals, is_surface = image_normals(points.astype(np.float32), mask)
    expected = np.ones((6, 8), bool)
    expected[:, 4], expected[0, 0] = False, False
    np.testing.assert_array_equal(is_surface, expected)
    np.testing.assert_allclose(np.abs(normals[expected] @ normal), 1.0, atol=1e-5)
    assert not normals[~expected].any()
