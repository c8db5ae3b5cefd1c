"""The drives of a DeepPointMap training: simulated towns and folders of scans, prepared in parallel and kept."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import jax
from scipy.spatial import cKDTree
from tqdm import tqdm

from dpmjax.deeppointmap import PreparedDrive, SamplingConfig, TrainingConfig, prepare_drive
from dpmjax.io import LidarSequence, list_lidar_sequences, open_lidar_sequence
from dpmjax.simulation import LidarSensor, SceneMixture, draw_scene, simulate_scene

LOGGER = logging.getLogger("dpmjax.training")
TOWN = "town"
# Far from the seeds of training towns, which count up from the seed of the run.
HELD_OUT_SEED, SELECTION_SEED = 1_000_000, 2_000_000


@dataclass(frozen=True)
class Source:
    """Where a drive comes from.

    Attributes:
        path: folder of scans; None for a simulated town.
        name: name of the sequence in the folder; None where it holds one.
        town_seed: seed of the town.
        town_length_m: length of the drive through the town.
    """

    path: Path | None = None
    name: str | None = None
    town_seed: int = 0
    town_length_m: float = 600.0

    def open(self) -> LidarSequence:
        """Opens or simulates the drive."""
        if self.path is None:
            return town_drive(self.town_seed, length_m=self.town_length_m)
        return open_lidar_sequence(self.path, sequence=self.name)


def town_drive(
    seed: int, *, length_m: float, kind: str | None = None, sensor: LidarSensor | None = None
) -> LidarSequence:
    """Returns the simulated drive of a seed: any place and lidar of the mixture, or those that are given."""
    mixture = SceneMixture(length_m=length_m)
    if kind is not None:
        mixture = replace(mixture, kinds=((kind, 1.0),))
    if sensor is not None:
        mixture = replace(mixture, sensors=((sensor, 1.0),))
    return simulate_scene(draw_scene(seed, mixture))


def find_sources(data: Sequence[str], towns: Sequence[int], town_length_m: float) -> list[Source]:
    """Returns the drives to train on.

    Raises:
        ValueError: if a path cannot be read or holds no useful drive.
    """
    sources: list[Source] = []
    for entry in data:
        if entry == TOWN and not Path(entry).exists():
            sources += [Source(town_seed=seed, town_length_m=town_length_m) for seed in towns]
            continue
        names: Sequence[str | None] = list_lidar_sequences(entry) or [None]
        found = {Source(Path(entry), name): open_lidar_sequence(entry, sequence=name) for name in names}
        reasons = {source: reason for source, drive in found.items() if (reason := why_useless(drive)) is not None}
        if len(reasons) == len(found):
            raise ValueError("; ".join(f"{entry}: {reason}" for reason in dict.fromkeys(reasons.values())))
        for source, reason in reasons.items():
            LOGGER.warning("%s is left out: %s", found[source].name, reason)
        sources += [source for source in found if source not in reasons]
    return sources


def why_useless(drive: LidarSequence) -> str | None:
    """Returns the reason why nothing can be learned from a drive; None where something can."""
    limits = SamplingConfig()
    if drive.T_world_lidar is None:
        return "no poses; training needs a pose for each scan"
    positions = drive.T_world_lidar[:, :3, 3]
    tree = cKDTree(positions)
    num_near, num_too_near = (tree.count_neighbors(tree, r) for r in (limits.max_distance_m, limits.min_distance_m))
    if num_near == num_too_near:
        found = f"{len(positions)} scans, no two of them {limits.min_distance_m} to {limits.max_distance_m} m apart"
        return f"{found}; training needs such pairs (are the poses in metres?)"
    reason = ""
    for number in range(len(drive)):
        try:
            drive.read_scan(number)
        except ValueError as error:
            reason = reason or str(error)
            continue
        return None
    return f"all {len(drive)} scans are bad; the first, {reason}"


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
