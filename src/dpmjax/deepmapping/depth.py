"""Depth images as a sensor of DeepMapping (section 4.2): images are compared by the Chamfer distance or by projection.

The poses are those of `spatial`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from dpmjax.deepmapping.batches import draw_offsets
from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig, ProjectiveComparison
from dpmjax.deepmapping.objective import Terms, WorldBatch, chamfer_term, interpolate_log
from dpmjax.deepmapping.problem import MappingData, Params, Sensor, mapping_loss
from dpmjax.deepmapping.spatial import init_spatial, next_spatial_phase, scaled_start, spatial_poses, unscaled_poses
from dpmjax.geometry import rigid
from dpmjax.registration_rgbd.depth_images import DepthScans, PixelSample
from dpmjax.registration_rgbd.projective_consistency import consistency_of_pairs


def _draw_pixels(scans: DepthScans, count: int, *, key: jax.Array) -> PixelSample:
    """Draws different pixels from each image, because equal pixels would favour equal rays in the Chamfer distance."""
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
    """Computes DeepMapping eq. 6 of a batch of pixels, compared by the Chamfer distance or by projection."""
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


DEPTH = Sensor(scaled_start, unscaled_poses, init_spatial, _loss, spatial_poses, next_spatial_phase)
"""DeepMapping of depth images; poses are (n, 4, 4) T_world_camera."""
