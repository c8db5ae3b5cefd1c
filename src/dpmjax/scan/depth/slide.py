"""Shifts of a depth image along its own surfaces: an image of a wall hardly constrains the motion along the wall."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from dpmjax.scan.depth.align import DepthImages, Poses, group_consistency, linearise_images, step_poses


def slide_motions(T: Poses, directions: Float[np.ndarray, "a 3"], lengths: Float[np.ndarray, " s"]) -> Poses:
    """Shifts motions along the axes of an image.

    Args:
        T: (m, 4, 4) motions of the image.
        directions: principal axes of its surfaces, in its frame.
        lengths: of the shifts, unit of the points.

    Returns:
        The motions, and each motion after each shift along each axis.
    """
    return np.concatenate([T, (T[:, None] @ _shifts(lengths, directions)).reshape(-1, 4, 4)])


def slide_margin(images: DepthImages, T_world_camera: Poses, tolerance: float, distance: float) -> tuple[float, float]:
    """Compares the consistency of the last image with that after shifts along the axes of its surfaces.

    Args:
        images: n views and their camera.
        T_world_camera: (n, 4, 4) poses.
        tolerance: share of the depth by which matching points may differ.
        distance: of the longer shifts, unit of the points.

    Returns:
        The consistency of the last image with all others, and by how much it exceeds that after the best shift.
    """
    view, T, count = images.views[-1], T_world_camera[-1], len(T_world_camera) - 1
    moves = _shifts(distance * np.array([0.5, -0.5, 1.0, -1.0]), view.directions)
    nodes = np.concatenate([T_world_camera, T @ moves])
    own, other = np.divmod(np.arange((1 + len(moves)) * count), count)
    pairs = np.stack([np.r_[own + count, other], np.r_[other, own + count]], axis=1)
    shifted = images._replace(views=[*images.views, *[view] * len(moves)])
    found = linearise_images(shifted, nodes, pairs, tolerance)
    scores = group_consistency(found, pairs.max(axis=1) - count, 1 + len(moves))
    return float(scores[0]), float(scores[0] - scores[1:].max())


def _shifts(lengths: Float[np.ndarray, " s"], directions: Float[np.ndarray, "a 3"]) -> Poses:
    shifts = (lengths[:, None, None] * directions).reshape(-1, 3)
    return step_poses(np.eye(4), np.concatenate([shifts, np.zeros_like(shifts)], axis=1))
