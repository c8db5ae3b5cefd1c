"""Planar scans with a line fitted at each beam, and the lengths that settings refer to.

All lengths in settings are in typical ranges of the scans, so one set of settings serves pixels, rooms and streets. The
typical range is the range that nine in ten beams on a line stay below (`dpmjax.geometry.sampling.typical_range`).

A line with a normal is fitted at each beam. Two neighbouring beams give the exact normal of a noise-free wall, but a
random one as soon as the noise is as large as the distance between the beams. So lines are fitted to several windows of
neighbouring beams. These are centred on the beam or lie on either side of it, because a beam beside a corner lies on
one of two walls. Among the windows that are straight up to the noise, the one with the least directional error is kept.
The noise is estimated from the scans.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from dpmjax.checks import as_mask
from dpmjax.geometry.sampling import typical_range
from dpmjax.sequences import has_angular_order
from dpmjax.types import AnyArray, ScanSet

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Booleans = NDArray[np.bool_]
# Rows (p,) of the sources and of the targets of pairs of scans.
Pairs = tuple[Indices, Indices]

# A run of beams counts as straight if it bends by less than this part of its length (0.03 degrees).
_BEND = 5e-4
# Approximate number of beams in the median of the noise: a sort of millions would take longer than all other steps.
_NOISE_SAMPLES = 65536
# The widest run of beams that competes has 2 ** (this + 1) beams.
_NUM_DOUBLINGS = 4


class Tolerances(NamedTuple):
    """Tolerances for the comparison of hits of two scans, in the unit of the points.

    Attributes:
        match: standard deviation of a hit about the surface that it belongs to.
        contradict: least distance in front of a surface at which a hit contradicts the surface.
        jump: least difference of the ranges of two neighbouring beams that end on two surfaces.
    """

    match: float | Float[Array, ""]
    contradict: float | Float[Array, ""]
    jump: float | Float[Array, ""]

    @classmethod
    def of(cls, match: float | Float[Array, ""], contradict: float | Float[Array, ""]) -> Tolerances:
        """Makes tolerances with the usual jump."""
        return cls(match, contradict, 10.0 * match)


class PlanarScans(flax.struct.PyTreeNode):
    """Planar scans with a line fitted at every beam, each in its own sensor frame. Made by `planar_scans`.

    Attributes:
        points: measured beam end points, in the order of their angles; zero where `mask` is False.
        mask: True for valid beams.
        normals: unit normals of the fitted lines, turned towards the sensor; zero without a line.
        centroids: a point on each fitted line: the mean of its beams.
        is_on_line: True where the beam lies on a straight piece (valid, not a corner, not alone).
        noises: `noise`, repeated for each scan, so that rows can be taken in traced code.
        typical_ranges: `typical_range`, repeated likewise.
        is_ordered: True where neighbours in the array are neighbours in time.
    """

    points: Float[Array, "*n b 2"]
    mask: Bool[Array, "*n b"]
    normals: Float[Array, "*n b 2"]
    centroids: Float[Array, "*n b 2"]
    is_on_line: Bool[Array, "*n b"]
    noises: Float[Array, "*n"]
    typical_ranges: Float[Array, "*n"]
    is_ordered: bool = flax.struct.field(pytree_node=False, default=True)

    def __len__(self) -> int:
        return self.mask.shape[0]

    @property
    def noise(self) -> float:
        """Standard deviation of the range noise of all scans together, in the unit of the points."""
        return float(self.noises.reshape(-1)[0])

    @property
    def typical_range(self) -> float:
        """Range that nine in ten beams on a line stay below, median over the scans: the unit of all settings."""
        return float(self.typical_ranges.reshape(-1)[0])

    @property
    def tolerances(self) -> Tolerances:
        """Tolerances of these scans, from the typical range or from the noise, the larger ones."""
        reach, noise = self.typical_range, self.noise
        return Tolerances.of(match=max(0.006 * reach, 0.5 * noise), contradict=max(0.018 * reach, 5.0 * noise))

    def take(self, rows: Any) -> PlanarScans:
        """Returns the scans of these rows (an index, a slice, a list or an array), without an order in time."""
        index = np.array(rows) if isinstance(rows, list) else rows
        return replace(jax.tree.map(lambda x: x[index], self), is_ordered=False)

    def thin(self, stride: int) -> PlanarScans:
        """Returns the same scans with every `stride`-th beam."""
        kept = (slice(None),) * (self.mask.ndim - 1) + (slice(None, None, stride),)
        names = ("points", "mask", "normals", "centroids", "is_on_line")
        return replace(self, **{name: getattr(self, name)[kept] for name in names})


@jax.enable_x64(False)  # float32, also where JAX has 64 bits
def planar_scans(points: AnyArray | ScanSet, mask: AnyArray | None = None, *, is_ordered: bool = True) -> PlanarScans:
    """Prepares planar scans for registration: fits lines, measures noise and typical range.

    Args:
        points: (n, b, 2) beam end points in the frame of their sensor, any unit; or a ScanSet. Beams that are not in
            the order of their angles are sorted, each scan with its invalid beams last.
        mask: (n, b) True for valid beams; None: all are valid, or the mask of the ScanSet.
        is_ordered: True where neighbours in the array are neighbours in time.

    Returns:
        PlanarScans.

    Raises:
        ValueError: wrong shapes, no scan, fewer than three beams, no valid beam, or coordinates that are not finite
            where the mask is True.
    """
    if isinstance(points, ScanSet):
        mask, points = points.mask if mask is None else mask, points.points
    values = np.asarray(points, np.float32)
    if values.ndim != 3 or values.shape[2] != 2 or len(values) < 1 or values.shape[1] < 3:
        raise ValueError(f"points: expected shape (n, b, 2) with at least one scan and three beams, got {values.shape}")
    valid = as_mask("mask", mask, values.shape[:2], np)
    if not valid.any():
        raise ValueError("mask: expected at least one valid beam, got none")
    if not np.isfinite(values[valid]).all():
        raise ValueError("points: expected finite coordinates where the mask is True")
    # Masked values may be NaN, and zero times NaN is NaN.
    values = np.where(valid[..., None], values, np.float32(0.0))
    if not has_angular_order(values, valid):
        angle = np.where(valid, np.arctan2(values[..., 1], values[..., 0]), np.inf)
        order = np.argsort(angle, axis=1, kind="stable")
        values = np.take_along_axis(values, order[..., None], axis=1)
        valid = np.take_along_axis(valid, order, axis=1)
    fitted = _fit_lines(ScanSet(points=jnp.asarray(values), mask=jnp.asarray(valid)))
    # Beams on lines end on walls; with all beams, people and clutter would change the unit.
    is_used = np.asarray(fitted.is_on_line if fitted.is_on_line.any() else fitted.mask)
    length = jnp.full(len(values), typical_range(np.asarray(fitted.points), is_used), jnp.float32)
    return replace(fitted, typical_ranges=length, is_ordered=is_ordered)


def batches(count: int, size: int) -> Iterator[tuple[slice, Indices]]:
    """Splits rows 0 to `count` into batches of one shape; the last one is padded with repetitions.

    Args:
        count: number of rows.
        size: number of rows of a batch.

    Yields:
        The slice of a batch, and its rows (size,): those of the slice first, then their repetitions.
    """
    for start in range(0, count, size):
        stop = min(start + size, count)
        yield slice(start, stop), np.resize(np.arange(start, stop), size)


def rounded_up(count: int, least: int, largest: int) -> int:
    """Rounds a number of rows up so that few shapes compile.

    Args:
        count: number of rows.
        least: least result, a power of two.
        largest: largest power of two; beyond it, the result is a multiple of it.

    Returns:
        The padded number.
    """
    if count > largest:
        return largest * -(-count // largest)
    return max(least, 1 << max(count - 1, 0).bit_length())


def spread_evenly(num_scans: int, count: int) -> Indices:
    """Returns up to `count` evenly spaced rows, the first and the last among them."""
    return np.unique(np.round(np.linspace(0, num_scans - 1, min(num_scans, count))).astype(np.int64))


def _cross(a: Float[Array, "... 2"], b: Float[Array, "... 2"]) -> Float[Array, "..."]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


@jax.jit
def range_noise(scans: ScanSet) -> Float[Array, ""]:
    """Estimates the standard deviation of the range noise from the scans alone.

    A beam between two others that hit the same straight wall must end on their chord. The noise follows from the median
    over all beams of the distance along the beam to that chord, which is robust to corners and depth jumps.

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
    """First and second moments of runs of beams: (..., b) arrays, one run for each first beam."""

    count: float = flax.struct.field(pytree_node=False)
    mean: Float[Array, "... b 2"]
    scatter: Float[Array, "... b 2 2"]
    is_complete: Bool[Array, "... b"]


