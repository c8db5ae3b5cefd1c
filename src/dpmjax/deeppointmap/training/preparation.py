"""Scans prepared for training: thinned, varied, their pyramids stored in memory or in a file.

With `num_variants` 0 nothing is stored: `varied_scan` prepares a scan anew at each use, as the published program does.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import logging
import uuid
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from dpmjax.deeppointmap.encoding import pyramid_of_cloud
from dpmjax.deeppointmap.evaluation import true_poses
from dpmjax.deeppointmap.training.curriculum import MIN_DISTANCE_M, SamplingConfig, TrainingConfig
from dpmjax.geometry.pyramid_storage import record_type, store_pyramid
from dpmjax.scan.lidar.augment import SPARSE_POINTS, AugmentConfig, augment_scan
from dpmjax.scan.lidar.preprocess import MAX_CAPACITY, preprocess_scan_on_host
from dpmjax.sequences import LidarSequence
from dpmjax.types import PointCloud, Poses

LOGGER = logging.getLogger("dpmjax.training")
PUBLISHED = SamplingConfig()

VARIANT_STREAM, SHUFFLE_STREAM = 3104, 3106
# Version of the files, to be raised when the same scans and settings give other files.
FORMAT = 2


class PreparedDrive(NamedTuple):
    """The scans of one drive, ready for training.

    Attributes:
        T_world_lidar: (n, 4, 4) float64 true poses, metres.
        pyramids: (n, num_variants) records of `record_type`, or the file that holds them; or the drive itself, whose
            scans are prepared anew at each use.
        bad: reason for each bad scan; bad scans count as empty.
    """

    T_world_lidar: Poses
    pyramids: np.ndarray | Path | LidarSequence
    bad: dict[str, str]


class PreparedScan(NamedTuple):
    """All variants of one scan.

    Attributes:
        records: (num_variants,) records of `record_type`.
        bad: reason by the source of the scan where it is bad; else empty.
    """

    records: np.ndarray
    bad: dict[str, str]


def stored_bytes(config: TrainingConfig) -> int:
    """Computes the size of one prepared scan, in memory or on disk.

    Args:
        config: settings of training.

    Returns:
        Bytes of all variants of a scan; 0 where scans are prepared anew at each use.
    """
    return config.num_variants * _record_type(config).itemsize


def prepare_drive(drive: LidarSequence, config: TrainingConfig, *, seed: int = 0) -> PreparedDrive:
    """Makes the pyramids of all variants of all scans, in memory. Where `config.num_variants` is 0, nothing is made.

    Args:
        drive: drive with poses.
        config: settings of training.
        seed: seed of the variants.

    Returns:
        The drive.

    Raises:
        ValueError: if the drive has no poses.
    """
    poses = true_poses(drive)
    if config.num_variants == 0:
        return PreparedDrive(poses, drive, {})
    pyramids = np.zeros((len(drive), config.num_variants), _record_type(config))
    return PreparedDrive(poses, pyramids, _fill(pyramids, prepare_variants(drive, range(len(drive)), config, seed)))


def prepared_path(drive: LidarSequence, config: TrainingConfig, folder: Path, seed: int) -> Path:
    """Finds the name of the file of a drive: of its poses, its first, middle and last scan, the settings and the seed.

    Args:
        drive: drive with poses; up to three of its scans are read.
        config: settings of training.
        folder: folder of the files.
        seed: seed of the variants.

    Returns:
        The path, whether the file is there or not.
    """
    model = config.model
    settings = [dataclasses.asdict(part) for part in (model.preprocess, model.pyramid, config.augment)]
    settings[-1]["sparse_points"] = SPARSE_POINTS  # decides the points that are kept
    # Motions are drawn in the step, so they do not change the file.
    for name in ("max_yaw_rad", "max_tilt_rad", "tilt_power", "translation_sigma_m"):
        del settings[-1][name]
    order = [] if config.thins_as_in_use else ["shuffled"]
    content = json.dumps([FORMAT, settings, model.scale_m, config.num_variants, seed, *order], sort_keys=True)
    digest = hashlib.sha256(content.encode())
    digest.update(np.ascontiguousarray(drive.T_world_lidar).tobytes())
    for number in sorted({0, len(drive) // 2, len(drive) - 1}):
        try:
            digest.update(np.ascontiguousarray(drive.read_scan(number)).tobytes())
        except ValueError as error:
            digest.update(str(error).encode())
    return folder / f"{digest.hexdigest()[:24]}.npy"


def find_prepared(path: Path, T_world_lidar: Poses) -> PreparedDrive | None:
    """Finds the file that an earlier call has made.

    Args:
        path: path from `prepared_path`.
        T_world_lidar: true poses of the drive, metres.

    Returns:
        The drive; None where there is no such file.
    """
    reasons = path.with_suffix(".json")
    if not (path.is_file() and reasons.is_file()):
        return None
    return PreparedDrive(T_world_lidar, path, json.loads(reasons.read_text(encoding="utf-8")))


def prepare_variants(
    drive: LidarSequence, numbers: Iterable[int], config: TrainingConfig, seed: int
) -> Iterator[PreparedScan]:
    """Prepares the numbered scans of a drive, one by one.

    Args:
        drive: the drive.
        numbers: numbers of the scans.
        config: settings of training.
        seed: seed of the variants.

    Yields:
        Each scan.
    """
    for number in numbers:
        bad: dict[str, str] = {}
        points = read_or_note(drive, number, bad)
        yield PreparedScan(scan_records(points, config, (seed, number)), bad)


def store_scans(
    path: Path, T_world_lidar: Poses, scans: Iterable[PreparedScan], config: TrainingConfig
) -> PreparedDrive:
    """Writes the file of a drive under another name, which it keeps until it is whole.

    Args:
        path: path from `prepared_path`; its folder is made.
        T_world_lidar: true poses of the drive, metres.
        scans: all scans in their order.
        config: settings of training.

    Returns:
        The drive.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Process numbers would not do: two containers that share a folder may have the same.
    unfinished = path.with_name(f".{path.stem}.{uuid.uuid4().hex}.npy")
    shape = len(T_world_lidar), config.num_variants
    try:
        bad = _fill(np.lib.format.open_memmap(unfinished, "w+", _record_type(config), shape), scans)
        path.with_suffix(".json").write_text(json.dumps(bad), encoding="utf-8")
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return PreparedDrive(T_world_lidar, path, bad)


