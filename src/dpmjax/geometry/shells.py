"""Beams without an echo that were written as points at the largest range.

SICK and Hokuyo drivers, 3DTK and simulators write such beams at one range or a few, or with noise. These points lie on
a circle or sphere about the sensor and move with it, so that a registration finds no motion.
"""

from __future__ import annotations

import warnings

import numpy as np
from jaxtyping import Float

# Widths of a shell as shares of the largest range: SICK scanners have four codes within 0.1 %, simulators add noise.
_WIDTHS = (0.002, 0.004, 0.007, 0.012, 0.02, 0.03)
# A shell holds this share of all points at least, and this number; else it does no harm.
_LEAST_SHARE, _LEAST_COUNT = 0.003, 20
# A larger share of the points is the surrounding itself, such as a tank about the sensor.
_MOST_SHARE = 0.9
# A shell is this many times as dense as the same width below it. Real surfaces end gradually.
_LEAST_CONTRAST = 3.0
# The points of a shell are seen in this many of 72 directions: a wall lies within 1.5 % of one range over 20 degrees.
_NUM_SECTORS, _LEAST_SECTORS = 72, 12


def shell_radius(points: Float[np.ndarray, "n d"]) -> float | None:
    """Finds a shell of points about the sensor behind which nothing lies.

    Args:
        points: valid points of one scan or of several, each in the frame of its sensor; d is 2 or 3.

    Returns:
        The inner radius of the shell; points at this range or more are no echoes. None without a shell.
    """
    ranges = np.linalg.norm(points.astype(np.float64), axis=1)
    least = max(_LEAST_COUNT, round(_LEAST_SHARE * len(ranges)))
    if len(ranges) <= least:
        return None
    radius = float(ranges.max())
    inner = radius * (1.0 - np.array(_WIDTHS))
    width = radius - inner
    ordered = np.sort(ranges)
    count = len(ranges) - np.searchsorted(ordered, inner)
    below = np.searchsorted(ordered, inner - 0.3 * width) - np.searchsorted(ordered, inner - 1.3 * width)
    is_shell = (count >= _LEAST_CONTRAST * below) & (count <= _MOST_SHARE * len(ranges))
    excess = np.where(is_shell, count - below, 0)
    if excess.max() < least:
        return None
    # The narrowest one that holds nearly all.
    chosen = float(inner[np.argmax(excess >= 0.95 * excess.max())])
    x, y = points[ranges >= chosen, :2].T
    sectors = np.unique(np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * _NUM_SECTORS))
    return chosen if len(sectors) >= _LEAST_SECTORS else None


def without_shell(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Leaves out the points of a scan that are no echoes, and warns of them.

    Args:
        points: in the frame of the lidar; those that are not finite stay.

    Returns:
        The remaining points.
    """
    is_finite = np.isfinite(points).all(axis=1)
    radius = shell_radius(points[is_finite])
    if radius is None:
        return points
    # The same text each time, so that Python shows it once.
    warnings.warn("beams without an echo were written at the largest range of the lidar: left out", stacklevel=3)
    with np.errstate(invalid="ignore", over="ignore"):
        return points[~(np.linalg.norm(points.astype(np.float64), axis=1) >= radius)]
