import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.nets.layers import NORM_EPSILON
from dpmjax.nets.neighbourhood import maximum_of_normalised
from tests.tolerances import ACCUMULATED


def problem(seed: int, n: int = 30, m: int = 12, k: int = 5, f: int = 7) -> tuple[list[np.ndarray], np.ndarray]:
    """Points, offsets, kernel and scale; and neighbours."""
    rng = np.random.default_rng(seed)
    shapes = ((n, f), (m, k, 3), (3, f))
    return [*(rng.normal(size=shape) for shape in shapes), 1 + 0.3 * rng.normal(size=f)], rng.integers(0, n, (m, k))


def in_numpy(floats: list[np.ndarray], neighbours: np.ndarray) -> np.ndarray:
    points, offsets, kernel, scale = floats
    x = points[neighbours] + offsets @ kernel
    return (x / np.sqrt((x**2).mean(-1, keepdims=True) + NORM_EPSILON) * scale).max(1)


def in_jax(floats: list[np.ndarray] | list[jax.Array], neighbours: np.ndarray) -> jax.Array:
    points, offsets, kernel, scale = (jnp.asarray(x, jnp.float32) for x in floats)
    return maximum_of_normalised(points, offsets, kernel, jnp.asarray(neighbours), scale)


@pytest.mark.parametrize("k", [1, 5, 6])
def test_value_with_and_without_gradient(k: int) -> None:
    floats, neighbours = problem(0, k=k)
    expected = in_numpy(floats, neighbours)
    np.testing.assert_allclose(in_jax(floats, neighbours), expected, **ACCUMULATED)
    value, _ = jax.vjp(lambda points: in_jax([points, *floats[1:]], neighbours), jnp.asarray(floats[0]))
    np.testing.assert_allclose(value, expected, **ACCUMULATED)


@pytest.mark.parametrize("argument", range(4))
def test_gradient_is_the_slope(argument: int) -> None:
    """The gradient by each argument equals central differences in float64."""
    floats, neighbours = problem(1)
    weights = np.random.default_rng(9).normal(size=(12, 7))
    arrays = [jnp.asarray(x, jnp.float32) for x in floats]
    found = jax.grad(lambda arrays: jnp.sum(weights * in_jax(arrays, neighbours)))(arrays)[argument]
    expected = np.zeros_like(floats[argument])
    for place in np.ndindex(expected.shape):
        ends = []
        for step in (1e-6, -1e-6):
            moved = [x.copy() for x in floats]
            moved[argument][place] += step
            ends.append(np.sum(weights * in_numpy(moved, neighbours)))
        expected[place] = (ends[0] - ends[1]) / 2e-6
    np.testing.assert_allclose(found, expected, atol=5e-5)


def test_neighbours_that_repeat_share_the_gradient_of_one() -> None:
    """Beyond the radius the nearest neighbour is repeated; that must not count twice."""
    floats, neighbours = problem(2)
    weights = np.random.default_rng(9).normal(size=(12, 7))

    def gradient(columns: list[int]) -> jax.Array:
        chosen = [floats[0], floats[1][:, columns], *floats[2:]]
        loss = lambda points: jnp.sum(weights * in_jax([points, *chosen[1:]], neighbours[:, columns]))  # noqa: E731
        return jax.grad(loss)(jnp.asarray(floats[0], jnp.float32))

    np.testing.assert_allclose(gradient([0, 1, 2, 3, 4, 0, 0]), gradient([0, 1, 2, 3, 4]), **ACCUMULATED)


@pytest.mark.slow
def test_gradient_is_finite_where_all_is_zero() -> None:
    arrays = [jnp.zeros((3, 4)), jnp.zeros((2, 2, 3)), jnp.ones((3, 4)), jnp.ones(4)]
    gradients = jax.grad(lambda arrays: jnp.sum(in_jax(arrays, np.zeros((2, 2), int))))(arrays)
    assert all(np.isfinite(gradient).all() for gradient in gradients)
