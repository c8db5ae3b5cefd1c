"""Organised depth images as the fit takes them, their camera, and how a camera moves."""

from __future__ import annotations

from typing import NamedTuple

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike, NDArray

from dpmjax.geometry import se3


class Pinhole(NamedTuple):
    """Where a ray meets the image, in cells: column = fx x/z + cx, row = fy y/z + cy."""

    fx: Array
    fy: Array
    cx: Array
    cy: Array


def fit_pinhole(points: NDArray[np.floating], mask: NDArray[np.bool_]) -> Pinhole:
    """The camera of organised clouds (n, h, w, 3), by least squares."""
    _, row, column = np.nonzero(mask)
    valid = np.asarray(points, np.float64)[mask]

    def line(ratio: NDArray[np.float64], cell: NDArray[np.intp]) -> NDArray[np.float64]:
        return np.linalg.lstsq(np.stack([ratio, np.ones_like(ratio)], axis=-1), cell, rcond=None)[0]

    (fx, cx), (fy, cy) = line(valid[:, 0] / valid[:, 2], column), line(valid[:, 1] / valid[:, 2], row)
    return Pinhole(*(jnp.asarray(value, jnp.float32) for value in (fx, fy, cx, cy)))


@flax.struct.dataclass
class DepthScans:
    """Organised depth images as clouds in their camera frames (x right, y down, z forward).

    Attributes:
        points: metres, or reaches inside of the fit.
        mask: True where something was measured.
        pinhole: of the camera that took all of them.
    """

    points: Float[Array, "n h w 3"]
    mask: Bool[Array, "n h w"]
    pinhole: Pinhole

    @property
    def depth(self) -> Float[Array, "n h w"]:
        """Depth along z, 0 where nothing was measured."""
        return jnp.where(self.mask, self.points[..., 2], 0.0)


def as_depth_scans(points: ArrayLike, mask: ArrayLike | None = None) -> DepthScans:
    """Depth images from arrays; without a mask, pixels that are not finite or all zero measured nothing.

    Raises:
        ValueError: the shapes are not (n, h, w, 3) and (n, h, w) with n >= 2, an image has no valid pixel, or what the
            mask calls valid is not finite or not in front of the camera (z above 0).
    """
    cloud = np.asarray(points, np.float32)
    if cloud.ndim != 4 or cloud.shape[-1] != 3 or len(cloud) < 2:
        raise ValueError(f"points: expected shape (n, h, w, 3) with n >= 2, got {cloud.shape}")
    is_finite = np.isfinite(cloud).all(-1)
    valid = is_finite & (np.abs(cloud).sum(-1) > 0) if mask is None else np.asarray(mask)
    if valid.shape != cloud.shape[:3] or valid.dtype != bool:
        raise ValueError(f"mask: expected bool of shape {cloud.shape[:3]}, got {valid.dtype} of {valid.shape}")
    if (valid & ~is_finite).any():
        raise ValueError("points: expected finite coordinates where the mask is True")
    if (cloud[valid][:, 2] <= 0.0).any():
        raise ValueError("points: expected z above 0, in front of the camera, where the mask is True")
    empty = np.flatnonzero(~valid.any((1, 2)))
    if len(empty):
        raise ValueError(f"mask: image {empty[0]} has no valid pixel; leave it out ({len(empty)} such images)")
    pinhole = fit_pinhole(cloud, valid)
    return DepthScans(jnp.asarray(np.where(valid[..., None], cloud, 0.0)), jnp.asarray(valid), pinhole)


def measure_depth_reach(scans: DepthScans) -> float:
    """The unit of length of the fit: the range that nine pixels in ten stay below, median over the images."""
    ranges = np.linalg.norm(np.asarray(scans.points), axis=-1)
    return float(np.median([np.percentile(r[m], 90) for r, m in zip(ranges, np.asarray(scans.mask), strict=True)]))


def motion_matrices(values: Float[Array, "n k"]) -> Float[Array, "n 4 4"]:
    """Motions as matrices: k = 3 are x, z and the angle about y (section 4.2), k = 6 is a twist (v, w)."""
    if values.shape[-1] == 6:
        return se3.exp(values)
    x, z, cos, sin = values[:, 0], values[:, 1], jnp.cos(values[:, 2]), jnp.sin(values[:, 2])
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    rows = ((cos, zero, sin, x), (zero, one, zero, zero), (-sin, zero, cos, z), (zero, zero, zero, one))
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
