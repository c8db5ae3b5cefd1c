"""Straight pieces of wall in organised planar scans: one line with a normal for each beam, honest under range noise.

Two neighbouring beams give the exact normal of a noise-free wall and nonsense as soon as the noise is as large as the
distance between the beams. So several windows of neighbouring beams compete for each beam, centred on it and to either
side (a beam beside a corner sees only one of the two walls). The widest window that is still straight up to the noise
wins; the noise itself is measured from the scans first.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from dpmjax.types import ScanSet

# A run of beams counts as straight if it bends by less than this part of its length (0.03 degrees).
_BEND = 5e-4
# The noise is a median over at most so many beams: a sort of millions would take longer than all the rest.
_NOISE_SAMPLES = 65536


@flax.struct.dataclass
class LineScans:
    """Planar scans (or one) with a line fitted at every beam, in the sensor frame of each scan.

    Attributes:
        points: measured beam end points.
        normals: unit normals of the fitted lines, turned towards the sensor; zero where `mask` is False.
        centroids: a point on each fitted line: the mean of the beams that it was fitted to.
        mask: True where the beam lies on a straight piece (valid, not a corner, not alone).
        noise: standard deviation of the range noise that was measured in all scans together, in the unit of the points.
    """

    points: Float[Array, "*n b 2"]
    normals: Float[Array, "*n b 2"]
    centroids: Float[Array, "*n b 2"]
    mask: Bool[Array, "*n b"]
    noise: Float[Array, "*n"]


def _cross(a: Float[Array, "... 2"], b: Float[Array, "... 2"]) -> Float[Array, "..."]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


@jax.jit
def range_noise(scans: ScanSet) -> Float[Array, ""]:
    """Standard deviation of the range noise, measured from the scans alone.

    The beam between two others that hit the same straight wall must end on their chord. The median over all beams of
    the distance along the beam to that chord is not disturbed by corners and depth jumps, which are few.

    Args:
        scans: organised planar scans (n, b, 2).

    Returns:
        The noise in the unit of the points; about rounding error for noise-free scans, 0 when no beam has two
        neighbours.
    """
    before, here, after = scans.points[:, :-2], scans.points[:, 1:-1], scans.points[:, 2:]
    usable = scans.mask[:, :-2] & scans.mask[:, 1:-1] & scans.mask[:, 2:]
    reach = jnp.linalg.norm(here, axis=-1)
    direction = here / jnp.where(usable, reach, 1.0)[..., None]
    chord = after - before
    slope = _cross(direction, chord)
    along = _cross(before, chord) / jnp.where(jnp.abs(slope) > 1e-9, slope, 1.0)
    usable &= (jnp.abs(slope) > 1e-9) & (along > 0)
    deviation = jnp.where(usable, jnp.abs(reach - along), jnp.nan).reshape(-1)
    deviation = jnp.nanmedian(deviation[:: max(1, deviation.size // _NOISE_SAMPLES)])
    # A mean of two ends has variance 1/2, so the deviation has 3/2 of that of one beam; 1.4826: median to sigma.
    return jnp.nan_to_num(1.4826 * deviation / jnp.sqrt(1.5))


@flax.struct.dataclass
class _Moments:
    """First and second moments of a run of beams: (..., b) arrays, one run for each beam that it starts at."""

    count: float = flax.struct.field(pytree_node=False)
    mean: Float[Array, "... b 2"]
    xx: Float[Array, "... b"]
    xy: Float[Array, "... b"]
    yy: Float[Array, "... b"]
    is_complete: Bool[Array, "... b"]


def _shift(values: Array, offset: int, axis: int) -> Array:
    """Entry i becomes entry i + offset; what would come from outside repeats the border."""
    size = values.shape[axis]
    kept = jax.lax.slice_in_dim(values, max(offset, 0), size + min(offset, 0), axis=axis)
    border = jax.lax.slice_in_dim(values, size - 1 if offset > 0 else 0, size if offset > 0 else 1, axis=axis)
    filling = jnp.repeat(border, abs(offset), axis=axis)
    return jnp.concatenate([kept, filling] if offset > 0 else [filling, kept], axis=axis)


def _start_at(run: _Moments, offset: int) -> _Moments:
    """The runs that start `offset` beams later; incomplete where that is outside the scan."""
    size = run.xx.shape[-1]
    start = np.arange(size) + offset
    moved = jax.tree.map(lambda x: _shift(x, offset, axis=run.xx.ndim - 1), run)
    return dataclasses.replace(moved, is_complete=moved.is_complete & ((start >= 0) & (start < size)))


def _join(first: _Moments, second: _Moments) -> _Moments:
    """Moments of two disjoint runs together; stable, because only the difference of their means enters."""
    count = first.count + second.count
    step = second.mean - first.mean
    weight = first.count * second.count / count
    return _Moments(
        count=count,
        mean=first.mean + step * (second.count / count),
        xx=first.xx + second.xx + weight * step[..., 0] ** 2,
        xy=first.xy + second.xy + weight * step[..., 0] * step[..., 1],
        yy=first.yy + second.yy + weight * step[..., 1] ** 2,
        is_complete=first.is_complete & second.is_complete,
    )


def _runs(scans: ScanSet, num_doublings: int) -> list[_Moments]:
    """Runs of 3, 4, 8, 16 ... beams, each run joined from two shorter ones."""
    nothing = jnp.zeros(scans.mask.shape, scans.points.dtype)
    one = _Moments(count=1.0, mean=scans.points, xx=nothing, xy=nothing, yy=nothing, is_complete=scans.mask)
    two = _join(one, _start_at(one, 1))
    runs = [_join(two, _start_at(one, 2))]
    for k in range(1, num_doublings + 1):
        two = _join(two, _start_at(two, 2**k))
        runs.append(two)
    return runs


def _line_of(run: _Moments, noise: Float[Array, ""]) -> tuple[Float[Array, "... b 2"], Float[Array, "... b"]]:
    """Direction of the line through each run, and the error of that direction in radians: infinite if not straight."""
    half_difference, half_sum = 0.5 * (run.xx - run.yy), 0.5 * (run.xx + run.yy)
    radius = jnp.sqrt(half_difference**2 + run.xy**2)
    along, across = half_sum + radius, jnp.maximum(half_sum - radius, 0.0)
    angle = 0.5 * jnp.arctan2(run.xy, half_difference)
    deviation = jnp.sqrt(across / (run.count - 2.0))
    length = jnp.sqrt(along / run.count)
    allowed = noise * (1.0 + 2.0 / run.count**0.5) + _BEND * length
    is_straight = run.is_complete & (deviation <= allowed) & (along > 4.0 * across)
    error = jnp.maximum(deviation, noise) / jnp.sqrt(jnp.maximum(along, 1e-20))
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1), jnp.where(is_straight, error, jnp.inf)


@partial(jax.jit, static_argnames="num_doublings")
def fit_lines(scans: ScanSet, *, num_doublings: int = 4) -> LineScans:
    """Fits a line at every beam of organised planar scans.

    Args:
        scans: planar scans whose neighbouring beams are neighbours in the world, (n, b, 2).
        num_doublings: the widest run of beams that competes has 2 ** (num_doublings + 1) beams.

    Returns:
        LineScans; a beam without any straight run of its own is masked.
    """
    # What is masked may hold anything; zero times NaN would be NaN later on.
    scans = ScanSet(points=jnp.where(scans.mask[..., None], scans.points, 0.0), mask=scans.mask)
    # Rounding of float32 coordinates looks like noise of this size; below it "straight" would mean nothing.
    reach = jnp.max(jnp.where(scans.mask, jnp.linalg.norm(scans.points, axis=-1), 0.0))
    noise = jnp.maximum(range_noise(scans), 1e-6 * reach)
    tangent, centroid = jnp.zeros_like(scans.points), scans.points
    error = jnp.full(scans.mask.shape, jnp.inf, scans.points.dtype)
    for run in _runs(scans, num_doublings):
        run_tangent, run_error = _line_of(run, noise)
        width = int(run.count)
        for start in (0, 1 - width, -(width // 2)):
            here = _shift(run_error, start, axis=1)
            index = np.arange(scans.mask.shape[1]) + start
            here = jnp.where((index >= 0) & (index < scans.mask.shape[1]), here, jnp.inf)
            better = here < error
            error = jnp.where(better, here, error)
            tangent = jnp.where(better[..., None], _shift(run_tangent, start, axis=1), tangent)
            centroid = jnp.where(better[..., None], _shift(run.mean, start, axis=1), centroid)
    mask = jnp.isfinite(error)
    normal = jnp.stack([-tangent[..., 1], tangent[..., 0]], -1)
    towards_sensor = jnp.where((normal * centroid).sum(-1, keepdims=True) > 0, -normal, normal)
    return LineScans(
        points=scans.points,
        normals=towards_sensor,
        centroids=centroid,
        mask=mask,
        noise=jnp.broadcast_to(noise, mask.shape[:1]),
    )


@jax.jit
def sort_by_angle(scans: ScanSet) -> ScanSet:
    """The same scans with their points in the order of the angle at which the sensor saw them; masked ones last."""
    angle = jnp.where(scans.mask, jnp.arctan2(scans.points[..., 1], scans.points[..., 0]), jnp.inf)
    order = jnp.argsort(angle, axis=-1)
    return ScanSet(
        points=jnp.take_along_axis(scans.points, order[..., None], axis=1),
        mask=jnp.take_along_axis(scans.mask, order, axis=1),
    )
