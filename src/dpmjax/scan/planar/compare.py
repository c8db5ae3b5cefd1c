"""Comparison of pairs of scans at relative poses: hits of one scan match or contradict the view of its partner.

A hit of one scan is a match if it lies on the surface that its partner has seen. It is a contradiction in the free
space of the partner, and does not count in an unobserved region. The score of two scans is the agreement of their
visible beams.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dpmjax.geometry import se2
from dpmjax.kept_programs import kept_jit
from dpmjax.scan.planar.record import Booleans, Floats, Indices, PlanarScans, Tolerances, Views, batches
from dpmjax.types import AnyArray

# Odd minimax polynomial of the arctangent on [0, 1], the highest power first.
_ARCTANGENT = (-0.01171913, 0.05264734, -0.11642647, 0.19354037, -0.33262283, 0.99997722)
# Number of matched beams that outweigh a contradicting one; share of visible beams that noise makes contradictory.
_CONTRADICTION_WEIGHT, _NOISY_SHARE = 2.5, 0.02
# Regularisation of the score where few beams are visible, as a share of all beams.
LEAST_VISIBLE = 0.3
# A step with a lower score is weak.
WEAK_SCORE = 0.25
# Poses that are compared at a time: few shapes, so that few programs compile.
_BATCHES = (256, 2048)


class ViewComparison(NamedTuple):
    """Beams of two scans that match or contradict each other at a relative pose, both directions added.

    Attributes:
        matched: hits on the surface of the partner scan, on the side that faces it; near misses count as fractions.
        contradicted: hits in the free space of the partner scan.
        visible: hits at bearings that the partner scan has measured, not farther than its surface.
    """

    matched: Float[AnyArray, "..."]
    contradicted: Float[AnyArray, "..."]
    visible: Float[AnyArray, "..."]


def _bearing(x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
    """Computes the bearing in [0, 2 pi] to 2e-6 radians by a polynomial, which is quicker than an exact arctangent."""
    width, height = jnp.abs(x), jnp.abs(y)
    slope = jnp.minimum(width, height) / jnp.maximum(jnp.maximum(width, height), 1e-12)
    squared, octant = slope**2, jnp.zeros_like(slope)
    for factor in _ARCTANGENT:
        octant = octant * squared + factor
    octant = octant * slope
    quadrant = jnp.where(height > width, 0.5 * jnp.pi - octant, octant)
    half = jnp.where(x < 0, jnp.pi - quadrant, quadrant)
    return jnp.where(y < 0, 2 * jnp.pi - half, half)


@kept_jit("stride")
def _look(
    views: Views, pairs: tuple[Int[Array, " p"], Int[Array, " p"]], poses: Float[Array, "p h 3"],
    tolerances: Tolerances, *, stride: int,
) -> tuple[Float[Array, "p h"], ...]:  # fmt: skip
    """Compares the hits of scans with the views of others; `pairs` are both rows, `poses` T_seen_viewer."""
    (seen, viewer), beam = (rows[:, None, None] for rows in pairs), jnp.arange(0, views.mask.shape[1], stride)
    points, normals = views.points[seen, beam], views.normals[seen, beam]
    x, y = points[..., 0] - poses[..., 0, None], points[..., 1] - poses[..., 1, None]
    distance = jnp.sqrt(x**2 + y**2)
    count = views.surface.shape[1]
    turn = (_bearing(x, y) - poses[..., 2, None]) / (2 * jnp.pi)
    k = jnp.clip(((turn - jnp.floor(turn)) * count).astype(jnp.int32), 0, count - 1)
    near, far, slant = views.near[viewer, k], views.far[viewer, k], views.slant[viewer, k]
    to_edge = jnp.minimum(jnp.abs(distance - near), jnp.abs(distance - far))
    is_jump = far - near > tolerances.jump
    off = jnp.where(is_jump, to_edge, jnp.abs(distance - views.surface[viewer, k])) * slant
    counts = views.mask[seen, beam] & views.is_seen[viewer, k]
    # Largest sine by which a visible surface is turned away from the viewer.
    # A thin wall has two sides, and two rooms that share it must not match through it.
    is_facing = x * normals[..., 0] + y * normals[..., 1] <= 0.1 * distance
    matched = jnp.where(counts & is_facing, jnp.exp(-0.5 * (off / tolerances.match) ** 2), 0.0)
    contradicted = counts & (distance < near - tolerances.contradict / slant)
    visible = counts & (distance < far + tolerances.contradict / slant)
    # One reduction of all three sums, so that their common terms are computed once.
    terms = matched, contradicted.astype(jnp.float32), visible.astype(jnp.float32)
    zeros = (jnp.zeros((), jnp.float32),) * 3
    return tuple(jax.lax.reduce(terms, zeros, lambda a, b: tuple(x + y for x, y in zip(a, b, strict=True)), (2,)))


def compare_pairs(
    scans: PlanarScans, source: Indices, target: Indices, poses: Floats,
    *, stride: int = 2, tolerances: Tolerances | None = None,
) -> ViewComparison:  # fmt: skip
    """Compares p pairs of scans at given relative poses.

    Args:
        scans: n scans.
        source: (p,) rows.
        target: (p,) rows.
        poses: (p, 3) T_target_source, or (p, h, 3), several of each pair.
        stride: every `stride`-th beam is compared.
        tolerances: None: those of the scans.

    Returns:
        ViewComparison with float64 arrays (p,) or (p, h) on the host.
    """
    views, tolerances = scans.views, tolerances or scans.tolerances
    several = poses if poses.ndim == 3 else poses[:, None]
    result = np.zeros((3, *several.shape[:2]))
    num_poses = several.shape[1]
    size = _BATCHES[0] if num_poses == 1 and len(source) <= _BATCHES[0] else _BATCHES[1] // num_poses
    for part, rows in batches(len(source), size):
        ends, T_target_source = np.stack([source[rows], target[rows]]).astype(np.int32), several[rows]
        for seen, T in ((ends, se2.inverse(T_target_source)), (ends[::-1], T_target_source)):
            sums = _look(views, tuple(seen), T.astype(np.float32), tolerances, stride=stride)
            result[:, part] += np.asarray(sums)[:, : part.stop - part.start]
    return ViewComparison(*(stride * result.reshape(3, *poses.shape[:-1])))


def contradicted_share(scans: PlanarScans, source: Indices, target: Indices, poses: Floats) -> Floats:
    """Computes the contradicting share (p,) of the visible beams of two scans; the divisor is at least 20 beams."""
    views = compare_pairs(scans, source, target, poses)
    return np.asarray(views.contradicted / np.maximum(views.visible, 20.0))


def find_evidence(scans: PlanarScans, source: Indices, target: Indices, poses: Floats) -> tuple[Floats, Floats]:
    """Compares pairs of scans at T_target_source (p, 3) or (p, h, 3).

    Args:
        scans: n scans.
        source: (p,) rows.
        target: (p,) rows.
        poses: T_target_source.

    Returns:
        The agreement (matched less weighted contradicting beams), and the beams that end in the visible region of their
        partner scan. Both are shares of all beams of both scans.
    """
    views = compare_pairs(scans, source, target, poses, stride=4)
    contradicted = np.maximum(views.contradicted - _NOISY_SHARE * views.visible, 0.0)
    num_beams = scans.mask.sum(1)
    beams = np.maximum(num_beams[source] + num_beams[target], 1).reshape(-1, *(1,) * (poses.ndim - 2))
    return np.asarray((views.matched - _CONTRADICTION_WEIGHT * contradicted) / beams), np.asarray(views.visible / beams)


def pair_scores(scans: PlanarScans, source: Indices, target: Indices, poses: Floats) -> Floats:
    """Computes the scores (p,) of pairs at T_target_source, at most 1: the agreement of the visible beams."""
    agreement, visible = find_evidence(scans, source, target, poses)
    return agreement / (visible + LEAST_VISIBLE)


def weak_steps(scans: PlanarScans, poses: Floats, rows: Indices) -> Booleans:
    """Returns True for each of the k - 1 steps whose scan-match score is below `WEAK_SCORE`."""
    before, after = rows[:-1], rows[1:]
    return pair_scores(scans, after, before, se2.relative(poses[before], poses[after])) < WEAK_SCORE
