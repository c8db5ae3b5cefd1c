"""The surface and the free space of a scan in few bytes, for maps: small integers from which both are made again.

What is kept is thinner than the scan. It verifies a registration nearly as well, for planes need few points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Int8, Int16, UInt8

from dpmjax.scans.free_space import RangeImage
from dpmjax.scans.surfaces import Surface, surface_of_points

MAX_COORDINATE = np.iinfo(np.int16).max
MAX_COMPONENT = np.iinfo(np.int8).max
MAX_FLATNESS = MAX_CODE = np.iinfo(np.uint8).max
OTHER_SHARE = 0.15
"""Share of the points that are no part of a plane: views of a scan from above draw them too."""

MIN_RANGE_M, MAX_RANGE_M = 0.5, 150.0
"""Ranges of the codes, 2.3 % apart."""


class CompactSurface(NamedTuple):
    """A thinned surface, 10 bytes a point.

    Attributes:
        unit_m: what 1 stands for in `points`.
        points: (n, 3) in units, along a curve that fills space, so that neighbours stand side by side.
        normals: (n, 3) unit normals times 127.
        flatness: (n,) times 255.
    """

    unit_m: float
    points: Int16[np.ndarray, "n 3"]
    normals: Int8[np.ndarray, "n 3"]
    flatness: UInt8[np.ndarray, " n"]


class CompactImage(NamedTuple):
    """A range image, 2 bytes a pixel: codes of the logarithm of the range; 0 where nothing was measured.

    Attributes:
        num_rows: rows of the whole image.
        first_row: rows before it are empty; so are those after the last one.
        nearest: (r, c) codes, rounded down.
        farthest: (r, c) codes, rounded up.
    """

    num_rows: int
    first_row: int
    nearest: UInt8[np.ndarray, "r c"]
    farthest: UInt8[np.ndarray, "r c"]


def compact_surface(surface: Surface, max_points: int) -> CompactSurface:
    """Thins a surface: the first samples are kept, and some of the points that are no part of a plane.

    Chosen at random, the points meet planes nearly as often as all of them do; a point of each voxel would not.

    Args:
        surface: of a scan.
        max_points: number of points that are kept at most.

    Returns:
        The thinned surface.
    """
    rows = _thinned(surface, max_points)
    points = surface.points[rows]
    unit_m = max(float(np.abs(points).max(initial=0.0)), 1.0) / MAX_COORDINATE
    units = np.rint(points / unit_m).astype(np.int16)
    along = np.argsort(_places_on_curve(units), kind="stable")
    normals = np.rint(surface.normals[rows] * MAX_COMPONENT).astype(np.int8)
    flatness = np.rint(surface.flatness[rows] * MAX_FLATNESS).astype(np.uint8)
    return CompactSurface(unit_m, units[along], normals[along], flatness[along])


def expand_surface(compact: CompactSurface) -> Surface:
    """Makes the surface again.

    Args:
        compact: from `compact_surface`.

    Returns:
        The thinned surface, with its tree.
    """
    normals = compact.normals.astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1)
    flatness = compact.flatness.astype(np.float64) / MAX_FLATNESS
    return surface_of_points(compact.points * compact.unit_m, normals, flatness)


def compact_image(image: RangeImage) -> CompactImage:
    """Rounds a range image to codes, so that nothing is contradicted that was not before.

    Args:
        image: of a scan.

    Returns:
        The codes.
    """
    is_measured = np.isfinite(image.nearest_m) & (image.farthest_m > 0)
    rows = np.flatnonzero(is_measured.any(axis=1))
    kept = slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) else slice(0, 0)
    nearest = np.where(is_measured, np.floor(_codes(image.nearest_m)), 0).astype(np.uint8)
    farthest = np.where(is_measured, np.ceil(_codes(image.farthest_m)), 0).astype(np.uint8)
    return CompactImage(len(is_measured), kept.start, nearest[kept], farthest[kept])


def expand_image(compact: CompactImage) -> RangeImage:
    """Makes the range image again.

    Args:
        compact: from `compact_image`.

    Returns:
        The image.
    """
    ranges_m = MIN_RANGE_M * (MAX_RANGE_M / MIN_RANGE_M) ** ((np.arange(MAX_CODE + 1) - 1) / (MAX_CODE - 1))
    shape = (compact.num_rows, compact.nearest.shape[1])
    nearest, farthest = np.full(shape, np.inf), np.zeros(shape)
    kept = slice(compact.first_row, compact.first_row + len(compact.nearest))
    nearest[kept] = np.where(compact.nearest > 0, ranges_m[compact.nearest], np.inf)
    farthest[kept] = np.where(compact.farthest > 0, ranges_m[compact.farthest], 0)
    return RangeImage(nearest, farthest)


def _thinned(surface: Surface, max_points: int) -> Int[np.ndarray, " n"]:
    if len(surface.points) <= max_points:
        return np.arange(len(surface.points))
    is_sample = np.zeros(len(surface.points), bool)
    is_sample[surface.samples] = True
    others = np.random.default_rng(0).permutation(np.flatnonzero(~is_sample))
    num_others = max(min(round(OTHER_SHARE * max_points), len(others)), max_points - len(surface.samples))
    return np.concatenate([surface.samples[: max_points - num_others], others[:num_others]])


def _codes(ranges_m: Float[np.ndarray, "r c"]) -> Float[np.ndarray, "r c"]:
    """Returns codes from 1 to 255 before rounding."""
    shares = np.log(np.clip(ranges_m, MIN_RANGE_M, MAX_RANGE_M) / MIN_RANGE_M) / np.log(MAX_RANGE_M / MIN_RANGE_M)
    return 1 + (MAX_CODE - 1) * shares


def _places_on_curve(units: Int16[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Returns the place of each point on the Z-order curve: the bits of its coordinates in turn (Morton 1966)."""
    shifted = units.astype(np.int64) + MAX_COORDINATE + 1
    places = np.zeros(len(units), np.int64)
    for bit in range(16):
        for axis in range(3):
            places |= ((shifted[:, axis] >> bit) & 1) << (3 * bit + axis)
    return places
