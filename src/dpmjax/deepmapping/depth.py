"""DeepMapping of depth images (section 4.2): the problem, and `fit_depth` around the engine.

Poses are T_start @ motion. The start is kept as it is given; L-Net's output, or what is optimised freely, is a motion
after it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike, NDArray

from dpmjax.deepmapping.config import DepthMappingConfig, PhaseConfig
from dpmjax.deepmapping.fit import Report, fit
from dpmjax.deepmapping.objective import Terms, WorldBatch, chamfer_term, interpolate_log
from dpmjax.deepmapping.problem import (
    MapFrame,
    MappingData,
    MappingFunctions,
    Params,
    Problem,
    choose_frame,
    draw_offsets,
    mapping_loss,
    mapping_problem,
)
from dpmjax.deepmapping.projective_consistency import DepthScans, PixelSample, consistency_of_pairs, fit_pinhole
from dpmjax.geometry import rigid, se3
from dpmjax.geometry.rays import typical_range
from dpmjax.nets.localization import LocalizationNet
from dpmjax.nets.occupancy import init_map_net


class DepthFitted(NamedTuple):
    """Result of `fit_depth`.

    Attributes:
        T_world_camera: (n, 4, 4) float64, unit of the points.
        params: of L-Net and M-Net.
        report: of the last call of the step.
        unit: the length that the parameters count in, unit of the points.
    """

    T_world_camera: NDArray[np.float64]
    params: Params
    report: Report | None
    unit: float


def as_depth_scans(points: ArrayLike, mask: ArrayLike | None = None) -> DepthScans:
    """Checked depth images.

    Args:
        points: (n, h, w, 3) in the camera frames (x right, y down, z forward), any unit.
        mask: (n, h, w) True where something was measured; None: pixels that are not finite or all zero measured
            nothing.

    Returns:
        The images with their camera.

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


def motion_matrices(values: Float[Array, "n k"]) -> Float[Array, "n 4 4"]:
    """Motions as matrices.

    Args:
        values: k = 3 are x, z and the angle about y (section 4.2), k = 6 is a twist (v, w).

    Returns:
        (n, 4, 4) rigid motions.
    """
    if values.shape[-1] == 6:
        return se3.exp(values)
    x, z, cos, sin = values[:, 0], values[:, 1], jnp.cos(values[:, 2]), jnp.sin(values[:, 2])
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    rows = ((cos, zero, sin, x), (zero, one, zero, zero), (-sin, zero, cos, z), (zero, zero, zero, one))
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def fit_depth(
    scans: DepthScans | ArrayLike,
    config: DepthMappingConfig | None = None,
    *,
    key: jax.Array,
    init: ArrayLike | None = None,
    num_starts: int = 1,
) -> DepthFitted:
    """Registers depth images by optimising L-Net and M-Net on them alone (DeepMapping section 4.2).

    Args:
        scans: (n, h, w, 3) in the camera frames, any unit, or DepthScans with their mask.
        config: settings; None: `depth_preset("fast")`.
        key: of the whole run.
        init: (n, 4, 4) T_world_camera to start from; None: cold start.
        num_starts: starts with other weights, side by side; the worse half by the loss is dropped again and again.

    Returns:
        DepthFitted, in the world of `init`, or an arbitrary one after a cold start.

    Raises:
        ValueError: as `as_depth_scans`, or `init` has a wrong shape or is not finite.
    """
    config = config or DepthMappingConfig()
    scans = scans if isinstance(scans, DepthScans) else as_depth_scans(scans)
    unit = typical_range(scans.points, scans.mask)
    start = None if init is None else _start_poses(init, len(scans.points), unit)
    data = MappingData(replace(scans, points=scans.points / unit), start)
    fitted = fit(depth_problem(config, data), data, key=key, num_starts=num_starts)
    T = np.array(fitted.poses, np.float64)
    T[:, :3, 3] *= unit
    return DepthFitted(T, fitted.state.params, fitted.report, unit)


def _start_poses(poses: ArrayLike, num_scans: int, unit: float) -> Float[Array, "n 4 4"]:
    """Checked poses to start from, in typical ranges."""
    T = np.array(poses, np.float64)
    if T.shape != (num_scans, 4, 4) or not np.isfinite(T).all():
        raise ValueError(f"init: expected finite numbers of shape ({num_scans}, 4, 4), got {T.shape}")
    T[:, :3, 3] /= unit
    return jnp.asarray(T, jnp.float32)


def _net(config: DepthMappingConfig) -> LocalizationNet:
    return LocalizationNet(config.localization, 3 if config.motion == "planar" else 6)


