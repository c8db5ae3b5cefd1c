"""A lidar scan as every later step takes it: its surface, its free space, and its descriptors.

One tree and its neighbours serve the outlier filter and the normals. `lidar_scan` makes the few elements of odometry,
`measure_scan` the dense surface of a registration, and `measured_elements` the surface of elements that a map keeps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dpmjax.geometry.shells import without_shell
from dpmjax.scans.preprocess import PreprocessConfig, as_cloud, filter_points, first_of_each_voxel
from dpmjax.scans.surfaces import (
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
from dpmjax.scans.weak_directions import FIRM_FLATNESS, corridor_axis, has_facing
from dpmjax.types import DescriptorCloud, PointCloud, SurfaceElements

# A scan with fewer flat surface elements counts as empty.
MIN_NUM_POINTS = 100

# Largest number of surface elements of a scan: denser scans would align ring with ring.
MAX_ELEMENTS = 3000

# Neighbourhoods of all points of a scan, and of spread ones: in scans of 1,000 points neighbours are farther away.
DENSE, NEIGHBOURHOODS = SurfaceConfig(), SurfaceConfig(sparse_radius_share=1.5)

# Voxels and the largest number of elements in a corridor that hardly any element faces: there a relief of centimetres
# may hold the way along it. Its corners need flatter elements.
FINE_VOXEL_M, MAX_FINE_ELEMENTS, FINE_FLATNESS = 0.08, 6000, 0.5

# One element of each voxel of this size is chosen first, because ground near the lidar is dense.
SPREAD_M = 1.5


class Scan(NamedTuple):
    """A scan that is ready for any number of registrations.

    Attributes:
        surface: points, normals and a tree, metres, in the frame of the lidar.
        image: range image, the free space.
        descriptors: descriptors of the scan, positions in metres times `scale`; None before it is encoded.
        scale: factor by which the points were enlarged for the encoder.
        cloud: thinned points, metres, in the frame of the lidar: input of the encoder; None where none is needed.
        extent_m: median range of the thinned points.
        weak_axis: unit vector along a corridor, which few walls face, in the frame of the lidar; None elsewhere.
    """

    surface: Surface
    image: RangeImage
    descriptors: DescriptorCloud | None = None
    scale: float = 1.0
    cloud: PointCloud | None = None
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
    points = without_shell(points)
    tree, rows = filter_points(points, None, config)
    thinned = tree.points.take(rows, axis=0)
    is_inlier = np.zeros(len(tree.points), bool)
    is_inlier[rows] = True
    surface = surface_at(tree, rows[_spread_rows(thinned)], NEIGHBOURHOODS, is_counted=is_inlier)
    if np.count_nonzero(surface.flatness) < MIN_NUM_POINTS:
        return None
    weak_axis = corridor_axis(surface)
    if weak_axis is not None:
        surface = firm_surface(surface, FIRM_FLATNESS)
        if not has_facing(surface, weak_axis):
            surface = _fine_surface(points, config)
    thinned = thinned.astype(np.float32)
    extent_m = float(np.median(np.linalg.norm(thinned, axis=1)))
    cloud = as_cloud(thinned, config)
    return Scan(surface, range_image(thinned), cloud=cloud, extent_m=extent_m, weak_axis=weak_axis)


def _fine_surface(points: Float[np.ndarray, "n 3"], config: PreprocessConfig) -> Surface:
    """Measures the surface of a scan at points that are near each other; only flat elements are kept."""
    surface = scan_surface(points, SurfaceConfig(config.min_range_m, config.max_range_m, voxel_size_m=FINE_VOXEL_M))
    rows = np.flatnonzero(surface.flatness > FINE_FLATNESS)
    rows = rows[_spread_rows(surface.points[rows])][:MAX_FINE_ELEMENTS]
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


def _spread_rows(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " e"]:
    """Chooses points in random order: first one of each coarse voxel, then others."""
    rng, is_first = np.random.default_rng(0), np.zeros(len(points), bool)
    is_first[first_of_each_voxel(points, SPREAD_M)] = True
    return np.concatenate([rng.permutation(np.flatnonzero(part)) for part in (is_first, ~is_first)])[:MAX_ELEMENTS]
