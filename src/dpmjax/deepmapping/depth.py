"""DeepMapping of depth images (section 4.2): the problem, and `fit_depth` around the engine.

`spatial` has the poses; here are the images, and how they are compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike, NDArray

from dpmjax.deepmapping.batches import draw_offsets
from dpmjax.deepmapping.config import PhaseConfig
from dpmjax.deepmapping.depth_config import DepthMappingConfig
from dpmjax.deepmapping.engine import Fit, Report, fit
from dpmjax.deepmapping.objective import Terms, WorldBatch, chamfer_term, interpolate_log
from dpmjax.deepmapping.problem import (
    MappingData,
    MappingFunctions,
    Params,
    Problem,
    mapping_loss,
    mapping_problem,
)
from dpmjax.deepmapping.projective_consistency import DepthScans, PixelSample, consistency_of_pairs, fit_pinhole
from dpmjax.deepmapping.spatial import fitted_poses, init_spatial, next_spatial_phase, spatial_poses, start_poses
from dpmjax.geometry import rigid
from dpmjax.geometry.rays import typical_range


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


def fit_depth(
    scans: DepthScans | ArrayLike,
    config: DepthMappingConfig | None = None,
    *,
    key: jax.Array,
    start: ArrayLike | None = None,
    engine: Callable[..., Fit] = fit,
) -> DepthFitted:
    """Registers depth images by optimising L-Net and M-Net on them alone (DeepMapping section 4.2).

    Args:
        scans: (n, h, w, 3) in the camera frames, any unit, or DepthScans with their mask.
        config: settings; None: `depth_preset("fast")`.
        key: of the whole run.
        start: (n, 4, 4) T_world_camera to start from; None: cold start.
        engine: what trains, called as `engine(problem, data, key=key)`;
            `functools.partial(fit, on_report=..., stop=...)` reports each call of the step and can be stopped.

    Returns:
        DepthFitted, in the world of `start`, or an arbitrary one after a cold start.

    Raises:
        ValueError: as `as_depth_scans`, or `start` has a wrong shape or is not finite.
    """
    config = config or DepthMappingConfig()
    scans = scans if isinstance(scans, DepthScans) else as_depth_scans(scans)
    unit = typical_range(scans.points, scans.mask)
    T_start = None if start is None else start_poses(start, len(scans.points), unit)
    data = MappingData(replace(scans, points=scans.points / unit), T_start)
    fitted = engine(depth_problem(config, data), data, key=key)
    return DepthFitted(fitted_poses(fitted.poses, unit), fitted.state.params, fitted.report, unit)


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
    T = spatial_poses(config, phase, params, data)
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
    return mapping_problem(config, data, MappingFunctions(init_spatial, _loss, spatial_poses, next_spatial_phase))
