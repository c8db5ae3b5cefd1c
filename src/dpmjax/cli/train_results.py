"""The results of a training: recall on held-out pairs, the model file, pictures, the summary."""

from __future__ import annotations

from typing import Any

import numpy as np

from dpmjax import viz
from dpmjax.cli.result_files import read_history
from dpmjax.cli.run_folder import HISTORY, METRICS, RunFolder
from dpmjax.cli.train_run import KIND_NAMES, Records
from dpmjax.deeppointmap import Evaluation, EvaluationPairs, Model, Trained, evaluate_registration
from dpmjax.weights import save_model

MODEL = "model.safetensors"
# More bad scans than this are counted only.
MAX_LISTED = 10
SHOWN_CURVES = ("loss", "pairing", "offset", "top1_accuracy", "recall", "recall_far", "real_recall")


def measure(trained: Trained, records: Records) -> tuple[Evaluation, dict[str, Any]]:
    """Returns recall and errors of the trained and of the untrained network, and times."""
    pairs = records.sets.held_out
    models = {"": trained.model, "_untrained": records.untrained}
    evaluations = {suffix: evaluate_registration(model, pairs) for suffix, model in models.items()}
    metrics: dict[str, Any] = {
        "num_held_out_pairs": len(pairs.pairs[0].sources),
        "steps": int(trained.progress.state.step),
        "best_step": int(trained.progress.best_step) or None,
        "selection_score": float(trained.progress.best_score),
        "train_s": records.run_s,
        "compile_s": trained.speed.compile_s,
        "scans_per_s": trained.speed.scans_per_s,
    }
    for suffix, evaluation in evaluations.items():
        near = evaluation.recalls[0]
        of_kinds = zip(KIND_NAMES, evaluation.recalls, strict=True)
        metrics |= {f"{name}{suffix}": recall.recall for name, recall in of_kinds}
        metrics |= {
            f"translation_error_median{suffix}_m": float(np.median(near.translation_errors_m)),
            f"rotation_error_median{suffix}_deg": float(np.median(near.rotation_errors_deg)),
        }
    return evaluations[""], metrics


def write_model(folder: RunFolder, model: Model, metrics: dict[str, Any], *, origin: str) -> None:
    """Writes model.safetensors with a description of its training, which begins with the preset and the data."""
    best = "" if metrics["best_step"] is None else f" (best recall after {metrics['best_step']})"
    card = (
        f"{origin} ({metrics['num_scans']} scans), "
        f"{metrics['steps']} steps{best}, seed {metrics['seed']}. Held-out town, {metrics['num_held_out_pairs']} pairs "
        f"2-10 m apart, any yaw: recall (2 m, 5 deg) {metrics['recall']:.3f}, "
        f"untrained {metrics['recall_untrained']:.3f}."
    )
    unfinished = folder / f".tmp_{MODEL}"
    save_model(model, unfinished, card=card)
    unfinished.replace(folder / MODEL)


def draw(folder: RunFolder, evaluation: Evaluation, pairs: EvaluationPairs) -> None:
    """Draws loss.png and matches.png."""
    rows = read_history(folder / HISTORY)
    if rows:
        names = {name: name.replace("_", " ") for name in SHOWN_CURVES}
        curves = {label: np.array([float(row[name] or "nan") for row in rows]) for name, label in names.items()}
        curves = {label: curve for label, curve in curves.items() if np.isfinite(curve).any()}
        steps = [int(row["step"]) for row in rows]
        viz.save_figure(viz.curves_figure(steps, curves), folder / "loss.png")
    # The held-out pair of scans of median error.
    errors, of_kind = evaluation.recalls[0].translation_errors_m, pairs.pairs[0]
    number = int(np.argsort(errors)[len(errors) // 2])
    a, b = int(of_kind.sources[number, 0]), int(of_kind.targets[number, 0])
    matches, T_true = evaluation.matches[0], pairs.true_motions(of_kind)[number]
    is_inlier = matches.is_inlier[number]
    p = np.asarray(evaluation.clouds.positions[a])[matches.source_indices[number][is_inlier]]
    q = np.asarray(evaluation.clouds.positions[b])[matches.target_indices[number][is_inlier]]
    distances = np.linalg.norm(p @ T_true[:3, :3].T + T_true[:3, 3] - q, axis=1)
    title = f"held-out pair of median error, {errors[number]:.2f} m; green: matches less than 3 m apart"
    scans = viz.MatchedScans(pairs.scan_points(a), pairs.scan_points(b), p, q, distances < 3.0)
    viz.save_figure(viz.matches_figure(scans, matches.T_target_source[number], title=title), folder / "matches.png")


def print_summary(folder: RunFolder, metrics: dict[str, Any]) -> None:
    """Prints the recall, the scans that were left out, and the folder."""
    at = "" if metrics["best_step"] is None else f" (best, after step {metrics['best_step']})"
    print(f"recall on the held-out town {metrics['recall_untrained']:.2f} -> {metrics['recall']:.2f}{at}")
    bad = metrics["bad_scans"]
    if bad:
        print(f"{len(bad)} scans left out, all of them in {folder / METRICS}:")
        for source, reason in list(bad.items())[:MAX_LISTED]:
            print(f"  {source}: {reason}")
    print(f"results in {folder.path}")
