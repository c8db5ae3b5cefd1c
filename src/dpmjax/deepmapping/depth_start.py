"""A start for depth images without any first guess: one image after the other is placed where it contradicts the
images before it least.

What two depth images say of each other costs one projection: a point of one that lands on the surface that the other
sees agrees with it; a point that floats in front of that surface contradicts it, for the other camera looked through
it (the self-contradictory occupancy of DeepMapping figure 3, asked of the images instead of the map); a point behind it
is hidden and says nothing. A beam search over motions maximises agreements less contradictions against the last images
together, coarse to fine.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from dpmjax.deepmapping.depth_config import Motion
from dpmjax.deepmapping.depth_fit import DepthScans, motion_matrices
from dpmjax.geometry.poses import invert, transform_points

# Four pixels whose inverse depths differ by less than this share lie on one surface; else an edge runs between them.
_EDGE = 0.15


@dataclass(frozen=True)
class DepthStartConfig:
    """Settings of the search. Lengths are in the unit of the points, metres by default.

    Attributes:
        max_translation: between neighbouring images, along each axis.
        max_turn_deg: between neighbouring images, about the vertical axis of the camera.
        max_tilt_deg: about the other axes; full motion only.
        num_candidates: motions that are tried at first, spread evenly.
        num_kept: best ones that go on to the next round.
        num_rounds: each kept motion is varied, half as widely as in the round before.
        num_references: images before that are compared to.
        num_points: of each image.
        tolerance: share of the depth by which agreeing points may differ, in the first and in the last round.
    """

    max_translation: float = 0.7
    max_turn_deg: float = 75.0
    max_tilt_deg: float = 30.0
    num_candidates: int = 4096
    num_kept: int = 32
    num_rounds: int = 7
    num_references: int = 4
    num_points: int = 200
    tolerance: tuple[float, float] = (0.12, 0.01)

    def __post_init__(self) -> None:
        if min(self.num_candidates, self.num_kept, self.num_rounds, self.num_references, self.num_points) < 1:
            raise ValueError(f"all counts must be at least 1, got {self}")


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
    fx, cx = np.polyfit(valid[:, 0] / valid[:, 2], column, 1)
    fy, cy = np.polyfit(valid[:, 1] / valid[:, 2], row, 1)
    return Pinhole(*(jnp.asarray(value, jnp.float32) for value in (fx, fy, cx, cy)))


def agreement(
    T_other_camera: Float[Array, "4 4"],
    points: Float[Array, "p 3"],
    mask: Bool[Array, " p"],
    depth_other: Float[Array, "h w"],
    pinhole: Pinhole,
    tolerance: Float[Array, ""],
) -> Float[Array, ""]:
    """Agreements less contradictions of points with what another camera sees, per point, in [-1, 1].

    Args:
        T_other_camera: brings the points into the frame of the other camera.
        points: in their camera frame.
        mask: False for points that are not there.
        depth_other: depth image of the other camera, 0 where nothing was measured.
        pinhole: of the other camera.
        tolerance: share of the depth by which agreeing points may differ.
    """
    seen = transform_points(T_other_camera, points)
    depth = seen[:, 2]
    safe = jnp.maximum(depth, 1e-3)
    column = pinhole.fx * seen[:, 0] / safe + pinhole.cx
    row = pinhole.fy * seen[:, 1] / safe + pinhole.cy
    inverse, is_smooth = _inverse_depth_at(depth_other, row, column)
    is_told = mask & (depth > 1e-3) & is_smooth
    # How far the point is in front of the surface, in shares of the surface's depth, over the tolerance.
    gap = jnp.where(is_told, 1.0 - depth * inverse, 0.0) / tolerance
    floats = jax.nn.sigmoid(3.0 * (gap - 2.0))
    score = jnp.where(is_told, jnp.exp(-(gap**2)) - floats, 0.0)
    return score.sum() / jnp.maximum(mask.sum(), 1)


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


def place_images(
    scans: DepthScans, config: DepthStartConfig | None = None, *, motion: Motion = "planar", key: jax.Array
) -> NDArray[np.float64]:
    """Poses of all images, the first at the origin.

    Args:
        scans: in order of time; neighbours overlap.
        config: of the search.
        motion: "planar" or "full".
        key: of the search.

    Returns:
        (n, 4, 4) T_world_camera, unit of the points.
    """
    config = config or DepthStartConfig()
    num_scans = scans.mask.shape[0]
    points, mask = np.asarray(scans.points), np.asarray(scans.mask)
    pinhole = fit_pinhole(points, mask)
    depth = jnp.asarray(np.where(mask, points[..., 2], 0.0))
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    chosen = [rng.choice(np.flatnonzero(m), config.num_points) for m in mask.reshape(num_scans, -1)]
    some = jnp.asarray(np.stack([p[c] for p, c in zip(points.reshape(num_scans, -1, 3), chosen, strict=True)]))
    T = [np.eye(4)]
    for scan in range(1, num_scans):
        # A window of fixed length: where there are fewer images before, the last is repeated without weight.
        rows = np.maximum(scan - 1 - np.arange(config.num_references), 0)
        weights = (scan - 1 - np.arange(config.num_references) >= 0).astype(np.float32)
        T_last_reference = np.linalg.inv(T[-1]) @ np.stack([T[row] for row in rows])
        T_last_scan = _search(
            jnp.asarray(T_last_reference, jnp.float32),
            jnp.asarray(weights),
            some[rows],
            depth[rows],
            some[scan],
            depth[scan],
            pinhole,
            jax.random.fold_in(key, scan),
            config=config,
            motion=motion,
        )
        T.append(T[-1] @ np.asarray(T_last_scan, np.float64))
    return np.stack(T)


@partial(jax.jit, static_argnames=("config", "motion"))
def _search(
    T_last_reference: Float[Array, "r 4 4"],
    weights: Float[Array, " r"],
    reference_points: Float[Array, "r p 3"],
    reference_depth: Float[Array, "r h w"],
    points: Float[Array, "p 3"],
    depth: Float[Array, "h w"],
    pinhole: Pinhole,
    key: jax.Array,
    *,
    config: DepthStartConfig,
    motion: Motion,
) -> Float[Array, "4 4"]:
    """T_last_scan of the image."""
    everywhere = jnp.ones(points.shape[0], bool)

    def score(values: Float[Array, " k"], tolerance: Array) -> Array:
        T_last_scan = motion_matrices(values[None])[0]

        def against(T_last_ref: Array, ref_points: Array, ref_depth: Array) -> Array:
            T_ref_scan = jnp.matmul(invert(T_last_ref), T_last_scan, precision=jax.lax.Precision.HIGHEST)
            there = agreement(T_ref_scan, points, everywhere, ref_depth, pinhole, tolerance)
            back = agreement(invert(T_ref_scan), ref_points, everywhere, depth, pinhole, tolerance)
            return there + back

        scores = jax.vmap(against)(T_last_reference, reference_points, reference_depth)
        return jnp.sum(weights * scores)

    turn, tilt = np.deg2rad(config.max_turn_deg), np.deg2rad(config.max_tilt_deg)
    reach = config.max_translation
    widths = jnp.array([reach, reach, turn] if motion == "planar" else [reach, reach, reach, tilt, turn, tilt])
    first_key, round_key = jax.random.split(key)
    values = widths * jax.random.uniform(first_key, (config.num_candidates, len(widths)), minval=-1.0, maxval=1.0)
    values = values.at[0].set(0.0)
    first, last = np.log(config.tolerance[0]), np.log(config.tolerance[1])
    num_varied = config.num_candidates // config.num_kept
    for step in range(config.num_rounds):
        tolerance = jnp.exp(first + (last - first) * step / max(config.num_rounds - 1, 1))
        scores = jax.lax.map(partial(score, tolerance=tolerance), values, batch_size=256)
        best = values[jax.lax.top_k(scores, config.num_kept)[1]]
        if step + 1 == config.num_rounds:
            return motion_matrices(best[:1])[0]
        noise = jax.random.normal(jax.random.fold_in(round_key, step), (num_varied, *best.shape))
        spread = 0.25 * widths * 0.5**step
        # The kept ones themselves stay in the race.
        values = (best + spread * noise.at[0].set(0.0)).reshape(-1, len(widths))
    raise AssertionError
