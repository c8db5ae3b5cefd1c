"""Preparation of the drives of a training: all processors share the scans, also those of one long drive."""

from __future__ import annotations

import math
import os
import shutil
import signal
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from dpmjax import cli
from dpmjax import deeppointmap as dpm
from dpmjax.compile_cache import enable_compile_cache
from dpmjax.types import Poses

# Least number of scans of a part of a drive; each part opens the drive again. A drive this short is prepared here.
MIN_PART = 64
# Parts for each processor, so that all end at about the same time.
PARTS_EACH = 2


class Preparation(NamedTuple):
    """Settings of the preparation of all drives.

    Attributes:
        settings: settings of training.
        folder: folder of prepared scans.
        seed: seed of the variants.
        run: part of the names of unfinished files.
    """

    settings: dpm.TrainingConfig
    folder: Path
    seed: int
    run: str


class PlannedDrive(NamedTuple):
    """A drive before its preparation.

    Attributes:
        source: opens the drive.
        T_world_lidar: true poses of its scans, metres.
        path: file of its prepared scans.
        found: the drive, where the file is there already.
    """

    source: cli.Source
    T_world_lidar: Poses
    path: Path
    found: dpm.PreparedDrive | None


def prepare_sources(
    sources: Sequence[cli.Source],
    settings: dpm.TrainingConfig,
    folder: Path,
    *,
    seed: int,
    on_wait: Callable[[], object] = lambda: None,
) -> list[dpm.PreparedDrive]:
    """Prepares all drives by all processors and keeps them in a folder for later runs.

    Args:
        sources: the drives.
        settings: settings of training.
        folder: folder of prepared scans.
        seed: seed of the variants.
        on_wait: called about every second; an error of it ends the preparation.

    Returns:
        The drives, in order.

    Raises:
        ValueError: if the prepared scans do not fit on the disk, or if a drive cannot be read.
    """
    if settings.num_variants == 0:
        print("each scan is prepared anew at each use; nothing is kept on disk")
        return [dpm.prepare_drive(source(), settings) for source in sources]
    work = Preparation(settings, folder, seed, uuid.uuid4().hex)
    if len(sources) == 1 and len(drive := sources[0]()) <= MIN_PART:
        check_space(len(drive), work)
        with tqdm(desc="prepare scans", total=len(drive), unit=" scans", dynamic_ncols=True) as bar:
            on_scan = lambda: (bar.update(1), on_wait())  # noqa: E731
            return [dpm.prepare_drive(drive, settings, folder=folder, seed=seed, on_scan=on_scan)]
    with _workers(work) as pool:
        return _prepare(pool, sources, work, on_wait)


