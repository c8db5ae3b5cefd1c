"""Encoding: a raw scan to its descriptors."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.model import Model, encode_pyramid
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.geometry.pyramid_host import build_pyramid_on_host
from dpmjax.scans.preprocess import preprocess_scan_on_host
from dpmjax.types import AnyArray, DescriptorCloud, PointCloud, PointPyramid


def encode(model: Model, points: PointCloud | Float[AnyArray, "n 3"]) -> DescriptorCloud:
    """Encodes a raw scan to descriptors, preprocessing included (DeepPointMap section 3.1).

    A `ValueError` says if the points are no real numbers (n, 3). A warning says if hardly any point is in range: the
    points are then probably not in metres.

    Args:
        model: its configuration includes the preprocessing.
        points: (n, 3), metres, in the frame of the lidar; points that are not finite are dropped.

    Returns:
        `model.config.num_descriptors` descriptors, metres, same frame. The mask of an empty scan is all False.
    """
    return encode_pyramid(model, pyramid_of_scan(points, model.config))


def pyramid_of_scan(points: PointCloud | Float[AnyArray, "n 3"], config: ModelConfig) -> PointPyramid:
    """Computes the first half of `encode` on the host: preprocessing, normalisation and the point pyramid.

    Args:
        points: (n, 3), metres, in the frame of the lidar; points that are not finite are dropped.
        config: preprocessing, pyramid, and scale of its coordinates.

    Returns:
        The pyramid, in normalised coordinates.

    Raises:
        ValueError: if the points are no real numbers (n, 3).
    """
    array, mask = (points.points, points.mask) if isinstance(points, PointCloud) else (points, None)
    array = np.asarray(array)
    if array.ndim != 2 or array.shape[1] != 3:
        hint = "; pass points[:, :3] without the reflectance" if array.shape[1:] == (4,) else ""
        raise ValueError(f"points: expected shape (n, 3), got {array.shape}{hint}")
    if not (np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)):
        raise ValueError(f"points: expected real numbers, got dtype {array.dtype}")
    cloud = preprocess_scan_on_host(array, None if mask is None else np.asarray(mask), config.preprocess)
    return pyramid_of_cloud(cloud, config)


def pyramid_of_cloud(cloud: PointCloud, config: ModelConfig, *, num_threads: int = 2) -> PointPyramid:
    """Converts metres to normalised coordinates and builds the pyramid on the host.

    Args:
        cloud: a preprocessed scan, metres, in the frame of the lidar.
        config: pyramid, and scale of its coordinates.
        num_threads: threads of the neighbour search.

    Returns:
        The pyramid, in normalised coordinates.
    """
    scaled = np.asarray(cloud.points) / np.float32(config.scale_m)
    return build_pyramid_on_host(scaled, np.asarray(cloud.mask), config.pyramid, num_threads=num_threads)
