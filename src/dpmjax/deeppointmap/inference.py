"""Inference: encode a raw scan to descriptors, register two scans or maps, predict their overlap."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from dpmjax.deeppointmap.matching import MatchConfig, match_descriptors
from dpmjax.deeppointmap.model import (
    Model,
    ModelConfig,
    correlate,
    encode_pyramid,
    overlap_probability,
    predict_offsets,
    similarity_features,
)
from dpmjax.geometry.bearing import directions_of
from dpmjax.geometry.pyramid_host import build_pyramid_on_host
from dpmjax.scans.preprocess import preprocess_scan_on_host
from dpmjax.types import AnyArray, DescriptorCloud, PointCloud, PointPyramid, Registration

ScanOrCloud = DescriptorCloud | PointCloud | Float[AnyArray, "_n 3"]
"""A raw scan in metres, in the frame of its lidar; or the descriptors of a scan; or a map of such descriptors."""


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


def register(
    model: Model, source: ScanOrCloud, target: ScanOrCloud, *, config: MatchConfig | None = None
) -> Registration:
    """Registers two scans or maps without a first guess (DeepPointMap section 3.2).

    A `ValueError` says if the points are no real numbers (n, 3), or if features have another width than the model.

    Args:
        model: encoder and decoder.
        source: a raw scan (n, 3) in metres, or a descriptor cloud.
        target: the same; one may be a scan and the other a map.
        config: choice of pairs and inliers; None takes that of the model.

    Returns:
        `T_target_source`, `confidence`, `rmse_m` and the pairs. Failure is data: without any pair the motion is the
        identity and the confidence 0; with fewer than three distinct pairs `rmse_m` is infinite.
    """
    clouds = _as_cloud(model, source), _as_cloud(model, target)
    correlated = correlate(model, *clouds)
    return register_correlated(model, *correlated, config=config or model.config.matching)


def overlap(model: Model, source: ScanOrCloud, target: ScanOrCloud) -> Float[Array, ""]:
    """Predicts the probability that two scans or maps overlap: less than 20 m apart (DeepPointMap section 3.2).

    A `ValueError` says if the points are no real numbers (n, 3), or if features have another width than the model.

    Args:
        model: encoder and decoder.
        source: a raw scan (n, 3) in metres, or a descriptor cloud.
        target: the same; the order matters a little.

    Returns:
        The probability; 0 where a scan is empty or a feature is not finite.
    """
    return overlap_probability(model, _as_cloud(model, source), _as_cloud(model, target))


def _as_cloud(model: Model, scan: ScanOrCloud) -> DescriptorCloud:
    return scan if isinstance(scan, DescriptorCloud) else encode(model, scan)


@functools.partial(jax.jit, static_argnames="config")
def register_correlated(
    model: Model, source: DescriptorCloud, target: DescriptorCloud, *, config: MatchConfig
) -> Registration:
    """Registers two clouds whose features are correlated already.

    Args:
        model: encoder and decoder.
        source: from `correlate`.
        target: the other one.
        config: choice of pairs and inliers.

    Returns:
        As `register`.
    """
    directions = [_unit(similarity_features(model, cloud)) for cloud in (source, target)]
    similarity = jnp.matmul(directions[0], directions[1].T, precision=lax.Precision.HIGHEST)

    def offsets(source_rows: Array, target_rows: Array) -> tuple[Array, Array]:
        a, b = source.features[source_rows], target.features[target_rows]
        of_source, of_target = directions_of(source)[source_rows], directions_of(target)[target_rows]
        return predict_offsets(model, a, b, of_source), predict_offsets(model, b, a, of_target)

    return match_descriptors(source, target, similarity, offsets, config=config)


def _unit(features: Float[Array, "m c"]) -> Float[Array, "m c"]:
    squared = jnp.sum(features.astype(jnp.float32) ** 2, axis=1, keepdims=True)
    return features / jnp.sqrt(jnp.where(squared > 0, squared, 1))
