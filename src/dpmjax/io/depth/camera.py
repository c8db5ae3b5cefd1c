"""A pinhole camera and the way from a depth image to an organised cloud.

Camera frame: x to the right, y down, z forward; metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

    Attributes:
        width: of the image, pixels.
        height: of the image, pixels.
        fx: focal length along x, pixels.
        fy: focal length along y, pixels.
        cx: column of the optical axis, pixels from the centre of the first.
        cy: row of the optical axis.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 1 or not min(self.fx, self.fy) > 0.0:
            raise ValueError(f"camera: expected a size and focal lengths above 0, got {self}")

    def rays(self, columns: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Directions (h, w, 3) with z = 1 of the pixels at rows (h,) and columns (w,)."""
        x, y = np.meshgrid((columns - self.cx) / self.fx, (rows - self.cy) / self.fy)
        return np.stack([x, y, np.ones_like(x)], axis=-1)


ACTIVE_VISION = Camera(1920, 1080, 1070.0, 1069.126, 927.268, 545.76)
"""The camera of the Active Vision Dataset."""


def sample_positions(length: int, count: int) -> NDArray[np.int64]:
    """`count` pixel positions spread evenly over `length` pixels, in the middles of their cells."""
    return ((np.arange(count) + 0.5) * length / count).astype(np.int64)


def back_project(
    depth_m: NDArray[np.floating], camera: Camera, *, height: int, width: int, max_depth_m: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """An organised cloud out of a depth image, thinned to `height` x `width` of its pixels.

    Args:
        depth_m: (rows, columns) depth along z, metres; zero, negative or not finite: nothing measured.
        camera: that took it; its size is that of the image.
        height: rows of the cloud.
        width: columns of the cloud.
        max_depth_m: deeper pixels are masked.

    Returns:
        points: (height, width, 3) in the camera frame, zero where masked.
        mask: (height, width) True where something was measured.

    Raises:
        ValueError: the image has another size than the camera, or is smaller than the cloud.
    """
    if depth_m.shape != (camera.height, camera.width):
        raise ValueError(f"depth_m: expected {(camera.height, camera.width)} as the camera, got {depth_m.shape}")
    if height > camera.height or width > camera.width:
        raise ValueError(f"height, width: expected at most {depth_m.shape}, got {(height, width)}")
    rows, columns = sample_positions(camera.height, height), sample_positions(camera.width, width)
    depth = np.asarray(depth_m, np.float64)[np.ix_(rows, columns)]
    mask = np.isfinite(depth) & (depth > 0.0) & (depth <= max_depth_m)
    points = camera.rays(columns.astype(np.float64), rows.astype(np.float64)) * np.where(mask, depth, 0.0)[..., None]
    return points.astype(np.float32), mask
