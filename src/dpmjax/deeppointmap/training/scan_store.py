"""The prepared scans of all drives, and the batches made of them.

Samples are drawn by seed and step, and batches are made ahead by threads, on the processor. A sample depends on
the seed and the number of the step alone, so a resumed run sees the batches of an unbroken one.
"""

from __future__ import annotations

import functools
import os
from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from dpmjax.deeppointmap.training.curriculum import TrainingConfig, layout_capacity
from dpmjax.deeppointmap.training.label_refinement import moved_points, refine_labels
from dpmjax.deeppointmap.training.preparation import (
    LOGGER,
    PreparedDrive,
    prepare_drive,
    read_or_note,
    scan_records,
    why_useless,
)
from dpmjax.deeppointmap.training.sampling import (
    PlacedScans,
    RegistrationSample,
    SampleScans,
    ScanTable,
    arrange_groups,
    draw_groups,
)
from dpmjax.geometry.pyramid_storage import sampled_positions, stored_pyramids
from dpmjax.scan.lidar.augment import random_motions_on_host
from dpmjax.sequences import LidarSequence

SAMPLE_STREAM, EPOCH_STREAM = 3101, 3102
STEPS_AHEAD = 4


class ScanStore:
    """The scans of all drives.

    Attributes:
        table: poses of all scans.
        bad: reason for each bad scan.
        threads: threads for work on scans that takes longer than a step.
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
        self.threads = ThreadPoolExecutor(os.cpu_count())
        self._number = np.concatenate([np.arange(len(T)) for T in poses])

    def read(
        self, rows: Int[np.ndarray, " s"], config: TrainingConfig, rng: np.random.Generator
    ) -> tuple[SampleScans, PlacedScans]:
        """Reads a random variant of each scan, or makes a new one, and draws its motion.

        Args:
            rows: numbers of the scans in the table.
            config: settings of training that the drives were prepared with.
            rng: source of the draws.

        Returns:
            The scans, and their true places after the motions.
        """
        variants = rng.integers(config.num_variants or 1 << 31, size=len(rows))
        motions = random_motions_on_host(config.augment, len(rows), rng)
        records = list(self.threads.map(functools.partial(self._record, config), rows.tolist(), variants.tolist()))
        pyramids = stored_pyramids(np.stack(records), config.model.pyramid)
        T_world_lidar = self.table.T_world_lidar[rows]
        positions, mask = sampled_positions(pyramids, config.model.num_descriptors)
        turned = config.model.scale_m * positions @ T_world_lidar[:, :3, :3].swapaxes(1, 2)
        positions_world = turned + T_world_lidar[:, None, :3, 3]
        placed = PlacedScans(T_world_lidar @ np.linalg.inv(motions), positions_world, mask)
        return SampleScans(pyramids, motions.astype(np.float32)), placed

    def _record(self, config: TrainingConfig, row: int, variant: int) -> Any:
        pyramids, number = self._pyramids[self.table.scene[row]], int(self._number[row])
        if isinstance(pyramids, LidarSequence):
            points = read_or_note(pyramids, number, self.bad)
            (record,) = scan_records(points, replace(config, num_variants=1), (variant, number))
            return record
        return pyramids[number, variant]


def prepare_drives(drives: Sequence[LidarSequence], config: TrainingConfig, *, seed: int = 0) -> ScanStore:
    """Prepares the scans of all drives, in order.

    Args:
        drives: drives with poses.
        config: settings of training.
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
        prepared.append(prepare_drive(drive.take(drive.has_reference), config, seed=seed))
    return ScanStore(prepared)


@dataclass(frozen=True)
class SampleMaker:
    """Makes the batch of any step.

    Attributes:
        store: the scans.
        config: settings of training.
        seed: seed of the run.
        numbers: which of the samples of a step this process makes, one for each of its devices.
        num_in_step: number of samples of a step, one for each device of all processes.
    """

    store: ScanStore
    config: TrainingConfig
    seed: int
    numbers: Sequence[int] = (0,)
    num_in_step: int = 1

    def __call__(self, step: int) -> RegistrationSample:
        """Makes the batch of a step, the same one every time.

        Args:
            step: number of the step.

        Returns:
            Samples of NumPy arrays, stacked.
        """
        samples = [self._sample(step, number) for number in self.numbers]
        batch: RegistrationSample = jax.tree.map(lambda *leaves: np.stack(leaves), *samples)
        return batch

    def batches(self, start: int, stop: int) -> Generator[RegistrationSample]:
        """Makes the batches of the steps from `start` to `stop - 1`, each some steps before it is needed.

        Args:
            start: first step.
            stop: step after the last.

        Yields:
            The batches in order.
        """
        ahead: deque[Future[RegistrationSample]] = deque()
        thread = ThreadPoolExecutor(1)
        try:
            for step in range(start, stop + STEPS_AHEAD):
                if step < stop:
                    ahead.append(thread.submit(self, step))
                if step >= start + STEPS_AHEAD:
                    yield ahead.popleft().result()
        finally:
            thread.shutdown(wait=True, cancel_futures=True)

    def _sample(self, step: int, number: int) -> RegistrationSample:
        rng = np.random.default_rng([SAMPLE_STREAM, self.seed, step, number])
        table, sampling = self.store.table, self.config.sampling
        layout = self.config.layout_at(step, seed=self.seed)
        capacity = layout_capacity(layout, sampling)
        groups = draw_groups(table, self._anchor(step, number), layout, sampling, rng)
        rows = np.concatenate([group.rows for group in groups])
        # The number of scans is always that of the capacity: another number would be compiled again.
        num_spare = capacity.num_scans - len(rows)
        padded = np.concatenate([rows, np.full(num_spare, rows[0])])
        scans, placed = self.store.read(padded, self.config, rng)
        placed = PlacedScans(*(values[: len(rows)] for values in placed))
        if self.config.refines_labels:
            motions = np.asarray(scans.T_augmented_lidar)[: len(rows)]
            points = moved_points(scans.pyramids, motions, self.config.model.scale_m)
            placed = refine_labels(placed, points, groups, mapper=self.store.threads.map)
        return RegistrationSample(scans, arrange_groups(groups, capacity, placed, thins=self.config.thins_maps))

    def _anchor(self, step: int, number: int) -> int:
        # Every scan is a first anchor once in an epoch, whatever the number of devices.
        epoch, place = divmod(step * self.num_in_step + number, len(self.store.table))
        order = np.random.default_rng([EPOCH_STREAM, self.seed, epoch]).permutation(len(self.store.table))
        return int(order[place])
