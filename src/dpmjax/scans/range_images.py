"""Free space that a lidar scan has measured, on the host, as a range image by azimuth and elevation.

A point of another scan cannot lie in the free space between the lidar and the surfaces.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter1d, minimum_filter1d

# Pixels of 2 degrees, in elevation and azimuth.
NUM_ROWS, NUM_COLUMNS = 90, 180

# A point contradicts a measurement if it is nearer by more than both: a distance, and a share of its range.
MARGIN_M, MARGIN_SHARE = 1.0, 0.1


class RangeImage(NamedTuple):
    """Ranges by azimuth and elevation, as the lidar sees them.

    Attributes:
        nearest_m: (rows, columns) smallest range of a pixel and its neighbours; infinite where nothing was measured.
        farthest_m: (rows, columns) largest such range; 0 where nothing was measured.
    """

    nearest_m: Float[np.ndarray, "r c"]
    farthest_m: Float[np.ndarray, "r c"]


class View(NamedTuple):
    """Visibility of the points of another scan in a range image.

    Attributes:
        is_visible: True where the lidar measured something in this direction, and the point is not far behind it.
        is_contradicted: True where the point lies clearly in front of all that was measured in this direction.
    """

    is_visible: Bool[np.ndarray, "*n"]
    is_contradicted: Bool[np.ndarray, "*n"]


def range_image(points: Float[np.ndarray, "n 3"]) -> RangeImage:
    """Makes the range image of a scan, with a margin of one pixel about each measurement.

    Args:
        points: metres, in the frame of the lidar.

    Returns:
        The image.
    """
    nearest, farthest = np.full((NUM_ROWS, NUM_COLUMNS), np.inf), np.zeros((NUM_ROWS, NUM_COLUMNS))
    pixels, ranges = _project(points)
    np.minimum.at(nearest.reshape(-1), pixels, ranges)
    np.maximum.at(farthest.reshape(-1), pixels, ranges)
    nearest = minimum_filter1d(minimum_filter1d(nearest, 3, axis=0, mode="nearest"), 3, axis=1, mode="wrap")
    farthest = maximum_filter1d(maximum_filter1d(farthest, 3, axis=0, mode="nearest"), 3, axis=1, mode="wrap")
    return RangeImage(nearest, farthest)


def view_points(image: RangeImage, points: Float[np.ndarray, "*n 3"]) -> View:
    """Compares points with the ranges that the lidar of an image has measured in their directions.

    Args:
        image: range image from `range_image`.
        points: metres, in the frame of that lidar.

    Returns:
        Masks of the points that are visible, and of those that contradict the image.
    """
    pixels, ranges = _project(points)
    nearest, farthest = image.nearest_m.ravel()[pixels], image.farthest_m.ravel()[pixels]
    margin = np.maximum(MARGIN_M, MARGIN_SHARE * ranges)
    is_measured = np.isfinite(nearest)
    return View(is_measured & (ranges <= farthest + margin), is_measured & (ranges < nearest - margin))


def _project(points: Float[np.ndarray, "*n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pixel and the range of each point."""
    x, y, z = np.moveaxis(points, -1, 0)
    flat = np.hypot(x, y)
    column = np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * NUM_COLUMNS).astype(np.int64) % NUM_COLUMNS
    row = np.floor((np.arctan2(z, flat) / np.pi + 0.5) * NUM_ROWS).astype(np.int64)
    return np.clip(row, 0, NUM_ROWS - 1) * NUM_COLUMNS + column, np.hypot(flat, z)
