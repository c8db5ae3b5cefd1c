"""Encoding: raw scans to their descriptors, and to scans that are ready for registrations.

Many scans are encoded in chunks of one size, so that one program is compiled.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dpmjax.checks import as_host_points, require_type, require_value, runs_on_host
from dpmjax.deeppointmap.model import Model, encode_pyramid
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.geometry.pyramid import build_pyramid_on_host
from dpmjax.geometry.shells import without_shell
from dpmjax.kept_programs import kept_jit
from dpmjax.reading import read_path
from dpmjax.scan.lidar.preprocess import preprocess_scan_on_host
from dpmjax.scan.lidar.record import Scan, measure_scan, valid_points
from dpmjax.types import DescriptorCloud, PointCloud, PointPyramid, RawScan

# Number of scans in one call of a compiled program.
CHUNK = 4

# Number of threads that measure and verify scans while JAX encodes and matches others.
NUM_THREADS = 2

# A raw scan, a prepared scan, or descriptors of a scan or of a map.
ScanOrCloud = DescriptorCloud | Scan | RawScan


@runs_on_host("call encode_pyramid on geometry.build_pyramid there")
def encode(model: Model, points: RawScan, *, num_elements: int | None = None) -> DescriptorCloud:
    """Encodes a raw scan to descriptors, preprocessing included (DeepPointMap section 3.1).

    Raises a `ValueError` if the points are no real numbers (n, 3), or if `num_elements` is out of range. Warns if
    hardly any point is in range: the points are then probably not in metres.

    Args:
        model: its configuration includes the preprocessing.
        points: (n, 3), metres, in the frame of the lidar, or their file; points that are not finite are dropped.
        num_elements: number of surface elements, from that of the descriptors to that of the points of the first stage
            of `model.config.pyramid`. Elements beyond the descriptors have no features, and make `register` of two
            clouds more exact. None for the descriptors alone, which are surface elements too.

    Returns:
        `model.config.num_descriptors` descriptors and the further elements, metres, same frame, in the order of
        farthest points. The mask of an empty scan is all False.
    """
    require_type("model", model, Model, "load_model")
    return encode_pyramid(model, pyramid_of_scan(points, model.config), num_elements=num_elements)


@runs_on_host("call encode_pyramid on geometry.build_pyramid there")
def encode_scans(model: Model, scans: Sequence[RawScan] | Path, *, num_elements: int | None = None) -> DescriptorCloud:
    """Encodes many raw scans; they may have different numbers of points.

    Raises a `ValueError` if there is no scan, or if points are no real numbers (n, 3).

    Args:
        model: encoder and configuration.
        scans: points in metres, each in the frame of its lidar, or their files; or a folder of scans.
        num_elements: see `encode`.

    Returns:
        Stacked clouds, as `merge_clouds` takes them: positions (s, n, 3), features (s, m, c), mask (s, n).
    """
    require_type("model", model, Model, "load_model")
    drive: Sequence[RawScan] = read_path(scans, "io.open_lidar_sequence")
    require_value(len(drive) > 0, "scans", "at least one", "none")
    pyramids = (pyramid_of_scan(points, model.config) for points in drive)
    return jax.tree.map(jnp.asarray, encode_pyramids(model, pyramids, num_elements=num_elements))


def descriptors_of(scan: DescriptorCloud | Scan) -> DescriptorCloud:
    """Returns the descriptors of a prepared scan, or the cloud itself; a `ValueError` refuses a scan without any."""
    cloud = scan.descriptors if isinstance(scan, Scan) else scan
    if cloud is None:
        raise ValueError("scan: expected descriptors, got a scan that is not encoded; call prepare_scan")
    return cloud


def prepare_scan(model: Model, points: RawScan) -> Scan:
    """Encodes a raw scan and prepares the verification by its points, so that `register` need not do it again.

    Raises a `ValueError` if the points are no real numbers (n, 3).

    Args:
        model: encoder and configuration.
        points: (n, 3), metres, in the frame of the lidar, or their file; points that are not finite are dropped.

    Returns:
        Descriptors, surface and free space.
    """
    return prepare_scans(model, [points])[0]


def prepare_scans(model: Model, scans: Iterable[RawScan]) -> list[Scan]:
    """Prepares scans in their order; threads measure their surfaces while JAX encodes.

    Raises a `ValueError` if the points of a scan are no real numbers (n, 3).

    Args:
        model: encoder and configuration.
        scans: points in metres, each in the frame of its lidar.

    Returns:
        The prepared scans.
    """
    # Threads run NumPy only: compiled programs need threads of JAX, and several may wait for each other.
    with ThreadPoolExecutor(NUM_THREADS) as pool:
        clouds, measured = [], []
        for scan in scans:
            points = cast(RawScan, read_path(scan, "io.read_lidar_file"))
            pyramid = pyramid_of_scan(points, model.config)
            measured.append(pool.submit(measure_scan, valid_points(points), model.config.verification.surface))
            clouds.append(encode_pyramid(model, pyramid))
        return [future.result()._replace(descriptors=cloud) for cloud, future in zip(clouds, measured, strict=True)]


def encode_pyramids(
    model: Model, pyramids: Iterable[PointPyramid], *, num_elements: int | None = None
) -> DescriptorCloud:
    """Encodes pyramids; an iterator makes the next ones while JAX encodes.

    Args:
        model: encoder and configuration.
        pyramids: at least one, in normalised coordinates, from the host.
        num_elements: see `encode`.

    Returns:
        Stacked clouds, as arrays of NumPy: moved to a device, another number of scans would be compiled again.
    """
    parts, num, remaining = [], 0, iter(pyramids)
    while some := list(itertools.islice(remaining, CHUNK)):
        num += len(some)
        filled = some + some[-1:] * (CHUNK - len(some))
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *filled)
        parts.append(jax.device_get(_encode_chunk(model, stacked, num_elements=num_elements)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:num], *parts)


def pyramid_of_scan(points: RawScan, config: ModelConfig) -> PointPyramid:
    """Computes the first half of `encode` on the host: preprocessing, normalisation and the point pyramid.

    Raises a `ValueError` if the points are no real numbers (n, 3).

    Args:
        points: (n, 3), metres, in the frame of the lidar; points that are not finite are dropped.
        config: preprocessing, pyramid, and scale of its coordinates.

    Returns:
        The pyramid, in normalised coordinates.
    """
    return pyramid_of_cloud(thin_scan(points, config), config)


def thin_scan(points: RawScan, config: ModelConfig) -> PointCloud:
    """Preprocesses a raw scan for the encoder, on the host.

    Args:
        points: (n, 3), metres, in the frame of the lidar; points that are not finite are dropped.
        config: preprocessing.

    Returns:
        The remaining points, metres; arrays of NumPy.

    Raises:
        ValueError: if the points are no real numbers (n, 3).
    """
    if isinstance(points, PointCloud):
        array = as_host_points("points", points.points)
        return preprocess_scan_on_host(array, np.asarray(points.mask), config.preprocess)
    return preprocess_scan_on_host(without_shell(as_host_points("points", points)), None, config.preprocess)


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


@kept_jit("num_elements")
def _encode_chunk(model: Model, pyramids: Any, *, num_elements: int | None) -> DescriptorCloud:
    return jax.lax.map(functools.partial(encode_pyramid, model, num_elements=num_elements), pyramids)


def pooled_vector(cloud: DescriptorCloud) -> Float[np.ndarray, " d"]:
    """Pools the descriptors of a scan into one unit vector: their mean and their deviation in each channel.

    Neither depends on the order of the descriptors. With features in frames that turn with the scan, neither changes
    where the scan turns about the vertical.

    Args:
        cloud: descriptors of a scan.

    Returns:
        (2 c,) float32; zero for an empty cloud.
    """
    features = np.asarray(cloud.features, np.float32)[np.asarray(cloud.mask)]
    if len(features) == 0:
        return np.zeros(2 * cloud.features.shape[-1], np.float32)
    features = features / np.maximum(np.linalg.norm(features, axis=1, keepdims=True), 1e-12)
    pooled = np.concatenate([features.mean(axis=0), features.std(axis=0)])
    return np.asarray(pooled / max(float(np.linalg.norm(pooled)), 1e-12), np.float32)
