"""Organised depth images: points in the camera frames with their camera, and the surface between the pixels."""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike, NDArray

from dpmjax.checks import as_mask
from dpmjax.geometry import rigid


class Pinhole(NamedTuple):
    """A camera: column = fx x/z + cx, row = fy y/z + cy, in pixels."""

    fx: Array
    fy: Array
    cx: Array
    cy: Array


class PixelSample(NamedTuple):
    """Sampled points of each image, in the camera frame.

    Attributes:
        points: (n, p, 3), or (p, 3) of one image.
        mask: False for invalid points.
    """

    points: Float[Array, "... p 3"]
    mask: Bool[Array, "... p"]


@flax.struct.dataclass
class DepthScans:
    """Organised depth images as clouds in their camera frames (x right, y down, z forward).

    Attributes:
        points: metres, or typical ranges inside of the fit.
        mask: True for valid pixels.
        pinhole: camera of all images.
    """

    points: Float[Array, "n h w 3"]
    mask: Bool[Array, "n h w"]
    pinhole: Pinhole

    @property
    def surfaces(self) -> Float[Array, "n 4 r c"]:
        """Computes the surface between the pixels of each image; see `image_surface`."""
        return jax.vmap(image_surface)(jnp.where(self.mask, self.points[..., 2], 0.0))

    def take(self, rows: NDArray[np.integer]) -> DepthScans:
        """Returns the images of these rows."""
        return DepthScans(self.points[rows], self.mask[rows], self.pinhole)

    @property
    def pixels(self) -> PixelSample:
        """Returns all pixels of each image."""
        count = self.mask.shape[0]
        return PixelSample(self.points.reshape(count, -1, 3), self.mask.reshape(count, -1))


class Views(NamedTuple):
    """Images that are compared with each other; without the leading axis for one image.

    Attributes:
        sample: (r, p, 3) points of each image.
        surfaces: (r, 4, h - 1, w - 1) surfaces of `image_surface`.
    """

    sample: PixelSample
    surfaces: Float[Array, "... 4 r c"]


def as_depth_scans(points: ArrayLike, mask: ArrayLike | None = None) -> DepthScans:
    """Checks depth images and fits the camera.

    Args:
        points: (n, h, w, 3) in the camera frames (x right, y down, z forward), any unit.
        mask: (n, h, w) True for valid pixels; None: pixels that are not finite or all zero are invalid.

    Returns:
        The images with their camera.

    Raises:
        ValueError: the shapes are not (n, h, w, 3) and (n, h, w) with n >= 2. Also if an image has no valid pixel, or
            if a valid point is not finite or not in front of the camera (z above 0).
    """
    cloud = np.asarray(points, np.float32)
    if cloud.ndim != 4 or cloud.shape[-1] != 3 or len(cloud) < 2:
        raise ValueError(f"points: expected shape (n, h, w, 3) with n >= 2, got {cloud.shape}")
    is_finite = np.isfinite(cloud).all(-1)
    measured = is_finite & (np.abs(cloud).sum(-1) > 0)
    valid = as_mask("mask", measured if mask is None else np.asarray(mask), cloud.shape[:3], np)
    if (valid & ~is_finite).any():
        raise ValueError("points: expected finite coordinates where the mask is True")
    if (cloud[valid][:, 2] <= 0.0).any():
        raise ValueError("points: expected z above 0, in front of the camera, where the mask is True")
    empty = np.flatnonzero(~valid.any((1, 2)))
    if len(empty):
        raise ValueError(f"mask: image {empty[0]} has no valid pixel; leave it out ({len(empty)} such images)")
    pinhole = fit_pinhole(cloud, valid)
    return DepthScans(jnp.asarray(np.where(valid[..., None], cloud, 0.0)), jnp.asarray(valid), pinhole)


def image_surface(depth: Any) -> Any:
    """Computes the surface between the pixels of a depth image, by bilinear interpolation of the inverse depth.

    The inverse depth is linear on a plane.

    Args:
        depth: (h, w) depth along z, 0 at invalid pixels; of NumPy or of JAX.

    Returns:
        For each cell of four pixels the value at the upper left pixel, the slopes along columns and rows, and the
        mixed derivative. All are 0 where the four pixels do not lie on one surface. r = h - 1, c = w - 1.
    """
    xp = rigid.namespace_of(depth)
    inverse = xp.where(depth > 0.0, 1.0 / xp.where(depth > 0.0, depth, 1.0), 0.0)
    corners = xp.stack([inverse[:-1, :-1], inverse[:-1, 1:], inverse[1:, :-1], inverse[1:, 1:]])
    low, high = corners.min(axis=0), corners.max(axis=0)
    a, b, c, d = corners
    # Largest relative difference of the inverse depths of four pixels on one surface.
    return xp.where((low > 0.0) & (high - low < 0.15 * high), xp.stack([a, b - a, c - a, a - b - c + d]), 0.0)


