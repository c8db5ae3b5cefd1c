"""A lidar scan as every later step takes it: its surface, its free space, and its descriptors.

One search of neighbours serves the outlier filter and the normals. `lidar_scan` makes the few elements of odometry,
`measure_scan` the dense surface of a registration, and `measured_elements` the surface of elements that a map keeps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dpmjax.checks import as_host_points
from dpmjax.geometry.neighbours import HostTree
from dpmjax.geometry.shells import without_shell
from dpmjax.scan.lidar.preprocess import PreprocessConfig, first_of_each_voxel, thin_points
from dpmjax.scan.lidar.slide import FIRM_FLATNESS, corridor_axis, has_facing
from dpmjax.scan.lidar.surfaces import (
    RangeImage,
    Surface,
    SurfaceConfig,
    chosen_elements,
    firm_surface,
    range_image,
    scan_surface,
    surface_at,
    surface_of_elements,
)
from dpmjax.types import DescriptorCloud, PointCloud, RawScan, SurfaceElements

# A scan with fewer flat surface elements counts as empty.
MIN_NUM_POINTS = 100

# Largest number of surface elements of a scan, the outliers that are then left out among them: denser scans would align
# ring with ring.
MAX_ELEMENTS = 3000

# Neighbourhoods of all points of a scan, and of spread ones: in scans of 1,000 points neighbours are farther away.
DENSE, NEIGHBOURHOODS = SurfaceConfig(), SurfaceConfig(sparse_radius_share=1.5)

# Voxels in a corridor that hardly any element faces: there a relief of centimetres may hold the way along it. Its
# corners need flatter elements.
FINE_VOXEL_M, FINE_FLATNESS = 0.08, 0.5

# One element of each voxel of this size is chosen first, because ground near the lidar is dense.
SPREAD_M = 1.5


class Scan(NamedTuple):
    """A scan that is ready for any number of registrations.

    Attributes:
        surface: points, normals and a tree, metres, in the frame of the lidar.
        image: range image, the free space.
        descriptors: descriptors of the scan, positions in metres; None before it is encoded.
        thinned: points that range and voxel leave, outliers among them: input of the encoder; None if none is needed.
        extent_m: median range of the thinned points.
        weak_axis: unit vector along a corridor, which few walls face, in the frame of the lidar; None elsewhere.
    """

    surface: Surface
    image: RangeImage
    descriptors: DescriptorCloud | None = None
    thinned: HostTree | None = None
    extent_m: float = 0.0
    weak_axis: Float[np.ndarray, "3"] | None = None


def lidar_scan(points: Float[np.ndarray, "n 3"], config: PreprocessConfig) -> Scan | None:
    """Thins a scan as the encoder does, and estimates its surface at spread points.

    Args:
        points: finite, metres, in the frame of the lidar.
        config: filters of the encoder.

    Returns:
        The scan without descriptors; None if it has too few flat points.
    """
    if len(points) < MIN_NUM_POINTS:
        return None
    points = _echoes(points, config)
    tree = thin_points(points, None, config)
    rows, weights = _spread_rows(tree.points)
    weighing = weights if config.num_outlier_neighbours > 0 else None
    surface = surface_at(tree, rows, NEIGHBOURHOODS, weights=weighing)
    if np.count_nonzero(surface.flatness) < MIN_NUM_POINTS:
        return None
    weak_axis = corridor_axis(surface)
    if weak_axis is not None:
        surface = firm_surface(surface, FIRM_FLATNESS)
        if not has_facing(surface, weak_axis):
            surface = _fine_surface(points, config)
    extent_m = float(np.median(np.linalg.norm(tree.points, axis=1)))
    return Scan(surface, range_image(tree.points), thinned=tree, extent_m=extent_m, weak_axis=weak_axis)


def _echoes(points: Float[np.ndarray, "n 3"], config: PreprocessConfig) -> Float[np.ndarray, "m 3"]:
    """Leaves out points that are no echoes, unless the range filter does."""
    # A shell of points without an echo is no wider (`geometry.shells`): if the farthest point is this many times as far
    # as the largest range, the range filter leaves out the whole shell.
    is_beyond = np.square(points, dtype=np.float64).sum(axis=1).max(initial=0) > (1.04 * config.max_range_m) ** 2
    return points if is_beyond else without_shell(points)


def _fine_surface(points: Float[np.ndarray, "n 3"], config: PreprocessConfig) -> Surface:
    """Measures the surface of a scan at points that are near each other; only flat elements are kept."""
    surface = scan_surface(points, SurfaceConfig(config.min_range_m, config.max_range_m, voxel_size_m=FINE_VOXEL_M))
    rows = np.flatnonzero(surface.flatness > FINE_FLATNESS)
    rows = rows[_spread_rows(surface.points[rows])[0]]
    return chosen_elements(surface, rows)


def measure_scan(points: Float[np.ndarray, "n 3"], config: SurfaceConfig = DENSE) -> Scan:
    """Prepares all points of a scan for registrations.

    Args:
        points: metres, in the frame of the lidar; points that are not finite are dropped.
        config: resolution.

    Returns:
        Surface and free space.
    """
    surface = scan_surface(without_shell(points), config)
    return Scan(surface, range_image(surface.points))


def measured_elements(elements: SurfaceElements) -> Scan:
    """Prepares the surface elements of a scan for registrations, without the scan.

    Args:
        elements: metres, in the frame of the lidar.

    Returns:
        Surface and free space, as far as the elements show it.
    """
    surface = surface_of_elements(elements)
    return Scan(surface, range_image(surface.points))


def _spread_rows(points: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, " e"], Float[np.ndarray, " e"]]:
    """Chooses points, first one of each coarse voxel, then others at random.

    Args:
        points: points of a scan.

    Returns:
        Their rows, in the order of the scan, and the number of points that each stands for.
    """
    rng, is_first = np.random.default_rng(0), np.zeros(len(points), bool)
    is_first[first_of_each_voxel(points, SPREAD_M)] = True
    weights, num_left = np.zeros(len(points)), MAX_ELEMENTS
    for part in (is_first, ~is_first):
        rows = np.flatnonzero(part)
        chosen = rng.permutation(rows)[:num_left]
        weights[chosen] = len(rows) / max(len(chosen), 1)
        num_left -= len(chosen)
    rows = np.flatnonzero(weights)
    return rows, weights[rows]


def valid_points(points: RawScan) -> Float[np.ndarray, "n 3"]:
    """Returns the points of a scan that its mask allows, as an array of NumPy."""
    if isinstance(points, PointCloud):
        return np.asarray(points.points)[np.asarray(points.mask)]
    return as_host_points("points", points)
