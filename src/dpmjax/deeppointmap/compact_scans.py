"""The compact form of a scan for maps: small integers from which it is restored for registrations."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int8, Int16, UInt8

from dpmjax.scan.lidar.record import Scan
from dpmjax.scan.lidar.surfaces import RangeImage, surface_of_elements
from dpmjax.types import DescriptorCloud, SurfaceElements

MAX_COORDINATE = np.iinfo(np.int16).max
MAX_COMPONENT = np.iinfo(np.int8).max
MAX_CODE = np.iinfo(np.uint8).max
# Ranges of the codes, 2.3 % apart.
MIN_RANGE_M, MAX_RANGE_M = 0.5, 150.0


class CompactElements(NamedTuple):
    """Surface elements, 10 bytes each, in their order.

    Attributes:
        unit_m: metres that 1 stands for in `positions`; 2 mm for a scan of 60 m.
        positions: (n, 3) in units.
        normals: (n, 3) unit normals times 127; 0 where there is no plane.
        planarity: (n,) planarity times 255.
        mask: (n,) True for elements that are there.
    """

    unit_m: float
    positions: Int16[np.ndarray, "n 3"]
    normals: Int8[np.ndarray, "n 3"]
    planarity: UInt8[np.ndarray, " n"]
    mask: Bool[np.ndarray, " n"]


class CompactImage(NamedTuple):
    """A range image, 2 bytes a pixel: codes of the logarithm of the range; 0 where nothing was measured.

    Attributes:
        num_rows: rows of the whole image.
        first_row: row of the image that is the first of the codes; all rows outside the codes are empty.
        nearest: (r, c) codes, rounded down.
        farthest: (r, c) codes, rounded up.
    """

    num_rows: int
    first_row: int
    nearest: UInt8[np.ndarray, "r c"]
    farthest: UInt8[np.ndarray, "r c"]


def compact_elements(elements: SurfaceElements) -> CompactElements:
    """Rounds surface elements to integers.

    Args:
        elements: elements of a scan, metres, in the frame of the lidar.

    Returns:
        The integers.
    """
    mask = np.asarray(elements.mask)
    positions, normals = (np.where(mask[:, None], array, 0) for array in (elements.positions, elements.normals))
    unit_m = max(float(np.abs(positions).max(initial=0.0)), 1.0) / MAX_COORDINATE
    return CompactElements(
        unit_m,
        np.rint(positions / unit_m).astype(np.int16),
        np.rint(normals * MAX_COMPONENT).astype(np.int8),
        np.rint(np.where(mask, elements.planarity, 0) * MAX_CODE).astype(np.uint8),
        mask,
    )


def expand_elements(compact: CompactElements) -> SurfaceElements:
    """Restores the surface elements.

    Args:
        compact: compact form from `compact_elements`.

    Returns:
        Elements as float32 arrays of NumPy, metres.
    """
    normals = compact.normals.astype(np.float32)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    positions = (compact.positions * compact.unit_m).astype(np.float32)
    planarity = compact.planarity.astype(np.float32) / MAX_CODE
    return SurfaceElements(positions, normals / np.maximum(lengths, 1), planarity, compact.mask)


def compact_image(image: RangeImage) -> CompactImage:
    """Rounds near ranges down and far ranges up, so that the free space of a range image never grows.

    Args:
        image: image of a scan.

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
    """Restores the range image.

    Args:
        compact: compact form from `compact_image`.

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


def _codes(ranges_m: Float[np.ndarray, "r c"]) -> Float[np.ndarray, "r c"]:
    """Returns codes from 1 to 255 before rounding."""
    shares = np.log(np.clip(ranges_m, MIN_RANGE_M, MAX_RANGE_M) / MIN_RANGE_M) / np.log(MAX_RANGE_M / MIN_RANGE_M)
    return 1 + (MAX_CODE - 1) * shares


class CompactScan(NamedTuple):
    """Compact form in which a map stores a scan, as arrays of NumPy.

    Attributes:
        elements: surface elements in the order of farthest points; the first m have features.
        features: (m, c) in steps.
        feature_steps: (m,) step of the features of each descriptor, float32.
        directions: (m,) azimuths of the frames of the descriptors, in steps of pi / 127.
        image: range image.
    """

    elements: CompactElements
    features: Int8[np.ndarray, "m c"]
    feature_steps: Float[np.ndarray, " m"]
    directions: Int8[np.ndarray, " m"]
    image: CompactImage

    @property
    def cloud(self) -> DescriptorCloud:
        """Descriptors and surface elements, as float32 arrays of NumPy."""
        elements = expand_elements(self.elements)
        angles = self.directions * (np.pi / MAX_COMPONENT)
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1).astype(np.float32)
        features = self.features * self.feature_steps[:, None]
        # `DescriptorCloud` is typed for arrays of JAX, but these stay on the host.
        parts: Any = elements.positions, features, elements.mask, directions, elements.normals, elements.planarity
        return DescriptorCloud(*parts)


def compact_scan(cloud: DescriptorCloud, image: RangeImage) -> CompactScan:
    """Makes the compact form of a scan.

    Args:
        cloud: descriptors of one scan with surface elements and directions.
        image: free space of the scan.

    Returns:
        The compact scan.
    """
    return CompactScan(
        compact_elements(cloud.elements),
        *round_features(np.asarray(cloud.features, np.float32)),
        round_directions(np.asarray(cloud.directions)),
        compact_image(image),
    )


def round_features(
    features: Float[np.ndarray, "*k m c"],
) -> tuple[Int8[np.ndarray, "*k m c"], Float[np.ndarray, "*k m"]]:
    """Rounds the features of each descriptor to 127 steps of their largest absolute value.

    Args:
        features: features of the descriptors.

    Returns:
        The features in steps, and the steps.
    """
    steps = np.maximum(np.abs(features).max(axis=-1, initial=0), 1e-12).astype(np.float32) / np.float32(MAX_COMPONENT)
    return np.rint(features / steps[..., None]).astype(np.int8), steps


def round_directions(directions: Float[np.ndarray, "m 2"]) -> Int8[np.ndarray, " m"]:
    """Rounds horizontal directions to azimuths 1.4 degrees apart.

    Args:
        directions: unit vectors.

    Returns:
        Azimuths in steps of pi / 127.
    """
    return np.rint(np.arctan2(directions[:, 1], directions[:, 0]) * (MAX_COMPONENT / np.pi)).astype(np.int8)


def expand_scan(compact: CompactScan) -> Scan:
    """Restores a scan for registrations, in a millisecond.

    Args:
        compact: compact form from `compact_scan`.

    Returns:
        Descriptors, surface and free space.
    """
    cloud = compact.cloud
    return Scan(surface_of_elements(cloud.elements), expand_image(compact.image), cloud)
