"""Laws of the alignment of surface elements: the motion of the surfaces, masks, jit, vmap, derivative."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.geometry import se3
from dpmjax.scans.element_alignment import align_elements, align_elements_on_host
from dpmjax.scans.surfaces import scan_surface
from dpmjax.types import SurfaceElements
from tests.scans.surface_scenes import motion, seen_from, street

T_WORLD_A, T_WORLD_B = motion(5, (1, -2, 0.1), 1), motion(40, (-2, 1, 0), -1)
T_B_A = np.linalg.inv(T_WORLD_B) @ T_WORLD_A
GUESS = T_B_A @ motion(2, (0.5, -0.4, 0.2), 0.3)


def elements(seed: int, T_world_scan: np.ndarray, num: int = 300) -> SurfaceElements:
    """Each num-th point of the street with its normal, in float32."""
    surface = scan_surface(seen_from(street(seed), T_world_scan))
    rows = np.random.default_rng(seed).permutation(len(surface.points))[:num]
    arrays = (surface.points[rows], surface.normals[rows], surface.flatness[rows])
    return SurfaceElements(*(jnp.asarray(array, jnp.float32) for array in arrays), jnp.ones(num, bool))


SOURCE, TARGET = elements(0, T_WORLD_A), elements(1, T_WORLD_B)


def error_m_deg(T: np.ndarray) -> tuple[float, float]:
    difference = np.linalg.inv(T_B_A) @ np.asarray(T, float)
    return float(np.linalg.norm(difference[:3, 3])), float(np.degrees(np.linalg.norm(se3.log(difference)[3:])))


@pytest.mark.slow
def test_two_views_of_one_surface_are_aligned() -> None:
    """The views share no point; the oracle is the motion with which they were made."""
    found = align_elements(SOURCE, TARGET, GUESS)
    error_m, error_deg = error_m_deg(found.T_target_source)
    assert error_m < 0.02
    assert error_deg < 0.1
    assert found.rmse < 0.03
    assert 100 < found.num_pairs <= 600


@pytest.mark.slow
def test_the_same_elements_are_aligned_to_rounding() -> None:
    T_b_a = motion(3, (0.3, -0.2, 0.1))
    moved = SurfaceElements(
        jnp.asarray(np.asarray(SOURCE.positions) @ T_b_a[:3, :3].T + T_b_a[:3, 3], jnp.float32),
        jnp.asarray(np.asarray(SOURCE.normals) @ T_b_a[:3, :3].T, jnp.float32),
        SOURCE.planarity,
        SOURCE.mask,
    )
    for align in (align_elements, align_elements_on_host):
        np.testing.assert_allclose(align(SOURCE, moved, np.eye(4)).T_target_source, T_b_a, atol=2e-5)


def test_trees_and_exhaustive_search_give_one_motion() -> None:
    ours, host = (align(SOURCE, TARGET, GUESS) for align in (align_elements, align_elements_on_host))
    np.testing.assert_allclose(ours.T_target_source, host.T_target_source, atol=2e-4)
    np.testing.assert_allclose(ours.rmse, host.rmse, rtol=1e-2)
    assert abs(int(ours.num_pairs) - int(host.num_pairs)) <= 2


def test_the_symmetric_motion_back_is_the_inverse() -> None:
    there = align_elements_on_host(SOURCE, TARGET, GUESS)
    back = align_elements_on_host(TARGET, SOURCE, np.linalg.inv(GUESS))
    np.testing.assert_allclose(there.T_target_source @ back.T_target_source, np.eye(4), atol=2e-3)


@pytest.mark.slow
def test_masked_and_uneven_elements_count_for_nothing() -> None:
    junk = SurfaceElements(
        jnp.full((40, 3), jnp.nan), jnp.full((40, 3), jnp.nan), jnp.full(40, jnp.nan), jnp.zeros(40, bool)
    )
    uneven = elements(7, T_WORLD_A, 40).replace(planarity=jnp.full(40, 0.05))
    padded = jax.tree.map(lambda *parts: jnp.concatenate(parts), SOURCE, junk, uneven)
    for align in (align_elements, align_elements_on_host):
        expected, found = align(SOURCE, TARGET, GUESS), align(padded, TARGET, GUESS)
        np.testing.assert_allclose(found.T_target_source, expected.T_target_source, atol=1e-5)
        assert found.num_pairs == expected.num_pairs


@pytest.mark.slow
def test_starts_are_aligned_side_by_side() -> None:
    starts = jnp.asarray(np.stack([GUESS, T_B_A @ motion(-3, (-0.6, 0.3, 0))]), jnp.float32)
    many = jax.vmap(align_elements, (None, None, 0))(SOURCE, TARGET, starts)
    for row, start in enumerate(starts):
        expected = align_elements(SOURCE, TARGET, start)
        np.testing.assert_allclose(many.T_target_source[row], expected.T_target_source, atol=1e-5)


@pytest.mark.parametrize("num", [0, 5])
def test_too_few_pairs_leave_the_motion(num: int) -> None:
    few, fewer = (side.replace(mask=jnp.arange(300) < num) for side in (SOURCE, TARGET))
    for align in (align_elements, align_elements_on_host):
        found = align(few, fewer, GUESS)
        np.testing.assert_allclose(found.T_target_source, GUESS, atol=1e-6)
        assert np.isinf(found.rmse)


@pytest.mark.slow
def test_the_derivative_is_that_of_the_solution() -> None:
    """If the target moves, the motion moves with it: the derivative by a translation of the target is one."""

    def solution(shift: jax.Array) -> jax.Array:
        return align_elements(SOURCE, TARGET.replace(positions=TARGET.positions + shift), GUESS).T_target_source[:3, 3]

    derivative = jax.jacobian(solution)(jnp.zeros(3))
    np.testing.assert_allclose(derivative, np.eye(3), atol=2e-2)


@pytest.mark.slow
def test_the_derivative_is_finite_where_nothing_is_there() -> None:
    def loss(positions: jax.Array, target: SurfaceElements) -> jax.Array:
        found = align_elements(SOURCE.replace(positions=positions), target, GUESS)
        return jnp.sum(found.T_target_source**2) + jnp.where(jnp.isfinite(found.rmse), found.rmse, 0)

    empty = TARGET.replace(mask=jnp.zeros(300, bool))
    for target in (TARGET, empty, SOURCE):
        assert np.isfinite(jax.grad(loss)(SOURCE.positions, target)).all()
