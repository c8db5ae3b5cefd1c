"""What depth images at given poses say of each other: agreements less contradictions.

An organised image is its own nearest-neighbour structure: two of them are compared by one projection each way, and a
point is held against the surface between the pixels instead of against the nearest of them.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dpmjax.deepmapping.depth_scans import DepthScans, Pinhole
from dpmjax.geometry import rigid

# Four pixels whose inverse depths differ by less than this share lie on one surface; else an edge runs between them.
_EDGE = 0.15
# What a contradiction costs in agreements: along a bare wall a wrong place agrees nearly everywhere, and overlaps more.
_CONTRADICTION = 3.0
# Agreements count as a share of what is told, not of all points, or else every image would be pulled onto the others;
# with this share of all points added, a little overlap that agrees is worth little.
_UNTOLD = 0.1


def agreement(
    T_other_camera: Float[Array, "4 4"],
    points: Float[Array, "p 3"],
    mask: Bool[Array, " p"],
    depth_other: Float[Array, "h w"],
    pinhole: Pinhole,
    tolerance: Float[Array, ""],
) -> Float[Array, ""]:
    """Agreements less contradictions of points with what another camera sees, per told point, in [-3, 1].

    A point that lands on the surface that the other camera sees agrees with it; one that floats in front of that
    surface contradicts it, for the other camera looked through it (the self-contradictory occupancy of DeepMapping
    figure 3, asked of the image instead of the map); one behind it is hidden and says nothing.

    Args:
        T_other_camera: brings the points into the frame of the other camera.
        points: in their camera frame.
        mask: False for points that are not there.
        depth_other: depth image of the other camera, 0 where nothing was measured.
        pinhole: of the other camera.
        tolerance: share of the depth by which agreeing points may differ.
    """
    seen = rigid.transform_points(T_other_camera, points)
    depth = seen[:, 2]
    safe = jnp.maximum(depth, 1e-3)
    column = pinhole.fx * seen[:, 0] / safe + pinhole.cx
    row = pinhole.fy * seen[:, 1] / safe + pinhole.cy
    inverse, is_smooth = _inverse_depth_at(depth_other, row, column)
    is_told = mask & (depth > 1e-3) & is_smooth
    # How far the point is in front of the surface, in shares of the surface's depth, over the tolerance.
    gap = jnp.where(is_told, 1.0 - depth * inverse, 0.0) / tolerance
    floats = jax.nn.sigmoid(3.0 * (gap - 2.0))
    score = jnp.where(is_told, jnp.exp(-(gap**2)) - _CONTRADICTION * floats, 0.0)
    return score.sum() / jnp.maximum(is_told.sum() + _UNTOLD * mask.sum(), 1.0)


def _inverse_depth_at(
    depth: Float[Array, "h w"], row: Float[Array, " p"], column: Float[Array, " p"]
) -> tuple[Float[Array, " p"], Bool[Array, " p"]]:
    """One over the depth between four pixels, which is linear on a plane; and whether they lie on one surface."""
    height, width = depth.shape
    top = jnp.clip(jnp.floor(row).astype(jnp.int32), 0, height - 2)
    left = jnp.clip(jnp.floor(column).astype(jnp.int32), 0, width - 2)
    inverse = jnp.where(depth > 0.0, 1.0 / jnp.where(depth > 0.0, depth, 1.0), 0.0)
    corners = jnp.stack([inverse[top + i, left + j] for i in (0, 1) for j in (0, 1)], axis=-1)
    v, u = row - top, column - left
    shares = jnp.stack([(1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u], axis=-1)
    is_inside = (row >= 0.0) & (row <= height - 1) & (column >= 0.0) & (column <= width - 1)
    low, high = corners.min(-1), corners.max(-1)
    is_smooth = is_inside & (low > 0.0) & (high - low < _EDGE * high)
    return jnp.sum(jnp.where(is_inside[:, None], shares, 0.0) * corners, axis=-1), is_smooth


def agreement_of_pairs(
    T_world_camera: Float[Array, "n 4 4"],
    points: Float[Array, "n p 3"],
    mask: Bool[Array, "n p"],
    depth: Float[Array, "n h w"],
    pinhole: Pinhole,
    offsets: Int[Array, " o"],
    tolerance: Float[Array, ""],
) -> Float[Array, ""]:
    """Mean agreement of each image with those `offsets` later, the last followed by the first, both ways.

    Args:
        T_world_camera: poses.
        points: some points of each image, in its camera frame.
        mask: False for points that are not there.
        depth: depth images, 0 where nothing was measured.
        pinhole: of the camera.
        offsets: 1 to n - 1.
        tolerance: share of the depth by which agreeing points may differ.
    """
    count = T_world_camera.shape[0]
    compare = jax.vmap(partial(agreement, pinhole=pinhole, tolerance=tolerance))

    def against(offset: Int[Array, ""]) -> Float[Array, ""]:
        other = (jnp.arange(count) + offset) % count
        T_other_camera = jnp.matmul(
            rigid.inverse(T_world_camera[other]), T_world_camera, precision=jax.lax.Precision.HIGHEST
        )
        there = compare(T_other_camera, points, mask, depth[other])
        back = compare(rigid.inverse(T_other_camera), points[other], mask[other], depth)
        return 0.5 * (there + back).mean()

    return jax.lax.map(against, offsets).mean()


@jax.jit
def mean_agreement(
    scans: DepthScans, T_world_camera: Float[Array, "n 4 4"], tolerance: Float[Array, ""] | float = 0.02
) -> Float[Array, ""]:
    """Mean agreement of all pairs of images, all their pixels: which of several trajectories is right, without a truth.

    Args:
        scans: depth images.
        T_world_camera: their poses, unit of the points.
        tolerance: share of the depth by which agreeing points may differ.

    Returns:
        -3 (everything floats in front of something) to 1; images that see nothing of each other count 0.
    """
    count = scans.mask.shape[0]
    points, mask = scans.points.reshape(count, -1, 3), scans.mask.reshape(count, -1)
    # Half the circle of offsets has every pair once.
    offsets = jnp.arange(1, count // 2 + 1)
    T = jnp.asarray(T_world_camera, points.dtype)
    return agreement_of_pairs(T, points, mask, scans.depth, scans.pinhole, offsets, jnp.asarray(tolerance))
