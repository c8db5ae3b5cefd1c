"""Data of a training: drives, prepared in parallel and kept in files, and the pairs of its evaluations."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import jax
from tqdm import tqdm

from dpmjax.cli.drives import TOWN, Source
from dpmjax.deeppointmap import (
    EvaluationPairs,
    PairKind,
    PreparedDrive,
    TrainingConfig,
    draw_evaluation_pairs,
    prepare_drive,
)
from dpmjax.io import open_lidar_sequence
from dpmjax.simulation import HDL32E, HDL64E, OS1_64, simulate_drive

# Far from the seeds of training towns, which count up from the seed of the run.
HELD_OUT_SEED, SELECTION_SEED = 1_000_000, 2_000_000
SELECTION_PAIRS, VALIDATION_PAIRS = 320, 60
SELECTION_SCENES = (("suburb", HDL64E), ("canyon", OS1_64), ("country", HDL32E), ("campus", OS1_64))
SELECTION_LENGTH_M = 250.0
KINDS = (PairKind(2.0, 10.0), PairKind(10.0, 20.0), PairKind(2.0, 10.0, 4), PairKind(10.0, 20.0, 4))
"""Pairs that models are selected and reported by: scans and maps of four scans, near and far."""

KIND_NAMES = ("recall", "recall_far", "recall_maps", "recall_maps_far")


class EvaluationSets(NamedTuple):
    """Pairs of a run.

    Attributes:
        selection: pairs of towns of their own, by which the best model is chosen.
        real: pairs of each folder of real scans, which are measured but not used for selection.
        held_out: pairs of another town, measured once at the end.
    """

    selection: tuple[EvaluationPairs, ...]
    real: tuple[EvaluationPairs, ...]
    held_out: EvaluationPairs


def draw_sets(
    settings: TrainingConfig, held_out_pairs: int, validate: Sequence[Path], *, length_m: float
) -> EvaluationSets:
    """Returns the pairs of a run; `validate` names folders of real scans, `length_m` is that of towns."""
    draw = partial(draw_evaluation_pairs, config=settings.model)
    num = max(1, SELECTION_PAIRS // (len(KINDS) * len(SELECTION_SCENES)))
    towns = [
        simulate_drive(SELECTION_SEED + number, length_m=min(length_m, SELECTION_LENGTH_M), kind=kind, sensor=sensor)
        for number, (kind, sensor) in enumerate(SELECTION_SCENES)
    ]
    held_out = simulate_drive(HELD_OUT_SEED, length_m=length_m, kind="suburb", sensor=HDL64E)
    work = [partial(draw, town, num, kinds=KINDS, max_scans=64) for town in towns]
    work += [partial(draw, open_lidar_sequence(path), VALIDATION_PAIRS, kinds=KINDS[:2]) for path in validate]
    work += [partial(draw, held_out, held_out_pairs, kinds=KINDS)]
    sets = [one() for one in tqdm(work, desc="prepare evaluation", unit=" drives", dynamic_ncols=True)]
    return EvaluationSets(tuple(sets[: len(towns)]), tuple(sets[len(towns) : -1]), sets[-1])


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
