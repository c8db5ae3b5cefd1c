"""Free space between a lidar and the surfaces that it measured: a point of another scan cannot lie there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from dpmjax.checks import require_positive_fields


@dataclass(frozen=True)
class RangeImageConfig:
    """Resolution of a range image, and margins of a contradiction.

    Attributes:
        pixel_deg: side of a pixel in azimuth and elevation.
        margin_m: a point contradicts a measurement if it is nearer by more than this distance.
        margin_share: the point must also be nearer by more than this share of its range.
    """

    pixel_deg: float = 2.0
    margin_m: float = 1.0
    margin_share: float = 0.1

    def __post_init__(self) -> None:
        require_positive_fields(self, "pixel_deg", "margin_m", "margin_share")


class RangeImage(NamedTuple):
    """Ranges by azimuth and elevation, as the lidar sees them.

    Attributes:
        nearest_m: (rows, columns) smallest range of a pixel and its neighbours; infinite where nothing was measured.
        farthest_m: the largest; 0 where nothing was measured.
    """

    nearest_m: Float[np.ndarray, "r c"]
    farthest_m: Float[np.ndarray, "r c"]


class View(NamedTuple):
    """Visibility of the points of another scan in a range image.

    Attributes:
        is_visible: the lidar measured something in this direction, and the point is not far behind it.
        is_contradicted: the point lies clearly in front of all that was measured in this direction.
    """

    is_visible: Bool[np.ndarray, " n"]
    is_contradicted: Bool[np.ndarray, " n"]


def range_image(points: Float[np.ndarray, "n 3"], config: RangeImageConfig = RangeImageConfig()) -> RangeImage:
    """Makes the range image of a scan, with a margin of one pixel about each measurement.

    Args:
        points: metres, in the frame of the lidar.
        config: resolution.

    Returns:
        The image.
    """
    rows, columns = _shape(config)
    nearest, farthest = np.full((rows, columns), np.inf), np.zeros((rows, columns))
    pixels, ranges = _project(points, config)
    np.minimum.at(nearest.reshape(-1), pixels, ranges)
    np.maximum.at(farthest.reshape(-1), pixels, ranges)
    nearest = minimum_filter1d(minimum_filter1d(nearest, 3, axis=0, mode="nearest"), 3, axis=1, mode="wrap")
    farthest = maximum_filter1d(maximum_filter1d(farthest, 3, axis=0, mode="nearest"), 3, axis=1, mode="wrap")
    return RangeImage(nearest, farthest)


def view_points(
    image: RangeImage, points: Float[np.ndarray, "n 3"], config: RangeImageConfig = RangeImageConfig()
) -> View:
    """Compares points with the ranges that the lidar of an image has measured in their directions.

    Args:
        image: from `range_image` of the same configuration.
        points: metres, in the frame of that lidar.
        config: resolution and margins.

    Returns:
        Masks of the points that are visible, and of those that contradict the image.
    """
    pixels, ranges = _project(points, config)
    nearest, farthest = image.nearest_m.ravel()[pixels], image.farthest_m.ravel()[pixels]
    margin = np.maximum(config.margin_m, config.margin_share * ranges)
    is_measured = np.isfinite(nearest)
    return View(is_measured & (ranges <= farthest + margin), is_measured & (ranges < nearest - margin))


def _shape(config: RangeImageConfig) -> tuple[int, int]:
    columns = max(1, round(360 / config.pixel_deg))
    return max(1, round(180 / config.pixel_deg)), columns


def _project(points: Float[np.ndarray, "n 3"], config: RangeImageConfig) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pixel and the range of each point."""
    rows, columns = _shape(config)
    x, y, z = points.T
    flat = np.hypot(x, y)
    column = np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * columns).astype(np.int64) % columns
    row = np.floor((np.arctan2(z, flat) / np.pi + 0.5) * rows).astype(np.int64)
    return np.clip(row, 0, rows - 1) * columns + column, np.hypot(flat, z)