def check_space(num_scans: int, work: Preparation) -> None:
    """Prints the size of the prepared scans; raises a ValueError where the disk has less free space."""
    each = dpm.stored_bytes(work.settings)
    needed = num_scans * each
    folder = next(path for path in (work.folder.absolute(), *work.folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(folder).free
    if needed > free:
        one = needed / work.settings.num_variants
        raise ValueError(
            f"--cache {work.folder}: {num_scans} scans of {each / 1e6:.2f} MB need {needed / 1e9:.1f} GB, "
            f"{free / 1e9:.1f} GB are free; --variants 1 needs {one / 1e9:.1f} GB, --variants 0 nothing"
        )
    if num_scans > 0:
        print(
            f"prepares {num_scans} scans of {each / 1e6:.2f} MB: {needed / 1e9:.1f} GB in {work.folder}, "
            f"{free / 1e9:.1f} GB are free"
        )


@contextmanager
def _workers(work: Preparation) -> Iterator[ProcessPoolExecutor]:
    """Yields processes; after an error both they and their unfinished files are gone."""
    # A fresh interpreter: a fork of a process that runs JAX may hang.
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn"), initializer=_begin_worker) as pool:
        try:
            yield pool
        except BaseException:
            processes = active_children()
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.kill()
                process.join()
            for unfinished in work.folder.glob(f".*.{work.run}.*"):
                unfinished.unlink()
            raise


def _begin_worker() -> None:
    # The device belongs to the process that trains, and so does the answer to Ctrl-C.
    jax.config.update("jax_platforms", "cpu")
    enable_compile_cache()  # the caster of each lidar compiles for ten seconds
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _prepare(
    pool: ProcessPoolExecutor, sources: Sequence[cli.Source], work: Preparation, on_wait: Callable[[], object]
) -> list[dpm.PreparedDrive]:
    with tqdm(desc="open drives", total=len(sources), unit=" drives", dynamic_ncols=True) as bar:
        begun = [pool.submit(_plan, source, work) for source in sources]
        _wait_for(begun, on_wait, bar, lambda: sum(one.done() for one in begun))
    plans = [one.result() for one in begun]
    # The same drive may be given twice.
    missing = {plan.path: plan for plan in plans if plan.found is None}
    num_scans = sum(len(plan.T_world_lidar) for plan in missing.values())
    check_space(num_scans, work)
    made = _fill_all(pool, list(missing.values()), work, on_wait) if missing else {}
    return [plan.found or made[plan.path] for plan in plans]


def _plan(source: cli.Source, work: Preparation) -> PlannedDrive:
    drive = source()
    if drive.T_world_lidar is None:
        raise ValueError(f"{drive.name}: expected a true pose for each scan, got a drive without poses")
    path = dpm.prepared_path(drive, work.settings, work.folder, work.seed)
    return PlannedDrive(source, drive.T_world_lidar, path, dpm.find_prepared(path, drive.T_world_lidar))


def _fill_all(
    pool: ProcessPoolExecutor, plans: Sequence[PlannedDrive], work: Preparation, on_wait: Callable[[], object]
) -> dict[Path, dpm.PreparedDrive]:
    """Prepares the scans of all drives, in parts; the bar counts scans."""
    num_scans = sum(len(plan.T_world_lidar) for plan in plans)
    part = max(MIN_PART, math.ceil(num_scans / (PARTS_EACH * (os.cpu_count() or 1))))
    unfinished = [dpm.begin_file(plan.path, len(plan.T_world_lidar), work.settings, run=work.run) for plan in plans]
    # Each worker appends a byte for each scan.
    count = work.folder / f".count.{work.run}.txt"
    count.touch()
    begun = [
        [
            pool.submit(_fill, plan.source, file, range(first, min(first + part, len(plan.T_world_lidar))), work, count)
            for first in range(0, len(plan.T_world_lidar), part)
        ]
        for plan, file in zip(plans, unfinished, strict=True)
    ]
    with tqdm(desc="prepare scans", total=num_scans, unit=" scans", dynamic_ncols=True) as bar:
        _wait_for([part for parts in begun for part in parts], on_wait, bar, lambda: count.stat().st_size)
    made = {}
    for plan, file, parts in zip(plans, unfinished, begun, strict=True):
        bad = {source: reason for one in parts for source, reason in one.result().items()}
        made[plan.path] = dpm.end_file(file, plan.path, plan.T_world_lidar, bad)
    count.unlink()
    return made


def _fill(source: cli.Source, unfinished: Path, numbers: range, work: Preparation, count: Path) -> dict[str, str]:
    pyramids = np.load(unfinished, mmap_mode="r+")
    with count.open("ab", buffering=0) as file:
        return dpm.fill_scans(
            pyramids,
            drive=source(),
            numbers=numbers,
            config=work.settings,
            seed=work.seed,
            on_scan=lambda: file.write(b"."),
        )


def _wait_for(
    begun: Sequence[Future[Any]], on_wait: Callable[[], object], bar: tqdm[Any], num_done: Callable[[], int]
) -> None:
    """Waits for all, and raises the first error."""
    remaining = set(begun)
    while remaining:
        done, remaining = wait(remaining, timeout=1.0, return_when=FIRST_EXCEPTION)
        for one in done:
            one.result()
        bar.update(num_done() - bar.n)
        on_wait()
