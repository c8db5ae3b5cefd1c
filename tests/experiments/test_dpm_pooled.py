"""Rows of the pairs of all drives together."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from experiments.dpm_evaluate import (
    CLOUDS,
    KISS,
    MONITORED,
    NETWORK,
    SEARCH,
    VERIFIED,
    cloud_tables,
    pooled_rows,
    pooled_table,
    table,
)

NUM_PAIRS, NUM_NETWORK, NUM_SEARCH = 30, 20, 25


def rows_of(drive: str, *, with_kiss: bool = True) -> list[dict[str, Any]]:
    """Rows of 30 pairs: all verified, the first 20 by the network alone, the first 25 by the search, none by KISS."""
    number = np.arange(NUM_PAIRS)
    case = {"sequence": drive, "band": "near", "num_pairs": NUM_PAIRS}
    stages = {f"recall_{stage}": 0.5 for stage in ("descriptors", "verified", "refined")}
    errors = {f"median_error_{stage}_m": 0.1 for stage in ("descriptors", "refined")}
    ours = {"is_right_descriptors": (number < NUM_NETWORK).tolist(), "is_right": [True] * NUM_PAIRS}
    rows = [
        {"method": "DeepPointMap", **case, **ours, **stages, **errors, "pair_s": 0.2},
        {"method": "search", **case, "is_right": (number < NUM_SEARCH).tolist(), "recall_refined": 0.83},
    ]
    if with_kiss:
        kiss = {"is_right": [False] * NUM_PAIRS, "recall_refined": 0.0, "pair_s": 0.6}
        rows.append({"method": "KISS-Matcher", **case, **kiss})
    return rows


def test_drives_are_pooled_with_and_without_those_that_were_watched() -> None:
    names = ["a", MONITORED[0], "b"]
    pooled = pooled_rows([row for name in names for row in rows_of(name)], names)
    by_case = {(row["drives"], row["method"]): row for row in pooled}
    unseen = f"all drives but {MONITORED[0]}"
    assert set(by_case) == {(title, m) for title in ("all drives", unseen) for m in (NETWORK, VERIFIED, SEARCH, KISS)}
    for title, num_drives in (("all drives", 3), (unseen, 2)):
        network = by_case[title, NETWORK]
        assert (network["num_right"], network["num_pairs"]) == (NUM_NETWORK * num_drives, NUM_PAIRS * num_drives)
        interval = stats.binomtest(network["num_right"], network["num_pairs"]).proportion_ci(method="wilson")
        assert (network["recall_low"], network["recall_high"]) == pytest.approx(interval)
        # The search is right on all pairs of the network and on five more a drive.
        assert network["p_values"][SEARCH] == pytest.approx(0.5 ** (5 * num_drives - 1))
        assert by_case[title, SEARCH]["p_values"][NETWORK] == network["p_values"][SEARCH]


def test_a_method_that_left_out_a_drive_is_not_pooled() -> None:
    pooled = pooled_rows([*rows_of("a"), *rows_of("b", with_kiss=False)], ["a", "b"])
    assert [row["method"] for row in pooled] == [NETWORK, VERIFIED, SEARCH]
    assert pooled_rows([], ["a"]) == []
    assert pooled_table([]) == ""


def test_the_table_names_every_method_alone() -> None:
    text = table(rows_of("a"))
    header, _, line = text.splitlines()
    for name in (NETWORK, VERIFIED, SEARCH, KISS):
        assert name in header
    assert line.startswith("| a | 2-10 m | 30 | 0.50 | 0.50 | 0.50 | 0.83 | 0.00 |")


def test_the_pooled_table_names_the_drives_that_were_watched() -> None:
    seen = pooled_table(pooled_rows(rows_of(MONITORED[0]), [MONITORED[0]]))
    assert f"{MONITORED[0]} was watched during the training" in seen
    assert f"| {NETWORK} | 20 | 0.667 (0.488 to 0.808) |" in seen
    assert f"{KISS} < 0.001" in seen
    assert "watched" not in pooled_table(pooled_rows(rows_of("a"), ["a"]))


def test_clouds_have_a_row_for_each_number_of_elements() -> None:
    row = {"method": f"{CLOUDS}512", "sequence": "street", "band": "near", "num_pairs": 20}
    row |= {"recall_refined": 0.0, "median_error_refined_m": None}
    lines = cloud_tables([*rows_of("street"), row, row | {"num_pairs": 0}]).splitlines()
    assert lines[2:] == ["| street | 2-10 m | 512 | 20 | 0.00 | - |"]
    assert cloud_tables(rows_of("street")) == ""