def _shift(values: Any, offset: int) -> tuple[Any, Booleans]:
    """Shifts arrays (n, b, ...) so that beam i is beam i + offset; the mask (b,) is True where this is in the scan."""
    moved = jax.tree.map(lambda x: jnp.roll(x, -offset, axis=1), values)
    size = jax.tree.leaves(values)[0].shape[1]
    beam = np.arange(size) + offset
    return moved, (beam >= 0) & (beam < size)


def _join(first: _Moments, second: _Moments, offset: int) -> _Moments:
    """Joins the moments of disjoint runs, the second ones `offset` beams later; incomplete outside the scan."""
    # Stable, because only the difference of the means enters.
    second, is_inside = _shift(second, offset)
    count = first.count + second.count
    step = second.mean - first.mean
    spread = (first.count * second.count / count) * step[..., :, None] * step[..., None, :]
    return _Moments(
        count=count,
        mean=first.mean + step * (second.count / count),
        scatter=first.scatter + second.scatter + spread,
        is_complete=first.is_complete & second.is_complete & is_inside,
    )


def _runs(scans: ScanSet) -> list[_Moments]:
    """Returns runs of 3, 4, 8, 16 and further powers of two beams, each run joined from two shorter ones."""
    one = _Moments(1.0, scans.points, jnp.zeros((*scans.mask.shape, 2, 2)), scans.mask)
    two = _join(one, one, 1)
    runs = [_join(two, one, 2)]
    for k in range(1, _NUM_DOUBLINGS + 1):
        two = _join(two, two, 2**k)
        runs.append(two)
    return runs