def _fill(pyramids: np.ndarray, scans: Iterable[PreparedScan]) -> dict[str, str]:
    """Copies the records of all scans; returns the reason for each bad scan."""
    bad: dict[str, str] = {}
    for number, scan in enumerate(scans):
        pyramids[number] = scan.records
        bad |= scan.bad
    return bad


def read_or_note(drive: LidarSequence, number: int, bad: dict[str, str]) -> Float[np.ndarray, "n 3"]:
    """Reads a scan; a bad one is empty, and its reason is noted.

    Args:
        drive: the drive.
        number: number of the scan.
        bad: reason for each bad scan, by its source; this function adds to it.

    Returns:
        The points, metres.
    """
    try:
        return drive.read_scan(number)
    except ValueError as error:
        source = drive.sources[number]
        if source not in bad:
            bad[source] = str(error).removeprefix(f"{source}: ")
            LOGGER.warning("scan %s is left out: %s", source, bad[source])
        return np.zeros((0, 3), np.float32)


def scan_records(points: Float[np.ndarray, "n 3"], config: TrainingConfig, seeds: tuple[int, int]) -> np.ndarray:
    """Prepares the variants of a scan.

    Args:
        points: the scan as it was read, metres.
        config: settings of training.
        seeds: two numbers that decide the variants.

    Returns:
        A record of `record_type` for each variant.
    """
    stored = (
        store_pyramid(pyramid_of_cloud(cloud, config.model, num_threads=1))
        for cloud in _variants(points, config, seeds)
    )
    return np.array([tuple(jax.tree.leaves(one)) for one in stored], _record_type(config))


