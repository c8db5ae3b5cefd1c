"""Scans for DeepPointMap's training: from simulated towns or from files, as samples made ahead of the step.

What a sample holds depends on the seed and the number of the step alone; so a resumed run sees what an unbroken one
does, and it does not matter how far ahead the background has come.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from experiments._machine import usable_cores

if TYPE_CHECKING:
    from dpmjax.deeppointmap import ScanTable, TrainingConfig
    from dpmjax.io import LidarSequence
    from dpmjax.scans import AugmentConfig
    from dpmjax.types import PointCloud, PointPyramid

LOGGER = logging.getLogger("dpmjax.training")
SAMPLE_STREAM, EPOCH_STREAM = 3101, 3102
TOWN = "town"
# Far from the seeds of training towns, which count up from the seed of the run.
HELD_OUT_SEED = 1_000_000


def town_drive(seed: int, *, length_m: float) -> LidarSequence:
    """A drive through a town: 64 beams, a third of the columns, a scan every two metres."""
    from dpmjax.simulation import HDL64E, DriveConfig, TownConfig, simulate_lidar_sequence

    return simulate_lidar_sequence(
        seed,
        TownConfig(route_length_m=length_m),
        driving=DriveConfig(speed_m_s=8.0, rate_hz=4.0),
        sensor=HDL64E.with_azimuths(600),
    )


def open_drives(data: Sequence[str], *, num_towns: int, town_length_m: float, seed: int) -> list[LidarSequence]:
    """The drives to train on.

    Raises:
        ValueError: a path that cannot be read, or in which no drive is of use.
    """
    from dpmjax.io import list_lidar_sequences, open_lidar_sequence

    drives: list[LidarSequence] = []
    for entry in data:
        if entry == TOWN and not Path(entry).exists():
            drives += [town_drive(seed + number, length_m=town_length_m) for number in range(num_towns)]
            continue
        names: Sequence[str | None] = list_lidar_sequences(entry) or [None]
        found = [open_lidar_sequence(entry, sequence=name) for name in names]
        reasons = {drive.name: why_useless(drive) for drive in found}
        useful = [drive for drive in found if reasons[drive.name] is None]
        if not useful:
            raise ValueError("; ".join(f"{entry}: {reason}" for reason in dict.fromkeys(reasons.values())))
        for drive in found:
            if reasons[drive.name] is not None:
                LOGGER.warning("%s is left out: %s", drive.name, reasons[drive.name])
        drives += useful
    return drives


def why_useless(drive: LidarSequence) -> str | None:
    """Why nothing can be learned from a drive; None where something can."""
    from dpmjax.deeppointmap import SamplingConfig
    from dpmjax.io import InputError

    limits = SamplingConfig()
    if drive.T_world_lidar is None:
        return "no poses; training needs a pose for each scan"
    places = drive.T_world_lidar[:, :3, 3]
    tree = cKDTree(places)
    num_near, num_too_near = (tree.count_neighbors(tree, r) for r in (limits.max_distance_m, limits.min_distance_m))
    if num_near == num_too_near:
        found = f"{len(places)} scans, no two of them {limits.min_distance_m} to {limits.max_distance_m} m apart"
        return f"{found}; training needs such pairs (are the poses in metres?)"
    reason = ""
    for number in range(len(drive)):
        try:
            drive.read_scan(number)
        except InputError as error:
            reason = reason or f"{drive.sources[number]}: {error.found}"
            continue
        return None
    return f"all {len(drive)} scans are bad; the first, {reason}"


class ScanStore:
    """Preprocessed scans of all drives by row, each read and preprocessed once and kept.

    Args:
        drives: with poses.
        config: how scans are preprocessed is in its model.
    """

    def __init__(self, drives: Sequence[LidarSequence], config: TrainingConfig) -> None:
        from dpmjax.deeppointmap import ScanTable

        self._drives = drives
        self._config = config.model.preprocess
        self._number = np.concatenate([np.arange(len(drive)) for drive in drives])
        scene = np.concatenate([np.full(len(drive), i) for i, drive in enumerate(drives)])
        self.table: ScanTable = ScanTable(np.concatenate([_poses(drive) for drive in drives]), scene)
        self._kept: dict[int, NDArray[np.float32]] = {}
        self.bad: dict[str, str] = {}

    def __getitem__(self, row: int) -> PointCloud:
        """The scan at its full capacity; a bad one is empty, and told once."""
        from dpmjax.types import PointCloud

        if row not in self._kept:
            self._kept[row] = self._read(row)
        kept = self._kept[row]
        points = np.zeros((self._config.capacity, 3), np.float32)
        points[: len(kept)] = kept
        return PointCloud(points, np.arange(len(points)) < len(kept))

    def _read(self, row: int) -> NDArray[np.float32]:
        from dpmjax.io import InputError
        from dpmjax.scans import preprocess_scan_on_host

        drive, number = self._drives[int(self.table.scene[row])], int(self._number[row])
        try:
            points = drive.read_scan(number)
        except InputError as error:
            self.bad[drive.sources[number]] = error.found
            LOGGER.warning("left out: %s: %s", drive.sources[number], error.found)
            return np.zeros((0, 3), np.float32)
        cloud = preprocess_scan_on_host(points, None, self._config, num_threads=1)
        return np.asarray(cloud.points)[np.asarray(cloud.mask)]


class SampleMaker:
    """Makes the batch of a step.

    Args:
        store: the scans.
        config: of training.
        seed: of the run.
        num_samples: of one batch: devices of this process.
        first_sample: number of the first of them among those of all processes.
    """

    def __init__(
        self,
        store: ScanStore,
        config: TrainingConfig,
        *,
        seed: int,
        num_samples: int = 1,
        first_sample: int = 0,
    ) -> None:
        self._store, self._config, self._seed = store, config, seed
        self._numbers = range(first_sample, first_sample + num_samples)
        self._pool = ThreadPoolExecutor(usable_cores())

    def __call__(self, step: int) -> Any:
        """The batch of step `step`, arrays of NumPy; the same one every time."""
        from dpmjax.deeppointmap import stack

        return stack([self._sample(step, number) for number in self._numbers])

    def close(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _sample(self, step: int, number: int) -> Any:
        from dpmjax.deeppointmap import OverlapSample, arrange_groups, draw_groups, draw_overlap_pairs, stack

        table, sampling = self._store.table, self._config.sampling
        rng = np.random.default_rng([SAMPLE_STREAM, self._seed, step, number])
        stage = self._config.stage_at(step)
        if stage is None:
            pairs = draw_overlap_pairs(table, sampling, rng)
            scans = self._augmented(np.concatenate([pairs.first, pairs.second]), step, number)
            half = len(pairs.first)
            return OverlapSample(stack(scans.pyramids[:half]), stack(scans.pyramids[half:]), pairs.is_overlap)
        groups = draw_groups(table, self._anchor(step), stage.max_group, sampling, rng)
        rows = np.concatenate([side for group in groups for side in group])
        scans = self._augmented(rows, step, number)
        T_world_scan = table.T_world_lidar[rows] @ np.linalg.inv(scans.T_augmented_lidar)
        return arrange_groups(groups, scans.pyramids, T_world_scan, stage.max_group, sampling)

    def _anchor(self, step: int) -> int:
        """Every scan is the first anchor once in an epoch."""
        epoch, place = divmod(step, len(self._store.table))
        return int(np.random.default_rng([EPOCH_STREAM, self._seed, epoch]).permutation(len(self._store.table))[place])

    def _augmented(self, rows: NDArray[np.int64], step: int, number: int) -> _Augmented:
        clouds = list(self._pool.map(lambda row: self._store[int(row)], rows))
        points, masks = np.stack([c.points for c in clouds]), np.stack([c.mask for c in clouds])
        points, masks, motions = augment_clouds(points, masks, self._config.augment, (self._seed, step, number))
        pyramids = list(self._pool.map(self._pyramid, points, masks))
        return _Augmented(pyramids, motions.astype(np.float64))

    def _pyramid(self, points: NDArray[np.float32], mask: NDArray[np.bool_]) -> PointPyramid:
        from dpmjax.geometry.pyramid_host import build_pyramid_on_host

        scaled = points / np.float32(self._config.model.scale_m)
        return build_pyramid_on_host(scaled, mask, self._config.model.pyramid, num_threads=1)


class _Augmented(NamedTuple):
    pyramids: list[PointPyramid]
    T_augmented_lidar: NDArray[np.float64]


class _Clouds(NamedTuple):
    points: NDArray[np.float32]
    masks: NDArray[np.bool_]
    T_augmented_lidar: NDArray[np.float32]


def augment_clouds(
    points: NDArray[np.float32], masks: NDArray[np.bool_], config: AugmentConfig, seeds: tuple[int, int, int]
) -> _Clouds:
    """Each cloud augmented on its own, on the processor, whatever device trains."""
    import jax

    from dpmjax.scans import augment_scan
    from dpmjax.types import PointCloud

    def of_all(points: Any, masks: Any, key: Any) -> Any:
        keys = jax.random.split(key, len(points))
        return jax.vmap(lambda p, m, k: augment_scan(PointCloud(p, m), config, key=k))(points, masks, keys)

    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        key = jax.random.key(seeds[0])
        for seed in seeds[1:]:
            key = jax.random.fold_in(key, seed)
        done = _jitted(of_all, config)(points, masks, key)
    return _Clouds(np.asarray(done.cloud.points), np.asarray(done.cloud.mask), np.asarray(done.T_augmented_lidar))


_COMPILED: dict[Any, Any] = {}


def _jitted(function: Callable[..., Any], config: AugmentConfig) -> Callable[..., Any]:
    import jax

    return _COMPILED.setdefault(config, jax.jit(function))


@contextmanager
def made_ahead(make: Callable[[int], Any], start: int, stop: int, *, depth: int = 3) -> Iterator[Iterator[Any]]:
    """The results of make(start) ... make(stop - 1) in order, made in the background, at most `depth` ahead.

        with made_ahead(maker, 0, 100) as batches:
            for batch in batches: ...

    An error in the background is raised where its result would have come. At the end of the block the background stops.
    """
    waiting: queue.Queue[tuple[Any, BaseException | None]] = queue.Queue(maxsize=depth)
    is_over = threading.Event()

    def put(entry: tuple[Any, BaseException | None]) -> None:
        while not is_over.is_set():
            try:
                waiting.put(entry, timeout=0.1)
            except queue.Full:
                continue
            return

    def work() -> None:
        for step in range(start, stop):
            if is_over.is_set():
                return
            try:
                put((make(step), None))
            except BaseException as error:  # is raised again in the main thread
                put((None, error))
                return

    def results() -> Iterator[Any]:
        for _ in range(start, stop):
            result, error = waiting.get()
            if error is not None:
                raise error
            yield result

    thread = threading.Thread(target=work, name="samples", daemon=True)
    thread.start()
    try:
        yield results()
    finally:
        is_over.set()
        thread.join()


def _poses(drive: LidarSequence) -> NDArray[np.float64]:
    if drive.T_world_lidar is None:
        raise ValueError(f"{drive.name}: no poses; training needs a pose for each scan")
    return drive.T_world_lidar