def _motions(config: DepthMappingConfig, phase: PhaseConfig, params: Params, scans: DepthScans) -> Float[Array, "n k"]:
    if phase.poses == "free":
        return params.poses
    return jax.vmap(_net(config).apply, in_axes=(None, 0, 0))(params.localization, scans.points, scans.mask)  # type: ignore[return-value]


def _poses(config: DepthMappingConfig, phase: PhaseConfig, params: Params, data: MappingData) -> Float[Array, "n 4 4"]:
    motions = motion_matrices(_motions(config, phase, params, data.scans))
    return jnp.matmul(params.start, motions, precision=jax.lax.Precision.HIGHEST)


def _choose_frame(config: DepthMappingConfig, scans: DepthScans, T: Float[Array, "n 4 4"]) -> MapFrame:
    """The cube that the images cover at these poses."""
    count = scans.mask.shape[0]
    world = rigid.transform_points(T, scans.points.reshape(count, -1, 3))
    return choose_frame(world, scans.mask.reshape(count, -1), config.map_margin)


def _init(config: DepthMappingConfig, key: jax.Array, data: MappingData) -> Params:
    """Without a start all cameras are at one place."""
    net_key, map_key = jax.random.split(key)
    scans, start = data
    count, net = scans.mask.shape[0], _net(config)
    T_start = jnp.tile(jnp.eye(4), (count, 1, 1)) if start is None else start
    params = Params(
        localization=net.init(net_key, scans.points[0], scans.mask[0]),
        poses=jnp.zeros((count, net.num_outputs)),
        occupancy=init_map_net(config.occupancy, key=map_key, num_dimensions=3),
        start=T_start,
        frame=_choose_frame(config, scans, T_start),
    )
    first = config.cold_phases[0]
    if first.poses == "free" and start is None:
        # The paper's direct baseline starts where L-Net's first forward pass puts the cameras.
        params = replace(params, poses=_motions(config, replace(first, poses="network"), params, scans))
    return params


def _next_phase(config: DepthMappingConfig, phase: PhaseConfig, params: Params, data: MappingData) -> Params:
    """The poses reached are the new start, in a map frame around them."""
    T = _poses(config, phase, params, data)
    return replace(params, poses=jnp.zeros_like(params.poses), start=T, frame=_choose_frame(config, data.scans, T))


def _draw_pixels(scans: DepthScans, count: int, *, key: jax.Array) -> PixelSample:
    """Other pixels from each image: equal ones would pull equal rays together."""
    num_scans, height, width = scans.mask.shape
    points, mask = scans.points.reshape(num_scans, -1, 3), scans.mask.reshape(num_scans, -1)
    if count >= height * width:
        return PixelSample(points, mask)
    keys = jax.random.split(key, num_scans)
    pixels = jax.vmap(lambda key: jax.random.randint(key, (count,), 0, height * width))(keys)
    points = jnp.take_along_axis(points, pixels[..., None], axis=1)
    return PixelSample(points, jnp.take_along_axis(mask, pixels, axis=1))


def _loss(
    config: DepthMappingConfig,
    phase: PhaseConfig,
    params: Params,
    data: MappingData,
    step: Int[Array, ""],
    key: jax.Array,
) -> tuple[Float[Array, ""], Terms]:
    """DeepMapping eq. 6 of a batch of pixels; images are compared by the Chamfer distance or by projection."""
    batch_key, loss_key = jax.random.split(key)
    scans, progress = data.scans, step / phase.num_steps
    count = scans.mask.shape[0]
    sample = _draw_pixels(scans, phase.beams_per_step, key=batch_key)
    T = _poses(config, phase, params, data)
    rows = jnp.arange(count)
    points = rigid.transform_points(T, sample.points)
    world = WorldBatch(points, T[:, :3, 3], sample.mask, rows, jnp.zeros_like(rows), progress)
    free_key, offset_key = jax.random.split(loss_key)
    if phase.projection_tolerance is None:
        limit = None if phase.chamfer_limit is None else interpolate_log(phase.chamfer_limit, progress)
        pair_term = chamfer_term(world, draw_offsets(phase, count - 1, key=offset_key), limit)
    else:
        tolerance = interpolate_log(phase.projection_tolerance, progress)
        offsets = draw_offsets(phase, count // 2, key=offset_key)
        pair_term = 1.0 - consistency_of_pairs(T, sample, scans, offsets, tolerance)
    return mapping_loss(config, phase, params, world, pair_term, key=free_key)


def depth_problem(config: DepthMappingConfig, data: MappingData) -> Problem:
    """DeepMapping of depth images; poses are (n, 4, 4) T_world_camera.

    Args:
        config: settings of the fit.
        data: DepthScans and first poses, in typical ranges.

    Returns:
        The problem.
    """
    return mapping_problem(config, data, MappingFunctions(_init, _loss, _poses, _next_phase))
