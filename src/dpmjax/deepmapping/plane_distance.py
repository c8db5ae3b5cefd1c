"""Distances of points to the planes of other scans: the comparison of lidar scans, and of trajectories.

The rings of two lidar scans do not meet the same points. The nearest point of another scan lies on a ring, beside the
surface between rings, and the Chamfer distance pulls ring onto ring; a plane through the nearest point does not.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dpmjax.deepmapping.cloud_scans import CloudScans
from dpmjax.geometry import rigid
from dpmjax.geometry.neighbours import k_nearest

# Reach of the search for a plane, in widths of the kernel and in spacings of the points; the larger of both.
_REACH_WIDTHS, _REACH_SPACINGS = 5.0, 2.0
# Planes whose normals have a smaller cosine do not match; the two sides of a wall do not either.
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
    """The points of all scans with their planes."""
    return PlaneCloud(scans.points, scans.mask, scans.normals, scans.flatness)


def take_rows(cloud: PlaneCloud, rows: Int[Array, " m"]) -> PlaneCloud:
    """Some of the scans."""
    return PlaneCloud(*(leaf[rows] for leaf in cloud))


def plane_misfit(
    T_target_source: Float[Array, "4 4"],
    source: PlaneCloud,
    target: PlaneCloud,
    width: Float[Array, ""] | float,
    spacing: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Share of the source's planes that do not meet a plane of the target, softly: 0 all do, 1 none.

    A point at the distance r from the plane through the nearest point of the target has the misfit r^2 / (r^2 +
    width^2) (Geman and McClure 1985). The misfit is 1 without such a plane. Flat neighbourhoods count more.

    Args:
        T_target_source: maps the source's points into the frame of the target.
        source: some points of a scan.
        target: scan with the planes.
        width: width of the kernel, unit of the points.
        spacing: typical distance of a point of the target to its neighbours.

    Returns:
        The misfit; 1 where the source has no plane. Which plane is nearest has no derivative.
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
    """Mean misfit of pairs of scans, in both directions.

    Args:
        T_world_scan: poses.
        samples: some points of each scan.
        scans: the scans.
        pairs: rows of the scans.
        is_pair: False for pairs that do not count.
        sizes: width and spacing, as of `plane_misfit`.

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
    """Mean misfit of each scan with those 1, 2, 4 and 8 later, and with its partners: compares trajectories.

    Args:
        scans: the scans.
        T_world_scan: their poses, unit of the points.
        width: width of the kernel, unit of the points.

    Returns:
        0 (all planes meet) to 1 (none does); no reference is needed.
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
