"""Rows of `dpm_evaluate` for the pairs of all drives together: the 30 pairs of one drive cannot tell methods apart.

Every method registers the same pairs. Each share has a 95 % interval (Wilson), and methods are compared by McNemar's
exact test on the pairs that one of the two registers right. Pairs of one drive resemble each other, so the true
uncertainty of other drives is larger than these numbers say.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dpmjax.cli import BAND_NAMES
from dpmjax.metrics import mcnemar_p_value, wilson_interval

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
        rows: of `dpm_evaluate`.
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
    for (title, names), band in itertools.product(sets.items(), BAND_NAMES):
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
    lines = [
        "| pooled over | distance | pairs | method | right | recall (95 % interval) | p against the other methods |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in pooled:
        p_values = "; ".join(f"{name} {_p_value(p)}" for name, p in row["p_values"].items())
        lines.append(
            f"| {row['drives']} | {BAND_NAMES[row['band']]} | {row['num_pairs']} | {row['method']} "
            f"| {row['num_right']} | {row['recall']:.3f} ({row['recall_low']:.3f} to {row['recall_high']:.3f}) "
            f"| {p_values or '-'} |"
        )
    notes = "Intervals: Wilson. p: McNemar's exact test, two-sided, on the same pairs."
    notes += " All motions but those of the network alone and of KISS-Matcher are refined."
    if watched := sorted({name for row in pooled for name in row["sequences"]} & set(MONITORED)):
        notes += f" The recall on {', '.join(watched)} was watched during the training: it is no unseen drive."
    return "\n".join([*lines, "", notes])


def _p_value(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"
