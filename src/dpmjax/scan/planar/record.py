"""Planar scans with a line fitted at each beam, and the lengths that settings refer to.

All lengths in settings are in typical ranges of the scans, so one set of settings serves pixels, rooms and streets. The
typical range is the range that nine in ten beams on a line stay below (`dpmjax.geometry.sampling.typical_range`).

A line with a normal is fitted at each beam. Two neighbouring beams give the exact normal of a noise-free wall. If the
noise is as large as the distance between the beams, their normal is random. So lines are fitted to several windows of
neighbouring beams. The windows are centred on the beam or lie on either side of it, because a beam beside a corner lies
on one of two walls. Of the windows that are straight up to the noise, the one with the least directional error is kept.
The noise is estimated from the scans.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
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

# Numbers of beams of the runs that compete.
_WIDTHS = (3, 4, 8, 16, 32)
# Scans that lines are fitted to at a time, few enough for the cache.
_BLOCK = 256
# Least cosine of the slant of a surface. Surfaces with a smaller cosine do not correct the range of a beam.
_MIN_COSINE = 0.3
_UNKNOWN_COSINE = 0.7


class Tolerances(NamedTuple):
    """Tolerances for the comparison of hits of two scans, in the unit of the points.

    Attributes:
        match: standard deviation of a hit about its surface.
        contradict: least distance in front of a surface at which a hit contradicts the surface.
        jump: least difference of the ranges of two neighbouring beams that end on two surfaces.
    """

    match: float
    contradict: float
    jump: float

    @classmethod
    def of(cls, match: float, contradict: float) -> Tolerances:
        """Makes tolerances with the usual jump."""
        return cls(match, contradict, 10.0 * match)


class Lines(NamedTuple):
    """Lines of scans, the input of alignments: arrays (n, b, ...) of NumPy or of JAX.

    Attributes:
        points: beam end points.
        normals: unit normals of the fitted lines.
        centroids: a point on each fitted line.
        mask: True where the beam lies on a line.
    """

    points: Float[AnyArray, "*n b 2"]
    normals: Float[AnyArray, "*n b 2"]
    centroids: Float[AnyArray, "*n b 2"]
    mask: Bool[AnyArray, "*n b"]


class Views(NamedTuple):
    """Views of n scans over c bearings; bearing k is 2 pi (k + 0.5) / c counter-clockwise from the scan's x axis.

    The arrays have more rows than there are scans, so that few programs compile.

    Attributes:
        points: hits, moved along their beams onto the fitted lines.
        normals: unit normals at the hits; zero without a line.
        mask: True for valid hits.
        surface: range of the surface, on the chord between the two beams around the bearing.
        near: the smaller range of the two beams; nearer points are free.
        far: the larger range of the two beams; farther points are hidden.
        slant: cosine of the angle between beam and surface.
        is_seen: False for a bearing that no two neighbouring beams enclose.
    """

    points: Float[Array, "n b 2"]
    normals: Float[Array, "n b 2"]
    mask: Bool[Array, "n b"]
    surface: Float[Array, "n c"]
    near: Float[Array, "n c"]
    far: Float[Array, "n c"]
    slant: Float[Array, "n c"]
    is_seen: Bool[Array, "n c"]


@dataclass(frozen=True, eq=False)
class PlanarScans:
    """Planar scans with a line fitted at every beam, each in its own sensor frame, on the host. By `planar_scans`.

    Attributes:
        points: measured beam end points, in the order of their angles; zero where `mask` is False.
        mask: True for valid beams.
        normals: unit normals of the fitted lines, turned towards the sensor; zero without a line.
        centroids: a point on each fitted line: the mean of its beams.
        is_on_line: True where the beam lies on a straight piece (valid, not a corner, not alone).
        noise: standard deviation of the range noise of all scans together, in the unit of the points.
        typical_range: range that nine in ten beams on a line stay below, median over the scans: the unit of settings.
        is_ordered: True if neighbours in the array are neighbours in time.
        num_bearings: number of bearings of the views.
        hits: hits that are compared with other scans; None: all valid ones.
    """

    points: Float[np.ndarray, "n b 2"]
    mask: Bool[np.ndarray, "n b"]
    normals: Float[np.ndarray, "n b 2"]
    centroids: Float[np.ndarray, "n b 2"]
    is_on_line: Bool[np.ndarray, "n b"]
    noise: float
    typical_range: float
    is_ordered: bool = True
    num_bearings: int = 512
    hits: Bool[np.ndarray, "n b"] | None = None

    def __len__(self) -> int:
        return len(self.mask)

    @cached_property
    def views(self) -> Views:
        """Ranges of the scans by the bearing, made once."""
        return make_views(self, self.num_bearings)

    @cached_property
    def fine(self) -> PlanarScans:
        """The same scans with views for comparisons to a thousandth of the typical range, made once."""
        # Number of bearings of fine views.
        return replace(self, num_bearings=4096)

    @property
    def num_on_line(self) -> Indices:
        """Number (n,) of beams on a line of each scan, at least 1."""
        return np.maximum(self.is_on_line.sum(1), 1)

    @property
    def tolerances(self) -> Tolerances:
        """Tolerances of these scans, from the typical range or from the noise, the larger ones."""
        reach, noise = self.typical_range, self.noise
        return Tolerances.of(match=max(0.006 * reach, 0.5 * noise), contradict=max(0.018 * reach, 5.0 * noise))

    def take(self, rows: Any) -> PlanarScans:
        """Returns the scans of these rows (a slice, a list or an array), without an order in time."""
        names = ["points", "mask", "normals", "centroids", "is_on_line", *(["hits"] if self.hits is not None else [])]
        return replace(self, **{name: getattr(self, name)[rows] for name in names}, is_ordered=False)

    def lines(self, rows: Any = slice(None), stride: int = 1) -> Lines:
        """Returns every `stride`-th beam of the scans of these rows."""
        arrays = self.points, self.normals, self.centroids, self.is_on_line
        return Lines(*(x[rows, ::stride] if stride > 1 else x[rows] for x in arrays))


def planar_scans(points: AnyArray | ScanSet, mask: AnyArray | None = None, *, is_ordered: bool = True) -> PlanarScans:
    """Prepares planar scans for registration: fits lines, measures noise and typical range.

    Args:
        points: (n, b, 2) beam end points in the frame of their sensor, any unit; or a ScanSet. Beams are sorted by
            angle if they are not in this order; then the invalid beams of a scan come last.
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
    # Rounding of float32 coordinates looks like noise of this size, a lower bound of the noise.
    noise = max(range_noise(values, valid), 1e-6 * float(np.linalg.norm(values, axis=-1).max()))
    blocks = [slice(first, first + _BLOCK) for first in range(0, len(values), _BLOCK)]
    fitted = [_fit_lines(values[block], valid[block], noise) for block in blocks]
    normals, centroids, is_on_line = (np.concatenate(parts) for parts in zip(*fitted, strict=True))
    # Beams on lines end on walls; with all beams, people and clutter would change the unit.
    unit = typical_range(values, is_on_line if is_on_line.any() else valid)
    return PlanarScans(values, valid, normals, centroids, is_on_line, noise, unit, is_ordered)


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


