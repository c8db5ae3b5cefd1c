"""The data pipeline of training: samples are drawn by seed and step, and batches are made ahead by a thread.

A sample depends on the seed and the number of the step alone, so a resumed run sees the batches of an unbroken one.
The thread runs NumPy only.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from dpmjax.deeppointmap.training.curriculum import TrainingConfig, stage_layouts
from dpmjax.deeppointmap.training.sampling import PlacedScans, RegistrationSample, arrange_groups, draw_groups, stack
from dpmjax.deeppointmap.training.scan_store import ScanStore

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
    ) -> None:
        """Starts the thread.

        Args:
            store: the scans.
            config: settings of training.
            seed: seed of the run.
            num_samples: number of samples of a batch, one for each device of this process.
            first_sample: number of the first sample among the samples of all processes.
        """
        self._store, self._config, self._seed = store, config, seed
        self._numbers = range(first_sample, first_sample + num_samples)
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
        layouts = stage_layouts(self._config.stage_at(step).max_group, sampling)
        layout = layouts[step % len(layouts)]
        groups = draw_groups(table, self._anchor(step, number), layout, sampling, rng)
        rows = np.concatenate([group.rows for group in groups if group is not None])
        # The number of scans is always that of the layout: another number would be compiled again.
        num_spare = sum(map(sum, layout)) - len(rows)
        padded = np.concatenate([rows, np.full(num_spare, rows[0])])
        scans, placed = self._store.read(padded, self._config, rng)
        placed = PlacedScans(*(values[: len(rows)] for values in placed))
        return RegistrationSample(scans, arrange_groups(groups, layout, placed))

    def _anchor(self, step: int, number: int) -> int:
        # Every scan is the first anchor once in an epoch, in another order for each device.
        epoch, place = divmod(step, len(self._store.table))
        order = np.random.default_rng([EPOCH_STREAM, self._seed, epoch, number]).permutation(len(self._store.table))
        return int(order[place])
