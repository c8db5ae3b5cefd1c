"""Elevations of beams that a calibration got wrong."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from dpmjax.types import AnyArray

KITTI_ELEVATION_DEG = 0.205
"""By so much the beams of KITTI's HDL-64E point higher than its points say (KISS-ICP corrects it by the same angle)."""


def raise_beams(points: Float[AnyArray, "n 3"], elevation_deg: float) -> Float[np.ndarray, "n 3"]:
    """Turns each point up about the lidar; azimuth and range stay.

    A lidar whose elevations are off by a constant sees flat ground as a bowl, and odometry on it climbs or sinks.

    Args:
        points: metres, z up, in the frame of the lidar.
        elevation_deg: degrees to add to the elevation of each point.

    Returns:
        (n, 3) float32 points.
    """
    points = np.asarray(points, np.float64)
    across = np.hypot(points[:, 0], points[:, 1])
    elevation = np.arctan2(points[:, 2], across) + np.radians(elevation_deg)
    ranges = np.hypot(across, points[:, 2])
    # A point straight above has no azimuth: it stays there.
    shares = np.divide(ranges * np.cos(elevation), across, out=np.ones_like(across), where=across > 0)
    heights = np.where(across > 0, ranges * np.sin(elevation), points[:, 2])
    return np.column_stack([points[:, :2] * shares[:, None], heights]).astype(np.float32)
