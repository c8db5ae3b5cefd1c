"""What users do with a model: a raw scan to descriptors, two of them to a motion or to a probability of overlap."""

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
    correlate,
    encode_pyramid,
    overlap_probability,
    predict_offsets,
    similarity_features,
)
from dpmjax.geometry.pyramid_host import build_pyramid_on_host
from dpmjax.scans.preprocess_host import preprocess_scan_on_host
from dpmjax.types import AnyArray, DescriptorCloud, PointCloud, PointPyramid, Registration

ScanOrCloud = DescriptorCloud | PointCloud | Float[AnyArray, "n 3"]
"""A raw scan in metres, in the frame of its lidar, or what `encode` made of one; a map of such clouds too."""


def encode(model: Model, points: PointCloud | Float[AnyArray, "n 3"]) -> DescriptorCloud:
    """A raw scan to its descriptors, preprocessing included (DeepPointMap section 3.1).

    Args:
        model: its configuration says how scans are preprocessed.
        points: (n, 3), metres, in the frame of the lidar; points that are not finite are left out.

    Returns:
        `model.config.num_descriptors` descriptors, metres, same frame. Of an empty scan none is there.

    Raises:
        ValueError: the shape is another one, or these are no real numbers.
    """
    return encode_pyramid(model, pyramid_of_scan(model, points))


def pyramid_of_scan(model: Model, points: PointCloud | Float[AnyArray, "n 3"]) -> PointPyramid:
    """The first half of `encode`, on the host: the preprocessed and normalised scan as a pyramid.

    Raises:
        ValueError: see `encode`.
    """
    array, mask = (points.points, points.mask) if isinstance(points, PointCloud) else (points, None)
    array = np.asarray(array)
    if array.ndim != 2 or array.shape[1] != 3:
        hint = "; of (n, 4), with reflectance, give points[:, :3]" if array.shape[1:] == (4,) else ""
        raise ValueError(f"points: expected shape (n, 3), got {array.shape}{hint}")
    if not (np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)):
        raise ValueError(f"points: expected real numbers, got dtype {array.dtype}")
    config = model.config
    cloud = preprocess_scan_on_host(array, None if mask is None else np.asarray(mask), config.preprocess)
    return pyramid_of_cloud(model, cloud)


def pyramid_of_cloud(model: Model, cloud: PointCloud) -> PointPyramid:
    """The pyramid of a preprocessed cloud, metres: the one place where metres become normalised coordinates."""
    scaled = np.asarray(cloud.points) / np.float32(model.config.scale_m)
    return build_pyramid_on_host(scaled, np.asarray(cloud.mask), model.config.pyramid)


def register(
    model: Model, source: ScanOrCloud, target: ScanOrCloud, *, config: MatchConfig | None = None
) -> Registration:
    """The motion between two scans, or two maps, without a first guess (DeepPointMap section 3.2).

    Args:
        model: encoder and decoder.
        source: a raw scan (n, 3) in metres, or a descriptor cloud.
        target: the same; one may be a scan and the other a map.
        config: which pairs are chosen and believed; the model's own where not given.

    Returns:
        `T_target_source`, `confidence`, `rmse_m` and the pairs. Failure is data: without any pair the motion is the
        identity, the confidence 0 and the error infinite.

    Raises:
        ValueError: see `encode`; or features of another width than the model takes.
    """
    clouds = _as_cloud(model, source), _as_cloud(model, target)
    correlated = correlate(model, *clouds)
    return _register(model, *correlated, config=config or model.config.matching)


def overlap(model: Model, source: ScanOrCloud, target: ScanOrCloud) -> Float[Array, ""]:
    """Probability that two scans, or maps, see the same place, less than 20 m apart (DeepPointMap section 3.2).

    Args:
        model: encoder and decoder.
        source: a raw scan (n, 3) in metres, or a descriptor cloud.
        target: the same; the order matters a little.

    Raises:
        ValueError: see `encode`; or features of another width than the model takes.
    """
    return overlap_probability(model, _as_cloud(model, source), _as_cloud(model, target))


def _as_cloud(model: Model, scan: ScanOrCloud) -> DescriptorCloud:
    return scan if isinstance(scan, DescriptorCloud) else encode(model, scan)


@functools.partial(jax.jit, static_argnames="config")
def _register(model: Model, source: DescriptorCloud, target: DescriptorCloud, *, config: MatchConfig) -> Registration:
    """From correlated clouds."""
    directions = [_unit(similarity_features(model, cloud)) for cloud in (source, target)]
    similarity = jnp.matmul(directions[0], directions[1].T, precision=lax.Precision.HIGHEST)

    def offsets(source_rows: Array, target_rows: Array) -> tuple[Array, Array]:
        a, b = source.features[source_rows], target.features[target_rows]
        return predict_offsets(model, a, b), predict_offsets(model, b, a)

    return match_descriptors(
        source.positions, target.positions, similarity, offsets, source.mask, target.mask, config=config
    )


def _unit(features: Float[Array, "m c"]) -> Float[Array, "m c"]:
    squared = jnp.sum(features.astype(jnp.float32) ** 2, axis=1, keepdims=True)
    return features / jnp.sqrt(jnp.where(squared > 0, squared, 1))
