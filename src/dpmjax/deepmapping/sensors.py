"""The sensors of DeepMapping: their poses, and the losses of their scans (sections 3 and 4.2).

Planar scans have poses x, y, heading, by one L-Net or by one for each window. Depth images have poses T_start @ motion
in SE(3). T_start is constant in a phase; the motion is L-Net's output or a free parameter. Scans are compared by the
Chamfer distance, images also by projection.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike, NDArray

from dpmjax.checks import Beams, as_beams
from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig
from dpmjax.deepmapping.objective import (
    Terms,
    WorldBatch,
    blocks_of_step,
    chamfer_term,
    draw_offsets,
    interpolate_log,
    join_windows,
    window_rows,
)
from dpmjax.deepmapping.problem import MapFrame, MappingData, Params, Problem, choose_frame, mapping_loss, phases_of
from dpmjax.geometry import rigid, se2
from dpmjax.geometry.se3 import motion_matrices
from dpmjax.nets.mapping import LocalizationNet, init_map_net
from dpmjax.scan.depth.compare import consistency_of_pairs
from dpmjax.scan.depth.record import DepthScans, PixelSample
from dpmjax.types import ScanSet

_ALL = slice(None)
# Side of the map as a multiple of the extent of the scans at the start of a phase. If it is smaller, scans whose poses
# still move leave the map; if it is larger, its cells are coarser. Depth images see farther past their neighbours.
_PLANAR_MARGIN, _DEPTH_MARGIN = 1.15, 1.2
# Largest coordinate of an initial pose, in typical ranges of the scans.
_MAX_COORDINATE = 1e4


def as_scan_set(scans: Beams, *, min_scans: int = 2, may_be_blind: bool = False) -> ScanSet:
    """Checks scans; beams with coordinates that are not finite, or both zero, are invalid.

    Args:
        scans: (n, b, 2) in the sensor frames, any unit; or a ScanSet.
        min_scans: the smallest number of scans.
        may_be_blind: True where some scans may have no valid beam, fewer than half.

    Returns:
        The scans, zeros at invalid beams.

    Raises:
        ValueError: the shape is not (n, b, 2), there are too few scans, a scan has no valid beam, or a valid beam of a
            ScanSet is not finite.
    """
    beams = as_beams("scans", scans)
    if beams.points.shape[0] < min_scans:
        raise ValueError(f"scans: expected at least {min_scans}, got {beams.points.shape[0]}")
    empty = np.flatnonzero(~np.asarray(beams.mask).any(-1))
    if len(empty) > (may_be_blind * (len(beams.mask) - 1)) // 2:
        raise ValueError(f"scans: scan {empty[0]} has no valid beam; leave it out ({len(empty)} such scans)")
    return beams


def positions_of(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns a view of the positions of poses x, y, heading, or of matrices (..., 4, 4)."""
    return poses[..., :2] if poses.shape[-1] == 3 else poses[..., :3, 3]


def scale_start(start: ArrayLike, scans: ScanSet | DepthScans, unit: float) -> Float[Array, "n ..."]:
    """Checks initial poses, and scales them from the unit of the points to that of the fit.

    Args:
        start: (n, 3) or (n, 3, 3) for planar scans, (n, 4, 4) for depth images.
        scans: the n scans.
        unit: unit of the fit, in that of the points.

    Returns:
        (n, 3) or (n, 4, 4) float32.

    Raises:
        ValueError: another shape, numbers that are not finite, or positions too far from the origin for float32.
    """
    count = len(scans.mask)
    poses = np.array(se2.as_poses("start", start, count) if isinstance(scans, ScanSet) else start, np.float64)
    if isinstance(scans, DepthScans) and (poses.shape != (count, 4, 4) or not np.isfinite(poses).all()):
        raise ValueError(f"start: expected finite numbers of shape ({count}, 4, 4), got {poses.shape}")
    positions = positions_of(poses)
    positions /= unit
    if np.abs(positions).max(initial=0.0) > _MAX_COORDINATE:
        raise ValueError("start: the positions are too far from the origin for float32; subtract the first one")
    return jax.device_put(poses.astype(np.float32))


def localize_scans(
    params: Any, points: Float[Array, "m b 2"], mask: Bool[Array, "m b"], config: DeepMappingConfig
) -> Float[Array, "m 3"]:
    """Computes L-Net's outputs for scans.

    Args:
        params: weights of L-Net.
        points: points in the sensor frames, in typical ranges, beams thinned as in the fit.
        mask: False for beams that measured nothing.
        config: settings of the fit.

    Returns:
        x, y, heading in typical ranges and radians.
    """
    return jax.vmap(LocalizationNet(config.localization).apply, in_axes=(None, 0, 0))(params, points, mask)  # type: ignore[return-value]


