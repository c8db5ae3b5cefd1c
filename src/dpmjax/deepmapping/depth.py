"""DeepMapping of depth images (section 4.2): the problem, `fit_depth` around the engine, and `register_depth`.

`spatial` has the poses; here are the images, and how they are compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike, NDArray

from dpmjax.deepmapping.batches import draw_offsets
from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig, ProjectiveComparison
from dpmjax.deepmapping.depth_initialization import initialize_depth
from dpmjax.deepmapping.depth_motion_search import depth_search
from dpmjax.deepmapping.engine import Fit, Report, fit
from dpmjax.deepmapping.objective import Terms, WorldBatch, chamfer_term, interpolate_log
from dpmjax.deepmapping.presets import depth_preset
from dpmjax.deepmapping.problem import MappingData, MappingFunctions, Params, Problem, mapping_loss, mapping_problem
from dpmjax.deepmapping.projective_consistency import (
    DepthScans,
    PixelSample,
    consistency_of_pairs,
    fit_pinhole,
    projective_consistency,
)
from dpmjax.deepmapping.spatial import fitted_poses, init_spatial, next_spatial_phase, spatial_poses, start_poses
from dpmjax.geometry import rigid
from dpmjax.geometry.sampling import typical_range


class RegisteredDepth(NamedTuple):
    """Result of `register_depth`.

    Attributes:
        T_world_camera: (n, 4, 4) float64, unit of the points: of the fit, or the start where that agrees better.
        kept: source of the poses, the fit or the start.
        consistency: projective consistency of the fit, at most 1.
        start_consistency: the same of the start.
        start: (n, 4, 4) poses that the fit started from.
        fitted: DeepMapping of the images.
    """

    T_world_camera: NDArray[np.float64]
    kept: Literal["fit", "start"]
    consistency: float
    start_consistency: float
    start: NDArray[np.float64]
    fitted: DepthFitted


def register_depth(
    images: DepthScans | ArrayLike,
    config: DeepMappingConfig | None = None,
    *,
    key: jax.Array,
    start: ArrayLike | None = None,
    engine: Callable[..., Fit] = fit,
) -> RegisteredDepth:
    """Registers depth images: a search for first poses, DeepMapping from them (section 4.2), and of both the better.

    They are compared by `projective_consistency`, without ground truth.

    Args:
        images: (n, h, w, 3) points in the camera frames (x right, y down, z forward), any unit; or DepthScans.
        config: settings of the fit; None: `depth_preset("fast")`. Its `motion` holds for the search, too.
        key: key of the search and of the fit.
        start: (n, 4, 4) T_world_camera to start from; None: `initialize_depth` searches first poses.
        engine: engine of the fit, as in `fit_depth`.

    Returns:
        RegisteredDepth, in the world of the start.

    Raises:
        ValueError: as `as_depth_scans`, or `start` has a wrong shape or is not finite.
    """
    config = config or depth_preset("fast")
    scans = images if isinstance(images, DepthScans) else as_depth_scans(images)
    if start is None:
        start = initialize_depth(scans, depth_search(config.motion), key=key)
    # Search and fit share the key: a fit from given poses gives the same as one from the same poses, found here. The
    # published numbers rest on it.
    fitted = fit_depth(scans, config, key=key, start=start, engine=engine)
    T_start = np.asarray(start, np.float64)
    consistency, start_consistency = (float(projective_consistency(scans, T)) for T in (fitted.T_world_camera, T_start))
    # A fit that is not finite is not better.
    if consistency >= start_consistency:
        return RegisteredDepth(fitted.T_world_camera, "fit", consistency, start_consistency, T_start, fitted)
    return RegisteredDepth(T_start, "start", consistency, start_consistency, T_start, fitted)


class DepthFitted(NamedTuple):
    """Result of `fit_depth`.

    Attributes:
        T_world_camera: (n, 4, 4) float64, unit of the points.
        params: parameters of L-Net and M-Net.
        report: report of the last call of the step.
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
        ValueError: the shapes are not (n, h, w, 3) and (n, h, w) with n >= 2, an image has no valid pixel, or a valid
            point is not finite or not in front of the camera (z above 0).
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
    config: DeepMappingConfig | None = None,
    *,
    key: jax.Array,
    start: ArrayLike | None = None,
    engine: Callable[..., Fit] = fit,
) -> DepthFitted:
    """Registers depth images by optimising L-Net and M-Net on them alone (DeepMapping section 4.2).

    Args:
        scans: (n, h, w, 3) in the camera frames, any unit, or DepthScans with their mask.
        config: settings; None: `depth_preset("fast")`.
        key: key of the whole run.
        start: (n, 4, 4) T_world_camera to start from; None: cold start.
        engine: what trains, called as `engine(problem, data, key=key)`;
            `functools.partial(fit, on_report=..., stop=...)` reports each call of the step and can be stopped.

    Returns:
        DepthFitted, in the world of `start`, or an arbitrary one after a cold start.

    Raises:
        ValueError: as `as_depth_scans`, or `start` has a wrong shape or is not finite.
    """
    config = config or depth_preset("fast")
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
    config: DeepMappingConfig,
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
    if isinstance(phase.comparison, ProjectiveComparison):
        tolerance = interpolate_log(phase.comparison.tolerance, progress)
        offsets = draw_offsets(phase, count // 2, key=offset_key)
        pair_term = 1.0 - consistency_of_pairs(T, sample, scans, offsets, tolerance)
    else:
        pair_term = chamfer_term(world, draw_offsets(phase, count - 1, key=offset_key), phase.comparison)
    return mapping_loss(config, phase, params, world, pair_term, key=free_key)


def depth_problem(config: DeepMappingConfig, data: MappingData) -> Problem:
    """DeepMapping of depth images; poses are (n, 4, 4) T_world_camera.

    Args:
        config: settings of the fit.
        data: DepthScans and first poses, in typical ranges.

    Returns:
        The problem.
    """
    return mapping_problem(config, data, MappingFunctions(init_spatial, _loss, spatial_poses, next_spatial_phase))