def _record_type(config: TrainingConfig) -> np.dtype:
    return record_type(config.model.pyramid, config.model.preprocess.capacity)


def _variants(points: Float[np.ndarray, "n 3"], config: TrainingConfig, seeds: tuple[int, int]) -> list[PointCloud]:
    # The motion is left to the step.
    still = replace(config.augment, max_yaw_rad=0.0, max_tilt_rad=0.0, translation_sigma_m=0.0)
    settings = config.model.preprocess
    if config.thins_as_in_use:
        cloud = preprocess_scan_on_host(points, None, settings, num_threads=1)
        return variants_on_host(cloud, still, config.num_variants, seeds)
    # Published: shuffle, filter by voxel and range, drop and occlude, and then thin to the capacity.
    rng = np.random.default_rng([SHUFFLE_STREAM, *seeds])
    whole = replace(settings, num_outlier_neighbours=0, capacity=max(MAX_CAPACITY, settings.capacity))
    variants = []
    for _ in range(config.num_variants):
        cloud = preprocess_scan_on_host(rng.permutation(points), None, whole, num_threads=1)
        (varied,) = variants_on_host(cloud, still, 1, (seeds[0], int(rng.integers(1 << 31))))
        # Evenly spaced points; of shuffled ones these are random. Valid points stand in front.
        slots, num_valid = np.arange(settings.capacity), int(np.sum(varied.mask))
        rows = slots * num_valid // len(slots) if num_valid > len(slots) else slots
        variants.append(PointCloud(np.asarray(varied.points)[rows], np.asarray(varied.mask)[rows]))
    return variants


def variants_on_host(
    cloud: PointCloud, config: AugmentConfig, num_variants: int, seeds: tuple[int, int]
) -> list[PointCloud]:
    """Augments a scan several times, on the processor, whatever device trains.

    Args:
        cloud: a preprocessed scan, metres.
        config: strength of the augmentation.
        num_variants: number of variants.
        seeds: seed of the run, and number of the scan.

    Returns:
        The variants in NumPy, valid points in front.
    """
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(VARIANT_STREAM), seeds[0]), seeds[1])
        host = PointCloud(np.asarray(cloud.points), np.asarray(cloud.mask))
        done = jax.device_get(_augmented(host, jax.random.split(key, num_variants), config=config))
    fronts = np.argsort(~done.mask, axis=1, kind="stable")
    return [PointCloud(*(leaf[row][front] for leaf in (done.points, done.mask))) for row, front in enumerate(fronts)]


@functools.partial(jax.jit, static_argnames="config")
def _augmented(cloud: PointCloud, keys: Array, *, config: AugmentConfig) -> PointCloud:
    return jax.vmap(lambda key: augment_scan(jax.tree.map(jnp.asarray, cloud), config, key=key).cloud)(keys)


def why_useless(drive: LidarSequence, sampling: SamplingConfig = PUBLISHED) -> str | None:
    """Finds a reason against training or evaluation on a drive. Reads scans up to the first good one.

    Args:
        drive: drive that is checked.
        sampling: distances between the scans of a pair.

    Returns:
        The reason; None where there is none.
    """
    if drive.T_world_lidar is None:
        return "no poses; a pose for each scan is needed, such as a file poses.txt beside the scans (docs/files.md)"
    positions = drive.T_world_lidar[drive.has_reference, :3, 3]
    tree = cKDTree(positions)
    limits = MIN_DISTANCE_M, sampling.max_distance_m
    num_too_near, num_near = (tree.count_neighbors(tree, limit) for limit in limits)
    if num_near == num_too_near:
        found = f"{len(positions)} scans, no two of them {limits[0]} to {limits[1]} m apart"
        return f"{found}; such pairs are needed (are the poses in metres?)"
    reasons = []
    for number in range(len(drive)):
        try:
            drive.read_scan(number)
        except ValueError as error:
            reasons.append(str(error))
        else:
            return None
    return f"all {len(drive)} scans are bad; the first, {reasons[0]}"
