"""Rows of `dpm_evaluate` beside the model's own: the search without a network, KISS-Matcher; pooled and as a table."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from dpmjax import cli, registration_recall
from dpmjax.deeppointmap import (
    VerificationConfig,
    choose_motion,
    draw_scan_pairs,
    measure_scan,
    read_scan_pairs,
    refine_motion,
)
from dpmjax.io import LidarSequence
from dpmjax.metrics import mcnemar_p_value, wilson_interval

# KISS-Matcher's voxels, metres; indoors is where half of the points are nearer than INDOORS_M.
VOXEL_M, INDOOR_VOXEL_M, INDOORS_M = 0.3, 0.2, 5.0
Matcher = Callable[[np.ndarray, np.ndarray], np.ndarray]


def kiss_matcher(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Returns `T_target_source` of KISS-Matcher (Lim et al. 2025)."""
    import kiss_matcher

    ranges = np.linalg.norm(np.concatenate([source, target]), axis=1)
    voxel_m = INDOOR_VOXEL_M if np.median(ranges) < INDOORS_M else VOXEL_M
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_m))
    found = matcher.estimate(list(source.astype(np.float32)), list(target.astype(np.float32)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found.rotation, np.ravel(found.translation)
    return T


def search_alone(source: np.ndarray, target: np.ndarray, config: VerificationConfig) -> np.ndarray:
    """Returns `T_target_source` by the search of `register` among the views from above, without a network."""
    measured = measure_scan(source, config), measure_scan(target, config)
    chosen = choose_motion(*measured, np.eye(4)[None], config)
    return refine_motion(*measured, chosen, config).T_target_source


def evaluate_matcher(
    matcher: Matcher, drive: LidarSequence, band: str, num_pairs: int, *, seed: int, on_pair: Callable[[], object]
) -> cli.Row:
    """Returns errors and seconds of another matcher on the same pairs."""
    motions, seconds, true = [], [], []
    for pair in read_scan_pairs(drive, draw_scan_pairs(drive, band, num_pairs, seed=seed), seed=seed):
        started = time.perf_counter()
        motions.append(matcher(pair.source, pair.target))
        seconds.append(time.perf_counter() - started)
        true.append(pair.T_target_source)
        on_pair()
    errors = registration_recall(np.reshape(motions, (-1, 4, 4)), np.reshape(true, (-1, 4, 4)))
    row = cli.error_columns(errors, "_refined")
    row["is_right"] = row.pop("is_right_refined")
    return row | ({"pair_s": float(np.median(seconds))} if seconds else {})


def table(rows: Sequence[cli.Row]) -> str:
    """Returns the rows as a Markdown table: one line a sequence and distance."""
    columns = (
        "sequence", "distance", "pairs", f"recall: {NETWORK}", VERIFIED, "the same, refined", f"{SEARCH}, refined",
        KISS, "median error: network alone", "refined", "s / pair", f"{KISS}, s", "overlap AUC",
    )  # fmt: skip
    by_case = {(row["method"], row["sequence"], row["band"]): row for row in rows}
    lines = []
    for (method, sequence, band), row in by_case.items():
        if method != "DeepPointMap" or band not in cli.BAND_NAMES or not row["num_pairs"]:
            continue
        kiss, search = (by_case.get((other, sequence, band), {}) for other in ("KISS-Matcher", "search"))
        auc = by_case.get(("overlap", sequence, "all"), {}).get("auc") if band == "near" else None
        recalls = (row[f"recall_{stage}"] for stage in ("descriptors", "verified", "refined"))
        others = (other.get("recall_refined") for other in (search, kiss))
        errors = (cli.length_text(row[f"median_error_{stage}_m"]) for stage in ("descriptors", "refined"))
        seconds = (row["pair_s"], kiss.get("pair_s"), cli.cell_text(auc, 3))
        lines.append([sequence, cli.BAND_NAMES[band], row["num_pairs"], *recalls, *others, *errors, *seconds])
    return cli.markdown(columns, lines)


NETWORK, VERIFIED = "network alone", "network, search and verification"
SEARCH, KISS = "search and verification, no network", "KISS-Matcher"
# The row and its entry that say which pairs a method has registered right.
_ANSWERS = {
    NETWORK: ("DeepPointMap", "is_right_descriptors"),
    VERIFIED: ("DeepPointMap", "is_right"),
    SEARCH: ("search", "is_right"),
    KISS: ("KISS-Matcher", "is_right"),
}
MONITORED = ("kitti_00_drive",)
"""Real drives whose recall was watched during the training of `dpm_small`: they are no unseen data."""


def pooled_rows(rows: Sequence[Mapping[str, Any]], drives: Sequence[str]) -> list[dict[str, Any]]:
    """Pools the rows of pairs over drives, with and without those that were watched during the training.

    Args:
        rows: rows of `dpm_evaluate`.
        drives: names of the drives to pool.

    Returns:
        One row for each set of drives, band and method that has registered all pairs of the set. `p_values` holds, by
        the name of another method, the p-value of the difference.
    """
    sets = {"all drives": list(drives)}
    unseen = [name for name in drives if name not in MONITORED]
    if len(unseen) < len(drives):
        sets[f"all drives but {', '.join(sorted(set(drives) - set(unseen)))}"] = unseen
    pooled: list[dict[str, Any]] = []
    for (title, names), band in itertools.product(sets.items(), cli.BAND_NAMES):
        answers = {method: _answers(rows, method, names, band) for method in _ANSWERS}
        known = {method: of_all for method, of_all in answers.items() if of_all is not None and len(of_all)}
        for method, is_right in known.items():
            share, low, high = wilson_interval(int(is_right.sum()), len(is_right))
            others = {name: mcnemar_p_value(is_right, other) for name, other in known.items() if name != method}
            numbers = {"num_pairs": len(is_right), "num_right": int(is_right.sum())}
            interval = {"recall": share, "recall_low": low, "recall_high": high}
            case = {"drives": title, "sequences": names, "band": band, "method": method}
            pooled.append({**case, **numbers, **interval, "p_values": others})
    return pooled


def _answers(rows: Sequence[Mapping[str, Any]], method: str, drives: Sequence[str], band: str) -> np.ndarray | None:
    """Returns which pairs of all drives are right; None where the method has not registered those of every drive."""
    name, entry = _ANSWERS[method]
    by_drive = {row["sequence"]: row for row in rows if row["method"] == name and row["band"] == band}
    if any(entry not in by_drive.get(drive, {}) for drive in drives):
        return None
    return np.concatenate([np.zeros(0, bool), *(np.asarray(by_drive[drive][entry], bool) for drive in drives)])


def pooled_table(pooled: Sequence[Mapping[str, Any]]) -> str:
    """Returns the pooled rows as Markdown; without any, an empty string."""
    if not pooled:
        return ""
    lines = []
    for row in pooled:
        p_values = "; ".join(f"{name} {_p_value(p)}" for name, p in row["p_values"].items())
        recall = f"{row['recall']:.3f} ({row['recall_low']:.3f} to {row['recall_high']:.3f})"
        numbers = (row["num_pairs"], row["method"], row["num_right"], recall)
        lines.append([row["drives"], cli.BAND_NAMES[row["band"]], *numbers, p_values or "-"])
    columns = ("pooled over", "distance", "pairs", "method", "right", "recall (95 % interval)")
    text = cli.markdown((*columns, "p against the other methods"), lines)
    notes = "Intervals: Wilson. p: McNemar's exact test, two-sided, on the same pairs."
    notes += " All motions but those of the network alone and of KISS-Matcher are refined."
    if watched := sorted({name for row in pooled for name in row["sequences"]} & set(MONITORED)):
        notes += f" The recall on {', '.join(watched)} was watched during the training: it is no unseen drive."
    return f"{text}\n\n{notes}"


def _p_value(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"
