"""Trains the networks of DeepPointMap: descriptors of lidar scans, and how two clouds of them are registered.

    dpmjax train                                                  tiny network, simulated towns, two cores
    dpmjax train --preset small --num-towns 20 --hours 8          two cores, over night
    dpmjax train --data kitti town --preset paper                 drives from files, and towns
    dpmjax train --data kitti --preset small --weights dpm_small  tune trained weights
    dpmjax train --resume                                         continue the latest run
    dpmjax train --resume --finish                                end it now: the learning rate falls
    dpmjax train --coordinator host0:8476 --num-processes 2 --process-id 0
                                                                  on two hosts; --process-id 1 on the other

Results go to results/train/<time>/ (latest links to the newest): model.safetensors for dpmjax.load_model, metrics.csv,
metrics.json, checkpoints, and pictures: loss.png, matches.png. Recall is the share of pairs of a held-out town, turned
by any yaw, that are registered within 2 m and 5 degrees. The pairs are of scans and of maps, 2 to 10 and 10 to 20 m
apart. The model is the one of the step with the best mean recall on other towns (metrics.json: best_step). Afterwards
`python -m experiments.dpm_calibrate MODEL` calibrates its overlap and its confidence.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import FlagCreatePairsOff, arg

from dpmjax.cli.command import StopFlag, check_least, run_command
from dpmjax.cli.machine import peak_rss_gb, select_device
from dpmjax.cli.run_folder import RunFolder, RunOptions, open_run_folder, recording, write_metrics

if TYPE_CHECKING:
    from dpmjax.cli.train_run import Records
    from dpmjax.deeppointmap import Model, TrainingConfig

NAME = "train"


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"hours", "finish", "cache", "validate"})

    data: Annotated[tuple[str, ...], arg(metavar="town|PATH")] = ("town",)
    """Drives to train on: simulated towns, or folders of scans with poses (KITTI, KITTI-360, MulRan, plain ...)."""
    preset: Literal["tiny", "small", "paper"] = "tiny"
    """Size of the network and length of its training."""
    weights: Annotated[str | None, arg(metavar="NAME|FILE")] = None
    """Go on from these weights, whose network takes the place of that of the preset; without it, from random ones."""
    without: tuple[Literal["offset-head", "coarse-loss", "curriculum", "occlusion"], ...] = ()
    """Leave these out, to see what each is worth (the paper's Table 2)."""
    frame: Literal["lidar", "bearing", "local"] | None = None
    """Frame of the encoder's features: of the lidar, of the ray to each point, or of the wall at it; without it, the
    preset decides."""
    steps: Annotated[int | None, arg(metavar="N")] = None
    """Train for about N steps in all, stages in proportion; without it, the preset decides."""
    groups: Annotated[tuple[int, ...], arg(metavar="N ...")] = ()
    """Largest group of scans of each stage of the curriculum, stages of equal length, such as 8 16 8 16 for weights
    that register pairs already; without it, the preset decides."""
    num_towns: Annotated[int, arg(metavar="N")] = 4
    """How many towns to train on, where town is among the data."""
    town_length_m: Annotated[float, arg(metavar="M")] = 600.0
    """Length of the drive through each town."""
    hours: Annotated[float | None, arg(metavar="H")] = None
    """Train for about H hours: the learning rate falls in the last part of them. Without it, the steps decide."""
    finish: FlagCreatePairsOff[bool] = False
    """Let the learning rate fall from here on, and end: with --resume, a run that was planned longer ends well."""
    cache: Annotated[Path, arg(metavar="DIR")] = Path("results/train/cache")
    """Folder where prepared scans are kept between runs; 0.8 MB for each scan of `small`."""
    selection_pairs: Annotated[int, arg(metavar="N")] = 320
    """Pairs of scans and of maps, of towns of their own, by which the best model is chosen."""
    held_out_pairs: Annotated[int, arg(metavar="N")] = 60
    """Pairs of each kind of the held-out town that recall is reported on."""
    validate: Annotated[tuple[Path, ...], arg(metavar="PATH")] = ()
    """Folders of real scans with poses: their recall is drawn beside that of the towns, and chooses nothing."""
    recall_every: Annotated[int, arg(metavar="N")] = 200
    """Measure recall every N steps, and at the end."""
    bfloat16: FlagCreatePairsOff[bool] = False
    """Multiply matrices of the networks in bfloat16; geometry stays in float32."""
    coordinator: Annotated[str | None, arg(metavar="HOST:PORT|auto")] = None
    """Train in several processes as one, at this address of process 0; auto: as Slurm, Open MPI or a TPU pod says."""
    num_processes: Annotated[int | None, arg(metavar="N")] = None
    """How many processes there are."""
    process_id: Annotated[int | None, arg(metavar="I")] = None
    """Which of them this one is, from 0; process 0 alone writes and prints."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            ValueError: if an option is out of range.
        """
        check_least(self, steps=3, num_towns=1, selection_pairs=1, held_out_pairs=1, recall_every=1, seed=0)
        check_least(self, groups=2)
        check_least(self, town_length_m=100, num_processes=1, process_id=0)
        if self.hours is not None and not 0 < self.hours < float("inf"):
            raise ValueError(f"--hours: expected more than 0, got {self.hours}")
        if not self.data:
            raise ValueError("--data: expected town or a folder of scans")
        if self.weights is not None and self.frame is not None:
            raise ValueError("--frame: --weights has a frame already; give one of the two")


def main(config: Config) -> None:
    """Trains, evaluates, and writes the files; one of several processes writes."""
    from dpmjax.deeppointmap.training.processes import is_first, join_processes, merged, together

    started = time.perf_counter()
    join_processes(config.coordinator, config.num_processes, config.process_id)
    if config.coordinator is not None:  # not before the processes have found each other
        select_device(config.device)
    from dpmjax.cli.drive_sources import Source, find_sources
    from dpmjax.cli.train_data import prepare_sources
    from dpmjax.cli.train_results import draw, measure, print_summary, write_model
    from dpmjax.cli.train_run import run_training
    from dpmjax.deeppointmap import ScanStore, TrainingHooks
    from dpmjax.simulation import TRAINING_MIXTURE
    from dpmjax.weights import load_model

    with together():
        weights = None if config.weights is None else load_model(config.weights)
        settings = training_settings(config, weights)
        seeds = range(config.seed, config.seed + config.num_towns)
        town = Source(town_length_m=config.town_length_m, town_mixture=TRAINING_MIXTURE)
        towns = [replace(town, town_seed=seed) for seed in seeds]
        sources = find_sources(config.data, towns, settings.sampling)
        folder = open_run_folder(config, NAME) if is_first() else None
    with recording(folder) if folder is not None else nullcontext(), StopFlag() as stop:
        with together():
            store = ScanStore(prepare_sources(sources, settings, config.cache, seed=config.seed))
            records = None if folder is None else _open_records(folder, config, settings, store, weights)
        hooks = TrainingHooks(evaluate_every=config.recall_every, stop=lambda: stop.received or 0)
        plateau_s = plateau_seconds(config, settings)
        trained = run_training(records, store, settings, hooks, seed=config.seed, plateau_s=plateau_s)
        if trained.stopped_by:
            stop.request(trained.stopped_by)
        bad = merged(store.bad)
        if folder is None or records is None:
            return
        evaluation, metrics = measure(trained, records)
        metrics |= {
            "num_scans": len(store.table),
            "bad_scans": bad,
            "wall_s": time.perf_counter() - started,
            "peak_rss_gb": peak_rss_gb(),
            "is_interrupted": stop.is_requested,
            "seed": config.seed,
        }
        # Numbers first: a picture that fails must not cost them.
        write_metrics(folder, metrics)
        write_model(folder, trained.model, metrics, origin=f"{config.preset}, trained on {', '.join(config.data)}")
        draw(folder, evaluation, records.sets.held_out)
        print_summary(folder, metrics)


def _open_records(
    folder: RunFolder, config: Config, settings: TrainingConfig, store: Any, weights: Model | None
) -> Records:
    from dpmjax.cli.train_run import Records, draw_sets

    print(f"{len(store.table)} scans; {config.preset}: {settings.num_steps} steps at most")
    sets = draw_sets(
        settings,
        selection_pairs=config.selection_pairs,
        held_out_pairs=config.held_out_pairs,
        validate=config.validate,
        length_m=config.town_length_m,
    )
    return Records(folder, settings, sets, seed=config.seed, weights=weights)


def plateau_seconds(config: Config, settings: TrainingConfig) -> float | None:
    """Returns the seconds of steps after which the learning rate falls; None where the steps decide."""
    if config.finish:
        return 0.0
    return None if config.hours is None else 3600 * config.hours * (1 - settings.decay_ratio)


def training_settings(config: Config, weights: Model | None = None) -> TrainingConfig:
    """Returns the preset, with the options applied; the network is that of the weights, if there are any."""
    from dpmjax.deeppointmap import CurriculumStage, training_preset, without

    settings = training_preset(config.preset)
    if weights is not None:
        settings = replace(settings, model=replace(weights.config, calibration=None, overlap=None))
    if config.frame is not None:
        encoder = replace(settings.model.encoder, frame=config.frame)
        settings = replace(settings, model=replace(settings.model, encoder=encoder))
    if config.groups:
        num_steps = max(1, settings.num_steps // len(config.groups))
        settings = replace(settings, curriculum=tuple(CurriculumStage(group, num_steps) for group in config.groups))
    for part in config.without:
        settings = without(settings, part)
    if config.bfloat16:
        settings = replace(settings, model=settings.model.with_compute_dtype("bfloat16"))
    return settings if config.steps is None else settings.with_steps(config.steps)


def run(args: Sequence[str] | None = None) -> int:
    """Runs the subcommand; returns the exit code."""
    return run_command(main, Config, name=NAME, description=__doc__, args=args)
