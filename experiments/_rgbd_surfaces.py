"""How well the surfaces in depth images hold a planar trajectory: what `deepmapping_rgbd` says of its hard walks.

Images of one bare wall do not tell how far the camera moved along it, whatever the method. Here every pixel that an
image shares with another one, at the true poses and without noise, holds the two cameras together along the normal of
its surface, and nothing else does but a loose prior on the moves. The edges of surfaces that hide others hold more
than this says.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dpmjax.deepmapping import Pinhole, as_depth_scans
from dpmjax.geometry import image_normals
from dpmjax.io import DepthSequence
from dpmjax.metrics import absolute_trajectory_error

# Standard deviations: of the length of a move if nothing is seen, and of what a pixel says at depth 0.
_MOVE_M, _FLOOR_M = 0.3, 0.002
# Pixels whose depths differ by more than this share see different surfaces.
_SAME_DEPTH = 0.03
_NUM_DRAWS = 200


def surface_spread(sequence: DepthSequence, depth_noise_m: float) -> float:
    """Median ATE of the trajectories that the surfaces cannot tell from the true one.

    They are drawn from the normal distribution whose information matrix is that of point-to-plane distances between all
    pairs of images.

    Args:
        sequence: noise-free images of a level camera with their true poses.
        depth_noise_m: standard deviation of the depth at one metre; it grows with the square of the depth.

    Returns:
        Millimetres.
    """
    T = sequence.T_world_camera
    assert T is not None
    count = len(sequence)
    information = _information_of_moves(count)
    pinhole = as_depth_scans(sequence.points, sequence.mask).pinhole
    surfaces = image_normals(sequence.points, sequence.mask)
    for one in range(count):
        for other in range(count):
            if one != other:
                _add_pair(information, sequence, pinhole, surfaces, (one, other), depth_noise_m)
    # The first camera stays: the world has no frame of its own.
    root = np.linalg.cholesky(np.linalg.inv(information[3:, 3:]))
    draws = np.random.default_rng(0).standard_normal((_NUM_DRAWS, len(root))) @ root.T
    moved = np.concatenate([np.zeros((_NUM_DRAWS, 3)), draws], axis=1).reshape(_NUM_DRAWS, count, 3)
    errors = []
    for move in moved:
        positions = T[:, :3, 3].copy()
        positions[:, [0, 2]] += move[:, :2]
        errors.append(absolute_trajectory_error(positions, T[:, :3, 3]))
    return 1e3 * float(np.median(errors))


def _information_of_moves(count: int) -> Float[np.ndarray, "m m"]:
    """Information matrix of x, z and angle of all cameras if nothing is seen."""
    step = np.zeros((2 * (count - 1), 3 * count))
    for row in range(len(step)):
        camera, axis = divmod(row, 2)
        step[row, 3 * camera + axis], step[row, 3 * camera + 3 + axis] = -1.0, 1.0
    return step.T @ step / _MOVE_M**2


def _add_pair(
    information: NDArray[np.float64],
    sequence: DepthSequence,
    pinhole: Pinhole,
    surfaces: tuple[NDArray[np.float64], NDArray[np.bool_]],
    pair: tuple[int, int],
    depth_noise_m: float,
) -> None:
    """Adds what the points of one image say on the surfaces (normals, and where there are some) of another one."""
    T = sequence.T_world_camera
    assert T is not None
    one, other = pair
    normals, is_surface = (values[other] for values in surfaces)
    fx, fy, cx, cy = (float(value) for value in pinhole)
    height, width = sequence.mask.shape[1:]
    points = np.asarray(sequence.points[one][sequence.mask[one]], np.float64)
    world = points @ T[one, :3, :3].T + T[one, :3, 3]
    seen = (world - T[other, :3, 3]) @ T[other, :3, :3]
    depth = np.maximum(seen[:, 2], 1e-3)
    row, column = np.rint(fy * seen[:, 1] / depth + cy).astype(int), np.rint(fx * seen[:, 0] / depth + cx).astype(int)
    is_seen = (seen[:, 2] > 0.05) & (row >= 0) & (row < height - 1) & (column >= 0) & (column < width - 1)
    row, column = np.where(is_seen, row, 0), np.where(is_seen, column, 0)
    there = np.asarray(sequence.points[other, row, column, 2], np.float64)
    is_seen &= is_surface[row, column] & (np.abs(there - depth) < _SAME_DEPTH * depth)
    normal = normals[row, column][is_seen] @ T[other, :3, :3].T
    noise = depth_noise_m**2 * (points[is_seen, 2] ** 4 + there[is_seen] ** 4) + _FLOOR_M**2
    blocks = []
    for camera, sign in ((one, 1.0), (other, -1.0)):
        arm = world[is_seen] - T[camera, :3, 3]
        turned = normal[:, 0] * arm[:, 2] - normal[:, 2] * arm[:, 0]
        blocks.append(sign * np.stack([normal[:, 0], normal[:, 2], turned], axis=-1))
    for i, left in zip((one, other), blocks, strict=True):
        for j, right in zip((one, other), blocks, strict=True):
            information[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += (left / noise[:, None]).T @ right
