"""Lidar clouds as a sensor of DeepMapping in SE(3): clouds are compared by planes or by the Chamfer distance.

The rings of two lidar scans hit different points of a surface. The nearest point of another scan lies on a ring, at
some distance along the surface. So the Chamfer distance aligns rings; the distance to the plane of the nearest point
does not.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dpmjax.deepmapping.batches import draw_offsets, scans_in_block, scans_of_step
from dpmjax.deepmapping.cloud_scans import CloudScans
from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig, PlaneComparison
from dpmjax.deepmapping.objective import Terms, WorldBatch, chamfer_term, interpolate_log
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
from dpmjax.geometry.neighbours import k_nearest

# Search radius of planes, in widths of the kernel and in spacings of the points; the larger of both.
_REACH_WIDTHS, _REACH_SPACINGS = 5.0, 2.0
# Planes whose normals have a smaller cosine do not match, so the two sides of a wall do not match.
_MIN_COSINE = 0.3
# Trajectories are compared by pairs of scans at these distances in time, and by this number of points of each scan.
_JUDGED_OFFSETS, _JUDGED_POINTS = (1, 2, 4, 8), 512


class PlaneCloud(NamedTuple):
    """Points of one scan with their planes, or of several with a leading axis; as in CloudScans."""

    points: Float[Array, "... c 3"]
    mask: Bool[Array, "... c"]
    normals: Float[Array, "... c 3"]
    flatness: Float[Array, "... c"]


def clouds_of(scans: CloudScans) -> PlaneCloud:
    """Returns the points of all scans with their planes."""
    return PlaneCloud(scans.points, scans.mask, scans.normals, scans.flatness)


def take_rows(cloud: PlaneCloud, rows: Int[Array, " m"]) -> PlaneCloud:
    """Returns the scans of these rows."""
    return PlaneCloud(*(leaf[rows] for leaf in cloud))


def plane_misfit(
    T_target_source: Float[Array, "4 4"],
    source: PlaneCloud,
    target: PlaneCloud,
    width: Float[Array, ""] | float,
    spacing: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Computes the soft share of the source's planes that match no plane of the target: 0 if all match, 1 if none.

    A point at the distance r from the plane through the nearest point of the target has the misfit r^2 / (r^2 +
    width^2) (Geman and McClure 1985). The misfit is 1 without such a plane. Weights are the flatness of the points.

    Args:
        T_target_source: transform of source points into the frame of the target.
        source: sampled points of a scan.
        target: scan with the planes.
        width: width of the kernel, unit of the points.
        spacing: typical distance of a point of the target to its neighbours.

    Returns:
        The misfit; 1 where the source has no plane. The choice of the nearest plane has no derivative.
    """
    moved = rigid.transform_points(T_target_source, source.points)
    reach = jnp.maximum(_REACH_WIDTHS * width, _REACH_SPACINGS * spacing)
    near = k_nearest(jax.lax.stop_gradient(moved), target.points, 1, target.mask)
    nearest = near.indices[:, 0]
    is_paired = source.mask & near.mask[:, 0] & (near.squared_distances[:, 0] <= reach**2)
    normals = target.normals[nearest]
    gap = jnp.where(is_paired, jnp.sum((moved - target.points[nearest]) * normals, axis=-1), 0.0)
    turned = jnp.einsum("ij,pj->pi", T_target_source[:3, :3], source.normals, precision=jax.lax.Precision.HIGHEST)
    cosines = jnp.sum(turned * normals, axis=-1)
    agreement = target.flatness[nearest] * jnp.maximum(cosines - _MIN_COSINE, 0.0) / (1.0 - _MIN_COSINE)
    agreement = jax.lax.stop_gradient(jnp.where(is_paired, agreement, 0.0))
    weights = jnp.where(source.mask, source.flatness, 0.0)
    total = weights.sum()
    matched = jnp.sum(weights * agreement * width**2 / (width**2 + gap**2))
    return 1.0 - matched / jnp.where(total > 0.0, total, 1.0)


def misfit_of_pairs(
    T_world_scan: Float[Array, "m 4 4"],
    samples: PlaneCloud,
    scans: PlaneCloud,
    pairs: Int[Array, "p 2"],
    is_pair: Bool[Array, " p"],
    sizes: tuple[Float[Array, ""] | float, Float[Array, ""] | float],
) -> Float[Array, ""]:
    """Computes the mean misfit of pairs of scans, in both directions.

    Args:
        T_world_scan: poses.
        samples: sampled points of each scan.
        scans: the scans.
        pairs: rows of the scans.
        is_pair: False for invalid pairs.
        sizes: width and spacing, as in `plane_misfit`.

    Returns:
        The mean; 0 without a pair.
    """
    both = jnp.concatenate([pairs, pairs[:, ::-1]])
    source, target = both[:, 0], both[:, 1]
    T = rigid.compose(rigid.inverse(T_world_scan[target]), T_world_scan[source])
    sources, targets = take_rows(samples, source), take_rows(scans, target)
    misfits = jax.vmap(plane_misfit, in_axes=(0, 0, 0, None, None))(T, sources, targets, *sizes)
    counts = jnp.tile(is_pair, 2)
    return jnp.sum(jnp.where(counts, misfits, 0.0)) / jnp.maximum(counts.sum(), 1)


@jax.jit
def trajectory_misfit(
    scans: CloudScans, T_world_scan: Float[Array, "n 4 4"], width: Float[Array, ""] | float
) -> Float[Array, ""]:
    """Computes the mean misfit of each scan with those 1, 2, 4 and 8 later and with its partners, without ground truth.

    Args:
        scans: the scans.
        T_world_scan: poses of the scans, unit of the points.
        width: width of the kernel, unit of the points.

    Returns:
        0 (all planes match) to 1 (no plane matches).
    """
    count = scans.mask.shape[0]
    first = jnp.arange(count)
    later = first + jnp.array([offset for offset in _JUDGED_OFFSETS if offset < count])[:, None]
    others = jnp.concatenate([jnp.where(later < count, later, -1), scans.partners.T])
    clouds = clouds_of(scans)
    samples = jax.tree.map(lambda leaf: leaf[:, :_JUDGED_POINTS], clouds)

    def judge(other: Int[Array, " n"]) -> tuple[Float[Array, ""], Int[Array, ""]]:
        is_pair = other >= 0
        pairs = jnp.stack([first, jnp.maximum(other, 0)], axis=-1)
        mean = misfit_of_pairs(T_world_scan, samples, clouds, pairs, is_pair, (width, scans.spacing))
        return mean * is_pair.sum(), is_pair.sum()

    totals, counts = jax.lax.map(judge, others)
    return totals.sum() / jnp.maximum(counts.sum(), 1)


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


def _loss(
    config: DeepMappingConfig,
    phase: PhaseConfig,
    params: Params,
    data: MappingData,
    step: Int[Array, ""],
    key: jax.Array,
) -> tuple[Float[Array, ""], Terms]:
    """Computes DeepMapping eq. 6 of a batch of scans and points, compared by planes or by the Chamfer distance."""
    row_key, point_key, partner_key, free_key, offset_key = jax.random.split(key, 5)
    scans, progress = data.scans, step / phase.num_steps
    count = scans.mask.shape[0]
    rows, block = scans_of_step(phase, count, step, key=row_key)
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


CLOUDS = Sensor(scaled_start, unscaled_poses, init_spatial, _loss, spatial_poses, next_spatial_phase)
"""DeepMapping of lidar clouds; poses are (n, 4, 4) T_world_scan."""
