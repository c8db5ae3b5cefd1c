"""Lidar scans for the fit of clouds: evenly thinned points with their planes, and pairs of scans at revisits."""

from __future__ import annotations

from collections.abc import Sequence

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from dpmjax.geometry import rigid
from dpmjax.geometry.neighbours import k_nearest
from dpmjax.scans import SurfaceConfig, scan_surface
from dpmjax.scans.preprocess import first_of_each_voxel
from dpmjax.types import SurfaceElements

# In typical ranges: nearest and farthest point, side of the voxels, and reach of the neighbours for the normals.
_NEAREST, _FARTHEST, _VOXEL, _NEIGHBOURS = 0.03, 3.0, 0.01, 0.1
_NUM_NEIGHBOURS = 24
# Two scans are a revisit if more than this number of scans lie between them, and they are nearer than this number of
# typical ranges.
_REVISIT_GAP, _REVISIT_DISTANCE = 8, 0.5
_NUM_PARTNERS = 8
# Search radius of planes, in widths of the kernel and in spacings of the points; the larger of both.
_REACH_WIDTHS, _REACH_SPACINGS = 5.0, 2.0
# Planes whose normals have a smaller cosine do not match, so the two sides of a wall do not match.
_MIN_COSINE = 0.3
# Trajectories are compared by pairs of scans at these distances in time, and by this number of points of each scan.
_COMPARED_OFFSETS, _COMPARED_POINTS = (1, 2, 4, 8), 512


@flax.struct.dataclass
class CloudScans:
    """Lidar scans of equal capacity; the points of each are in random order, invalid rows at the end.

    Attributes:
        points: points in the lidar frames, any unit; in typical ranges inside of the fit.
        mask: False for invalid rows.
        normals: unit normals of the planes around the points, towards the lidar.
        flatness: planarity of the neighbourhood, in [0, 1].
        spacing: median distance of a point to its nearest neighbour in the scan.
        partners: indices of revisits at the initial poses, near in space and far in time; -1: none.
    """

    points: Float[Array, "n c 3"]
    mask: Bool[Array, "n c"]
    normals: Float[Array, "n c 3"]
    flatness: Float[Array, "n c"]
    spacing: Float[Array, ""]
    partners: Int[Array, "n p"]

    @property
    def planes(self) -> SurfaceElements:
        """Points of all scans with their planes, in the unit of the points."""
        return SurfaceElements(self.points, self.normals, self.flatness, self.mask)


def as_cloud_scans(scans: Sequence[ArrayLike], num_points: int = 2048) -> CloudScans:
    """Thins lidar scans evenly, and estimates the plane around each point from the denser scan.

    Args:
        scans: (m_i, 3) points in the lidar frames, any unit, any number; points that are not finite are left out.
        num_points: capacity of each scan.

    Returns:
        The scans, in the unit of the points, without partners.

    Raises:
        ValueError: there are fewer than two scans, one is not (m, 3), or one has no point.
    """
    if len(scans) < 2:
        raise ValueError(f"scans: expected at least 2, got {len(scans)}")
    clouds = [_checked(scan, number) for number, scan in enumerate(scans)]
    unit = float(np.median([np.percentile(np.linalg.norm(cloud, axis=1), 90) for cloud in clouds]))
    config = SurfaceConfig(
        min_range_m=_NEAREST * unit, max_range_m=_FARTHEST * unit, voxel_size_m=_VOXEL * unit,
        num_neighbours=_NUM_NEIGHBOURS, neighbour_radius_m=_NEIGHBOURS * unit,
    )  # fmt: skip
    rows = [_thinned(cloud, number, config, num_points) for number, cloud in enumerate(clouds)]
    planes = jax.tree.map(lambda *fields: jnp.asarray(np.stack(fields)), *rows)
    partners = jnp.full((len(scans), _NUM_PARTNERS), -1, jnp.int32)
    spacing = np.median([_spacing(np.asarray(row.positions)[np.asarray(row.mask)]) for row in rows])
    fields = planes.positions, planes.mask, planes.normals, planes.planarity
    return CloudScans(*fields, jnp.asarray(spacing, jnp.float32), partners)


def _checked(scan: ArrayLike, number: int) -> NDArray[np.float32]:
    points = np.asarray(scan, np.float32)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"scans: expected shape (m, 3) of scan {number}, got {points.shape}")
    points = points[np.isfinite(points).all(axis=1) & points.any(axis=1)]
    if not len(points):
        raise ValueError(f"scans: scan {number} has no valid point; leave it out")
    return points


def _thinned(cloud: NDArray[np.float32], number: int, config: SurfaceConfig, num_points: int) -> SurfaceElements:
    """Returns the evenly thinned points of one scan with their planes, in random order."""
    surface = scan_surface(cloud, config)
    if not len(surface.points):
        raise ValueError(f"scans: scan {number} has no point near the ranges of the others; leave it out")
    rows = np.random.default_rng(number).permutation(_evenly(surface.points, config.voxel_size_m, num_points))
    missing = num_points - len(rows)
    both = (surface.points[rows], surface.normals[rows])
    points, normals = (np.pad(values, ((0, missing), (0, 0))).astype(np.float32) for values in both)
    flatness = np.pad(surface.flatness[rows], (0, missing)).astype(np.float32)
    # The two sides of a wall are different surfaces, so normals point to the lidar.
    normals[np.sum(normals * points, axis=1) > 0.0] *= -1.0
    return SurfaceElements(points, normals, flatness, np.arange(num_points) < len(rows))