def _line_of(run: _Moments, noise: Float[Array, ""]) -> tuple[Float[Array, "... b 2"], Float[Array, "... b"]]:
    """Computes the direction of the line through each run, and its error in radians: infinite if not straight."""
    xx, xy, yy = run.scatter[..., 0, 0], run.scatter[..., 0, 1], run.scatter[..., 1, 1]
    half_difference, half_sum = 0.5 * (xx - yy), 0.5 * (xx + yy)
    radius = jnp.sqrt(half_difference**2 + xy**2)
    along, across = half_sum + radius, jnp.maximum(half_sum - radius, 0.0)
    angle = 0.5 * jnp.arctan2(xy, half_difference)
    deviation = jnp.sqrt(across / (run.count - 2.0))
    length = jnp.sqrt(along / run.count)
    allowed = noise * (1.0 + 2.0 / run.count**0.5) + _BEND * length
    is_straight = run.is_complete & (deviation <= allowed) & (along > 4.0 * across)
    error = jnp.maximum(deviation, noise) / jnp.sqrt(jnp.maximum(along, 1e-20))
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1), jnp.where(is_straight, error, jnp.inf)


@jax.jit
def _fit_lines(scans: ScanSet) -> PlanarScans:
    """Fits a line at each beam with a straight run; typical ranges are set to 1."""
    # Rounding of float32 coordinates looks like noise of this size, a lower bound of the noise.
    reach = jnp.max(jnp.where(scans.mask, jnp.linalg.norm(scans.points, axis=-1), 0.0))
    noise = jnp.maximum(range_noise(scans), 1e-6 * reach)
    tangent, centroid = jnp.zeros_like(scans.points), scans.points
    error = jnp.full(scans.mask.shape, jnp.inf, scans.points.dtype)
    for run in _runs(scans):
        width = int(run.count)
        for start in (0, 1 - width, -(width // 2)):
            found, is_inside = _shift((*_line_of(run, noise), run.mean), start)
            better = is_inside & (found[1] < error)
            error = jnp.where(better, found[1], error)
            tangent = jnp.where(better[..., None], found[0], tangent)
            centroid = jnp.where(better[..., None], found[2], centroid)
    is_on_line = jnp.isfinite(error)
    normal = jnp.stack([-tangent[..., 1], tangent[..., 0]], -1)
    towards_sensor = jnp.where((normal * centroid).sum(-1, keepdims=True) > 0, -normal, normal)
    noises, ones = jnp.full(len(scans.mask), noise), jnp.ones(len(scans.mask))
    return PlanarScans(scans.points, scans.mask, towards_sensor, centroid, is_on_line, noises, ones)
