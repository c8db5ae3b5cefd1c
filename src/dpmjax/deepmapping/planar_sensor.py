"""Planar scans as a sensor of DeepMapping: poses x, y, heading, by one L-Net or by one for each window."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike, NDArray

from dpmjax.checks import as_beams
from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig
from dpmjax.deepmapping.objective import (
    Terms,
    WorldBatch,
    chamfer_term,
    draw_offsets,
    in_windows,
    join_windows,
    scans_in_block,
    scans_of_step,
    window_rows,
)
from dpmjax.deepmapping.problem import MapFrame, MappingData, Params, Sensor, choose_frame, mapping_loss, phases_of
from dpmjax.geometry import se2
from dpmjax.nets.mapping import LocalizationNet, init_map_net
from dpmjax.types import ScanSet


def as_scan_set(scans: ScanSet | ArrayLike, *, min_scans: int = 2) -> ScanSet:
    """Checks scans; beams with coordinates that are not finite, or both zero, are invalid.

    Args:
        scans: (n, b, 2) in the sensor frames, any unit; or a ScanSet.
        min_scans: the smallest number of scans.

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
    if len(empty):
        raise ValueError(f"scans: scan {empty[0]} has no valid beam; leave it out ({len(empty)} such scans)")
    return beams


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


def _init(config: DeepMappingConfig, key: jax.Array, data: MappingData) -> Params:
    """Makes initial parameters for planar scans (`Problem.init`); without initial poses the start is zero."""
    net_key, map_key = jax.random.split(key)
    scans, phase = data.scans, phases_of(config, data)[0]
    poses = start = jnp.zeros((scans.mask.shape[0], 3)) if data.start is None else data.start
    make_net = partial(LocalizationNet(config.localization).init, points=scans.points[0], mask=scans.mask[0])
    if phase.scans_per_window is None:
        localization = make_net(net_key)
    else:
        rows = window_rows(len(start), phase.scans_per_window)
        localization = jax.vmap(make_net)(jax.random.split(net_key, len(rows)))
        poses = start[rows] if phase.poses == "free" else start
    return Params(
        localization=localization,
        poses=poses,
        occupancy=init_map_net(config.occupancy, key=map_key),
        start=start,
        frame=_choose_frame(config, scans, start),
    )


def _choose_frame(config: DeepMappingConfig, scans: ScanSet, poses: Float[Array, "n 3"]) -> MapFrame:
    """Computes the square that the scans cover at these poses, with the margin of the map."""
    if config.occupancy.kind == "mlp":
        return MapFrame(centre=jnp.zeros(2), half_side=jnp.ones(()))
    return choose_frame(se2.transform_points(poses, scans.points), scans.mask, config.map_margin)


def _next_phase(config: DeepMappingConfig, phase: PhaseConfig, params: Params, data: MappingData) -> Params:
    """Starts the next phase for planar scans (`Problem.next_phase`): poses as estimated, the map frame re-centred."""
    poses = _poses(config, phase, params, data)
    return replace(params, poses=poses, frame=_choose_frame(config, data.scans, poses))


def _poses(config: DeepMappingConfig, phase: PhaseConfig, params: Params, data: MappingData) -> Float[Array, "n 3"]:
    """Computes the poses of all planar scans (`Problem.poses`), from the same number of beams as in training."""
    scans, count = data.scans, data.scans.mask.shape[0]
    rows = np.arange(count) if phase.scans_per_window is None else window_rows(count, phase.scans_per_window)
    poses = params.poses
    if phase.poses == "network":
        beams = choose_beams(scans.mask.shape[1], phase)
        some = ScanSet(scans.points[:, beams], scans.mask[:, beams])
        poses = in_windows(_localize(config, phase, params, some, rows.reshape(-1)), rows)
    return poses if phase.scans_per_window is None else join_windows(poses, count)


def _localize(
    config: DeepMappingConfig, phase: PhaseConfig, params: Params, scans: ScanSet, rows: Array | NDArray[np.intp]
) -> Float[Array, "m 3"]:
    """Computes the poses of the scans `rows` by L-Net, or of all windows by the L-Net of each window."""
    points, mask = scans.points[rows], scans.mask[rows]
    if phase.scans_per_window is None:
        outputs = localize_scans(params.localization, points, mask, config)
    else:
        windows = window_rows(len(scans.points), phase.scans_per_window)
        of_window = jax.vmap(partial(localize_scans, config=config))
        outputs = of_window(params.localization, in_windows(points, windows), in_windows(mask, windows)).reshape(-1, 3)
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
    batch_key, loss_key = jax.random.split(key)
    beam_key, row_key = jax.random.split(batch_key)
    beams = choose_beams(scans.mask.shape[1], phase, jax.random.randint(beam_key, (), 0, scans.mask.shape[1]))
    rows, block = scans_of_step(phase, scans.mask.shape[0], step, key=row_key)
    some = ScanSet(scans.points[:, beams], scans.mask[:, beams])
    if phase.poses == "network":
        poses = _localize(config, phase, params, some, rows)
    else:
        poses = params.poses[rows] if phase.scans_per_window is None else params.poses.reshape(-1, 3)
    points, mask = some.points[rows], some.mask[rows]
    world = WorldBatch(se2.transform_points(poses, points), poses[:, :2], mask, rows, block, progress)
    free_key, offset_key = jax.random.split(loss_key)
    offsets = draw_offsets(phase, scans_in_block(phase, scans.mask.shape[0]) - 1, key=offset_key)
    return mapping_loss(config, phase, params, world, chamfer_term(world, offsets, phase.comparison), key=free_key)


def _scaled_start(start: ArrayLike, num_scans: int, unit: float) -> Float[Array, "n 3"]:
    """Checks initial poses x, y, heading and scales them from the unit of the points to typical ranges."""
    return jnp.asarray(se2.as_poses("start", start, num_scans) / [unit, unit, 1.0], jnp.float32)


def _unscaled(poses: Float[Array, "n 3"], unit: float) -> NDArray[np.float64]:
    """Scales poses x, y, heading from typical ranges to the unit of the points."""
    return np.asarray(poses, np.float64) * [unit, unit, 1.0]


# DeepMapping of planar scans; poses are (n, 3) x, y, heading.
PLANAR = Sensor(_scaled_start, _unscaled, _init, _planar_loss, _poses, _next_phase)
