"""Trains the networks of DeepPointMap: descriptors of lidar scans, their registration, and their overlap.

    dpmjax train                                                  tiny network, simulated towns, two cores
    dpmjax train --preset small --num-towns 20 --hours 8          two cores, over night
    dpmjax train --data kitti town --preset paper                 drives from files, and towns
    dpmjax train --data kitti --preset small --weights dpm_small  tune trained weights
    dpmjax train --stages overlap --weights FILE --data kitti     train the overlap head of weights, and calibrate them
    dpmjax train --preset small --scans 96 --num-towns 200        one GPU
    dpmjax train --resume                                         continue the latest run
    dpmjax train --resume --finish                                end it now: the learning rate falls
    dpmjax train --coordinator host0:8476 --num-processes 2 --process-id 0
                                                                  on two hosts; --process-id 1 on the other

Results go to results/train/<time>/ (latest links to the newest): model.safetensors for dpmjax.load_model,
last.safetensors, metrics.csv, metrics.json, checkpoints, and pictures: loss.png, matches.png. Recall is the share of
pairs of held-out places, turned by any yaw, that are registered within 2 m and 5 degrees. The last tenth of the path of
each drive is held out, with all scans near it. The model of the step with the best mean recall is kept (metrics.json:
best_step, chosen_by). With `paper`, the last model is kept, as published. Then the overlap head is trained, and
confidence and overlap are calibrated, so that SLAM can use the model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from tqdm import tqdm
from tyro.conf import FlagCreatePairsOff, arg

from dpmjax import cli, deeppointmap, io, simulation, weights
from dpmjax.cli import train_files
from dpmjax.cli.options import RunOptions
from dpmjax.cli.run import Numbers, Run
from dpmjax.sequences import LidarSequence

if TYPE_CHECKING:
    from dpmjax.cli.train_run import Records, Selection

# Share of the learning rate at which trained weights are tuned: at the full rate they forget pairs far apart.
TUNING_SHARE = 0.2


@dataclass(frozen=True, kw_only=True)
class TrainOptions(RunOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"hours", "finish", "cache", "calibrate"})

    data: Annotated[tuple[str, ...], arg(metavar="town|PATH")] = ("town",)
    """Drives to train on: simulated towns, or folders of scans with poses (KITTI, KITTI-360, MulRan, plain ...)."""
    preset: Literal["tiny", "small", "paper"] = "tiny"
    """Size of the network and length of its training."""
    weights: Annotated[str | None, arg(metavar="NAME|FILE")] = None
    """Continue from these weights at a fifth of the learning rate. Their network replaces the network of the preset.
    Without it, begin from random weights."""
    stages: tuple[Literal["registration", "overlap"], ...] = ("registration", "overlap")
    """Stages of the training. registration: all networks except the overlap head; overlap: this head alone. If overlap
    is the only stage, the head of --weights is trained."""
    calibrate: bool = True
    """Fit the confidence and the overlap afterwards, on pairs of the data."""
    frame: Literal["lidar", "local"] | None = None
    """Frame of the encoder's features: the lidar, or the wall at each point. Without it, the preset decides."""
    steps: Annotated[int | None, arg(metavar="N"), cli.Bound(3)] = None
    """Train for about N steps in all, divided in proportion to the stages. Without it, the preset decides."""
    epochs: Annotated[float | None, arg(metavar="N"), cli.Bound(0, is_allowed=False)] = None
    """Train until each scan was N times the first of a group, instead of --steps. `paper` takes 12, as published."""
    groups: Annotated[tuple[int, ...], arg(metavar="N ..."), cli.Bound(2)] = ()
    """Largest group of scans in each stage of the curriculum, such as 8 16 8 16. Without it, the preset decides."""
    scans: Annotated[int | None, arg(metavar="N"), cli.Bound(2)] = None
    """Number of scans of a step. More scans keep a GPU busy, because it computes all of them at once. Without it, the
    preset decides."""
    num_towns: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 3
    """Number of towns for training, if town is among the data."""
    town_length_m: Annotated[float, arg(metavar="M"), cli.Bound(100)] = 400.0
    """Length of the drive through each town."""
    refine_labels: FlagCreatePairsOff[bool] = False
    """Align the scans of each group by point-to-plane ICP, from the given poses. Use it if the poses of neighbours are
    decimetres off."""
    hours: Annotated[float | None, arg(metavar="H"), cli.Bound(0, is_allowed=False)] = None
    """Train for about H hours, with at most the steps of the preset. The learning rate falls until the end. Without it,
    the steps decide."""
    finish: FlagCreatePairsOff[bool] = False
    """Let the learning rate fall faster, and end. With --resume, a longer run ends after a quarter of the steps that it
    has done."""
    cache: Annotated[Path, arg(metavar="DIR")] = Path("results/train/cache")
    """Folder that keeps prepared scans between runs: 0.3 MB for each scan of `tiny`, 0.5 MB of `small`. The run prints
    the needed and the free space first."""
    variants: Annotated[int | None, arg(metavar="N"), cli.Bound(0)] = None
    """Prepare each scan N times; steps choose among these variants. Each one needs disk, 0.8 MB for `paper`. 0: prepare
    it anew at each use, as published, which keeps many cores busy. Without it, the preset decides (`paper`: 0)."""
    held_out_pairs: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 32
    """Pairs of scans at each distance that choose the model, all drives together."""
    validate: Annotated[tuple[Path, ...], arg(metavar="PATH")] = ()
    """Folders of scans with poses whose pairs choose the model, instead of held-out places of --data."""
    recall_every: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 100
    """Measure recall every N steps, and at the end."""
    coordinator: Annotated[str | None, arg(metavar="HOST:PORT|auto")] = None
    """Address of process 0, to train in several processes. auto: the address of Slurm, Open MPI or a TPU pod."""
    num_processes: Annotated[int | None, arg(metavar="N"), cli.Bound(1)] = None
    """Number of processes."""
    process_id: Annotated[int | None, arg(metavar="I"), cli.Bound(0)] = None
    """Number of this process, from 0. Process 0 alone writes and prints."""

    def __post_init__(self) -> None:
        """Checks bounds, and options that do not go together."""
        super().__post_init__()
        if self.steps is not None and self.epochs is not None:
            raise ValueError("--epochs: expected without --steps; give one of the two")
        if not self.data:
            raise ValueError("--data: expected town or a folder of scans")
        if self.weights is not None and self.frame is not None:
            raise ValueError("--frame: --weights has a frame already; give one of the two")
        if not self.stages:
            raise ValueError("--stages: expected registration, overlap, or both")
        if "registration" not in self.stages and self.weights is None:
            raise ValueError("--stages overlap trains the head of a model: give it by --weights")


