"""Laws of the alignment of surface elements: the motion of the surfaces, masks, too few pairs."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.geometry import se3
from dpmjax.scans.element_alignment import align_elements
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


def test_two_views_of_one_surface_are_aligned() -> None:
    """The views share no point; the oracle is the motion with which they were made."""
    error_m, error_deg = error_m_deg(align_elements(SOURCE, TARGET, GUESS))
    assert error_m < 0.02
    assert error_deg < 0.1


def test_the_same_elements_are_aligned_to_rounding() -> None:
    T_b_a = motion(3, (0.3, -0.2, 0.1))
    moved = SurfaceElements(
        jnp.asarray(np.asarray(SOURCE.positions) @ T_b_a[:3, :3].T + T_b_a[:3, 3], jnp.float32),
        jnp.asarray(np.asarray(SOURCE.normals) @ T_b_a[:3, :3].T, jnp.float32),
        SOURCE.planarity,
        SOURCE.mask,
    )
    np.testing.assert_allclose(align_elements(SOURCE, moved, np.eye(4)), T_b_a, atol=2e-5)


def test_the_motion_back_is_the_inverse() -> None:
    there = align_elements(SOURCE, TARGET, GUESS)
    back = align_elements(TARGET, SOURCE, np.linalg.inv(GUESS))
    np.testing.assert_allclose(there @ back, np.eye(4), atol=2e-3)


def test_masked_and_uneven_elements_count_for_nothing() -> None:
    junk = SurfaceElements(
        jnp.full((40, 3), jnp.nan), jnp.full((40, 3), jnp.nan), jnp.full(40, jnp.nan), jnp.zeros(40, bool)
    )
    uneven = elements(7, T_WORLD_A, 40).replace(planarity=jnp.full(40, 0.05))
    padded = jax.tree.map(lambda *parts: jnp.concatenate(parts), SOURCE, junk, uneven)
    expected, found = align_elements(SOURCE, TARGET, GUESS), align_elements(padded, TARGET, GUESS)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("num", [0, 5])
def test_too_few_pairs_leave_the_motion(num: int) -> None:
    few, fewer = (side.replace(mask=jnp.arange(300) < num) for side in (SOURCE, TARGET))
    np.testing.assert_array_equal(align_elements(few, fewer, GUESS), GUESS)


def test_what_no_plane_holds_stays() -> None:
    """On a plain, only height and tilt are fixed."""
    rng = np.random.default_rng(0)

    def plain() -> SurfaceElements:
        positions = np.column_stack([rng.uniform(-20, 20, (300, 2)), np.full(300, -2.0)])
        up = np.tile([0.0, 0.0, 1.0], (300, 1))
        return SurfaceElements(jnp.asarray(positions), jnp.asarray(up), jnp.ones(300), jnp.ones(300, bool))

    start = motion(3, (0.5, -0.4, 0.3))
    found = align_elements(plain(), plain(), start)
    np.testing.assert_allclose(found[:2, 3], start[:2, 3], atol=2e-3)
    np.testing.assert_allclose(found[2, 3], 0, atol=1e-4)
