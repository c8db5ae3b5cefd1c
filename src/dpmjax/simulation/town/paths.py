"""Plane curves as dense polylines: resampled, smoothed, shifted to the side."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def arc_lengths(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Way from the start to each point.

    Args:
        path: (k, 2) points, m.

    Returns:
        (k,) m.
    """
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])


def at_way(path: NDArray[np.float64], way: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points at given ways along the path, linear between its points.

    Args:
        path: (k, d) points; the way counts x and y only.
        way: (m,) m, clipped to the path.

    Returns:
        (m, d).
    """
    lengths = arc_lengths(path)
    return np.column_stack([np.interp(way, lengths, column) for column in path.T])


def resample(path: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """The path at (nearly) equal steps, both ends kept.

    Args:
        path: (k, d) points.
        step: m.

    Returns:
        (m, d), m at least 2.
    """
    length = arc_lengths(path)[-1]
    return at_way(path, np.linspace(0.0, length, max(round(length / step), 1) + 1))


def tangents(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit directions along the path.

    Args:
        path: (k, 2) points, none of them twice in a row.

    Returns:
        (k, 2).
    """
    slope = np.gradient(path[:, :2], axis=0)
    return slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)


def shift_left(path: NDArray[np.float64], distance: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """The path moved to its left.

    Args:
        path: (k, 2) points.
        distance: m, one for all or one each; negative for the right.

    Returns:
        (k, 2).
    """
    along = tangents(path)
    return path[:, :2] + np.broadcast_to(distance, len(path))[:, None] * np.column_stack([-along[:, 1], along[:, 0]])


def smooth(path: NDArray[np.float64], sigma: float, *, is_closed: bool) -> NDArray[np.float64]:
    """Rounds corners with a Gaussian along the path.

    Args:
        path: (k, d) points at equal steps of `sigma / 6` or less.
        sigma: in steps.
        is_closed: the last point is the first one again.

    Returns:
        (k, d); ends stay where they are, unless the path is closed.
    """
    from scipy.ndimage import gaussian_filter1d

    if is_closed:
        ring = gaussian_filter1d(path[:-1], sigma, axis=0, mode="wrap")
        return np.vstack([ring, ring[:1]])
    line = np.linspace(0.0, 1.0, len(path))[:, None] * (path[-1] - path[0]) + path[0]
    # What is left after the straight line vanishes at both ends, and mirrored with a change of sign it stays so.
    padded = np.concatenate([-(path - line)[::-1][:-1], path - line, -(path - line)[::-1][1:]])
    rounded = gaussian_filter1d(padded, sigma, axis=0)
    return line + rounded[len(path) - 1 : 2 * len(path) - 1]
