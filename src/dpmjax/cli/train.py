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
metrics.csv, metrics.json, checkpoints, and the picture loss.png. Recall is the share of
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

from dpmjax import cli, deeppointmap, io, simulation, viz, weights
from dpmjax.cli.options import RunOptions
from dpmjax.cli.run import HISTORY, METRICS, Numbers, Run

if TYPE_CHECKING:
    from dpmjax.cli.train_run import Records, Selection

MODEL = "model.safetensors"
# Share of the learning rate at which trained weights are tuned: at the full rate they forget pairs far apart.
TUNING_SHARE = 0.2
TOWN_LENGTH_M = 400.0
SHOWN_CURVES = ("loss", "pairing", "offset", "top1_accuracy", "recall", "recall_far", "overlap_loss")


@dataclass(frozen=True, kw_only=True)
class TrainOptions(RunOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"hours", "finish", "cache", "calibrate"})

    data: Annotated[tuple[str, ...], arg(metavar="town|PATH")] = ("town",)
    """Drives to train on: simulated towns, or folders of scans with poses (KITTI, KITTI-360, MulRan, plain ...)."""
    preset: Literal["tiny", "small", "paper"] = "tiny"
    """Size of the network and length of its training."""
    weights: Annotated[str | None, arg(metavar="NAME|FILE")] = None
    """Tune these weights, at a fifth of the learning rate, by their network. Without it, begin at random."""
    stages: tuple[Literal["registration", "overlap"], ...] = ("registration", "overlap")
    """Stages. registration: all networks but the overlap head. overlap: this head alone, of --weights or the first."""
    calibrate: bool = True
    """Fit the confidence and the overlap afterwards, on pairs of the data."""
    without: tuple[Literal["offset-head", "coarse-loss", "curriculum", "occlusion"], ...] = ()
    """Leave these parts out, to measure their benefit (the paper's Table 2). tiny and small have no offset head."""
    steps: Annotated[int | None, arg(metavar="N"), cli.Bound(3)] = None
    """Train for about N steps in all, divided in proportion to the stages. Without it, the preset decides."""
    epochs: Annotated[float | None, arg(metavar="N"), cli.Bound(0, is_allowed=False)] = None
    """Train until each scan was N times the first of a group, instead of --steps. `paper` takes 12, as published."""
    groups: Annotated[tuple[int, ...], arg(metavar="N ..."), cli.Bound(2)] = ()
    """Largest group of scans in each stage of the curriculum, such as 8 16 8 16. Without it, the preset decides."""
    scans: Annotated[int | None, arg(metavar="N"), cli.Bound(2)] = None
    """Number of scans of a step; more keep a GPU busy. Without it, the preset decides."""
    num_towns: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 3
    """Number of towns for training, if town is among the data."""
    refine_labels: FlagCreatePairsOff[bool] = False
    """Align the scans of each group by ICP, from the given poses, for poses of neighbours that are decimetres off."""
    hours: Annotated[float | None, arg(metavar="H"), cli.Bound(0, is_allowed=False)] = None
    """Train for about H hours, with at most the steps of the preset. The learning rate falls until the end."""
    finish: FlagCreatePairsOff[bool] = False
    """With --resume, let the learning rate fall faster, and end after a quarter of the steps that are done."""
    cache: Annotated[Path, arg(metavar="DIR")] = Path("results/train/cache")
    """Folder that keeps prepared scans between runs, 0.3 to 0.8 MB each; the run prints needed and free space."""
    variants: Annotated[int | None, arg(metavar="N"), cli.Bound(0)] = None
    """Prepare each scan N times; steps choose among them. 0: anew at each use. Without it, the preset decides."""
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
        if not self.stages:
            raise ValueError("--stages: expected registration, overlap, or both")
        if "registration" not in self.stages and self.weights is None:
            raise ValueError("--stages overlap trains the head of a model: give it by --weights")


