"""Smallest possible error of positions in a known planar world: the Cramér-Rao bound under range noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike, NDArray

# Beams whose range changes faster than this jump between obstacles.
_STEEPEST = 10.0


def position_bound(
    cast_ranges: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    poses: ArrayLike,
    *,
    range_noise: float,
    step: float = 0.5,
) -> Float[np.ndarray, " n"]:
    """The least error of position that an unbiased estimate from one scan can have, with the world known exactly.

    The information of a scan is J^T J / noise^2, where J is the derivative of its ranges by x, y and heading (Kay 1993,
    eq. 3.31). An estimate that must find the world too cannot do better. The root mean square over the scans of a
    trajectory bounds its absolute trajectory error, up to the alignment of the trajectories (three of 3 n unknowns).

    Args:
        cast_ranges: ranges (m, b) of noise-free scans from poses (m, 3) in the world.
        poses: (n, 3) x, y in the unit of the ranges, heading in radians.
        range_noise: standard deviation of the noise of one range.
        step: half step of the numeric derivative of ranges; in a world of pixels, half a pixel.

    Returns:
        (n,) root of the summed variances of x and y; infinite where the scan leaves a direction open.
    """
    at = np.asarray(poses, np.float64).reshape(-1, 3)
    steps = np.diag([step, step, 1e-3])
    jacobian = np.stack([(cast_ranges(at + d) - cast_ranges(at - d)) / (2.0 * d.sum()) for d in steps], axis=-1)
    # A turn moves the end of a beam by its length.
    ranges = cast_ranges(at)
    steepness = np.abs(jacobian) / np.stack([np.ones_like(ranges), np.ones_like(ranges), ranges], axis=-1)
    used = jacobian * (steepness < _STEEPEST).all(axis=-1, keepdims=True)
    information = np.einsum("nbi,nbj->nij", used, used) / range_noise**2
    bound = np.full(len(at), np.inf)
    is_held = np.linalg.eigvalsh(information)[:, 0] > 1e-9 / range_noise**2
    covariance = np.linalg.inv(information[is_held])
    bound[is_held] = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
    return bound