def main(options: TrainOptions, run: Run) -> Numbers:
    """Trains, evaluates, and writes the files; of several processes, only the first one writes."""
    from dpmjax.deeppointmap.training.processes import is_first, join_processes

    join_processes(options.coordinator, options.num_processes, options.process_id)
    if options.coordinator is not None:  # not before the processes have found each other
        cli.select_device(options.device)
    from dpmjax.cli.train_preparation import prepare_sources
    from dpmjax.cli.train_run import Records, part_of_drive, run_training

    first = None if options.weights is None else weights.load_model(options.weights)
    settings = training_settings(options, first)
    sources = training_sources(options, settings)
    if is_first():
        run.open()
    parts = [partial(part_of_drive, source, "training") for source in sources]
    drives = prepare_sources(parts, settings, options.cache, seed=options.seed, on_wait=run.check_stop)
    store = deeppointmap.ScanStore(drives)
    settings = for_devices(settings, len(store.table))
    records = None
    if run.is_open:
        settings = without_impossible_stage(settings, store)
        num_scans = len(store.table)
        num_steps = {"registration": settings.num_steps, "overlap": settings.overlap.num_steps(num_scans)}
        plan = ", ".join(f"{num_steps[stage]} steps of {stage}" for stage in settings.stages)
        run.say(f"{options.preset}: {num_scans} scans; at most {plan}")
        selection = select_pairs(options, settings, sources, run.check_stop)
        is_last = options.preset == "paper"
        records = Records(run, settings, selection, seed=options.seed, weights=first, takes_last=is_last)
    hooks = deeppointmap.TrainingHooks(evaluate_every=options.recall_every, stop=lambda: run.is_stopped)
    total_s = 0.0 if options.finish else 3600 * (options.hours or math.inf)
    trained = run_training(records, store, settings, hooks, seed=options.seed, total_s=total_s)
    if records is None:
        return {}
    numbers = training_numbers(trained, records) | {"num_scans": len(store.table), "bad_scans": store.bad}
    evaluation, origin = None, f"{options.preset}, trained on {', '.join(options.data)}"
    if not run.is_stopped:  # this and the calibration take minutes, which a stopped run does not have
        evaluation, measured = evaluate(trained, records)
        numbers |= measured
    train_files.write_training(records, trained, evaluation, numbers, origin=origin)
    numbers["calibration"] = {}
    if options.calibrate and not run.is_stopped:
        # A signal that comes from here on loses the calibration alone.
        run.write_numbers({**numbers, "status": "interrupted"})
        chosen = chosen_sources(sources)
        model, numbers["calibration"] = calibrate_on_sources(trained.model, chosen, options.seed, run.check_stop)
        train_files.write_model(run / train_files.MODEL, model, numbers, origin=origin)
    return {"verdict": train_files.training_verdict(numbers), **numbers}


