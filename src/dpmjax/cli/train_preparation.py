"""Preparation of the drives of a training. All processors share the scans, even the scans of one long drive."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Literal, NamedTuple

import jax
from tqdm import tqdm

from dpmjax import cli
from dpmjax import deeppointmap as dpm
from dpmjax.compile_cache import enable_compile_cache
from dpmjax.sequences import LidarSequence
from dpmjax.types import Poses

# Scans of a drive that a processor prepares at a time; with more the bar stands still, with fewer the drive is opened
# more often.
NUM_AT_ONCE = 16


class PlannedDrive(NamedTuple):
    """A drive before its preparation.

    Attributes:
        source: opens the drive.
        T_world_lidar: true poses of its scans, metres.
        path: file of its prepared scans.
        found: the prepared drive if the file exists already; None otherwise.
    """

    source: cli.Source
    T_world_lidar: Poses
    path: Path
    found: dpm.PreparedDrive | None


def part_of_drive(source: cli.Source, part: Literal["training", "held_out"]) -> LidarSequence:
    """Opens the held-out places of a drive, or the remaining scans without those near them."""
    drive = source()
    return drive.take(getattr(dpm.split_places(drive), part))


def prepare_sources(
    sources: Sequence[cli.Source], settings: dpm.TrainingConfig, folder: Path, *, seed: int
) -> list[dpm.PreparedDrive]:
    """Prepares all drives on all processors and keeps them in a folder for later runs.

    Args:
        sources: the drives.
        settings: settings of training.
        folder: folder of prepared scans.
        seed: seed of the variants.

    Returns:
        The drives, in order.

    Raises:
        ValueError: if the prepared scans do not fit on the disk, or if a drive cannot be read.
    """
    if settings.num_variants == 0:
        print("each scan is prepared anew at each use; nothing is kept on disk")
        return [dpm.prepare_drive(source(), settings) for source in sources]
    with _workers() as pool:
        opened = pool.map(partial(_plan, settings=settings, folder=folder, seed=seed), sources)
        plans = list(tqdm(opened, "open drives", len(sources), unit=" drives", dynamic_ncols=True))
        # The same drive may be given twice.
        missing = {plan.path: plan for plan in plans if plan.found is None}
        num_scans = sum(len(plan.T_world_lidar) for plan in missing.values())
        check_space(num_scans, settings, folder)
        work = partial(_prepare, settings=settings, seed=seed)
        # All parts are begun here; each result is forgotten when it was written.
        parts = {path: pool.map(work, *_parts(plan)) for path, plan in missing.items()}
        with tqdm(desc="prepare scans", total=num_scans, unit=" scans", dynamic_ncols=True) as bar:

            def scans_of(path: Path) -> Iterator[dpm.PreparedScan]:
                for part in parts[path]:
                    yield from part
                    bar.update(len(part))

            made = {
                path: dpm.store_scans(path, plan.T_world_lidar, scans_of(path), settings)
                for path, plan in missing.items()
            }
    return [plan.found or made[plan.path] for plan in plans]


def check_space(num_scans: int, settings: dpm.TrainingConfig, folder: Path) -> None:
    """Prints the size of the prepared scans; raises a ValueError if the disk has less free space."""
    each = dpm.stored_bytes(settings)
    needed = num_scans * each
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    scans, free_text = f"{num_scans} scans of {each / 1e6:.2f} MB", f"{free / 1e9:.1f} GB are free"
    if needed > free:
        advice = f"--variants 1 needs {needed / settings.num_variants / 1e9:.1f} GB, --variants 0 nothing"
        raise ValueError(f"--cache {folder}: {scans} need {needed / 1e9:.1f} GB, {free_text}; {advice}")
    if num_scans > 0:
        print(f"prepares {scans}: {needed / 1e9:.1f} GB in {folder}, {free_text}")


@contextmanager
def _workers() -> Iterator[ProcessPoolExecutor]:
    """Yields processes, which are gone after an error."""
    # A fresh interpreter: a fork of a process that runs JAX may hang.
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn"), initializer=_begin_worker) as pool:
        try:
            yield pool
        except BaseException:
            processes = active_children()
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.kill()
            raise


def _begin_worker() -> None:
    # The device belongs to the process that trains, and so does the answer to Ctrl-C.
    jax.config.update("jax_platforms", "cpu")
    enable_compile_cache()  # the caster of each lidar compiles for ten seconds
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _plan(source: cli.Source, settings: dpm.TrainingConfig, folder: Path, seed: int) -> PlannedDrive:
    drive = source()
    if drive.T_world_lidar is None:
        raise ValueError(f"{drive.name}: expected a true pose for each scan, got a drive without poses")
    path = dpm.prepared_path(drive, settings, folder, seed)
    return PlannedDrive(source, drive.T_world_lidar, path, dpm.find_prepared(path, drive.T_world_lidar))


def _parts(plan: PlannedDrive) -> tuple[list[cli.Source], list[range]]:
    num = len(plan.T_world_lidar)
    rows = [range(first, min(first + NUM_AT_ONCE, num)) for first in range(0, num, NUM_AT_ONCE)]
    return [plan.source] * len(rows), rows


def _prepare(source: cli.Source, numbers: range, settings: dpm.TrainingConfig, seed: int) -> list[dpm.PreparedScan]:
    return list(dpm.prepare_variants(source(), numbers, settings, seed))
