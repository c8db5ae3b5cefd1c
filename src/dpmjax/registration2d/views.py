"""Views of planar scans: the range by the bearing, with the surfaces and the free space that a scan has seen.

A view has, for each bearing, the range and the slant of the surface, and the free space in front of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

if TYPE_CHECKING:
    from dpmjax.registration2d.planar_scans import PlanarScans

# A bearing is not seen where the two beams around it are farther apart than this many times an even spread.
_MAX_GAP = 2.5
# Least cosine of the slant of a surface. Surfaces with a smaller cosine do not correct the range of a beam.
_MIN_COSINE = 0.3
_UNKNOWN_COSINE = 0.7
# The number of scans is rounded up to a power of two, at least this, so that few programs compile.
_LEAST_ROWS = 64


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
    is_seen = (gap < _MAX_GAP * 2 * np.pi / num_beams) & (count > 1)
    slant = np.minimum(slants[row, before], slants[row, after])
    arrays = points, scans.normals, scans.mask, surface, near, far, slant, is_seen
    capacity = max(_LEAST_ROWS, 1 << (len(scans) - 1).bit_length())
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
