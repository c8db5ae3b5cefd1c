"""Planar poses (x, y, heading): `pose_a_b` maps b-coordinates to a-coordinates.

Every function takes NumPy arrays (float64 on the host: trajectories, graphs) or JAX arrays (traced, differentiable),
with any leading axes, and returns the same kind and dtype. Lengths keep their unit, angles are radians.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpmjax.checks import require_value
from dpmjax.geometry.rigid import namespace_of

Poses = NDArray[np.float64]


def wrap_angle(angle: Any) -> Any:
    """Wraps angles; small angles come back unchanged, and the derivative is 1 everywhere.

    Args:
        angle: radians, any shape.

    Returns:
        The same angles in [-pi, pi].
    """
    return angle - 2 * np.pi * namespace_of(angle).round(angle / (2 * np.pi))


def compose(pose_a_b: Any, pose_b_c: Any) -> Any:
    """Composes two motions: `T_a_c = T_a_b @ T_b_c`.

    Args:
        pose_a_b: (..., 3) pose of b in a.
        pose_b_c: (..., 3) pose of c in b; leading axes broadcast.

    Returns:
        (..., 3) pose of c in a.
    """
    xp = namespace_of(pose_a_b, pose_b_c)
    cos, sin = xp.cos(pose_a_b[..., 2]), xp.sin(pose_a_b[..., 2])
    x = pose_a_b[..., 0] + cos * pose_b_c[..., 0] - sin * pose_b_c[..., 1]
    y = pose_a_b[..., 1] + sin * pose_b_c[..., 0] + cos * pose_b_c[..., 1]
    return xp.stack([x, y, wrap_angle(pose_a_b[..., 2] + pose_b_c[..., 2])], axis=-1)


def inverse(pose_a_b: Any) -> Any:
    """Inverts a motion.

    Args:
        pose_a_b: (..., 3) pose of b in a.

    Returns:
        (..., 3) pose of a in b.
    """
    xp = namespace_of(pose_a_b)
    x, y, heading = pose_a_b[..., 0], pose_a_b[..., 1], pose_a_b[..., 2]
    cos, sin = xp.cos(heading), xp.sin(heading)
    return xp.stack([-cos * x - sin * y, sin * x - cos * y, wrap_angle(-heading)], axis=-1)


def relative(pose_w_a: Any, pose_w_b: Any) -> Any:
    """Finds the motion between two poses: `T_a_b = inverse(T_w_a) @ T_w_b`.

    Args:
        pose_w_a: (..., 3) pose of a in any frame w.
        pose_w_b: (..., 3) pose of b in w; leading axes broadcast.

    Returns:
        (..., 3) pose of b in a.
    """
    xp = namespace_of(pose_w_a, pose_w_b)
    cos, sin = xp.cos(pose_w_a[..., 2]), xp.sin(pose_w_a[..., 2])
    # The difference first: poses far from the origin lose no digits to each other.
    dx, dy = pose_w_b[..., 0] - pose_w_a[..., 0], pose_w_b[..., 1] - pose_w_a[..., 1]
    heading = wrap_angle(pose_w_b[..., 2] - pose_w_a[..., 2])
    return xp.stack([cos * dx + sin * dy, -sin * dx + cos * dy, heading], axis=-1)


def is_within(motions: Any, length: Any, angle: Any) -> Any:
    """Compares motions with limits.

    Args:
        motions: (..., 3) x, y, heading.
        length: limit of the translation.
        angle: limit of the turn, radians.

    Returns:
        (...) True where the translation is shorter than `length`, and the turn smaller than `angle`.
    """
    xp = namespace_of(motions)
    is_short = xp.hypot(motions[..., 0], motions[..., 1]) < length
    return is_short & (xp.abs(wrap_angle(motions[..., 2])) < angle)


def share_of(pose_a_b: Any, share: Any) -> Any:
    """Computes the part of a motion along its arc: the power `T_a_b ** share`.

    Args:
        pose_a_b: (..., 3), headings in [-pi, pi].
        share: (...) 0: identity, 1: the motion itself.

    Returns:
        (..., 3).
    """
    xp = namespace_of(pose_a_b, share)
    angle = wrap_angle(pose_a_b[..., 2])
    # The chord of an arc is turned by half its angle; sinc(x) is sin(pi x) / (pi x).
    length = share * xp.sinc(share * angle / (2 * np.pi)) / xp.sinc(angle / (2 * np.pi))
    half = 0.5 * (share - 1.0) * angle
    cos, sin, x, y = length * xp.cos(half), length * xp.sin(half), pose_a_b[..., 0], pose_a_b[..., 1]
    return xp.stack([cos * x - sin * y, sin * x + cos * y, share * angle], axis=-1)


def chain(steps: Poses) -> Poses:
    """Chains steps to poses: `T_world_next = T_world_scan @ T_scan_next`, the first pose zero.

    Args:
        steps: (n - 1, 3) T_scan_next.

    Returns:
        (n, 3) T_world_scan.
    """
    poses = [np.zeros(3)]
    for step in steps:
        poses.append(compose(poses[-1], step))
    return np.array(poses)


def driven_lengths(poses: Poses) -> Poses:
    """Computes the length of a trajectory up to each of its poses.

    Args:
        poses: (n, 3) T_world_scan, on the host.

    Returns:
        (n,), the first one zero.
    """
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))


def rotation(heading: Any) -> Any:
    """Makes rotation matrices.

    Args:
        heading: (...) radians.

    Returns:
        (..., 2, 2).
    """
    xp = namespace_of(heading)
    cos, sin = xp.cos(heading), xp.sin(heading)
    return xp.stack([xp.stack([cos, -sin], axis=-1), xp.stack([sin, cos], axis=-1)], axis=-2)


def to_matrix(pose_a_b: Any) -> Any:
    """Makes homogeneous matrices.

    Args:
        pose_a_b: (..., 3).

    Returns:
        `T_a_b` (..., 3, 3).
    """
    xp = namespace_of(pose_a_b)
    x, y = pose_a_b[..., 0], pose_a_b[..., 1]
    cos, sin = xp.cos(pose_a_b[..., 2]), xp.sin(pose_a_b[..., 2])
    zero, one = xp.zeros_like(x), xp.ones_like(x)
    rows = [xp.stack(row, axis=-1) for row in ((cos, -sin, x), (sin, cos, y), (zero, zero, one))]
    return xp.stack(rows, axis=-2)


def from_matrix(T_a_b: Any) -> Any:
    """Reads poses off homogeneous matrices.

    Args:
        T_a_b: (..., 3, 3).

    Returns:
        (..., 3) poses, heading in [-pi, pi].
    """
    xp = namespace_of(T_a_b)
    return xp.stack([T_a_b[..., 0, 2], T_a_b[..., 1, 2], xp.arctan2(T_a_b[..., 1, 0], T_a_b[..., 0, 0])], axis=-1)


def as_poses(name: str, value: Any, count: int) -> NDArray[np.float64]:
    """Makes poses x, y, heading from such poses or from matrices, on the host.

    Args:
        name: name of the argument, for messages.
        value: (count, 3) x, y, heading, or (count, 3, 3) homogeneous matrices.
        count: number of poses.

    Returns:
        (count, 3) float64.

    Raises:
        ValueError: the shape is another one, or a number is not finite.
    """
    poses = np.asarray(value, np.float64)
    require_value(
        poses.shape in ((count, 3), (count, 3, 3)), name, f"shape ({count}, 3) or ({count}, 3, 3)", poses.shape
    )
    if not np.isfinite(poses).all():
        raise ValueError(f"{name}: expected finite poses")
    return poses if poses.ndim == 2 else from_matrix(poses)


def transform_points(pose_a_b: Any, points_b: Any) -> Any:
    """Moves the points of each scan by its pose.

    Args:
        pose_a_b: (..., 3).
        points_b: (..., n, 2) points in b.

    Returns:
        (..., n, 2) points in a.
    """
    xp = namespace_of(pose_a_b, points_b)
    cos, sin = xp.cos(pose_a_b[..., 2, None]), xp.sin(pose_a_b[..., 2, None])
    x = cos * points_b[..., 0] - sin * points_b[..., 1] + pose_a_b[..., 0, None]
    y = sin * points_b[..., 0] + cos * points_b[..., 1] + pose_a_b[..., 1, None]
    return xp.stack([x, y], axis=-1)


def adjoint(pose_a_b: Any) -> Any:
    """Makes the adjoint, which moves tangents (dx, dy, dheading) from b to a.

    Args:
        pose_a_b: (..., 3).

    Returns:
        (..., 3, 3).
    """
    xp = namespace_of(pose_a_b)
    cos, sin = xp.cos(pose_a_b[..., 2]), xp.sin(pose_a_b[..., 2])
    zero, one = xp.zeros_like(cos), xp.ones_like(cos)
    rows = ((cos, -sin, pose_a_b[..., 1]), (sin, cos, -pose_a_b[..., 0]), (zero, zero, one))
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
