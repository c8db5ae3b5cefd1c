"""The data pipeline of training: samples are drawn by seed and step, and batches are made ahead by a thread.

A sample depends on the seed and the number of the step alone, so a resumed run sees the batches of an unbroken one.
The thread runs NumPy only.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Int

from dpmjax.deeppointmap.curriculum import TrainingConfig
from dpmjax.deeppointmap.layouts import stage_layouts
from dpmjax.deeppointmap.sampling import (
    OverlapSample,
    RegistrationSample,
    Sample,
    SampleScans,
    arrange_groups,
    draw_groups,
    draw_overlap_pairs,
    stack,
)
from dpmjax.deeppointmap.scan_store import ScanStore

SAMPLE_STREAM, EPOCH_STREAM = 3101, 3102
STEPS_AHEAD = 4


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
        registration_steps: int | None = None,
    ) -> None:
        """Starts the thread.

        Args:
            store: the scans.
            config: settings of training.
            seed: seed of the run.
            num_samples: samples of one batch: the number of devices of this process.
            first_sample: number of the first of them among those of all processes.
            registration_steps: steps of the registration part, where it ends earlier than the configuration says.
        """
        self._store, self._config, self._seed = store, config, seed
        self._numbers = range(first_sample, first_sample + num_samples)
        self._registration_steps = config.registration_steps if registration_steps is None else registration_steps
        self._thread = ThreadPoolExecutor(1)

    def __enter__(self) -> SampleMaker:
        return self

    def __exit__(self, *error: object) -> None:
        self._thread.shutdown(wait=True, cancel_futures=True)

    def __call__(self, step: int) -> Sample:
        """Makes the batch of a step, the same one every time.

        Args:
            step: number of the step.

        Returns:
            Samples of NumPy arrays, stacked.
        """
        return stack([self._sample(step, number) for number in self._numbers])

    def batches(self, start: int, stop: int) -> Iterator[Sample]:
        """Makes the batches of the steps from `start` to `stop - 1`, each some steps before it is needed.

        Args:
            start: first step.
            stop: step after the last.

        Yields:
            The batches in order.
        """
        ahead: deque[Future[Sample]] = deque()
        for step in range(start, stop + STEPS_AHEAD):
            if step < stop:
                ahead.append(self._thread.submit(self, step))
            if step >= start + STEPS_AHEAD:
                yield ahead.popleft().result()

    def _sample(self, step: int, number: int) -> Sample:
        rng = np.random.default_rng([SAMPLE_STREAM, self._seed, step, number])
        table, sampling = self._store.table, self._config.sampling
        if step >= self._registration_steps:
            pairs = draw_overlap_pairs(table, sampling, rng)
            return OverlapSample(self._read(np.concatenate([pairs.first, pairs.second]), rng)[0], pairs.is_overlap)
        layouts = stage_layouts(self._config.stage_at(step).max_group, sampling)
        layout = layouts[step % len(layouts)]
        groups = draw_groups(table, self._anchor(step, number), layout, sampling, rng)
        rows = np.concatenate([group.rows for group in groups if group is not None])
        # Always as many scans as the layout has: another number would be compiled again.
        num_spare = sum(map(sum, layout)) - len(rows)
        scans, T_world_scan = self._read(np.concatenate([rows, np.full(num_spare, rows[0])]), rng)
        return RegistrationSample(scans, arrange_groups(groups, layout, T_world_scan[: len(rows)]))

    def _read(
        self, rows: Int[np.ndarray, " s"], rng: np.random.Generator
    ) -> tuple[SampleScans, Float[np.ndarray, "s 4 4"]]:
        return self._store.read(rows, self._config, rng)

    def _anchor(self, step: int, number: int) -> int:
        # Every scan is the first anchor once in an epoch, in another order for each device.
        epoch, place = divmod(step, len(self._store.table))
        order = np.random.default_rng([EPOCH_STREAM, self._seed, epoch, number]).permutation(len(self._store.table))
        return int(order[place])
