"""Lidar clouds as a sensor of DeepMapping in SE(3): clouds are compared by planes or by the Chamfer distance.

`spatial` has the poses, `cloud_scans` the scans, `plane_distance` how they are compared.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dpmjax.deepmapping.batches import draw_offsets, draw_rows, scans_in_block
from dpmjax.deepmapping.cloud_scans import CloudScans, find_partners
from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig, PlaneComparison
from dpmjax.deepmapping.objective import Terms, WorldBatch, chamfer_term, interpolate_log
from dpmjax.deepmapping.plane_distance import PlaneCloud, clouds_of, misfit_of_pairs, take_rows
from dpmjax.deepmapping.problem import MappingData, Params, Sensor, mapping_loss
from dpmjax.deepmapping.spatial import (
    init_spatial,
    next_spatial_phase,
    poses_of_scans,
    scaled_start,
    spatial_poses,
    unscaled_poses,
)
from dpmjax.geometry import rigid


def _draw_points(scans: PlaneCloud, count: int, *, key: jax.Array) -> PlaneCloud:
    """Other points of each scan in every step."""
    num_scans, capacity = scans.mask.shape
    if count >= capacity:
        return scans
    first = jax.random.randint(key, (num_scans, 1), 0, capacity)
    rows = (first + jnp.arange(count)) % capacity
    return PlaneCloud(*(jax.vmap(lambda leaf, row: leaf[row])(leaf, rows) for leaf in scans))


def _draw_partners(scans: CloudScans, rows: Int[Array, " m"], count: int, *, key: jax.Array) -> Int[Array, "r m"]:
    """Scans near in space of each scan; -1: none."""
    columns = jax.random.choice(key, scans.partners.shape[1], (count,), replace=False)
    return scans.partners[rows][:, columns].T


def _loss(
    config: DeepMappingConfig,
    phase: PhaseConfig,
    params: Params,
    data: MappingData,
    step: Int[Array, ""],
    key: jax.Array,
) -> tuple[Float[Array, ""], Terms]:
    """DeepMapping eq. 6 of a batch of scans and points; scans are compared by planes or by the Chamfer distance."""
    row_key, point_key, partner_key, free_key, offset_key = jax.random.split(key, 5)
    scans, progress = data.scans, step / phase.num_steps
    count = scans.mask.shape[0]
    rows, block = draw_rows(phase, count, step, key=row_key)
    offsets = draw_offsets(phase, scans_in_block(phase, count) - 1, key=offset_key)
    comparison = phase.comparison
    num_revisits = comparison.num_revisits if isinstance(comparison, PlaneComparison) else 0
    partners = _draw_partners(scans, rows, num_revisits, key=partner_key)
    seen = jnp.concatenate([rows, jnp.maximum(partners, 0).reshape(-1)])
    T = poses_of_scans(config, phase, params, scans, seen)
    clouds = take_rows(clouds_of(scans), seen)
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


def _scaled(scans: CloudScans, start: Float[Array, "n 4 4"] | None, unit: float) -> CloudScans:
    scaled = replace(scans, points=scans.points / unit, spacing=scans.spacing / unit)
    return scaled if start is None else replace(scaled, partners=find_partners(np.asarray(start), 1.0))


CLOUDS = Sensor(_scaled, scaled_start, unscaled_poses, init_spatial, _loss, spatial_poses, next_spatial_phase)
"""DeepMapping of lidar clouds; poses are (n, 4, 4) T_world_scan."""
