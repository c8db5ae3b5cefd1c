"""A keyframe in few bytes: descriptors, surface elements and a coarse range image, from which registration goes on.

A run of SLAM works with the rounded values, so that a map which is read from a file is the map that was written.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int8

from dpmjax.deeppointmap.scan_registration import PreparedScan
from dpmjax.deeppointmap.verification import MeasuredScan
from dpmjax.scans.compact import (
    CompactElements,
    CompactImage,
    compact_elements,
    compact_image,
    expand_elements,
    expand_image,
)
from dpmjax.scans.surfaces import RangeImage, surface_of_elements
from dpmjax.types import DescriptorCloud

MAX_CODE = np.iinfo(np.int8).max


class CompactScan(NamedTuple):
    """Compact form in which a map stores a scan, as arrays of NumPy.

    Attributes:
        elements: surface elements in the order of farthest points; the first m have features.
        features: (m, c) in steps.
        feature_steps: (m,) step of the features of each descriptor, float32.
        directions: (m,) azimuths of the frames of the descriptors, pi as 127.
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
        angles = self.directions * (np.pi / MAX_CODE)
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1).astype(np.float32)
        features = self.features * self.feature_steps[:, None]
        # Arrays of NumPy stand for those of JAX.
        parts: tuple[Any, ...] = (elements.positions, features, elements.mask, directions)
        parts += elements.normals, elements.planarity
        return DescriptorCloud(*parts)


def compact_scan(cloud: DescriptorCloud, image: RangeImage) -> CompactScan:
    """Rounds what registration and verification need of a scan.

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
    features: Float[np.ndarray, "m c"],
) -> tuple[Int8[np.ndarray, "m c"], Float[np.ndarray, " m"]]:
    """Rounds the features of each descriptor to 127 steps of their largest absolute value.

    Args:
        features: of the descriptors.

    Returns:
        The features in steps, and the steps.
    """
    steps = np.maximum(np.abs(features).max(axis=1, initial=0), 1e-12).astype(np.float32) / np.float32(MAX_CODE)
    return np.rint(features / steps[:, None]).astype(np.int8), steps


def round_directions(directions: Float[np.ndarray, "m 2"]) -> Int8[np.ndarray, " m"]:
    """Rounds horizontal directions to azimuths 1.4 degrees apart.

    Args:
        directions: unit vectors.

    Returns:
        Azimuths, pi as 127.
    """
    return np.rint(np.arctan2(directions[:, 1], directions[:, 0]) * (MAX_CODE / np.pi)).astype(np.int8)


def expand_scan(compact: CompactScan) -> PreparedScan:
    """Makes a scan ready for registrations, in a millisecond.

    Args:
        compact: from `compact_scan`.

    Returns:
        Descriptors, surface and free space.
    """
    cloud = compact.cloud
    return PreparedScan(cloud, MeasuredScan(surface_of_elements(cloud.elements), expand_image(compact.image)))