def spread_evenly(num_scans: int, count: int) -> Indices:
    """Returns up to `count` evenly spaced rows, the first and the last among them."""
    return np.unique(np.round(np.linspace(0, num_scans - 1, min(num_scans, count))).astype(np.int64))


def range_noise(points: Float[np.ndarray, "n b 2"], mask: Bool[np.ndarray, "n b"]) -> float:
    """Estimates the standard deviation of the range noise from the scans alone.

    A beam between two others that hit the same straight wall must end on their chord. The noise follows from the median
    over all beams of the distance along the beam to that chord, which is robust to corners and depth jumps.

    Args:
        points: organised planar scans.
        mask: True for valid beams.

    Returns:
        The noise in the unit of the points; about rounding error for noise-free scans, 0 when no beam has two
        neighbours.
    """
    usable = mask[:, :-2] & mask[:, 1:-1] & mask[:, 2:]
    scan, beam = np.nonzero(usable)
    # Approximate number of beams in the median of the noise: a sort of millions would take longer than all other steps.
    stride = max(1, len(scan) // 65536)
    before, here, after = (points[scan[::stride], beam[::stride] + k].astype(np.float64) for k in range(3))
    reach = np.linalg.norm(here, axis=-1)
    direction, chord = here / np.maximum(reach, 1e-12)[:, None], after - before
    slope = _cross(direction, chord)
    is_crossed = np.abs(slope) > 1e-9
    along = _cross(before, chord) / np.where(is_crossed, slope, 1.0)
    deviation = np.abs(reach - along)[is_crossed & (along > 0)]
    # A mean of two ends has variance 1/2, so the deviation has 3/2 of that of one beam; 1.4826: median to sigma.
    return 1.4826 * float(np.median(deviation)) / 1.5**0.5 if len(deviation) else 0.0


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _fit_lines(
    points: Float[np.ndarray, "n b 2"], mask: Bool[np.ndarray, "n b"], noise: float
) -> tuple[Float[np.ndarray, "n b 2"], Float[np.ndarray, "n b 2"], Bool[np.ndarray, "n b"]]:
    """Fits a line at each beam with a straight run; returns normals, centroids, and True for beams on a line."""
    x, y = np.moveaxis(points.astype(np.float64), -1, 0)
    sums = [np.cumsum(np.pad(z, ((0, 0), (1, 0))), axis=1) for z in (mask * 1.0, x, y, x * x, x * y, y * y)]
    error = np.full(mask.shape, np.inf)
    best = np.stack([np.zeros(mask.shape), x, y])
    for width in (width for width in _WIDTHS if width <= mask.shape[1]):
        count, x, y, xx, xy, yy = (z[:, width:] - z[:, :-width] for z in sums)
        xx, xy, yy = xx - x * x / width, xy - x * y / width, yy - y * y / width
        half_sum, half_difference = 0.5 * (xx + yy), 0.5 * (xx - yy)
        radius = np.hypot(half_difference, xy)
        along, across = half_sum + radius, np.maximum(half_sum - radius, 0.0)
        deviation, length = np.sqrt(across / (width - 2.0)), np.sqrt(along / width)
        # A run of beams counts as straight if it bends by less than this part of its length (0.03 degrees).
        allowed = noise * (1.0 + 2.0 / width**0.5) + 5e-4 * length
        is_straight = (count == width) & (deviation <= allowed) & (along > 4.0 * across)
        found = np.stack([0.5 * np.arctan2(xy, half_difference), x / width, y / width])
        off = np.where(is_straight, np.maximum(deviation, noise) / np.sqrt(np.maximum(along, 1e-20)), np.inf)
        # The run begins at the beam, ends at it, or has it in the middle.
        for first in (0, width - 1, width // 2):
            beams = slice(first, first + off.shape[1])
            is_better = off < error[:, beams]
            np.copyto(error[:, beams], off, where=is_better)
            np.copyto(best[:, :, beams], found, where=is_better)
    is_on_line, centroids = np.isfinite(error), np.moveaxis(best[1:], 0, -1)
    normals = np.stack([-np.sin(best[0]), np.cos(best[0])], axis=-1) * is_on_line[..., None]
    normals *= np.where((normals * centroids).sum(-1, keepdims=True) > 0, -1.0, 1.0)
    return normals.astype(np.float32), centroids.astype(np.float32), is_on_line


def make_views(scans: PlanarScans, num_bearings: int) -> Views:
    """Makes the views of scans.

    Args:
        scans: n scans.
        num_bearings: c; larger values make comparisons of noise-free scans more accurate.

    Returns:
        Views.
    """
    points, slant = _smooth_ranges(scans)
    row = np.arange(len(scans))[:, None]
    # Bearings of beams that measured nothing lie behind those of all others.
    angle = np.where(scans.mask, np.arctan2(points[..., 1], points[..., 0]) % (2 * np.pi), 7.0)
    order = np.argsort(angle, axis=1)
    angle, beams, slants = angle[row, order], points[row, order], slant[row, order]
    count = np.maximum(scans.mask.sum(1), 1)[:, None]
    bearing = 2 * np.pi * (np.arange(num_bearings) + 0.5) / num_bearings
    # One search in all scans, whose bearings follow each other.
    index = np.searchsorted((angle + 8.0 * row).ravel(), (bearing + 8.0 * row).ravel())
    index = index.reshape(len(scans), num_bearings) - row * angle.shape[1]
    before, after = (index - 1) % count, index % count
    gap = (angle[row, after] - angle[row, before]) % (2 * np.pi)
    one, chord = beams[row, before], beams[row, after] - beams[row, before]
    across = np.cos(bearing) * chord[..., 1] - np.sin(bearing) * chord[..., 0]
    along = one[..., 0] * chord[..., 1] - one[..., 1] * chord[..., 0]
    reach = np.linalg.norm(beams, axis=-1)
    ends = reach[row, before], reach[row, after]
    near, far = np.minimum(*ends), np.maximum(*ends)
    surface = np.clip(along / np.where(np.abs(across) > 1e-9, across, 1.0), near, far)
    # Padding behind the last valid beam is no beam.
    num_beams = np.max(np.where(scans.mask, np.arange(1, angle.shape[1] + 1), 1), axis=1)[:, None]
    # A bearing is not seen where the two beams around it are farther apart than this many times an even spread.
    is_seen = (gap < 2.5 * 2 * np.pi / num_beams) & (count > 1)
    slant = np.minimum(slants[row, before], slants[row, after])
    hits = scans.mask if scans.hits is None else scans.mask & scans.hits
    arrays = points, scans.normals, hits, surface, near, far, slant, is_seen
    # The number of scans is rounded up to a power of two, at least this, so that few programs compile.
    capacity = max(64, 1 << (len(scans) - 1).bit_length())
    return Views(*(_padded(x, capacity) for x in arrays))


def _padded(values: np.ndarray, capacity: int) -> Array:
    """Returns values in single precision, with further rows of zeros."""
    rows = np.zeros((capacity, *values.shape[1:]), bool if values.dtype == bool else np.float32)
    rows[: len(values)] = values
    return jax.device_put(rows)  # `jnp.asarray` compiles a program for each shape


def _smooth_ranges(scans: PlanarScans) -> tuple[Float[np.ndarray, "n b 2"], Float[np.ndarray, "n b"]]:
    """Moves points along their beams onto their fitted lines, which averages the range noise of a wall.

    Returns:
        The points, and the cosine of the angle between each beam and its surface.
    """
    reach = np.maximum(np.linalg.norm(scans.points, axis=-1), 1e-9)
    beam = scans.points / reach[..., None]
    slope = (scans.normals * beam).sum(-1)
    on_line = (scans.normals * scans.centroids).sum(-1) / np.where(np.abs(slope) > 1e-3, slope, 1.0)
    usable = scans.is_on_line & (np.abs(slope) > _MIN_COSINE) & (np.abs(on_line - reach) < 4.0 * scans.noise)
    slant = np.where(scans.is_on_line, np.maximum(np.abs(slope), _MIN_COSINE), _UNKNOWN_COSINE)
    return np.where(usable[..., None], beam * on_line[..., None], scans.points), slant
