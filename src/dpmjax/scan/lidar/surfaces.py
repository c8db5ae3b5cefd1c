"""Surface and free space that a lidar scan has measured, on the host.

The surface is thinned points, their normals, and a tree to search them. Free space is a range image by azimuth and
elevation: a point of another scan cannot lie between the lidar and the surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from dpmjax.checks import as_host_points, require_count, require_positive_fields
from dpmjax.geometry.neighbours import HostTree
from dpmjax.geometry.planes import fit_planes
from dpmjax.scan.lidar.preprocess import first_of_each_voxel, largest_spread
from dpmjax.types import SurfaceElements

# A normal needs this many neighbours, the point itself among them.
MIN_NEIGHBOURS = 4

# Least flatness of a point of a surface; foliage, wires and edges are less flat.
MIN_FLATNESS = 0.1

# Pixels of 2 degrees, in elevation and azimuth.
NUM_ROWS, NUM_COLUMNS = 90, 180

# A point contradicts a measurement if it is nearer by more than both: a distance, and a share of its range.
MARGIN_M, MARGIN_SHARE = 1.0, 0.1


@dataclass(frozen=True)
class SurfaceConfig:
    """Range and density of the points, and neighbourhoods of the normals.

    Attributes:
        min_range_m: smallest range; nearer points belong to the vehicle.
        max_range_m: largest range; farther points are too sparse.
        voxel_size_m: side of a voxel, of which the first point is kept.
        num_neighbours: number of neighbours of a normal, the point itself among them.
        neighbour_radius_m: largest distance of a neighbour.
        sparse_radius_share: least radius in sparse scans, as a share of the median distance of the last neighbour.
    """

    min_range_m: float = 1.0
    max_range_m: float = 80.0
    voxel_size_m: float = 0.3
    num_neighbours: int = 12
    neighbour_radius_m: float = 1.5
    sparse_radius_share: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.min_range_m < self.max_range_m:
            raise ValueError(f"min_range_m: expected from 0 to below {self.max_range_m}, got {self.min_range_m}")
        require_positive_fields(self, "voxel_size_m", "neighbour_radius_m")
        require_count("num_neighbours", self.num_neighbours)


class Surface(NamedTuple):
    """The surface of a scan.

    Attributes:
        points: (n, 3) float64, metres, in the frame of the lidar.
        normals: (n, 3) unit normals, of either sign; undefined where `flatness` is 0.
        flatness: (n,) planarity of the neighbourhood in [0, 1]: (l2 - l1) / l3 of the eigenvalues of its
            covariance, smallest first; 0 where there are too few neighbours.
        samples: rows of flat points in random order, those of the three main directions of normals in turn. So the
            first few constrain each direction equally (normal-space sampling, Rusinkiewicz and Levoy 2001).
        tree: a tree of the points.
    """

    points: Float[np.ndarray, "n d"]
    normals: Float[np.ndarray, "n d"]
    flatness: Float[np.ndarray, " n"]
    samples: Int[np.ndarray, " s"]
    tree: HostTree


def scan_surface(points: Float[np.ndarray, "n 3"], config: SurfaceConfig = SurfaceConfig()) -> Surface:
    """Thins a scan and estimates its normals, ten times faster on a CPU than `estimate_normals`.

    Args:
        points: metres, in the frame of the lidar; points that are not finite are dropped.
        config: range, density and neighbourhoods.

    Returns:
        The surface; its points are in the order of the scan. It is empty where no point is in range.

    Raises:
        ValueError: if the shape is not (n, 3).
    """
    points = as_host_points("points", points)
    with np.errstate(invalid="ignore", over="ignore"):
        squared = np.sum(points.astype(np.float64) ** 2, axis=1)
        is_within = (squared >= config.min_range_m**2) & (squared <= config.max_range_m**2)
    points = points.take(np.flatnonzero(is_within), axis=0)
    points = points[first_of_each_voxel(points, config.voxel_size_m)].astype(np.float64)
    tree = HostTree(points)
    found = tree.nearest(points, min(config.num_neighbours, len(points)))
    normals, flatness = _normals(points, points, found, config)
    return Surface(points, normals, flatness, _samples(normals, flatness), tree)


def surface_at(
    tree: HostTree,
    rows: Int[np.ndarray, " e"],
    config: SurfaceConfig = SurfaceConfig(),
    *,
    weights: Float[np.ndarray, " e"] | None = None,
) -> Surface:
    """Estimates the surface of a thinned scan at some of its points, from the neighbours among all of them.

    Points that are no part of a surface are the last samples and have no normal: an alignment moves them onto planes.

    Args:
        tree: the points, metres, in the frame of the lidar.
        rows: rows of the chosen points; those in the order of the scan are searched faster.
        config: neighbourhoods; range and density are those of the points.
        weights: number of points that each chosen one stands for, to leave out outliers (`largest_spread`) by the same
            neighbours; None to keep them.

    Returns:
        The surface; its points are those of the rows.
    """
    chosen = tree.points.take(rows, axis=0)
    found = tree.nearest(chosen, min(config.num_neighbours, len(tree.points)))
    if weights is not None and found[1].shape[1] > 1:
        spread = found[1][:, 1:].mean(axis=1)
        is_inlier = spread <= largest_spread(spread, weights)
        chosen, found = chosen[is_inlier], (found[0][is_inlier], found[1][is_inlier])
    normals, flatness = _normals(chosen, tree.points, found, config)
    return firm_surface(Surface(chosen, normals, flatness, np.arange(len(chosen)), HostTree(chosen)), MIN_FLATNESS)


def firm_surface(surface: Surface, min_flatness: float) -> Surface:
    """Takes the normals from elements that are not flat enough; these become the last samples.

    Args:
        surface: surface of a scan.
        min_flatness: least flatness of an element with a normal, at least `MIN_FLATNESS`.

    Returns:
        The surface with fewer normals.
    """
    is_firm = surface.flatness > min_flatness
    normals, flatness = np.where(is_firm[:, None], surface.normals, 0), np.where(is_firm, surface.flatness, 0)
    samples = np.concatenate([_samples(normals, flatness), np.flatnonzero(~is_firm)])
    return surface._replace(normals=normals, flatness=flatness, samples=samples)


def chosen_elements(surface: Surface, rows: Int[np.ndarray, " e"]) -> Surface:
    """Returns a surface of some elements.

    Args:
        surface: surface of a scan.
        rows: rows of the elements.

    Returns:
        The surface; its samples are those of the elements that are flat.
    """
    points, normals, flatness = (values.take(rows, axis=0) for values in surface[:3])
    return Surface(points, normals, flatness, _samples(normals, flatness), HostTree(points))


def surface_of_elements(elements: SurfaceElements) -> Surface:
    """Makes a surface of elements whose normals are known.

    Args:
        elements: metres, in the frame of the lidar.

    Returns:
        The surface of the elements that are there, with samples and tree.
    """
    mask = np.asarray(elements.mask)
    points, normals, planarity = (
        np.asarray(array, np.float64)[mask] for array in (elements.positions, elements.normals, elements.planarity)
    )
    return Surface(points, normals, planarity, _samples(normals, planarity), HostTree(points))


def _normals(
    points: Float[np.ndarray, "n 3"],
    searched: Float[np.ndarray, "m 3"],
    found: tuple[Int[np.ndarray, "n k"], Float[np.ndarray, "n k"]],
    config: SurfaceConfig,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Fits planes to the neighbours of points, which were found among all points of a scan."""
    rows, distances = found
    if rows.shape[1] < MIN_NEIGHBOURS:
        return np.zeros((len(points), 3)), np.zeros(len(points))
    # Number of points whose neighbours measure the density of a scan.
    farthest_m = np.median(distances[:: max(1, len(points) // 200), -1]) if len(points) else 0.0
    is_near = distances < max(config.neighbour_radius_m, config.sparse_radius_share * farthest_m)
    columns, own = (np.ascontiguousarray(values.T, np.float32) for values in (searched, points))
    # Neighbour by neighbour in memory: sums over them are several times faster.
    rows, is_near = rows.T, np.asfortranarray(is_near)
    x, y, z = ((column.take(rows) - middle).T for column, middle in zip(columns, own, strict=True))
    fit = fit_planes((x, y, z), is_near)
    flatness = np.where(is_near.sum(axis=1) >= MIN_NEIGHBOURS, fit.flatness, 0)
    return fit.normals.astype(np.float64), flatness.astype(np.float64)


def _samples(normals: Float[np.ndarray, "n d"], flatness: Float[np.ndarray, " n"]) -> Int[np.ndarray, " s"]:
    rows = np.random.default_rng(0).permutation(np.flatnonzero(flatness > MIN_FLATNESS))
    direction = np.argmax(np.abs(normals[rows]), axis=1)
    rank = np.zeros(len(rows), np.int64)
    for axis in range(normals.shape[1]):
        is_along = direction == axis
        rank[is_along] = np.arange(is_along.sum())
    return rows[np.argsort(rank, kind="stable")]


class RangeImage(NamedTuple):
    """Ranges by azimuth and elevation, as the lidar sees them.

    Attributes:
        nearest_m: (rows, columns) smallest range of a pixel and its neighbours; infinite where nothing was measured.
        farthest_m: (rows, columns) largest such range; 0 where nothing was measured.
    """

    nearest_m: Float[np.ndarray, "r c"]
    farthest_m: Float[np.ndarray, "r c"]


def range_image(points: Float[np.ndarray, "n 3"]) -> RangeImage:
    """Makes the range image of a scan, with a margin of one pixel about each measurement.

    Args:
        points: metres, in the frame of the lidar.

    Returns:
        The image.
    """
    nearest, farthest = np.full((NUM_ROWS, NUM_COLUMNS), np.inf), np.zeros((NUM_ROWS, NUM_COLUMNS))
    pixels, ranges = _project(points)
    ranges = ranges.astype(np.float64)  # of another type, the next two lines take ten times as long
    np.minimum.at(nearest.reshape(-1), pixels, ranges)
    np.maximum.at(farthest.reshape(-1), pixels, ranges)
    nearest = minimum_filter1d(minimum_filter1d(nearest, 3, axis=0, mode="nearest"), 3, axis=1, mode="wrap")
    farthest = maximum_filter1d(maximum_filter1d(farthest, 3, axis=0, mode="nearest"), 3, axis=1, mode="wrap")
    return RangeImage(nearest, farthest)


def view_points(
    image: RangeImage, points: Float[np.ndarray, "*n 3"]
) -> tuple[Bool[np.ndarray, "*n"], Bool[np.ndarray, "*n"]]:
    """Compares points with the ranges that the lidar of an image has measured in their directions.

    Args:
        image: range image from `range_image`.
        points: metres, in the frame of that lidar.

    Returns:
        True for points that are visible: something was measured in their direction, and they are not far behind it.
        True for points that contradict the image: they lie clearly in front of all that was measured there.
    """
    pixels, ranges = _project(points)
    nearest, farthest = image.nearest_m.ravel()[pixels], image.farthest_m.ravel()[pixels]
    margin = np.maximum(MARGIN_M, MARGIN_SHARE * ranges)
    is_measured = np.isfinite(nearest)
    return is_measured & (ranges <= farthest + margin), is_measured & (ranges < nearest - margin)


def _project(points: Float[np.ndarray, "*n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pixel and the range of each point."""
    x, y, z = np.moveaxis(points, -1, 0)
    flat = np.hypot(x, y)
    column = np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * NUM_COLUMNS).astype(np.int64) % NUM_COLUMNS
    row = np.floor((np.arctan2(z, flat) / np.pi + 0.5) * NUM_ROWS).astype(np.int64)
    return np.clip(row, 0, NUM_ROWS - 1) * NUM_COLUMNS + column, np.hypot(flat, z)
