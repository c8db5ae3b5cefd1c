import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from dpmjax import chamfer_distance
from tests.tolerances import ACCUMULATED

DIMS = pytest.mark.parametrize("dim", [2, 3])
GRADIENTS = jax.jit(jax.grad(chamfer_distance, argnums=(0, 1)))


def clouds(seed: int, dim: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(30, dim)).astype(np.float32), rng.normal(size=(20, dim)).astype(np.float32)


def chamfer_in_scipy(a: np.ndarray, b: np.ndarray) -> float:
    distances = cdist(a.astype(np.float64), b.astype(np.float64))
    return float(distances.min(axis=1).mean() + distances.min(axis=0).mean())


@DIMS
@pytest.mark.parametrize("seed", [0, 1])
def test_distance_is_its_definition(dim: int, seed: int) -> None:
    pair = clouds(seed, dim)
    np.testing.assert_allclose(chamfer_distance(*pair), chamfer_in_scipy(*pair), **ACCUMULATED)


@DIMS
@pytest.mark.parametrize("empty", ["a", "b", "both"])
def test_distance_to_an_empty_cloud_is_zero_with_zero_gradient(dim: int, empty: str) -> None:
    a, b = clouds(5, dim)
    mask_a, mask_b = np.full(30, empty == "b"), np.full(20, empty == "a")
    assert float(chamfer_distance(a, b, mask_a, mask_b)) == 0
    for gradient in GRADIENTS(a, b, mask_a, mask_b):
        np.testing.assert_array_equal(gradient, 0)


def test_distance_to_an_array_without_rows_is_zero() -> None:
    assert float(chamfer_distance(jnp.zeros((0, 2)), jnp.ones((4, 2)))) == 0


@DIMS
def test_gradient_is_finite_at_coincident_points(dim: int) -> None:
    a, _ = clouds(6, dim)
    for gradient in GRADIENTS(a, a):
        np.testing.assert_array_equal(gradient, 0)
