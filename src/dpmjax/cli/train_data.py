"""Preparation of the drives of a training: in parallel, and kept in files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import jax
from tqdm import tqdm

from dpmjax.cli.drive_sources import TOWN, Source
from dpmjax.deeppointmap import PreparedDrive, TrainingConfig, prepare_drive

# Far from the seeds of training towns, which count up from the seed of the run.
HELD_OUT_SEED, SELECTION_SEED = 1_000_000, 2_000_000


def prepare_sources(
    sources: Sequence[Source], settings: TrainingConfig, folder: Path, *, seed: int
) -> list[PreparedDrive]:
    """Returns all drives, each prepared in a process of its own and kept in `folder` for later runs."""
    with tqdm(total=len(sources), desc="prepare scans", unit=" drives", dynamic_ncols=True) as bar:
        if len(sources) == 1:
            with tqdm(desc=str(sources[0].path or TOWN), unit=" scans", leave=False) as scans:
                prepared = prepare_drive(
                    sources[0].open(), settings, folder=folder, seed=seed, on_scan=lambda: scans.update(1)
                )
            bar.update(1)
            return [prepared]
        # A fresh interpreter: a fork of a process that runs JAX may hang.
        num_workers = min(len(sources), os.cpu_count() or 1)
        pool = ProcessPoolExecutor(num_workers, get_context("spawn"), initializer=_use_processor)
        try:
            tasks = {pool.submit(_prepare, source, settings, folder, seed): source for source in sources}
            done: dict[Source, PreparedDrive] = {}
            for task in as_completed(tasks):
                done[tasks[task]] = task.result()
                bar.update(1)
        finally:
            pool.shutdown(cancel_futures=True)
    return [done[source] for source in sources]


def _use_processor() -> None:
    # The device belongs to the process that trains.
    jax.config.update("jax_platforms", "cpu")


def _prepare(source: Source, settings: TrainingConfig, folder: Path, seed: int) -> PreparedDrive:
    return prepare_drive(source.open(), settings, folder=folder, seed=seed)
