"""Depth images and lidar clouds as sensors of DeepMapping in SE(3) (section 4.2): their poses and their losses.

A pose is T_start @ motion. T_start is constant in a phase; the motion is L-Net's output or a free parameter. Images are
compared by projection, clouds by planes, both also by the Chamfer distance.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike, NDArray

from dpmjax.deepmapping.cloud_scans import CloudScans, PlaneCloud, misfit_of_pairs, rows_of
from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig, PlaneComparison, ProjectiveComparison
from dpmjax.deepmapping.objective import (
    Terms,
    WorldBatch,
    chamfer_term,
    draw_offsets,
    interpolate_log,
    scans_in_block,
    scans_of_step,
)
from dpmjax.deepmapping.problem import MapFrame, MappingData, Params, Sensor, choose_frame, mapping_loss
from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import motion_matrices
from dpmjax.nets.mapping import LocalizationNet, init_map_net
from dpmjax.registration_rgbd.depth_images import DepthScans, PixelSample
from dpmjax.registration_rgbd.projective_consistency import consistency_of_pairs

SpatialScans = DepthScans | CloudScans
_ALL = slice(None)
# Number of scans near in space but not in time that each cloud is compared to by planes.
_NUM_REVISITS = 1


def _scaled_start(poses: ArrayLike, num_scans: int, unit: float) -> Float[Array, "n 4 4"]:
    """Checks initial poses and scales them from the unit of the points to typical ranges."""
    T = np.array(poses, np.float64)
    if T.shape != (num_scans, 4, 4) or not np.isfinite(T).all():
        raise ValueError(f"start: expected finite numbers of shape ({num_scans}, 4, 4), got {T.shape}")
    T[:, :3, 3] /= unit
    return jnp.asarray(T, jnp.float32)


def _unscaled(poses: ArrayLike, unit: float) -> NDArray[np.float64]:
    """Scales poses from typical ranges to the unit of the points."""
    T = np.array(poses, np.float64)
    T[..., :3, 3] *= unit
    return T


def _net(config: DeepMappingConfig) -> LocalizationNet:
    return LocalizationNet(config.localization, 3 if config.motion == "planar" else 6)


def _motions(
    config: DeepMappingConfig, phase: PhaseConfig, params: Params, scans: SpatialScans, rows: Int[Array, " m"] | slice
) -> Float[Array, "m k"]:
    if phase.poses == "free":
        return params.poses[rows]
    localize = jax.vmap(_net(config).apply, in_axes=(None, 0, 0))
    return localize(params.localization, scans.points[rows], scans.mask[rows])  # type: ignore[return-value]


def _poses(
    config: DeepMappingConfig,
    phase: PhaseConfig,
    params: Params,
    data: MappingData,
    rows: Int[Array, " m"] | slice = _ALL,
) -> Float[Array, "m 4 4"]:
    """Computes the poses of these scans, by default of all (`Problem.poses`): T_start @ motion, in typical ranges."""
    return rigid.compose(params.start[rows], motion_matrices(_motions(config, phase, params, data.scans, rows)))


def _choose_frame(config: DeepMappingConfig, scans: SpatialScans, T: Float[Array, "n 4 4"]) -> MapFrame:
    """Computes the cube that the scans cover at these poses, with the margin of the map."""
    count = scans.mask.shape[0]
    world = rigid.transform_points(T, scans.points.reshape(count, -1, 3))
    return choose_frame(world, scans.mask.reshape(count, -1), config.map_margin)


def _init(config: DeepMappingConfig, key: jax.Array, data: MappingData) -> Params:
    """Makes initial parameters (`Problem.init`); without initial poses all poses are the identity."""
    net_key, map_key = jax.random.split(key)
    scans, start = data
    count, net = scans.mask.shape[0], _net(config)
    T_start = jnp.tile(jnp.eye(4), (count, 1, 1)) if start is None else start
    localization: Any = net.init(net_key, scans.points[0], scans.mask[0])
    params = Params(
        localization=localization,
        poses=jnp.zeros((count, net.num_outputs)),
        occupancy=init_map_net(config.occupancy, key=map_key, num_dimensions=3),
        start=T_start,
        frame=_choose_frame(config, scans, T_start),
    )
    first = config.cold_phases[0]
    if first.poses == "free" and start is None:
        # The paper's direct baseline starts from the output of an untrained L-Net.
        params = replace(params, poses=_motions(config, replace(first, poses="network"), params, scans, _ALL))
    return params


def _next_phase(config: DeepMappingConfig, phase: PhaseConfig, params: Params, data: MappingData) -> Params:
    """Starts the next phase (`Problem.next_phase`): poses as estimated, motions zero, the map frame re-centred."""
    T = _poses(config, phase, params, data)
    return replace(params, poses=jnp.zeros_like(params.poses), start=T, frame=_choose_frame(config, data.scans, T))


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


def _depth_loss(
    config: DeepMappingConfig,
    phase: PhaseConfig,
    params: Params,
    data: MappingData,
    step: Int[Array, ""],
    key: jax.Array,
) -> tuple[Float[Array, ""], Terms]:
    """Computes eq. 6 of DeepMapping for depth images (`Problem.loss`): pixels by the Chamfer distance or projection."""
    batch_key, loss_key = jax.random.split(key)
    scans, progress = data.scans, step / phase.num_steps
    count = scans.mask.shape[0]
    sample = _draw_pixels(scans, phase.beams_per_step, key=batch_key)
    T = _poses(config, phase, params, data)
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


def _draw_points(scans: PlaneCloud, count: int, *, key: jax.Array) -> PlaneCloud:
    """Draws a random run of the shuffled points of each scan."""
    num_scans, capacity = scans.mask.shape
    if count >= capacity:
        return scans
    first = jax.random.randint(key, (num_scans, 1), 0, capacity)
    rows = (first + jnp.arange(count)) % capacity
    return PlaneCloud(*(jax.vmap(lambda leaf, row: leaf[row])(leaf, rows) for leaf in scans))


def _draw_partners(scans: CloudScans, rows: Int[Array, " m"], count: int, *, key: jax.Array) -> Int[Array, "r m"]:
    """Draws revisit partners of each scan; -1: none."""
    columns = jax.random.choice(key, scans.partners.shape[1], (count,), replace=False)
    return scans.partners[rows][:, columns].T


def _cloud_loss(
    config: DeepMappingConfig,
    phase: PhaseConfig,
    params: Params,
    data: MappingData,
    step: Int[Array, ""],
    key: jax.Array,
) -> tuple[Float[Array, ""], Terms]:
    """Computes eq. 6 of DeepMapping for lidar clouds (`Problem.loss`): points by planes or the Chamfer distance."""
    row_key, point_key, partner_key, free_key, offset_key = jax.random.split(key, 5)
    scans, progress = data.scans, step / phase.num_steps
    count = scans.mask.shape[0]
    rows, block = scans_of_step(phase, count, step, key=row_key)
    offsets = draw_offsets(phase, scans_in_block(phase, count) - 1, key=offset_key)
    comparison = phase.comparison
    num_revisits = _NUM_REVISITS if isinstance(comparison, PlaneComparison) else 0
    partners = _draw_partners(scans, rows, num_revisits, key=partner_key)
    seen = jnp.concatenate([rows, jnp.maximum(partners, 0).reshape(-1)])
    T = _poses(config, phase, params, data, seen)
    clouds = rows_of(scans.planes, seen)
    samples = _draw_points(clouds, phase.beams_per_step, key=point_key)
    own = jnp.arange(len(rows))
    points = rigid.transform_points(T[own], samples.points[own])
    world = WorldBatch(points, T[own, :3, 3], samples.mask[own], rows, block, progress)
    if not isinstance(comparison, PlaneComparison):
        pair_term = chamfer_term(world, offsets, comparison)
    else:
        later = jnp.minimum(own + offsets[:, None], len(rows) - 1)
        is_later = (rows[later] == rows + offsets[:, None]) & (block[later] == block)
        others = jnp.concatenate([later.reshape(-1), jnp.arange(len(rows), len(seen))])
        pairs = jnp.stack([jnp.resize(own, others.shape), others], axis=-1)
        is_pair = jnp.concatenate([is_later.reshape(-1), partners.reshape(-1) >= 0])
        width = interpolate_log(comparison.width, progress)
        pair_term = misfit_of_pairs(T, samples, clouds, pairs, is_pair, (width, scans.spacing))
    return mapping_loss(config, phase, params, world, pair_term, key=free_key)


# DeepMapping of depth images; poses are (n, 4, 4) T_world_camera.
DEPTH = Sensor(_scaled_start, _unscaled, _init, _depth_loss, _poses, _next_phase)

# DeepMapping of lidar clouds; poses are (n, 4, 4) T_world_scan.
CLOUDS = Sensor(_scaled_start, _unscaled, _init, _cloud_loss, _poses, _next_phase)
