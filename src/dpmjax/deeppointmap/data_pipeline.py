"""The data pipeline of training: scans are read once, samples are drawn by seed and step, batches are made ahead.

A sample depends on the seed and the number of the step alone, so a resumed run sees the batches of an unbroken one.
JAX programs run in the calling thread only; the worker threads run NumPy and SciPy.
"""

from __future__ import annotations

import functools
import logging
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from dpmjax.deeppointmap.curriculum import TrainingConfig
from dpmjax.deeppointmap.inference import pyramid_of_cloud
from dpmjax.deeppointmap.sampling import (
    OverlapSample,
    Sample,
    ScanTable,
    arrange_groups,
    draw_groups,
    draw_overlap_pairs,
    stack,
)
from dpmjax.scans.augment import AugmentConfig, AugmentedScan, augment_scan
from dpmjax.scans.preprocess import PreprocessConfig, preprocess_scan_on_host
from dpmjax.sequences import LidarSequence
from dpmjax.types import PointCloud, PointPyramid

LOGGER = logging.getLogger("dpmjax.training")
SAMPLE_STREAM, EPOCH_STREAM = 3101, 3102
STEPS_AHEAD = 2


class ScanStore:
    """Preprocessed scans of all drives; each is read and preprocessed once, when it is first requested.

    Attributes:
        table: poses of all scans.
        bad: for each bad scan the reason; bad scans count as empty.
    """

    def __init__(self, drives: Sequence[LidarSequence], config: PreprocessConfig) -> None:
        """Collects the poses.

        Args:
            drives: with poses.
            config: filters of the scans.

        Raises:
            ValueError: if a drive has no poses.
        """
        poses = [drive.T_world_lidar for drive in drives if drive.T_world_lidar is not None]
        if len(poses) < len(drives):
            raise ValueError("drives: expected a true pose for each scan, got a drive without poses")
        scene = np.concatenate([np.full(len(T), number) for number, T in enumerate(poses)])
        self.table = ScanTable(np.concatenate(poses), scene)
        self.bad: dict[str, str] = {}
        self._drives, self._config = drives, config
        self._number = np.concatenate([np.arange(len(T)) for T in poses])
        self._kept: dict[int, Future[NDArray[np.float32]]] = {}

    def request(self, row: int, pool: Executor) -> Future[NDArray[np.float32]]:
        """Reads a scan in this thread, because a reader may run JAX, and preprocesses it in the pool.

        Args:
            row: number of the scan in the table.
            pool: worker threads.

        Returns:
            The points that are left, (n, 3); none of a bad scan.
        """
        if row not in self._kept:
            self._kept[row] = pool.submit(self._preprocess, self._read(row))
        return self._kept[row]

    def _read(self, row: int) -> NDArray[np.float32]:
        drive, number = self._drives[int(self.table.scene[row])], int(self._number[row])
        try:
            return drive.read_scan(number)
        except ValueError as error:
            source = drive.sources[number]
            self.bad[source] = str(error).removeprefix(f"{source}: ")
            LOGGER.warning("scan %s is left out: %s", source, self.bad[source])
            return np.zeros((0, 3), np.float32)

    def _preprocess(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        cloud = preprocess_scan_on_host(points, None, self._config, num_threads=1)
        return np.asarray(cloud.points)[np.asarray(cloud.mask)]


class _Drawn(NamedTuple):
    """A sample whose scans are being read, and the function that arranges it from pyramids and motions."""

    seeds: tuple[int, int, int]
    points: list[Future[NDArray[np.float32]]]
    arrange: Callable[[list[PointPyramid], NDArray[np.float64]], Sample]


class SampleMaker:
    """Makes the batch of any step; a context manager that ends its worker threads."""

    def __init__(
        self, store: ScanStore, config: TrainingConfig, *, seed: int, num_samples: int = 1, first_sample: int = 0
    ) -> None:
        """Starts the worker threads.

        Args:
            store: the scans.
            config: settings of training.
            seed: seed of the run.
            num_samples: samples of one batch: the number of devices of this process.
            first_sample: number of the first of them among those of all processes.
        """
        self._store, self._config, self._seed = store, config, seed
        self._numbers = range(first_sample, first_sample + num_samples)
        self._pool = ThreadPoolExecutor(os.cpu_count())

    def __enter__(self) -> SampleMaker:
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __call__(self, step: int) -> Sample:
        """Makes the batch of a step, the same one every time.

        Args:
            step: number of the step.

        Returns:
            Samples of NumPy arrays, stacked.
        """
        return self._build(self._draw_all(step))()

    def batches(self, start: int, stop: int) -> Iterator[Sample]:
        """Makes the batches of the steps from `start` to `stop - 1`, each begun some steps before it is needed.

        Args:
            start: first step.
            stop: step after the last.

        Yields:
            The batches in order.
        """
        drawn: deque[list[_Drawn]] = deque()
        building: deque[Callable[[], Sample]] = deque()
        for step in range(start, stop + 2 * STEPS_AHEAD):
            if step < stop:
                drawn.append(self._draw_all(step))
            if start + STEPS_AHEAD <= step < stop + STEPS_AHEAD:
                building.append(self._build(drawn.popleft()))
            if step >= start + 2 * STEPS_AHEAD:
                yield building.popleft()()

    def _draw_all(self, step: int) -> list[_Drawn]:
        return [self._draw(step, number) for number in self._numbers]

    def _draw(self, step: int, number: int) -> _Drawn:
        table, sampling = self._store.table, self._config.sampling
        rng = np.random.default_rng([SAMPLE_STREAM, self._seed, step, number])
        stage = self._config.stage_at(step)
        if stage is None:
            pairs = draw_overlap_pairs(table, sampling, rng)
            rows = np.concatenate([pairs.first, pairs.second])

            def arrange(pyramids: list[PointPyramid], T_augmented_lidar: NDArray[np.float64]) -> Sample:
                half = len(pairs.first)
                return OverlapSample(stack(pyramids[:half]), stack(pyramids[half:]), pairs.is_overlap)
        else:
            groups = draw_groups(table, self._anchor(step), stage.max_group, sampling, rng)
            rows = np.concatenate([side for group in groups for side in group])

            def arrange(pyramids: list[PointPyramid], T_augmented_lidar: NDArray[np.float64]) -> Sample:
                T_world_augmented = table.T_world_lidar[rows] @ np.linalg.inv(T_augmented_lidar)
                return arrange_groups(groups, pyramids, T_world_augmented, stage.max_group, sampling)

        points = [self._store.request(int(row), self._pool) for row in rows]
        return _Drawn((self._seed, step, number), points, arrange)

    def _build(self, samples: list[_Drawn]) -> Callable[[], Sample]:
        # Augments the scans and starts their pyramids. The returned function waits for these.
        started = [self._start(sample) for sample in samples]
        return lambda: stack([finish() for finish in started])

    def _start(self, sample: _Drawn) -> Callable[[], Sample]:
        model = self._config.model
        num = len(sample.points)
        # Always room for as many scans as there can be: another number would be compiled again.
        points = np.zeros((max(num, self._config.sampling.num_scans), model.preprocess.capacity, 3), np.float32)
        mask = np.zeros(points.shape[:2], bool)
        for row, future in enumerate(sample.points):
            kept = future.result()
            points[row, : len(kept)], mask[row, : len(kept)] = kept, True
        clouds, motions = augment_on_host(PointCloud(points, mask), self._config.augment, sample.seeds)
        build = functools.partial(pyramid_of_cloud, config=model, num_threads=1)
        pyramids = [self._pool.submit(build, PointCloud(clouds.points[i], clouds.mask[i])) for i in range(num)]
        return lambda: sample.arrange([pyramid.result() for pyramid in pyramids], motions[:num])

    def _anchor(self, step: int) -> int:
        # Every scan is the first anchor once in an epoch.
        epoch, place = divmod(step, len(self._store.table))
        return int(np.random.default_rng([EPOCH_STREAM, self._seed, epoch]).permutation(len(self._store.table))[place])


def augment_on_host(
    clouds: PointCloud, config: AugmentConfig, seeds: tuple[int, int, int]
) -> tuple[PointCloud, Float[np.ndarray, "s 4 4"]]:
    """Augments each cloud on its own, on the processor, whatever device trains.

    Args:
        clouds: stacked clouds, (s, n, 3) and (s, n), metres.
        config: strength of the augmentation.
        seeds: seed of the run, step, number of the sample.

    Returns:
        The stacked clouds in NumPy, and the motion of each in float64.
    """
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        key = jax.random.key(seeds[0])
        for seed in seeds[1:]:
            key = jax.random.fold_in(key, seed)
        done = jax.device_get(_augment_all(clouds, key, config=config))
    return done.cloud, done.T_augmented_lidar.astype(np.float64)


@functools.partial(jax.jit, static_argnames="config")
def _augment_all(clouds: PointCloud, key: Array, *, config: AugmentConfig) -> AugmentedScan:
    keys = jax.random.split(key, len(clouds.points))
    return jax.vmap(lambda cloud, key: augment_scan(cloud, config, key=key))(clouds, keys)
