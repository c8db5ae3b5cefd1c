"""Trains the networks of DeepPointMap: descriptors of lidar scans, and how two clouds of them are registered.

    dpmjax train                                                  tiny network, simulated towns, two cores
    dpmjax train --preset small --num-towns 20 --hours 8          two cores, over night
    dpmjax train --data kitti town --preset paper                 drives from files, and towns
    dpmjax train --data kitti --preset small --weights dpm_small  tune trained weights
    dpmjax train --preset small --scans 96 --num-towns 200        one GPU
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

import math
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from tqdm import tqdm
from tyro.conf import FlagCreatePairsOff, arg

from dpmjax import cli, deeppointmap, io, simulation, viz, weights

if TYPE_CHECKING:
    from dpmjax.cli.train_run import Records

NAME = "train"
MODEL = "model.safetensors"
# Largest number of listed damaged scans; further ones are only counted.
MAX_LISTED = 10
# Share of the learning rate at which trained weights are tuned: at the full rate they forget pairs far apart.
TUNING_SHARE = 0.2
SHOWN_CURVES = ("loss", "pairing", "offset", "top1_accuracy", "recall", "recall_far", "real_recall")


@dataclass(frozen=True, kw_only=True)
class ProcessOptions(cli.RunOptions):
    """Options of a run of several processes."""

    coordinator: Annotated[str | None, arg(metavar="HOST:PORT|auto")] = None
    """Train in several processes as one, at this address of process 0; auto: as Slurm, Open MPI or a TPU pod says."""
    num_processes: Annotated[int | None, arg(metavar="N")] = None
    """How many processes there are."""
    process_id: Annotated[int | None, arg(metavar="I")] = None
    """Which of them this one is, from 0; process 0 alone writes and prints."""


@dataclass(frozen=True, kw_only=True)
class Config(ProcessOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"hours", "finish", "cache", "validate"})

    data: Annotated[tuple[str, ...], arg(metavar="town|PATH")] = ("town",)
    """Drives to train on: simulated towns, or folders of scans with poses (KITTI, KITTI-360, MulRan, plain ...)."""
    preset: Literal["tiny", "small", "paper"] = "tiny"
    """Size of the network and length of its training."""
    weights: Annotated[str | None, arg(metavar="NAME|FILE")] = None
    """Go on from these weights at a fifth of the learning rate; their network takes the place of that of the preset.
    Without it, begin from random ones."""
    without: tuple[Literal["offset-head", "coarse-loss", "curriculum", "occlusion"], ...] = ()
    """Leave these out, to see what each is worth (the paper's Table 2); tiny and small have no offset head."""
    frame: Literal["lidar", "bearing", "local"] | None = None
    """Frame of the encoder's features: of the lidar, of the ray to each point, or of the wall at it; without it, the
    preset decides."""
    steps: Annotated[int | None, arg(metavar="N")] = None
    """Train for about N steps in all, stages in proportion; without it, the preset decides."""
    groups: Annotated[tuple[int, ...], arg(metavar="N ...")] = ()
    """Largest group of scans of each stage of the curriculum, such as 8 16 8 16; without it, the preset decides."""
    scans: Annotated[int | None, arg(metavar="N")] = None
    """How many scans a step takes; more keep a GPU busy, which computes all of them at once. Without it, the preset
    decides."""
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
    held_out_pairs: Annotated[int, arg(metavar="N")] = 60
    """Pairs of each kind of the held-out town that recall is reported on."""
    validate: Annotated[tuple[Path, ...], arg(metavar="PATH")] = ()
    """Folders of real scans with poses: their recall is drawn beside that of the towns, and chooses nothing."""
    recall_every: Annotated[int, arg(metavar="N")] = 200
    """Measure recall every N steps, and at the end."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, steps=3, num_towns=1, held_out_pairs=1, recall_every=1, seed=0, groups=2, scans=2)
        cli.check_least(self, town_length_m=100, num_processes=1, process_id=0)
        if self.hours is not None and not 0 < self.hours < math.inf:
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
        cli.select_device(config.device)
    from dpmjax.cli.train_run import Records, draw_sets, prepare_sources, run_training

    with together():
        first = None if config.weights is None else weights.load_model(config.weights)
        settings = training_settings(config, first)
        sources = training_sources(config, settings.sampling)
        folder = cli.open_run_folder(config, NAME) if is_first() else None
    with cli.recording(folder) if folder is not None else nullcontext(), cli.StopFlag() as stop:
        with together():
            # Of several processes, none may end alone.
            on_wait = stop.end_if_requested if config.coordinator is None else lambda: None
            drives = prepare_sources(sources, settings, config.cache, seed=config.seed, on_wait=on_wait)
            store = deeppointmap.ScanStore(drives)
            records = None
            if folder is not None:
                print(f"{len(store.table)} scans; {config.preset}: {settings.num_steps} steps at most")
                length_m = config.town_length_m
                sets = draw_sets(settings, config.held_out_pairs, config.validate, length_m=length_m, on_wait=on_wait)
                records = Records(folder, settings, sets, seed=config.seed, weights=first)
        hooks = deeppointmap.TrainingHooks(evaluate_every=config.recall_every, stop=lambda: stop.received or 0)
        plateau_s = plateau_seconds(config)
        trained = run_training(records, store, settings, hooks, seed=config.seed, plateau_s=plateau_s)
        if trained.stopped_by:
            stop.request(trained.stopped_by)
        bad = merged(store.bad)
        if folder is None or records is None:
            return
        # The evaluation takes minutes, which a stopped run does not have.
        evaluation = None if stop.is_requested else evaluate(trained, records)
        metrics = {
            **training_numbers(trained, records),
            **({} if evaluation is None else evaluation.numbers),
            "num_scans": len(store.table),
            "bad_scans": bad,
            "wall_s": time.perf_counter() - started,
            "status": stop.status,
            "seed": config.seed,
        }
        # Numbers first, so that they are written even if a picture fails.
        cli.write_metrics(folder, metrics)
        write_model(folder, trained.model, metrics, origin=f"{config.preset}, trained on {', '.join(config.data)}")
        draw_curves(folder)
        if evaluation is not None:
            draw_matches(folder, evaluation.trained, records.sets.held_out)
        print_summary(folder, metrics)


def training_sources(config: Config, sampling: deeppointmap.SamplingConfig) -> list[cli.Source]:
    """Returns the drives of --data; a drive of --validate or --data that has no pairs of scans raises a ValueError."""
    town = partial(simulation.simulate_drive, length_m=config.town_length_m, mixture=simulation.TRAINING_MIXTURE)
    towns = [partial(town, config.seed + number) for number in range(config.num_towns)]
    sources = cli.find_sources(config.data, towns, sampling)
    for path in config.validate:
        if (reason := deeppointmap.why_useless(io.open_lidar_sequence(path), sampling)) is not None:
            raise ValueError(f"--validate {path}: {reason}")
    return sources


def plateau_seconds(config: Config) -> float:
    """Returns the seconds of steps after which the learning rate falls; infinite where the steps decide."""
    if config.finish:
        return 0.0
    return math.inf if config.hours is None else 3600 * config.hours * (1 - deeppointmap.DECAY_RATIO)


def training_settings(config: Config, first: deeppointmap.Model | None = None) -> deeppointmap.TrainingConfig:
    """Returns the preset, with the options applied; the network is that of the first weights, if there are any."""
    import jax

    settings = deeppointmap.training_preset(config.preset)
    if first is not None:
        model = replace(first.config, calibration=None, overlap=None)
        settings = replace(settings, model=model, learning_rate=TUNING_SHARE * settings.learning_rate)
    if config.frame is not None:
        encoder = replace(settings.model.encoder, frame=config.frame)
        settings = replace(settings, model=replace(settings.model, encoder=encoder))
    stages = settings.curriculum
    if config.groups:
        num_steps = max(1, settings.num_steps // len(config.groups))
        stages = tuple(deeppointmap.CurriculumStage(group, num_steps) for group in config.groups)
    num_scans = config.scans or settings.sampling.num_scans
    settings = replace(settings, curriculum=stages, sampling=replace(settings.sampling, num_scans=num_scans))
    if jax.default_backend() != "cpu":
        settings = replace(settings, scans_at_once=num_scans)
    for part in config.without:
        settings = deeppointmap.without(settings, part)
    return settings if config.steps is None else settings.with_steps(config.steps)


class Measured(NamedTuple):
    """Evaluation of the trained network, and the numbers of both networks for `metrics.json`."""

    trained: deeppointmap.Evaluation
    numbers: dict[str, Any]


def training_numbers(trained: deeppointmap.Trained, records: Records) -> dict[str, Any]:
    """Returns steps, selection score and seconds for `metrics.json`."""
    return {
        "steps": int(trained.progress.state.step),
        "best_step": int(trained.progress.best_step) or None,
        "selection_score": float(trained.progress.best_score),
        "train_s": records.run_s,
        "compile_s": trained.speed.compile_s,
        "scans_per_s": trained.speed.scans_per_s,
    }


def evaluate(trained: deeppointmap.Trained, records: Records) -> Measured:
    """Returns recall and errors of the trained and of the untrained network."""
    from dpmjax.cli.train_run import KIND_NAMES

    pairs = records.sets.held_out
    models = {"": trained.model, "_untrained": records.untrained}
    evaluations = {
        suffix: deeppointmap.evaluate_registration(model, pairs)
        for suffix, model in tqdm(models.items(), desc="evaluate", unit=" networks", dynamic_ncols=True)
    }
    metrics: dict[str, Any] = {"num_held_out_pairs": len(pairs.pairs[0].sources)}
    for suffix, evaluation in evaluations.items():
        near = evaluation.recalls[0]
        of_kinds = zip(KIND_NAMES, evaluation.recalls, strict=True)
        metrics |= {f"{name}{suffix}": recall.recall for name, recall in of_kinds}
        metrics[f"translation_error_median{suffix}_m"] = float(np.median(near.translation_errors_m))
        metrics[f"rotation_error_median{suffix}_deg"] = float(np.median(near.rotation_errors_deg))
    return Measured(evaluations[""], metrics)


def write_model(folder: cli.RunFolder, model: deeppointmap.Model, metrics: dict[str, Any], *, origin: str) -> None:
    """Writes model.safetensors with a description of its training, which begins with the preset and the data."""
    best = "" if metrics["best_step"] is None else f" (best recall after {metrics['best_step']})"
    card = f"{origin} ({metrics['num_scans']} scans), {metrics['steps']} steps{best}, seed {metrics['seed']}. "
    if "recall" in metrics:
        card += (
            f"Held-out town, {metrics['num_held_out_pairs']} pairs 2-10 m apart, any yaw: recall (2 m, 5 deg) "
            f"{metrics['recall']:.3f}, untrained {metrics['recall_untrained']:.3f}."
        )
    else:
        card += "Stopped before its evaluation."
    unfinished = folder / f".tmp_{MODEL}"
    weights.save_model(model, unfinished, card=card)
    unfinished.replace(folder / MODEL)


def draw_curves(folder: cli.RunFolder) -> None:
    """Draws loss.png: losses and recalls over the steps."""
    rows = cli.read_history(folder / cli.HISTORY)
    if rows:
        curves = {name: np.array([float(row[name] or "nan") for row in rows]) for name in SHOWN_CURVES}
        curves = {name.replace("_", " "): curve for name, curve in curves.items() if np.isfinite(curve).any()}
        viz.save_figure(viz.curves_figure([int(row["step"]) for row in rows], curves), folder / "loss.png")


def draw_matches(
    folder: cli.RunFolder, evaluation: deeppointmap.Evaluation, pairs: deeppointmap.EvaluationPairs
) -> None:
    """Draws matches.png: of the pairs left out of the training, the one of the median error."""
    errors, of_kind = evaluation.recalls[0].translation_errors_m, pairs.pairs[0]
    number = int(np.argsort(errors)[len(errors) // 2])
    a, b = int(of_kind.sources[number, 0]), int(of_kind.targets[number, 0])
    matches, T_true = evaluation.matches[0], pairs.true_motions(of_kind)[number]
    is_inlier = matches.is_inlier[number]
    p = np.asarray(evaluation.clouds.positions[a])[matches.source_indices[number][is_inlier]]
    q = np.asarray(evaluation.clouds.positions[b])[matches.target_indices[number][is_inlier]]
    distances = np.linalg.norm(p @ T_true[:3, :3].T + T_true[:3, 3] - q, axis=1)
    title = f"Pair of scans left out of the training, the one of the median error ({errors[number]:.2f} m)\n"
    title += "right matches are less than 3 m apart under the true motion"
    motions = {"source moved by the estimated motion": np.asarray(matches.T_target_source[number], np.float64)}
    pair = viz.RegisteredPair(title, pairs.scan_points(a), pairs.scan_points(b), motions)
    viz.save_figure(viz.matches_figure(pair, p, q, distances < 3.0), folder / "matches.png")


def print_summary(folder: cli.RunFolder, metrics: dict[str, Any]) -> None:
    """Prints the recall, the scans that were left out, and the folder."""
    at = "" if metrics["best_step"] is None else f" (best, after step {metrics['best_step']})"
    if "recall" in metrics:
        print(f"recall on the held-out town {metrics['recall_untrained']:.2f} -> {metrics['recall']:.2f}{at}")
    else:
        print(f"stopped after step {metrics['steps']}{at}; not evaluated on the held-out town")
    bad = metrics["bad_scans"]
    if bad:
        print(f"{len(bad)} scans left out, all of them in {folder / cli.METRICS}:")
        for source, reason in list(bad.items())[:MAX_LISTED]:
            print(f"  {source}: {reason}")
    print(f"results in {folder.path}")