def _spacing(points: NDArray[np.float32]) -> float:
    """Computes the median distance to the nearest neighbour; 0 for a single point."""
    if len(points) < 2:
        return 0.0
    distances, _ = cKDTree(points).query(points, 2)
    return float(np.median(np.asarray(distances)[:, 1]))


def _evenly(points: NDArray[np.float64], voxel: float, num_points: int) -> NDArray[np.int64]:
    """Selects up to `num_points` points, one for each voxel, with the smallest possible voxels."""
    if len(points) <= num_points:
        return np.arange(len(points))
    low, high = voxel, voxel
    rows = np.arange(len(points))
    while len(rows) > num_points:
        low, high = high, 2.0 * high
        rows = first_of_each_voxel(points, high)
    for _ in range(6):
        middle = float(np.sqrt(low * high))
        tried = first_of_each_voxel(points, middle)
        if len(tried) > num_points:
            low = middle
        else:
            high, rows = middle, tried
    return rows


def find_partners(T: NDArray[np.floating], unit: float) -> Int[Array, "n p"]:
    """Finds up to eight revisit partners of each scan: scans near in space and far apart in time.

    Args:
        T: (n, 4, 4) T_world_scan.
        unit: typical range, in the unit of the poses.

    Returns:
        Indices of the partners, nearest first; -1 for missing ones.
    """
    count = len(T)
    partners = np.full((count, _NUM_PARTNERS), -1, np.int32)
    tree = cKDTree(T[:, :3, 3])
    for row, near in enumerate(tree.query_ball_point(T[:, :3, 3], _REVISIT_DISTANCE * unit)):
        others = np.array([other for other in near if abs(other - row) > _REVISIT_GAP], int)
        order = np.argsort(np.linalg.norm(T[others, :3, 3] - T[row, :3, 3], axis=1), kind="stable")
        chosen = others[order][:_NUM_PARTNERS]
        partners[row, : len(chosen)] = chosen
    return jnp.asarray(partners)


def rows_of(planes: SurfaceElements, rows: Int[Array, " m"]) -> SurfaceElements:
    """Returns the scans of these rows."""
    return jax.tree.map(lambda leaf: leaf[rows], planes)


def plane_misfit(
    T_target_source: Float[Array, "4 4"],
    source: SurfaceElements,
    target: SurfaceElements,
    width: Float[Array, ""] | float,
    spacing: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Computes the soft share of the source's planes that match no plane of the target: 0 if all match, 1 if none.

    A point at the distance r from the plane through the nearest point of the target has the misfit r^2 / (r^2 +
    width^2) (Geman and McClure 1985). The misfit is 1 without such a plane. Weights are the planarity of the points.

    Args:
        T_target_source: transform of source points into the frame of the target.
        source: sampled points of a scan.
        target: scan with the planes.
        width: width of the kernel, unit of the points.
        spacing: typical distance of a point of the target to its neighbours.

    Returns:
        The misfit; 1 where the source has no plane. The choice of the nearest plane has no derivative.
    """
    moved = rigid.transform_points(T_target_source, source.positions)
    reach = jnp.maximum(_REACH_WIDTHS * width, _REACH_SPACINGS * spacing)
    near = k_nearest(jax.lax.stop_gradient(moved), target.positions, 1, target.mask)
    nearest = near.indices[:, 0]
    is_paired = source.mask & near.mask[:, 0] & (near.squared_distances[:, 0] <= reach**2)
    normals = target.normals[nearest]
    gap = jnp.where(is_paired, jnp.sum((moved - target.positions[nearest]) * normals, axis=-1), 0.0)
    turned = jnp.einsum("ij,pj->pi", T_target_source[:3, :3], source.normals, precision=jax.lax.Precision.HIGHEST)
    cosines = jnp.sum(turned * normals, axis=-1)
    agreement = target.planarity[nearest] * jnp.maximum(cosines - _MIN_COSINE, 0.0) / (1.0 - _MIN_COSINE)
    agreement = jax.lax.stop_gradient(jnp.where(is_paired, agreement, 0.0))
    weights = jnp.where(source.mask, source.planarity, 0.0)
    total = weights.sum()
    matched = jnp.sum(weights * agreement * width**2 / (width**2 + gap**2))
    return 1.0 - matched / jnp.where(total > 0.0, total, 1.0)


def misfit_of_pairs(
    T_world_scan: Float[Array, "m 4 4"],
    samples: SurfaceElements,
    scans: SurfaceElements,
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
    sources, targets = rows_of(samples, source), rows_of(scans, target)
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
    later = first + jnp.array([offset for offset in _COMPARED_OFFSETS if offset < count])[:, None]
    others = jnp.concatenate([jnp.where(later < count, later, -1), scans.partners.T])
    clouds = scans.planes
    samples = jax.tree.map(lambda leaf: leaf[:, :_COMPARED_POINTS], clouds)

    def mean_misfit(other: Int[Array, " n"]) -> tuple[Float[Array, ""], Int[Array, ""]]:
        is_pair = other >= 0
        pairs = jnp.stack([first, jnp.maximum(other, 0)], axis=-1)
        mean = misfit_of_pairs(T_world_scan, samples, clouds, pairs, is_pair, (width, scans.spacing))
        return mean * is_pair.sum(), is_pair.sum()

    totals, counts = jax.lax.map(mean_misfit, others)
    return totals.sum() / jnp.maximum(counts.sum(), 1)
