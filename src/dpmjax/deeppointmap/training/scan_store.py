"""The scans of drives, prepared for training: thinned, varied, their pyramids stored; and the batches made of them.

Samples are drawn by seed and step, and batches are made ahead by a thread, which runs NumPy only. A sample depends on
the seed and the number of the step alone, so a resumed run sees the batches of an unbroken one.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import logging
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int
from scipy.spatial import cKDTree

from dpmjax.deeppointmap.encoding import pyramid_of_cloud
from dpmjax.deeppointmap.training.curriculum import (
    MIN_DISTANCE_M,
    SamplingConfig,
    TrainingConfig,
    layout_capacity,
)
from dpmjax.deeppointmap.training.sampling import (
    PlacedScans,
    RegistrationSample,
    SampleScans,
    ScanTable,
    arrange_groups,
    draw_groups,
    stack,
)
from dpmjax.geometry.pyramid_storage import pack_pyramid, record_type, sampled_positions, stored_pyramids
from dpmjax.scans.augment import SPARSE_POINTS, AugmentConfig, augment_scan, random_motions_on_host
from dpmjax.scans.preprocess import preprocess_scan_on_host
from dpmjax.sequences import LidarSequence
from dpmjax.types import PointCloud, Poses

LOGGER = logging.getLogger("dpmjax.training")
PUBLISHED = SamplingConfig()

VARIANT_STREAM = 3104
SAMPLE_STREAM, EPOCH_STREAM = 3101, 3102
STEPS_AHEAD = 4
# Version of the files, to be raised when the same scans and settings give other files.
FORMAT = 2


class PreparedDrive(NamedTuple):
    """The scans of one drive, ready for training.

    Attributes:
        T_world_lidar: (n, 4, 4) float64 true poses, metres.
        pyramids: (n, num_variants) records of `record_type`, or the file that holds them.
        bad: reason for each bad scan; bad scans count as empty.
    """

    T_world_lidar: Poses
    pyramids: np.ndarray | Path
    bad: dict[str, str]


class ScanStore:
    """The scans of all drives.

    Attributes:
        table: poses of all scans.
        bad: reason for each bad scan.
    """

    def __init__(self, drives: Sequence[PreparedDrive]) -> None:
        """Collects the poses.

        Args:
            drives: drives from `prepare_drive`, all with the same settings.
        """
        poses = [drive.T_world_lidar for drive in drives]
        scene = np.concatenate([np.full(len(T), number) for number, T in enumerate(poses)])
        self.table = ScanTable(np.concatenate(poses), scene)
        self.bad = {source: reason for drive in drives for source, reason in drive.bad.items()}
        # Fails where a file is shorter than its header says.
        self._pyramids = [
            np.load(drive.pyramids, mmap_mode="r") if isinstance(drive.pyramids, Path) else drive.pyramids
            for drive in drives
        ]
        self._number = np.concatenate([np.arange(len(T)) for T in poses])

    def read(
        self, rows: Int[np.ndarray, " s"], config: TrainingConfig, rng: np.random.Generator
    ) -> tuple[SampleScans, PlacedScans]:
        """Reads a random variant of each scan, and draws its motion.

        Args:
            rows: numbers of the scans in the table.
            config: settings of training that the drives were prepared with.
            rng: source of the draws.

        Returns:
            The scans, and their true places after the motions.
        """
        variants = rng.integers(config.num_variants, size=len(rows))
        motions = random_motions_on_host(config.augment, len(rows), rng)
        records = [
            self._pyramids[self.table.scene[row]][self._number[row], variant]
            for row, variant in zip(rows, variants, strict=True)
        ]
        pyramids = stored_pyramids(np.stack(records), config.model.pyramid)
        T_world_lidar = self.table.T_world_lidar[rows]
        positions, mask = sampled_positions(pyramids, config.model.num_descriptors)
        turned = config.model.scale_m * positions @ T_world_lidar[:, :3, :3].swapaxes(1, 2)
        positions_world = turned + T_world_lidar[:, None, :3, 3]
        placed = PlacedScans(T_world_lidar @ np.linalg.inv(motions), positions_world, mask)
        return SampleScans(pyramids, motions.astype(np.float32)), placed


def prepare_drive(
    drive: LidarSequence,
    config: TrainingConfig,
    *,
    folder: Path | None = None,
    seed: int = 0,
    on_scan: Callable[[], object] | None = None,
) -> PreparedDrive:
    """Makes the pyramids of all variants of all scans, or finds the file that an earlier call has made.

    A file belongs to the poses, the first, middle and last scan, the settings and the seed. It is written under another
    name until it is whole.

    Args:
        drive: drive with poses.
        config: settings of training.
        folder: folder of the files; None keeps the pyramids in memory.
        seed: seed of the variants.
        on_scan: called after each scan, to show progress.

    Returns:
        The drive.

    Raises:
        ValueError: if the drive has no poses.
    """
    poses = drive.T_world_lidar
    if poses is None:
        raise ValueError("drives: expected a true pose for each scan, got a drive without poses")
    dtype = record_type(config.model.pyramid, config.model.preprocess.capacity)
    shape = (len(drive), config.num_variants)
    make = functools.partial(_fill, drive=drive, config=config, seed=seed, on_scan=on_scan or (lambda: None))
    if folder is None:
        pyramids = np.zeros(shape, dtype)
        return PreparedDrive(poses, pyramids, make(pyramids))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{_key(drive, config, seed)}.npy"
    reasons = path.with_suffix(".json")
    if not (path.is_file() and reasons.is_file()):
        unfinished = path.with_name(f".{path.name}.{os.getpid()}")
        written = np.lib.format.open_memmap(unfinished, mode="w+", dtype=dtype, shape=shape)
        try:
            bad = make(written)
        except BaseException:
            unfinished.unlink()
            raise
        written.flush()
        del written
        partial = unfinished.with_suffix(f"{unfinished.suffix}.json")
        partial.write_text(json.dumps(bad), encoding="utf-8")
        partial.replace(reasons)
        unfinished.replace(path)
    return PreparedDrive(poses, path, json.loads(reasons.read_text(encoding="utf-8")))


def _fill(
    pyramids: np.ndarray, drive: LidarSequence, config: TrainingConfig, seed: int, on_scan: Callable[[], object]
) -> dict[str, str]:
    # The motion is left to the step.
    still = replace(config.augment, max_yaw_rad=0.0, max_tilt_rad=0.0, translation_sigma_m=0.0)
    bad = {}
    for number in range(len(drive)):
        try:
            points = drive.read_scan(number)
        except ValueError as error:
            source = drive.sources[number]
            bad[source] = str(error).removeprefix(f"{source}: ")
            LOGGER.warning("scan %s is left out: %s", source, bad[source])
            points = np.zeros((0, 3), np.float32)
        cloud = preprocess_scan_on_host(points, None, config.model.preprocess, num_threads=1)
        for variant, thinned in enumerate(variants_on_host(cloud, still, config.num_variants, (seed, number))):
            pyramid = pyramid_of_cloud(thinned, config.model, num_threads=1)
            pack_pyramid(pyramid, pyramids[number, variant])
        on_scan()
    return bad


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
    variants = []
    for points, mask in zip(done.points, done.mask, strict=True):
        front = np.argsort(~mask, kind="stable")
        variants.append(PointCloud(points[front], mask[front]))
    return variants


@functools.partial(jax.jit, static_argnames="config")
def _augmented(cloud: PointCloud, keys: Array, *, config: AugmentConfig) -> PointCloud:
    return jax.vmap(lambda key: augment_scan(jax.tree.map(jnp.asarray, cloud), config, key=key).cloud)(keys)


def _key(drive: LidarSequence, config: TrainingConfig, seed: int) -> str:
    model = config.model
    settings = [dataclasses.asdict(part) for part in (model.preprocess, model.pyramid, config.augment)]
    settings[-1]["sparse_points"] = SPARSE_POINTS  # decides the points that are kept
    # Motions are drawn in the step, so they do not change the file.
    for name in ("max_yaw_rad", "max_tilt_rad", "tilt_power", "translation_sigma_m"):
        del settings[-1][name]
    content = json.dumps([FORMAT, settings, model.scale_m, config.num_variants, seed], sort_keys=True)
    digest = hashlib.sha256(content.encode())
    digest.update(np.ascontiguousarray(drive.T_world_lidar).tobytes())
    for number in sorted({0, len(drive) // 2, len(drive) - 1}):
        try:
            digest.update(np.ascontiguousarray(drive.read_scan(number)).tobytes())
        except ValueError as error:
            digest.update(str(error).encode())
    return digest.hexdigest()[:24]


def prepare_drives(
    drives: Sequence[LidarSequence], config: TrainingConfig, *, folder: Path | None = None, seed: int = 0
) -> ScanStore:
    """Prepares the scans of all drives, in order.

    Args:
        drives: drives with poses.
        config: settings of training.
        folder: folder of prepared scans for later calls; None keeps them in memory.
        seed: seed of the variants.

    Returns:
        The scans of all drives.

    Raises:
        ValueError: if there is no drive, or if `why_useless` gives a reason against one.
    """
    if not drives:
        raise ValueError("drives: expected at least one, got none")
    for drive in drives:
        if (reason := why_useless(drive, config.sampling)) is not None:
            raise ValueError(f"drives: {drive.name}: {reason}")
    prepared = []
    for number, drive in enumerate(drives):
        LOGGER.info("prepares %s, %d scans, drive %d of %d", drive.name, len(drive), number + 1, len(drives))
        prepared.append(prepare_drive(drive.take(drive.has_reference), config, folder=folder, seed=seed))
    return ScanStore(prepared)


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


class SampleMaker:
    """Makes the batch of any step; a context manager that ends its thread."""

    def __init__(
        self,
        store: ScanStore,
        config: TrainingConfig,
        *,
        seed: int,
        num_samples: int = 1,
        first_sample: int = 0,
        num_in_step: int | None = None,
    ) -> None:
        """Starts the thread.

        Args:
            store: the scans.
            config: settings of training.
            seed: seed of the run.
            num_samples: number of samples of a batch, one for each device of this process.
            first_sample: number of the first sample among the samples of all processes.
            num_in_step: number of samples of all processes; None: this process is alone.
        """
        self._store, self._config, self._seed = store, config, seed
        self._numbers = range(first_sample, first_sample + num_samples)
        self._num_in_step = num_in_step or num_samples
        self._thread = ThreadPoolExecutor(1)

    def __enter__(self) -> SampleMaker:
        return self

    def __exit__(self, *error: object) -> None:
        self._thread.shutdown(wait=True, cancel_futures=True)

    def __call__(self, step: int) -> RegistrationSample:
        """Makes the batch of a step, the same one every time.

        Args:
            step: number of the step.

        Returns:
            Samples of NumPy arrays, stacked.
        """
        return stack([self._sample(step, number) for number in self._numbers])

    def batches(self, start: int, stop: int) -> Iterator[RegistrationSample]:
        """Makes the batches of the steps from `start` to `stop - 1`, each some steps before it is needed.

        Args:
            start: first step.
            stop: step after the last.

        Yields:
            The batches in order.
        """
        ahead: deque[Future[RegistrationSample]] = deque()
        for step in range(start, stop + STEPS_AHEAD):
            if step < stop:
                ahead.append(self._thread.submit(self, step))
            if step >= start + STEPS_AHEAD:
                yield ahead.popleft().result()

    def _sample(self, step: int, number: int) -> RegistrationSample:
        rng = np.random.default_rng([SAMPLE_STREAM, self._seed, step, number])
        table, sampling = self._store.table, self._config.sampling
        layout = self._config.layout_at(step, seed=self._seed)
        capacity = layout_capacity(layout, sampling)
        groups = draw_groups(table, self._anchor(step, number), layout, sampling, rng)
        rows = np.concatenate([group.rows for group in groups if group is not None])
        # The number of scans is always that of the capacity: another number would be compiled again.
        num_spare = capacity.num_scans - len(rows)
        padded = np.concatenate([rows, np.full(num_spare, rows[0])])
        scans, placed = self._store.read(padded, self._config, rng)
        placed = PlacedScans(*(values[: len(rows)] for values in placed))
        return RegistrationSample(scans, arrange_groups(groups, capacity, placed))

    def _anchor(self, step: int, number: int) -> int:
        # Every scan is a first anchor once in an epoch, whatever the number of devices.
        epoch, place = divmod(step * self._num_in_step + number, len(self._store.table))
        order = np.random.default_rng([EPOCH_STREAM, self._seed, epoch]).permutation(len(self._store.table))
        return int(order[place])
