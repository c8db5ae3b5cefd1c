from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.scan import icp

NUM_POINTS = 300


def motion(dim: int, degrees: float, shift: float) -> np.ndarray:
    T = np.eye(dim + 1)
    axis = np.array([0.0, 0.0, 1.0]) if dim == 2 else np.array([0.6, 0.0, 0.8])
    T[:dim, :dim] = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()[:dim, :dim]
    T[:dim, dim] = shift * np.array([1.0, -0.5, 0.3])[:dim]
    return T


def apply(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    dim = points.shape[1]
    return points @ T[:dim, :dim].T + T[:dim, dim]


def surface(dim: int, seed: int = 0) -> np.ndarray:
    """Returns points on the sides of a box with a step in one side, so that it does not slide or turn onto itself."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (NUM_POINTS, dim))
    side = rng.integers(0, dim, NUM_POINTS)
    points[np.arange(NUM_POINTS), side] = np.where(rng.uniform(size=NUM_POINTS) < 0.5, -1.0, 1.0)
    points[(side == 0) & (points[:, 1] > 0.3), 0] *= 0.6
    return points * np.array([10.0, 6.0, 4.0])[:dim]


def error_of(found: np.ndarray, true: np.ndarray, points: np.ndarray) -> float:
    return float(np.linalg.norm(apply(np.asarray(found, np.float64), points) - apply(true, points), axis=-1).max())


@pytest.mark.parametrize("metric", ["point", "plane"])
@pytest.mark.parametrize("dim", [2, 3])
def test_known_motion_is_recovered(dim: int, metric: str) -> None:
    source, true = surface(dim), motion(dim, 3.0, 0.2)
    result = icp(source.astype(np.float32), apply(true, source).astype(np.float32), metric)
    assert error_of(result.T_target_source, true, source) < 2e-3
    assert bool(result.converged)
    assert int(result.num_inliers) > 0.9 * NUM_POINTS
    assert float(result.rmse) < 1e-3


@pytest.mark.parametrize("metric", ["point", "plane"])
def test_motion_is_recovered_from_a_guess_beyond_the_basin(metric: str) -> None:
    source, true = surface(2), motion(2, 120.0, 30.0)
    guess = true @ motion(2, 2.0, 0.1)
    result = icp(source.astype(np.float32), apply(true, source).astype(np.float32), metric, guess.astype(np.float32))
    assert error_of(result.T_target_source, true, source) < 5e-3


@pytest.mark.parametrize("metric", ["point", "plane"])
def test_outliers_and_what_only_the_source_has_seen_do_not_pull(metric: str) -> None:
    source, true = surface(2), motion(2, 2.0, 0.2)
    target = apply(true, source)
    target[:60] += np.random.default_rng(1).uniform(5.0, 15.0, (60, 2))
    for seen, most in ((target, 0.02), (apply(true, source)[source[:, 0] < 4.0], 0.05)):
        result = icp(source.astype(np.float32), seen.astype(np.float32), metric)
        assert error_of(result.T_target_source, true, source) < most
        assert int(result.num_inliers) < NUM_POINTS


@pytest.mark.slow
@pytest.mark.parametrize("metric", ["point", "plane"])
@pytest.mark.parametrize("dim", [2, 3])
def test_degenerate_clouds_stay_finite(dim: int, metric: str) -> None:
    one = np.ones((1, dim), np.float32)
    line = np.linspace(-1, 1, 20, dtype=np.float32)[:, None] * np.ones((1, dim), np.float32)
    for source, target in ((one, 2 * one), (line, line + np.float32(0.01)), (np.repeat(one, 20, 0), line)):
        result = icp(source, target, metric)
        assert all(np.isfinite(x).all() for x in result)
        R = np.asarray(result.T_target_source)[:dim, :dim]
        np.testing.assert_allclose(R @ R.T, np.eye(dim), atol=1e-4)


def test_a_line_slides_along_itself_only() -> None:
    line = np.stack([np.linspace(-5, 5, 60), np.zeros(60)], -1).astype(np.float32)
    result = icp(line, line + np.array([0.0, 0.3], np.float32), "plane")
    np.testing.assert_allclose(np.asarray(result.T_target_source)[:2, 2], [0.0, 0.3], atol=5e-3)


@pytest.mark.parametrize(
    ("source", "target", "options", "message"),
    [
        (np.ones((5, 4)), np.ones((5, 4)), {}, "source: expected"),
        (np.ones((5, 2)), np.ones((5, 3)), {}, "target: expected"),
        (np.ones((0, 2)), np.ones((5, 2)), {}, "source: expected one point or more"),
        (np.ones((5, 2)), np.full((5, 2), np.nan), {}, "target: .* finite numbers"),
        (np.ones((5, 2)), np.ones((5, 2)), {"metric": "wall"}, "metric: expected 'point' or 'plane'"),
        (np.ones((5, 2)), np.ones((5, 2)), {"T_init": np.eye(4)}, "T_init: expected shape"),
        (
            np.ones((5, 2)),
            np.ones((5, 2)),
            {"T_init": np.full((3, 3), np.nan)},
            "T_init: expected finite numbers, got NaN",
        ),
        (np.ones((5, 2)), np.ones((5, 2)), {"T_init": np.diag([2.0, 2.0, 1.0])}, "T_init: expected a rigid motion"),
        (np.ones((5, 2)), np.ones((5, 2)), {"T_init": np.diag([1.0, -1.0, 1.0])}, "T_init: expected a rigid motion"),
    ],
)
def test_bad_input_is_named(as_user, source, target, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        icp(source, target, **options)


def test_second_call_compiles_nothing(assert_compiles_nothing) -> None:
    source = surface(2).astype(np.float32)
    icp(source, source, "plane", np.eye(3, dtype=np.float32))
    with assert_compiles_nothing():
        icp(source + np.float32(0.1), source, "plane", np.eye(3, dtype=np.float32))


@pytest.mark.slow
@pytest.mark.parametrize("metric", ["point", "plane"])
def test_float32_stays_float32_where_jax_has_64_bits(metric: str, float64) -> None:
    source, true = surface(2).astype(np.float32), motion(2, 3.0, 0.2)
    target = apply(true, source).astype(np.float32)
    result = icp(source, target, metric)
    gradient = jax.grad(lambda source: icp(source, target, metric).T_target_source.sum())(jnp.asarray(source))
    assert result.T_target_source.dtype == result.rmse.dtype == gradient.dtype == np.float32
    assert error_of(result.T_target_source, true, source) < 2e-3
    assert np.isfinite(gradient).all()


@pytest.mark.slow
def test_a_single_point_moves_the_translation_only() -> None:
    point = jnp.asarray([[0.1257302, -0.13210486]])
    derivative = jax.jacfwd(lambda source: icp(source, point, "point").T_target_source)(point)[:, :, 0]
    np.testing.assert_allclose(derivative[:2, :2], 0.0, atol=1e-6)
    np.testing.assert_allclose(derivative[:2, 2], -np.eye(2), atol=1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_clouds_that_float32_cannot_hold_are_refused(dim: int) -> None:
    points = surface(dim)
    far = points + np.array([4.5e5, 5.4e6, 100.0])[:dim]
    with pytest.raises(ValueError, match="subtract their mean"):
        icp(far, far)
    near = points + 1e3
    assert error_of(icp(near, near).T_target_source, np.eye(dim + 1), near) < 1e-2
