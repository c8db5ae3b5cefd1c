"""Do two scans contradict each other? A beam that passes through what the other scan has hit says so."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dpmjax.types import ScanSet

# GPUs multiply in TF32 unless told otherwise: no angle of two degrees could be told from none.
_matmul = partial(jnp.matmul, precision="highest")

# A point counts as seen by a beam that points at most so far past it (cosine of 2 degrees).
_BEAM_COSINE = 0.99939


class Visibility(NamedTuple):
    """Counts of points of both scans in the view of the other one.

    Attributes:
        num_seen: points in the field of view of the other scan.
        num_matched: those that lie where the other scan has measured.
        num_crossed: those that a beam of the other scan has passed through.
    """

    num_seen: Float[Array, ""]
    num_matched: Float[Array, ""]
    num_crossed: Float[Array, ""]


def _view(
    points: Float[Array, "b 2"],
    mask: Bool[Array, " b"],
    beams: Float[Array, "c 2"],
    valid: Bool[Array, " c"],
    tolerance: Array,
) -> Visibility:
    """Points (in the frame of the viewing scan) against its beams."""
    reach = jnp.where(valid, jnp.linalg.norm(beams, axis=-1), 0.0)
    directions = beams / jnp.maximum(reach, 1e-9)[:, None]
    distance = jnp.linalg.norm(points, axis=-1)
    cosines = jnp.where(valid, _matmul(points / jnp.maximum(distance, 1e-9)[:, None], directions.T), -2.0)
    beam = cosines.argmax(-1)
    seen = mask & (cosines.max(-1) > _BEAM_COSINE)
    # Between two beams the surface may be anywhere between their two ranges.
    last = reach.shape[0] - 1
    around = jnp.stack([reach[jnp.clip(beam + k, 0, last)] for k in (-1, 0, 1)])
    crossed = seen & (distance < around.min(0) - tolerance)
    matched = seen & ~crossed & (distance <= around.max(0) + tolerance)
    return Visibility(*(x.sum().astype(points.dtype) for x in (seen, matched, crossed)))


@jax.jit
def compare_views(
    source: ScanSet, target: ScanSet, poses: Float[Array, "p 3"], tolerance: Float[Array, ""]
) -> Visibility:
    """Mutual visibility of p pairs of planar scans.

    Args:
        source: p scans.
        target: p scans.
        poses: x, y, heading of T_target_source.
        tolerance: how far in front of a surface a point must be to count as crossed, unit of the points.

    Returns:
        Visibility with arrays (p,), both directions added.
    """

    def compare(source: ScanSet, target: ScanSet, pose: Float[Array, " 3"]) -> Visibility:
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        rotation = jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
        there = _view(_matmul(source.points, rotation.T) + pose[:2], source.mask, target.points, target.mask, tolerance)
        back = _view(_matmul(target.points - pose[:2], rotation), target.mask, source.points, source.mask, tolerance)
        return Visibility(*(a + b for a, b in zip(there, back, strict=True)))

    return jax.lax.map(lambda x: compare(*x), (source, target, poses), batch_size=32)