def training_sources(options: TrainOptions, settings: deeppointmap.TrainingConfig) -> list[cli.Source]:
    """Returns the drives of --data; raises a ValueError if a drive of --validate or --data has no pairs of scans."""
    sampling = settings.sampling
    town = partial(simulation.simulate_drive, length_m=options.town_length_m, mixture=simulation.TRAINING_MIXTURE)
    towns: list[cli.Source] = [partial(town, options.seed + number) for number in range(options.num_towns)]
    if settings.num_variants == 0:  # scans that are read at each use are simulated once
        towns = [partial(kept_drive, source, options.cache) for source in towns]
    sources = cli.find_sources(options.data, towns, sampling)
    for path in options.validate:
        if (reason := deeppointmap.why_useless(io.open_lidar_sequence(path), sampling)) is not None:
            raise ValueError(f"--validate {path}: {reason}")
    return sources


def kept_drive(source: cli.Source, folder: Path) -> LidarSequence:
    """Returns a drive that keeps its scans in a folder after their first reading."""
    return cli.keep_scans(source(), folder)


def for_devices(settings: deeppointmap.TrainingConfig, num_scans: int) -> deeppointmap.TrainingConfig:
    """Converts epochs to steps: in an epoch, all devices together use each scan once."""
    import jax

    return settings.for_scans(num_scans, num_samples=jax.device_count())


def chosen_sources(sources: Sequence[cli.Source]) -> list[cli.Source]:
    """Returns the drives for the choice and the calibration of models: those of the user, or else the towns."""
    return [source for source in sources if not is_town(source)] or list(sources)


def is_town(source: cli.Source) -> bool:
    """Returns True for a simulated town of the seeds of the run."""
    return isinstance(source, partial) and source.func in (simulation.simulate_drive, kept_drive)


def select_pairs(
    options: TrainOptions,
    settings: deeppointmap.TrainingConfig,
    sources: Sequence[cli.Source],
    on_wait: Callable[[], object],
) -> Selection:
    """Returns the pairs that choose the model, of --validate or else of held-out places of the drives or towns."""
    from dpmjax.cli.train_run import Selection, draw_selection, part_of_drive

    if "registration" not in options.stages:
        return Selection(None, "given weights")
    if options.validate:
        drives: list[cli.Source] = [partial(io.open_lidar_sequence, path) for path in options.validate]
        name = "drives of --validate"
    else:
        chosen = chosen_sources(sources)
        drives = [partial(part_of_drive, source, "held_out") for source in chosen]
        name = f"held-out places of the {'towns' if is_town(chosen[0]) else 'drives'}"
    return draw_selection(settings, options.held_out_pairs, drives, name, on_wait=on_wait)


def without_impossible_stage(
    settings: deeppointmap.TrainingConfig, store: deeppointmap.ScanStore
) -> deeppointmap.TrainingConfig:
    """Leaves out the stage of overlap if the scans cannot train it, and prints a line.

    Args:
        settings: settings of training.
        store: the scans.

    Returns:
        The settings.

    Raises:
        ValueError: if no other stage remains.
    """
    reason = deeppointmap.why_no_overlap(store.table)
    if reason is None or "overlap" not in settings.stages:
        return settings
    if "registration" not in settings.stages:
        raise ValueError(f"--data: {reason}")
    print(f"the overlap head is not trained: {reason}; give more drives, or town too")
    return replace(settings, stages=("registration",))