def choose_beams(num_beams: int, phase: PhaseConfig, first: Int[Array, ""] | int = 0) -> Int[Array, " c"]:
    """Selects about `beams_per_step` evenly spaced beams.

    Args:
        num_beams: number of beams of a scan.
        phase: phase of the fit.
        first: offset of the first beam, modulo the spacing.

    Returns:
        The indices.
    """
    stride = max(1, -(-num_beams // phase.beams_per_step))
    return first % stride + stride * jnp.arange(num_beams // stride)


def _planar_init(config: DeepMappingConfig, key: jax.Array, data: MappingData) -> Params:
    """Makes initial parameters for planar scans (`Problem.init`); without initial poses the start is zero."""
    net_key, map_key = jax.random.split(key)
    scans, (phase, *later) = data.scans, phases_of(config, data)
    # From given poses there is no L-Net where no phase trains one, because it would compile for seconds.
    has_net = data.start is None or any(some.poses == "network" for some in (phase, *later))
    poses = start = jnp.zeros((scans.mask.shape[0], 3)) if data.start is None else data.start
    make_net = partial(LocalizationNet(config.localization).init, points=scans.points[0], mask=scans.mask[0])
    localization: Any = {}
    if has_net and phase.scans_per_window is None:
        localization = make_net(net_key)
    elif phase.scans_per_window is not None:
        rows = window_rows(len(start), phase.scans_per_window)
        localization = jax.vmap(make_net)(jax.random.split(net_key, len(rows)))
        poses = start[rows] if phase.poses == "free" else start
    params = Params(
        localization=localization,
        poses=poses,
        occupancy=init_map_net(config.occupancy, key=map_key),
        start=start,
        frame=_planar_frame(config, scans, start),
    )
    if phase.poses == "network" or data.start is not None:
        return params
    # The paper's direct baseline starts from the output of an untrained L-Net.
    return replace(params, poses=_localize_all(config, phase, params, scans).reshape(poses.shape))


def _planar_frame(config: DeepMappingConfig, scans: ScanSet, poses: Float[Array, "n 3"]) -> MapFrame:
    """Computes the square that the scans cover at these poses, with the margin of the map."""
    if config.occupancy.kind == "mlp":
        return MapFrame(centre=jnp.zeros(2), half_side=jnp.ones(()))
    return choose_frame(se2.transform_points(poses, scans.points), scans.mask, _PLANAR_MARGIN)


def _planar_next_phase(config: DeepMappingConfig, phase: PhaseConfig, params: Params, data: MappingData) -> Params:
    """Starts the next phase for planar scans (`Problem.next_phase`): poses as estimated, the map frame re-centred."""
    poses = _planar_poses(config, phase, params, data)
    return replace(params, poses=poses, frame=_planar_frame(config, data.scans, poses))


def _planar_poses(
    config: DeepMappingConfig, phase: PhaseConfig, params: Params, data: MappingData
) -> Float[Array, "n 3"]:
    """Computes the poses of all planar scans (`Problem.poses`), from the same number of beams as in training."""
    scans, count = data.scans, data.scans.mask.shape[0]
    poses = _localize_all(config, phase, params, scans) if phase.poses == "network" else params.poses
    return poses.reshape(count, 3) if phase.scans_per_window is None else join_windows(poses, count)


def _localize_all(
    config: DeepMappingConfig, phase: PhaseConfig, params: Params, scans: ScanSet
) -> Float[Array, "w m 3"]:
    """Computes the poses of all planar scans, window by window where there are windows, by L-Net."""
    rows = window_rows(scans.mask.shape[0], phase.scans_per_window or scans.mask.shape[0])
    return _localize(config, phase, params, _thinned(scans, choose_beams(scans.mask.shape[1], phase)), rows)


def _thinned(scans: ScanSet, beams: Int[Array, " c"]) -> ScanSet:
    return ScanSet(scans.points[:, beams], scans.mask[:, beams])


def _localize(
    config: DeepMappingConfig, phase: PhaseConfig, params: Params, scans: ScanSet, rows: Array | NDArray[np.intp]
) -> Float[Array, "w m 3"]:
    """Computes the poses of the scans `rows` (w, m) by L-Net, or of all windows by the L-Net of each window."""
    localize = partial(localize_scans, config=config)
    if phase.scans_per_window is None:
        flat = rows.reshape(-1)
        outputs = localize(params.localization, scans.points[flat], scans.mask[flat]).reshape(*rows.shape, 3)
    else:
        outputs = jax.vmap(localize)(params.localization, scans.points[rows], scans.mask[rows])
    return se2.compose(params.start[rows], outputs)


def _planar_loss(
    config: DeepMappingConfig,
    phase: PhaseConfig,
    params: Params,
    data: MappingData,
    step: Int[Array, ""],
    key: jax.Array,
) -> tuple[Float[Array, ""], Terms]:
    """Computes eq. 6 of DeepMapping for planar scans (`Problem.loss`): a batch of scans and beams."""
    scans, progress = data.scans, step / phase.num_steps
    beam_key, row_key, free_key, offset_key = jax.random.split(key, 4)
    num_scans, num_beams = scans.mask.shape
    first = (jax.random.bits(beam_key) % num_beams).astype(jnp.int32)
    some = _thinned(scans, choose_beams(num_beams, phase, first))
    rows, is_scan = blocks_of_step(phase, num_scans, step, key=row_key)
    if phase.poses == "network":
        poses = _localize(config, phase, params, some, rows)
    else:
        poses = params.poses[rows] if phase.scans_per_window is None else params.poses
    poses, flat = poses.reshape(-1, 3), rows.reshape(-1)
    points = se2.transform_points(poses, some.points[flat])
    world = WorldBatch(points, poses[:, :2], some.mask[flat], is_scan.reshape(-1), rows.shape[1], progress)
    offsets = draw_offsets(phase, rows.shape[1] - 1, key=offset_key)
    return mapping_loss(config, phase, params, world, chamfer_term(world, offsets, phase.chamfer_limit), key=free_key)


# The problem of DeepMapping of planar scans; poses are (n, 3) x, y, heading.
PLANAR = partial(Problem, init=_planar_init, loss=_planar_loss, poses=_planar_poses, next_phase=_planar_next_phase)


def _net(config: DeepMappingConfig) -> LocalizationNet:
    return LocalizationNet(config.localization, 3 if config.motion == "planar" else 6)


def _motions(
    config: DeepMappingConfig, phase: PhaseConfig, params: Params, scans: DepthScans, rows: Int[Array, " m"] | slice
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
    """Computes the poses of these scans, by default of all (`Problem.poses`): T_start @ motion, in units of the fit."""
    return rigid.matmul(params.start[rows], motion_matrices(_motions(config, phase, params, data.scans, rows)))


def _depth_frame(scans: DepthScans, T: Float[Array, "n 4 4"]) -> MapFrame:
    """Computes the cube that the scans cover at these poses, with the margin of the map."""
    count = scans.mask.shape[0]
    world = rigid.transform_points(T, scans.points.reshape(count, -1, 3))
    return choose_frame(world, scans.mask.reshape(count, -1), _DEPTH_MARGIN)


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
        frame=_depth_frame(scans, T_start),
    )
    first = config.cold_phases[0]
    if first.poses == "free" and start is None:
        # The paper's direct baseline starts from the output of an untrained L-Net.
        params = replace(params, poses=_motions(config, replace(first, poses="network"), params, scans, _ALL))
    return params


def _next_phase(config: DeepMappingConfig, phase: PhaseConfig, params: Params, data: MappingData) -> Params:
    """Starts the next phase (`Problem.next_phase`): poses as estimated, motions zero, the map frame re-centred."""
    T = _poses(config, phase, params, data)
    return replace(params, poses=jnp.zeros_like(params.poses), start=T, frame=_depth_frame(data.scans, T))


def _draw_pixels(scans: DepthScans, count: int, *, key: jax.Array) -> PixelSample:
    """Draws different pixels from each image, because equal pixels would favour equal rays in the Chamfer distance."""
    points, mask = scans.pixels
    num_scans, num_pixels = mask.shape
    if count >= num_pixels:
        return scans.pixels
    keys = jax.random.split(key, num_scans)
    pixels = jax.vmap(lambda key: jax.random.randint(key, (count,), 0, num_pixels))(keys)
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
    rows, is_scan = jnp.arange(count), jnp.ones(count, bool)
    if phase.is_as_published:
        (rows,), (is_scan,) = blocks_of_step(phase, count, step, key=batch_key)
        sample, count = PixelSample(sample.points[rows], sample.mask[rows]), len(is_scan)
    T = _poses(config, phase, params, data, rows)
    points = rigid.transform_points(T, sample.points)
    world = WorldBatch(points, T[:, :3, 3], sample.mask, is_scan, count, progress)
    free_key, offset_key = jax.random.split(loss_key)
    if phase.projective_tolerance is not None:
        tolerance = interpolate_log(phase.projective_tolerance, progress)
        offsets = draw_offsets(phase, count // 2, key=offset_key)
        pair_term = 1.0 - consistency_of_pairs(T, sample, scans, offsets, tolerance)
    else:
        pair_term = chamfer_term(world, draw_offsets(phase, count - 1, key=offset_key), phase.chamfer_limit)
    return mapping_loss(config, phase, params, world, pair_term, key=free_key)


# The problem of DeepMapping of depth images; poses are (n, 4, 4) T_world_camera.
DEPTH = partial(Problem, init=_init, loss=_depth_loss, poses=_poses, next_phase=_next_phase)