def main(options: TrainOptions, run: Run) -> Numbers:
    """Trains, evaluates, and writes the files; of several processes, only the first one writes."""
    from dpmjax.deeppointmap.training.processes import is_first, join_processes

    join_processes(options.coordinator, options.num_processes, options.process_id)
    import jax

    from dpmjax.cli.train_run import Records, part_of_drive, prepare_sources, run_training

    first = None if options.weights is None else weights.load_model(options.weights)
    settings = training_settings(options, first)
    towns = town_sources(options, settings)
    sources = cli.find_sources(options.data, towns, settings.sampling)
    for path in options.validate:
        if (reason := deeppointmap.why_useless(io.open_lidar_sequence(path), settings.sampling)) is not None:
            raise ValueError(f"--validate {path}: {reason}")
    # The user's drives choose and calibrate the model; towns do if there are no others.
    chosen = [source for source in sources if source not in towns] or sources
    # Until the run is open, Ctrl-C ends the process at once.
    parts = [partial(part_of_drive, source, "training") for source in sources]
    store = deeppointmap.ScanStore(prepare_sources(parts, settings, options.cache, seed=options.seed))
    settings, num_scans = settings.for_scans(len(store.table), num_samples=jax.device_count()), len(store.table)
    records = None
    if is_first():
        settings = without_impossible_stage(settings, store)
        selection = select_pairs(options, settings, chosen, "towns" if chosen[0] in towns else "drives")
        run.open()
        num_steps = {"registration": settings.num_steps, "overlap": settings.overlap.num_steps(num_scans)}
        plan = ", ".join(f"{num_steps[stage]} steps of {stage}" for stage in settings.stages)
        run.say(f"{options.preset}: {num_scans} scans; at most {plan}")
        takes_last = options.preset == "paper"
        records = Records(run, settings, selection, seed=options.seed, weights=first, takes_last=takes_last)
    hooks = deeppointmap.TrainingHooks(evaluate_every=options.recall_every, stop=lambda: run.is_stopped)
    total_s = 0.0 if options.finish else 3600 * (options.hours or math.inf)
    trained = run_training(records, store, settings, hooks, seed=options.seed, total_s=total_s)
    if records is None:
        return {}
    numbers = training_numbers(trained, records) | {"num_scans": num_scans, "bad_scans": store.bad, "calibration": {}}
    origin = f"{options.preset}, trained on {', '.join(options.data)}"
    # A stopped run has no minutes for the evaluation and the calibration.
    numbers |= {} if run.is_stopped else evaluate(trained, records)
    run.write_numbers(numbers)
    write_model(run / MODEL, trained.model, numbers, origin=origin)
    draw_curves(run)
    if options.calibrate and not run.is_stopped:
        # A signal that comes from here on loses the calibration alone.
        run.write_numbers({**numbers, "status": "interrupted"})
        model, numbers["calibration"] = calibrate_on_sources(trained.model, chosen, options.seed, run.check_stop)
        write_model(run / MODEL, model, numbers, origin=origin)
    return {"verdict": training_verdict(numbers), **numbers}


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
    given = {"num_variants": options.variants, "num_epochs": options.epochs}
    changed: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    num_scans = options.scans or settings.sampling.num_scans
    if options.groups:
        num_steps = max(1, settings.num_steps // len(options.groups))
        changed["curriculum"] = tuple(deeppointmap.CurriculumStage(group, num_steps) for group in options.groups)
    changed |= {"sampling": replace(settings.sampling, num_scans=num_scans), "stages": options.stages}
    settings = replace(settings, refines_labels=options.refine_labels, **changed)
    if jax.default_backend() != "cpu":
        settings = replace(settings, scans_at_once=num_scans)
    for part in options.without:
        settings = deeppointmap.without(settings, part)
    return settings if options.steps is None else settings.with_steps(options.steps)


def town_sources(options: TrainOptions, settings: deeppointmap.TrainingConfig) -> list[cli.Source]:
    """Returns the simulated towns; scans that are read at each use are simulated once."""
    town = partial(simulation.simulate_drive, length_m=TOWN_LENGTH_M, mixture=simulation.TRAINING_MIXTURE)
    towns: list[cli.Source] = [partial(town, options.seed + number) for number in range(options.num_towns)]
    if settings.num_variants > 0:
        return towns
    return [lambda town=town: cli.keep_scans(town(), options.cache) for town in towns]  # type: ignore[misc]


def select_pairs(
    options: TrainOptions, settings: deeppointmap.TrainingConfig, chosen: Sequence[cli.Source], kind: str
) -> Selection:
    """Draws the pairs that choose the model, of --validate or else of held-out places of the chosen drives."""
    from dpmjax.cli.train_run import Selection, draw_selection, part_of_drive

    if "registration" not in options.stages:
        return Selection(None, "given weights")
    if options.validate:
        given = [partial(io.open_lidar_sequence, path) for path in options.validate]
        return draw_selection(settings, given, "drives of --validate")
    drives = [partial(part_of_drive, source, "held_out") for source in chosen]
    return draw_selection(settings, drives, f"held-out places of the {kind}")


def without_impossible_stage(
    settings: deeppointmap.TrainingConfig, store: deeppointmap.ScanStore
) -> deeppointmap.TrainingConfig:
    """Leaves out the stage of overlap if the scans cannot train it, with a line; a ValueError if none remains."""
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


def evaluate(trained: deeppointmap.Trained, records: Records) -> Numbers:
    """Returns recall and errors of the trained and of the untrained network."""
    from dpmjax.cli.train_run import RECALLS

    pairs = records.selection.pairs
    if pairs is None:
        return {}
    numbers: Numbers = {"num_held_out_pairs": len(next(iter(pairs.pairs.values())))}
    print("evaluation ...", flush=True)
    for suffix, model in (("", trained.model), ("_untrained", records.untrained)):
        recalls = deeppointmap.evaluate_registration(model, pairs).recalls
        numbers |= {f"{RECALLS[band]}{suffix}": recall.recall for band, recall in recalls.items()}
        near = next(iter(recalls.values()))
        numbers[f"translation_error_median{suffix}_m"] = float(np.median(near.translation_errors_m))
        numbers[f"rotation_error_median{suffix}_deg"] = float(np.median(near.rotation_errors_deg))
    return numbers


def draw_curves(run: Run) -> None:
    """Draws loss.png: losses and recalls over the steps."""
    if rows := run.read_table(HISTORY):
        curves = {name: np.array([float(row[name] or "nan") for row in rows]) for name in SHOWN_CURVES}
        curves = {name.replace("_", " "): curve for name, curve in curves.items() if np.isfinite(curve).any()}
        viz.save_figure(viz.curves_figure([int(row["step"]) for row in rows], curves), run / "loss.png")


def write_model(path: Path, model: deeppointmap.Model, numbers: Numbers, *, origin: str) -> None:
    """Writes a model with a description of its training; the preset and the data come first."""
    best = "" if numbers["best_step"] is None else f" (best recall after {numbers['best_step']})"
    card = f"{origin} ({numbers['num_scans']} scans), {numbers['steps']} steps{best}, seed {numbers['seed']}. "
    card += f"Trained: {', '.join(model.config.trained) or 'nothing to its end'}; chosen by {numbers['chosen_by']}. "
    card += (
        "Not evaluated."
        if "recall" not in numbers
        else (
            f"Held-out places, {numbers['num_held_out_pairs']} pairs 2-10 m apart, any yaw: recall (2 m, 5 deg) "
            f"{numbers['recall']:.3f}, before {numbers['recall_untrained']:.3f}."
        )
    )
    unfinished = path.with_name(f".tmp_{path.name}")
    weights.save_model(model, unfinished, card=card)
    unfinished.replace(path)


def training_verdict(numbers: Numbers) -> str:
    """Returns the verdict: the recall, the overlap, and the scans that were left out."""
    at = "" if numbers["best_step"] is None else f" (best, after step {numbers['best_step']})"
    text = f"ended after step {numbers['steps']}{at}; not evaluated"
    if "recall" in numbers:
        text = f"recall on held-out places {numbers['recall_untrained']:.2f} -> {numbers['recall']:.2f}{at}"
    for name, by in (("overlap", "regression"), ("head", "head")):
        if np.isfinite(auc := numbers["calibration"].get(f"auc_{name}", math.nan)):
            text += f"; overlap by the {by}: AUC {auc:.3f} on held-out places"
    bad = numbers["bad_scans"]
    if bad:
        source, reason = next(iter(bad.items()))
        text += f"; {len(bad)} scans left out, such as {source}: {reason} ({METRICS} has all)"
    return text
