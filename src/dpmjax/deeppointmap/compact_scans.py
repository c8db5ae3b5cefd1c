"""A prepared scan in few bytes, for maps: descriptors, a thinned surface and a coarse range image."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dpmjax.deeppointmap.scan_registration import PreparedScan
from dpmjax.deeppointmap.verification import MeasuredScan
from dpmjax.geometry.bearing import directions_of
from dpmjax.scans.compact import (
    CompactImage,
    CompactSurface,
    compact_image,
    compact_surface,
    expand_image,
    expand_surface,
)
from dpmjax.types import DescriptorCloud

MAX_SURFACE_POINTS = 8000


class CompactScan(NamedTuple):
    """What a map keeps of a scan. All of it is arrays of NumPy, so that a file holds exactly the same.

    Attributes:
        positions: (m, 3) float32, of the descriptors, metres, in the frame of the lidar.
        features: (m, c) float32.
        directions: (m, 2) float32, of their frames.
        mask: (m,) True for descriptors that are there.
        surface: thinned points.
        image: range image.
    """

    positions: Float[np.ndarray, "m 3"]
    features: Float[np.ndarray, "m c"]
    directions: Float[np.ndarray, "m 2"]
    mask: Bool[np.ndarray, " m"]
    surface: CompactSurface
    image: CompactImage

    @property
    def descriptors(self) -> DescriptorCloud:
        """The descriptors, as arrays of NumPy."""
        arrays: tuple[Any, ...] = (self.positions, self.features, self.mask, self.directions)
        return DescriptorCloud(*arrays)


def compact_scan(
    descriptors: DescriptorCloud, measured: MeasuredScan, *, max_points: int = MAX_SURFACE_POINTS
) -> CompactScan:
    """Keeps of a scan what registration and verification need.

    Args:
        descriptors: of one scan.
        measured: surface and free space of the scan.
        max_points: number of surface points that are kept at most.

    Returns:
        The compact scan.
    """
    return CompactScan(
        np.asarray(descriptors.positions, np.float32),
        np.asarray(descriptors.features, np.float32),
        np.asarray(directions_of(descriptors), np.float32),
        np.asarray(descriptors.mask, bool),
        compact_surface(measured.surface, max_points),
        compact_image(measured.image),
    )


def expand_scan(compact: CompactScan) -> PreparedScan:
    """Makes the scan ready for registrations, in some milliseconds.

    Args:
        compact: from `compact_scan`.

    Returns:
        Descriptors and the thinned surface and free space.
    """
    measured = MeasuredScan(expand_surface(compact.surface), expand_image(compact.image))
    return PreparedScan(compact.descriptors, measured)
