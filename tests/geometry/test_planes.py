"""Laws of one point-to-plane step: least squares, NumPy as JAX, what no plane holds; planes of neighbourhoods."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.geometry.planes import PlaneStep, fit_planes, geman_mcclure, motion_about, step_to_planes
from tests.tolerances import ACCUMULATED, DOUBLE


def pairs(seed: int = 0, num: int = 60) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(num, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return 10 + 5 * rng.normal(size=(num, 3)), normals, 0.1 * rng.normal(size=num), rng.uniform(0.1, 1, num)


def test_a_step_solves_the_weighted_least_squares() -> None:
    points, normals, residuals, weights = pairs()
    step = step_to_planes(points, normals, residuals, weights)
    np.testing.assert_allclose(step.centre, points.mean(axis=0), **DOUBLE)
    jacobian = np.concatenate([normals, np.cross(points - step.centre, normals)], axis=1)
    root = np.sqrt(weights)
    expected = np.linalg.lstsq(root[:, None] * jacobian, -root * residuals)[0]
    np.testing.assert_allclose(step.tangent, expected, atol=1e-6)


def test_the_motion_of_a_step_turns_about_its_centre() -> None:
    rng = np.random.default_rng(1)
    tangent, centre = rng.normal(size=(5, 6)), rng.normal(size=(5, 3))
    tangent[0] = 0
    T = motion_about(PlaneStep(tangent, centre))
    for matrix, part, middle in zip(T, tangent, centre, strict=True):
        np.testing.assert_allclose(matrix[:3, :3], Rotation.from_rotvec(part[3:]).as_matrix(), **DOUBLE)
        np.testing.assert_allclose(matrix[:3, :3] @ middle + matrix[:3, 3], middle + part[:3], **DOUBLE)
        np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])


def test_both_kinds_of_arrays_give_one_step() -> None:
    arrays = [np.stack(parts) for parts in zip(pairs(0), pairs(1), strict=True)]
    host = step_to_planes(*arrays)
    ours = jax.jit(step_to_planes)(*(jnp.asarray(array, jnp.float32) for array in arrays))
    np.testing.assert_allclose(ours.tangent, host.tangent, **ACCUMULATED)
    np.testing.assert_allclose(motion_about(ours), motion_about(host), **ACCUMULATED)
    weights = geman_mcclure(jnp.asarray(arrays[2], jnp.float32), 0.1)
    np.testing.assert_allclose(weights, geman_mcclure(arrays[2], 0.1), **ACCUMULATED)


def test_pairs_of_no_weight_count_for_nothing() -> None:
    points, normals, residuals, weights = pairs()
    expected = step_to_planes(points[:40], normals[:40], residuals[:40], weights[:40])
    found = step_to_planes(points, normals, residuals, np.where(np.arange(60) < 40, weights, 0))
    np.testing.assert_allclose(found.tangent, expected.tangent, **DOUBLE)
    np.testing.assert_allclose(found.centre, expected.centre, **DOUBLE)
    for kind in (np.asarray, jnp.asarray):
        nothing = step_to_planes(*(kind(array) for array in (points, normals, residuals, np.zeros(60))))
        np.testing.assert_array_equal(nothing.tangent, np.zeros(6))


def test_directions_that_no_plane_holds_stay() -> None:
    points, _, residuals, weights = pairs()
    up = np.tile([0.0, 0.0, 1.0], (60, 1))
    tangent = step_to_planes(points, up, residuals, weights).tangent
    np.testing.assert_allclose(tangent[[0, 1, 5]], 0, atol=1e-9)


@pytest.mark.slow
def test_the_derivative_is_finite_at_the_zero_step() -> None:
    derivative = jax.jacobian(lambda tangent: motion_about(PlaneStep(tangent, jnp.ones(3))))(jnp.zeros(6))
    assert np.isfinite(derivative).all()
    np.testing.assert_allclose(derivative[:3, 3, :3], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(derivative[2, 1, 3], 1, atol=1e-6)


def neighbourhoods(rng: np.random.Generator, spread: tuple[float, float, float], count: int = 200) -> np.ndarray:
    """Random clouds of twelve points, stretched along random axes and moved: (count, 12, 3)."""
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    return (rng.normal(size=(count, 12, 3)) * spread) @ axes + rng.normal(size=(count, 1, 3))


@pytest.mark.parametrize("spread", [(1.0, 1.0, 0.01), (1.0, 0.5, 0.2), (1e-4, 3e-4, 1e-6), (300.0, 0.3, 100.0)])
def test_planes_are_those_of_the_eigenvectors(spread) -> None:
    rng = np.random.default_rng(0)
    points, is_near = neighbourhoods(rng, spread), rng.random((200, 12)) < 0.8
    is_near[:, :5] = True
    found = fit_planes(tuple(np.where(is_near[..., None], points, 1e9).transpose(2, 0, 1)), is_near)
    for cloud, kept, normal, flatness in zip(points, is_near, found.normals, found.flatness, strict=True):
        values, vectors = np.linalg.eigh(np.cov(cloud[kept].T, bias=True))
        assert flatness == pytest.approx((values[1] - values[0]) / values[2], abs=1e-9)
        if flatness > 1e-3:
            assert abs(normal @ vectors[:, 0]) == pytest.approx(1, abs=1e-9)


def test_degenerate_neighbourhoods_are_finite_and_not_flat() -> None:
    rng = np.random.default_rng(0)
    point = np.zeros((1, 12, 3))
    line = np.arange(12.0)[None, :, None] * np.array([1.0, 2.0, -1.0])
    sphere = np.concatenate([np.eye(3), -np.eye(3)] * 2)[None]
    clouds = np.concatenate([point, line, sphere])
    found = fit_planes(tuple(clouds.transpose(2, 0, 1)), np.ones((3, 12), bool))
    assert np.isfinite(found.normals).all()
    np.testing.assert_allclose(found.flatness, 0, atol=1e-7)
    alone = rng.random((3, 12)) < 0
    alone[:, 0] = True
    assert fit_planes(tuple(clouds.transpose(2, 0, 1)), alone).flatness.max() == 0
