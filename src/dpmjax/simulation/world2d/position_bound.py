"""How well scans of a planar world can be placed at all: the Cramér-Rao bound under range noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike, NDArray

from dpmjax.simulation.world2d.raycast import beam_angles, cast_rays

# Ranges are differentiated over half a pixel to either side: walls are rows of pixels, and slanted ones are stairs.
_STEP_PX = 0.5
# Beams whose range changes faster than this jump between walls.
_STEEPEST = 10.0


def position_bound(
    is_obstacle: NDArray[np.bool_], poses: ArrayLike, *, range_noise_px: float, num_beams: int = 256
) -> Float[np.ndarray, " n"]:
    """The least error of position that an unbiased estimate from one scan can have, with the world known exactly.

    The information of a scan is J^T J / noise^2, J the derivative of its ranges by x, y and heading (Kay 1993, eq.
    3.31). Whoever must find the world too cannot do better; the root mean square over the scans of a trajectory is a
    bound on its absolute trajectory error, but for what the alignment of the trajectories takes away (three unknowns of
    3 n).

    Args:
        is_obstacle: (h, w), True where a pixel is solid.
        poses: (n, 3) x, y (px) and heading (radians) in the world.
        range_noise_px: standard deviation of the noise of one range.
        num_beams: beams of a scan over 360 degrees.

    Returns:
        (n,) root of the summed variances of x and y, px; infinite where the scan leaves a direction open.

    Raises:
        ValueError: a pose lies in an obstacle or within half a pixel of one.
    """
    pose = np.asarray(poses, np.float64).reshape(-1, 3)
    steps = np.diag([_STEP_PX, _STEP_PX, 1e-3])

    def cast(at: NDArray[np.float64]) -> NDArray[np.float64]:
        angles = (at[:, 2:] + beam_angles(num_beams)).ravel()
        return cast_rays(is_obstacle, np.repeat(at[:, :2], num_beams, axis=0), angles).ranges.reshape(-1, num_beams)

    jacobian = np.stack([(cast(pose + step) - cast(pose - step)) / (2.0 * step.sum()) for step in steps], axis=-1)
    # A turn moves the end of a beam by its length.
    ranges = cast(pose)
    steepness = np.abs(jacobian) / np.stack([np.ones_like(ranges), np.ones_like(ranges), ranges], axis=-1)
    used = jacobian * (steepness < _STEEPEST).all(axis=-1, keepdims=True)
    information = np.einsum("nbi,nbj->nij", used, used) / range_noise_px**2
    bound = np.full(len(pose), np.inf)
    is_held = np.linalg.eigvalsh(information)[:, 0] > 1e-9 / range_noise_px**2
    covariance = np.linalg.inv(information[is_held])
    bound[is_held] = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
    return bound