def calibrate_on_sources(
    model: deeppointmap.Model, sources: Sequence[cli.Source], seed: int, on_wait: Callable[[], object]
) -> tuple[deeppointmap.Model, Numbers]:
    """Returns the model with regressions of confidence and overlap, and their numbers on held-out places."""
    with tqdm(desc="calibrate confidence (then overlap, about 2 min)", unit=" pairs", dynamic_ncols=True) as bar:
        on_pair = lambda: (on_wait(), bar.update(1))  # noqa: E731
        measured = deeppointmap.measure_drives(model, [source() for source in sources], seed, on_pair=on_pair)
    calibrated, numbers = deeppointmap.calibrate(model, measured)
    if calibrated.config.calibration is None:
        print("the confidence is not calibrated: all registrations of the data are right, or all are wrong")
    if calibrated.config.overlap is None:
        print("the overlap is not calibrated: pairs with overlap or without are missing; give more drives, or town too")
    return calibrated, numbers


def training_settings(options: TrainOptions, first: deeppointmap.Model | None = None) -> deeppointmap.TrainingConfig:
    """Returns the preset with the options applied; given first weights determine the network."""
    import jax

    settings = deeppointmap.training_preset(options.preset)
    if first is not None:
        model = replace(first.config, calibration=None, overlap=None, trained=())
        settings = replace(settings, model=model, learning_rate=TUNING_SHARE * settings.learning_rate)
        if "overlap" not in first.config.trained:  # this head begins, whatever is tuned
            rate_share = settings.overlap.rate_share / TUNING_SHARE
            settings = replace(settings, overlap=replace(settings.overlap, rate_share=rate_share))
    given: dict[str, Any] = {"num_variants": options.variants, "num_epochs": options.epochs}
    settings = replace(settings, **{name: value for name, value in given.items() if value is not None})
    settings = replace(settings, stages=options.stages, refines_labels=options.refine_labels)
    if options.frame is not None:
        encoder = replace(settings.model.encoder, frame=options.frame)
        settings = replace(settings, model=replace(settings.model, encoder=encoder))
    stages, num_scans = settings.curriculum, options.scans or settings.sampling.num_scans
    if options.groups:
        num_steps = max(1, settings.num_steps // len(options.groups))
        stages = tuple(deeppointmap.CurriculumStage(group, num_steps) for group in options.groups)
    settings = replace(settings, curriculum=stages, sampling=replace(settings.sampling, num_scans=num_scans))
    if jax.default_backend() != "cpu":
        settings = replace(settings, scans_at_once=num_scans)
    return settings if options.steps is None else settings.with_steps(options.steps)


def training_numbers(trained: deeppointmap.Trained, records: Records) -> Numbers:
    """Returns steps, selection score and seconds for `metrics.json`."""
    return {
        "seed": records.seed,
        "steps": int(trained.progress.state.step),
        "best_step": int(trained.progress.best_step) or None,
        "selection_score": float(trained.progress.best_score),
        "chosen_by": "the last step, as published" if records.takes_last else records.selection.chosen_by,
        "trained": trained.model.config.trained,
        "overlap_steps": 0 if trained.overlap is None else int(trained.overlap.step),
        "train_s": records.run_s,
        "compile_s": trained.speed.compile_s,
        "scans_per_s": trained.speed.scans_per_s,
    }


def evaluate(trained: deeppointmap.Trained, records: Records) -> tuple[deeppointmap.Evaluation | None, Numbers]:
    """Returns recall and errors of the trained network, and of the untrained one."""
    from dpmjax.cli.train_run import RECALLS

    pairs = records.selection.pairs
    if pairs is None:
        return None, {}
    models = {"": trained.model, "_untrained": records.untrained}
    metrics: Numbers = {"num_held_out_pairs": len(next(iter(pairs.pairs.values())))}
    evaluations = {}
    for suffix, model in tqdm(models.items(), desc="evaluate", unit=" networks", dynamic_ncols=True):
        evaluation = evaluations[suffix] = deeppointmap.evaluate_registration(model, pairs)
        near, *_ = evaluation.recalls.values()
        metrics |= {f"{RECALLS[band]}{suffix}": recall.recall for band, recall in evaluation.recalls.items()}
        metrics[f"translation_error_median{suffix}_m"] = float(np.median(near.translation_errors_m))
        metrics[f"rotation_error_median{suffix}_deg"] = float(np.median(near.rotation_errors_deg))
    return evaluations[""], metrics