def fit_pinhole(points: NDArray[np.floating], mask: NDArray[np.bool_]) -> Pinhole:
    """Fits the camera of organised clouds by least squares.

    Args:
        points: (n, h, w, 3) in the camera frames.
        mask: (n, h, w) True for valid pixels, with z above 0.

    Returns:
        Pinhole.
    """
    _, row, column = np.nonzero(mask)
    valid = np.asarray(points, np.float64)[mask]

    def line(ratio: NDArray[np.float64], pixel: NDArray[np.intp]) -> NDArray[np.float64]:
        return np.linalg.lstsq(np.stack([ratio, np.ones_like(ratio)], axis=-1), pixel, rcond=None)[0]

    (fx, cx), (fy, cy) = line(valid[:, 0] / valid[:, 2], column), line(valid[:, 1] / valid[:, 2], row)
    return Pinhole(*(jnp.asarray(value, jnp.float32) for value in (fx, fy, cx, cy)))


def surface_gap(
    T_other_camera: Float[Array, "4 4"], sample: PixelSample, surface_other: Float[Array, "4 r c"], pinhole: Pinhole
) -> tuple[Float[Array, " p"], Bool[Array, " p"]]:
    """Computes the distances of points in front of the surface of another camera's image.

    Args:
        T_other_camera: motion of the points into the frame of a second camera.
        sample: points of one image.
        surface_other: `image_surface` of that camera.
        pinhole: pinhole of that camera.

    Returns:
        Distance as a share of the surface's depth, negative behind the surface; and True for points that are projected
        to a surface, else the distance is 0.
    """
    gap, _, is_visible = surface_slopes(T_other_camera, sample, surface_other, pinhole)
    return gap, is_visible


def surface_slopes(
    T_other_camera: Float[Array, "4 4"], sample: PixelSample, surface_other: Float[Array, "4 r c"], pinhole: Pinhole
) -> tuple[Float[Array, " p"], Float[Array, "p 3"], Bool[Array, " p"]]:
    """Computes the distances of `surface_gap`, and how they change where a point moves.

    Args:
        T_other_camera: motion of the points into the frame of a second camera.
        sample: points of one image.
        surface_other: `image_surface` of that camera.
        pinhole: pinhole of that camera.

    Returns:
        The distances; their derivatives with respect to the point in the frame of the second camera; and True for
        points that are projected to a surface, else both are 0.
    """
    seen = rigid.transform_points(T_other_camera, sample.points)
    safe = jnp.maximum(seen[:, 2], 1e-3)
    x, y = seen[:, 0] / safe, seen[:, 1] / safe
    inverse, (along_row, along_column), is_smooth = _inverse_depth_at(
        surface_other, pinhole.fy * y + pinhole.cy, pinhole.fx * x + pinhole.cx
    )
    is_visible = sample.mask & (seen[:, 2] > 1e-3) & is_smooth
    by_x, by_y = pinhole.fx * along_column, pinhole.fy * along_row
    slopes = -jnp.stack([by_x, by_y, inverse - by_x * x - by_y * y], axis=-1)
    gap = jnp.where(is_visible, 1.0 - seen[:, 2] * inverse, 0.0)
    return gap, jnp.where(is_visible[:, None], slopes, 0.0), is_visible


def _inverse_depth_at(
    surface: Float[Array, "4 r c"], row: Float[Array, " p"], column: Float[Array, " p"]
) -> tuple[Float[Array, " p"], tuple[Float[Array, " p"], Float[Array, " p"]], Bool[Array, " p"]]:
    """Interpolates the inverse depth between four pixels, with its slopes; True where they lie on one surface."""
    num_rows, num_columns = surface.shape[1:]
    top = jnp.clip(jnp.floor(row).astype(jnp.int32), 0, num_rows - 1)
    left = jnp.clip(jnp.floor(column).astype(jnp.int32), 0, num_columns - 1)
    # One look-up in each of four flat arrays takes a seventh of the time of four look-ups in the image.
    cell = top * num_columns + left
    value, along_column, along_row, twist = (flat[cell] for flat in surface.reshape(4, -1))
    is_inside = (row >= 0.0) & (row <= num_rows) & (column >= 0.0) & (column <= num_columns)
    v, u = jnp.where(is_inside, row - top, 0.0), jnp.where(is_inside, column - left, 0.0)
    inverse = value + along_column * u + along_row * v + twist * u * v
    return inverse, (along_row + twist * u, along_column + twist * v), is_inside & (value > 0.0)
