"""The files of a training: models, curves, a picture of matches, and the summary."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dpmjax import deeppointmap, viz, weights
from dpmjax.cli.run import HISTORY, METRICS, Numbers, Run

if TYPE_CHECKING:
    from dpmjax.cli.train_run import Records

MODEL, LAST, BEST = "model.safetensors", "last.safetensors", "best.safetensors"
SHOWN_CURVES = ("loss", "pairing", "offset", "top1_accuracy", "recall", "recall_far", "overlap_loss")


def write_training(
    records: Records,
    trained: deeppointmap.Trained,
    evaluation: deeppointmap.Evaluation | None,
    metrics: Numbers,
    *,
    origin: str,
) -> None:
    """Writes all files of a run, numbers first, because a picture may fail."""
    from dpmjax.cli.train_run import with_params

    run, pairs = records.run, records.selection.pairs
    run.write_numbers(metrics)
    write_model(run / MODEL, trained.model, metrics, origin=origin)
    if metrics["best_step"] is not None and "registration" in metrics["trained"]:
        # The last model of the first stage stands beside the best, or the best beside the last.
        progress = trained.progress
        name, params = (BEST, progress.best_params) if records.takes_last else (LAST, progress.state.params)
        write_model(run / name, with_params(trained.model, params), metrics, origin=f"{name} of {origin}")
    draw_curves(run)
    if evaluation is not None and pairs is not None:
        draw_matches(run, evaluation, pairs)


def write_model(path: Path, model: deeppointmap.Model, metrics: Numbers, *, origin: str) -> None:
    """Writes a model with a description of its training; the preset and the data come first."""
    best = "" if metrics["best_step"] is None else f" (best recall after {metrics['best_step']})"
    card = f"{origin} ({metrics['num_scans']} scans), {metrics['steps']} steps{best}, seed {metrics['seed']}. "
    card += f"Trained: {', '.join(model.config.trained) or 'nothing to its end'}; chosen by {metrics['chosen_by']}. "
    if "recall" in metrics:
        card += (
            f"Held-out places, {metrics['num_held_out_pairs']} pairs 2-10 m apart, any yaw: recall (2 m, 5 deg) "
            f"{metrics['recall']:.3f}, before {metrics['recall_untrained']:.3f}."
        )
    else:
        card += "Not evaluated."
    unfinished = path.with_name(f".tmp_{path.name}")
    weights.save_model(model, unfinished, card=card)
    unfinished.replace(path)


def draw_curves(run: Run) -> None:
    """Draws loss.png: losses and recalls over the steps."""
    rows = run.read_table(HISTORY)
    if rows:
        curves = {name: np.array([float(row[name] or "nan") for row in rows]) for name in SHOWN_CURVES}
        curves = {name.replace("_", " "): curve for name, curve in curves.items() if np.isfinite(curve).any()}
        viz.save_figure(viz.curves_figure([int(row["step"]) for row in rows], curves), run / "loss.png")


def draw_matches(run: Run, evaluation: deeppointmap.Evaluation, pairs: deeppointmap.EvaluationPairs) -> None:
    """Draws matches.png: the held-out pair with the median error."""
    band = next(iter(pairs.pairs))
    errors = evaluation.recalls[band].translation_errors_m
    number = int(np.argsort(errors)[len(errors) // 2])
    a, b = pairs.pairs[band][number].tolist()
    matches, T_true = evaluation.matches[band], pairs.true_motions(band)[number]
    is_inlier = matches.is_inlier[number]
    p = np.asarray(evaluation.clouds.positions[a])[matches.source_indices[number][is_inlier]]
    q = np.asarray(evaluation.clouds.positions[b])[matches.target_indices[number][is_inlier]]
    distances = np.linalg.norm(p @ T_true[:3, :3].T + T_true[:3, 3] - q, axis=1)
    title = f"Pair of scans left out of the training, the one of the median error ({errors[number]:.2f} m)\n"
    title += "right matches are less than 3 m apart under the true motion"
    motions = {"source moved by the estimated motion": np.asarray(matches.T_target_source[number], np.float64)}
    source, target = (np.asarray(pairs.scans[row].points)[np.asarray(pairs.scans[row].mask)] for row in (a, b))
    pair = viz.RegisteredPair(title, source, target, motions)
    viz.save_figure(viz.matches_figure(pair, p, q, distances < 3.0), run / "matches.png")


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
