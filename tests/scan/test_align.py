"""Laws of the alignment: motions in the plane and in space, starts, masks, prior, jit, derivative."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.geometry import se3
from dpmjax.scan.lidar.align import LEVELS, AlignedMotion, AlignmentLevel, align, align_on_host
from dpmjax.scan.lidar.pairs import nearest_planes
from dpmjax.scan.lidar.surfaces import Surface, scan_surface, surface_of_elements
from dpmjax.types import SurfaceElements
from tests.scan.surface_scenes import motion, seen_from, street

T_WORLD_A, T_WORLD_B = motion(5, (1, -2, 0.1), 1), motion(40, (-2, 1, 0), -1)
T_B_A = np.linalg.inv(T_WORLD_B) @ T_WORLD_A
GUESS = T_B_A @ motion(2, (0.5, -0.4, 0.2), 0.3)


def elements(seed: int, T_world_scan: np.ndarray, num: int = 300) -> SurfaceElements:
    """Each num-th point of the street with its normal, in float32."""
    surface = scan_surface(seen_from(street(seed), T_world_scan))
    rows = np.random.default_rng(seed).permutation(len(surface.points))[:num]
    arrays = (surface.points[rows], surface.normals[rows], surface.flatness[rows])
    return SurfaceElements(*(jnp.asarray(array, jnp.float32) for array in arrays), jnp.ones(num, bool))


OF_SCANS = (AlignmentLevel(3.0, 1500, 6), AlignmentLevel(1.0, 4000, 8), AlignmentLevel(0.4, 8000, 10))
SOURCE, TARGET = elements(0, T_WORLD_A), elements(1, T_WORLD_B)


def on_host(source: SurfaceElements, target: SurfaceElements, T: np.ndarray) -> AlignedMotion:
    """The alignment with trees, from one start."""
    found = align_on_host(*map(surface_of_elements, (source, target)), np.asarray(T)[None], LEVELS)
    return AlignedMotion(*(values[0] for values in found))


def error_m_deg(T: np.ndarray) -> tuple[float, float]:
    difference = np.linalg.inv(T_B_A) @ np.asarray(T, float)
    return float(np.linalg.norm(difference[:3, 3])), float(np.degrees(np.linalg.norm(se3.log(difference)[3:])))


@pytest.mark.slow
def test_two_views_of_one_surface_are_aligned() -> None:
    """The views share no point; the oracle is the motion with which they were made."""
    found = align(SOURCE, TARGET, GUESS)
    error_m, error_deg = error_m_deg(found.T_target_source)
    assert error_m < 0.02
    assert error_deg < 0.1
    assert found.rmse < 0.03


@pytest.mark.slow
def test_the_same_elements_are_aligned_to_rounding() -> None:
    T_b_a = motion(3, (0.3, -0.2, 0.1))
    moved = SurfaceElements(
        jnp.asarray(np.asarray(SOURCE.positions) @ T_b_a[:3, :3].T + T_b_a[:3, 3], jnp.float32),
        jnp.asarray(np.asarray(SOURCE.normals) @ T_b_a[:3, :3].T, jnp.float32),
        SOURCE.planarity,
        SOURCE.mask,
    )
    for function in (align, on_host):
        np.testing.assert_allclose(function(SOURCE, moved, np.eye(4)).T_target_source, T_b_a, atol=2e-5)


def test_trees_and_exhaustive_search_give_one_motion() -> None:
    ours, host = (function(SOURCE, TARGET, GUESS) for function in (align, on_host))
    np.testing.assert_allclose(ours.T_target_source, host.T_target_source, atol=2e-3)
    np.testing.assert_allclose(ours.rmse, host.rmse, rtol=5e-2)


@pytest.mark.slow
def test_masked_and_uneven_elements_count_for_nothing() -> None:
    junk = SurfaceElements(
        jnp.full((40, 3), jnp.nan), jnp.full((40, 3), jnp.nan), jnp.full(40, jnp.nan), jnp.zeros(40, bool)
    )
    uneven = elements(7, T_WORLD_A, 40).replace(planarity=jnp.full(40, 0.05))
    padded = jax.tree.map(lambda *parts: jnp.concatenate(parts), SOURCE, junk, uneven)
    for function in (align, on_host):
        expected, found = function(SOURCE, TARGET, GUESS), function(padded, TARGET, GUESS)
        np.testing.assert_allclose(found.T_target_source, expected.T_target_source, atol=1e-5)


@pytest.mark.slow
def test_starts_are_aligned_side_by_side() -> None:
    starts = jnp.asarray(np.stack([GUESS, T_B_A @ motion(-3, (-0.6, 0.3, 0))]), jnp.float32)
    many = jax.vmap(align, (None, None, 0))(SOURCE, TARGET, starts)
    for row, start in enumerate(starts):
        expected = align(SOURCE, TARGET, start)
        np.testing.assert_allclose(many.T_target_source[row], expected.T_target_source, atol=1e-5)


@pytest.mark.parametrize("num", [0, 5])
def test_too_few_pairs_leave_the_motion(num: int) -> None:
    few, fewer = (side.replace(mask=jnp.arange(300) < num) for side in (SOURCE, TARGET))
    for function in (align, on_host):
        found = function(few, fewer, GUESS)
        np.testing.assert_allclose(found.T_target_source, GUESS, atol=1e-6)
        assert np.isinf(found.rmse)


@pytest.mark.slow
def test_the_derivative_is_that_of_the_solution() -> None:
    """If the target moves, the motion moves with it: the derivative by a translation of the target is one."""

    def solution(shift: jax.Array) -> jax.Array:
        return align(SOURCE, TARGET.replace(positions=TARGET.positions + shift), GUESS).T_target_source[:3, 3]

    derivative = jax.jacobian(solution)(jnp.zeros(3))
    np.testing.assert_allclose(derivative, np.eye(3), atol=2e-2)


@pytest.mark.slow
def test_the_derivative_is_finite_where_nothing_is_there() -> None:
    def loss(positions: jax.Array, target: SurfaceElements) -> jax.Array:
        found = align(SOURCE.replace(positions=positions), target, GUESS)
        return jnp.sum(found.T_target_source**2) + jnp.where(jnp.isfinite(found.rmse), found.rmse, 0)

    empty = TARGET.replace(mask=jnp.zeros(300, bool))
    for target in (TARGET, empty, SOURCE):
        assert np.isfinite(jax.grad(loss)(SOURCE.positions, target)).all()


@pytest.mark.parametrize("seed", range(3))
def test_two_samplings_of_a_street_are_aligned(seed: int) -> None:
    """The oracle is the motion with which the scans were made."""
    rng = np.random.default_rng(seed)
    T_world_a, T_world_b = motion(5, (1, -2, 0.1), 1), motion(rng.uniform(-180, 180), (-4, 3, 0), -1)
    a, b = seen_from(street(seed), T_world_a), seen_from(street(10 + seed), T_world_b)
    T_b_a = np.linalg.inv(T_world_b) @ T_world_a
    guess = T_b_a @ motion(rng.uniform(-4, 4), tuple(rng.uniform(-1, 1, 3)), 0.5)
    found = align_on_host(scan_surface(a), scan_surface(b), guess[None], OF_SCANS).T_target_source[0]
    difference = np.linalg.inv(T_b_a) @ found
    assert np.linalg.norm(difference[:3, 3]) < 0.02
    assert np.degrees(np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1))) < 0.1


def test_what_no_plane_holds_stays() -> None:
    """On a plain, only height and tilt are fixed."""
    rng = np.random.default_rng(0)
    plain = [np.column_stack([rng.uniform(-20, 20, (3000, 2)), np.full(3000, -2.0)]) for _ in range(2)]
    start = motion(3, (0.5, -0.4, 0.3))
    found = align_on_host(*map(scan_surface, plain), start[None], OF_SCANS).T_target_source[0]
    assert abs(found[2, 3]) < 0.01
    np.testing.assert_allclose(found[:2, 3], start[:2, 3], atol=0.05)


def test_starts_that_are_aligned_together_end_as_alone() -> None:
    a, b = scan_surface(street(6)), scan_surface(street(7))
    nowhere = motion(0, (500.0, 0, 0))
    starts = np.array([motion(2, (0.5, 0.3, 0)), nowhere, np.eye(4), motion(-60, (0, 2, 0))])
    together = align_on_host(a, b, starts, OF_SCANS).T_target_source
    for start, found in zip(starts, together, strict=True):
        alone = align_on_host(a, b, start[None], OF_SCANS).T_target_source[0]
        np.testing.assert_allclose(found, alone, atol=1e-9)
    np.testing.assert_array_equal(together[1], nowhere)
    np.testing.assert_allclose(together[0], together[2], atol=0.01)


def room(rng: np.random.Generator, num: int = 400) -> Surface:
    """Points on the walls of a planar room with a pillar, with their normals; of no two rooms is a point the same."""
    side, along = rng.integers(0, 5, num), rng.uniform(-1, 1, num)
    angle = np.where(side < 4, side * np.pi / 2, np.pi * along)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = np.stack([-normals[:, 1], normals[:, 0]], axis=1)
    points = np.where(side[:, None] < 4, 5 * normals + 5 * along[:, None] * across, [1, 2] + 0.7 * normals)
    return surface_of_elements(SurfaceElements(points, normals, np.ones(num), np.ones(num, bool)))


def elements_of(surface: Surface) -> SurfaceElements:
    return SurfaceElements(surface.points, surface.normals, surface.flatness, np.ones(len(surface.points), bool))


def planar(x: float, y: float, heading: float) -> np.ndarray:
    return np.array([[np.cos(heading), -np.sin(heading), x], [np.sin(heading), np.cos(heading), y], [0, 0, 1.0]])


def test_planar_scans_are_aligned_on_the_host_and_on_a_device() -> None:
    """The target is the room itself; the source sees other points of it from another pose."""
    rng, T = np.random.default_rng(0), planar(0.4, -0.3, 0.1)
    target, seen = room(rng), room(rng)
    inverse = np.linalg.inv(T)
    source = elements_of(seen).replace(
        positions=seen.points @ inverse[:2, :2].T + inverse[:2, 2], normals=seen.normals @ inverse[:2, :2].T
    )
    found = align_on_host(surface_of_elements(source), target, np.eye(3)[None], LEVELS)
    np.testing.assert_allclose(found.T_target_source[0], T, atol=2e-3)
    on_device = align(source, elements_of(target), np.eye(3))
    np.testing.assert_allclose(on_device.T_target_source, T, atol=2e-3)


def test_pairs_are_the_nearest_planes() -> None:
    """The oracle measures all distances."""
    a, b = (surface_of_elements(side) for side in (SOURCE, TARGET))
    found = nearest_planes(a, b, np.stack([GUESS, T_B_A]), 1.0, 100)
    for T, pairs in zip((GUESS, T_B_A), (found.take(row) for row in range(2)), strict=True):
        moved = a.points[a.samples[:100]] @ T[:3, :3].T + T[:3, 3]
        apart = np.linalg.norm(moved[:, None] - b.points, axis=2)
        rows = apart.argmin(axis=1)
        np.testing.assert_array_equal(pairs.is_paired, apart.min(axis=1) < 1.0)
        np.testing.assert_allclose(
            pairs.residuals, ((moved - b.points[rows]) * b.normals[rows]).sum(axis=1), atol=1e-12
        )
