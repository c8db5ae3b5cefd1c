"""The tables of registered pairs, on a network that compiles in seconds."""

import numpy as np
import pytest
from scipy import stats

from dpmjax import deeppointmap, simulation
from dpmjax.cli.evaluate import summarize_pairs
from dpmjax.cli.run import EXIT_OK, load_json
from experiments import dpm_evaluate
from experiments.dpm_evaluate import MONITORED, compare_methods, pool_drives
from tests.deeppointmap import toy
from tests.experiments.running import read_rows, run

NUM_PAIRS, NUM_NETWORK, NUM_SEARCH = 30, 20, 25


@pytest.mark.slow
def test_evaluation_measures_every_pair_and_resumes(weights, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(simulation, "simulate_drive", lambda seed, **_: toy.drive(seed))
    monkeypatch.setattr("dpmjax.cli.why_not_importable", lambda _: "it is not installed")
    out = tmp_path / "out"
    arguments = ["town", "--weights", weights, "--pairs", 2, "--num-towns", 1, "--clouds", 32, "-o", out]
    assert run(dpm_evaluate, *arguments) == EXIT_OK
    assert "KISS-Matcher was not run: it is not installed." in capsys.readouterr().out
    rows, metrics = read_rows(out), load_json(out / "metrics.json")
    assert [row["band"] for row in rows] == [band for band in ("near", "middle", "far") for _ in range(2)]
    # Pairs far apart have no overlap, so other methods do not register them.
    assert [bool(row["search_right"] and row["clouds_32_right"]) for row in rows] == [True] * 4 + [False] * 2
    assert {row["band"] for row in metrics["table"]} == {"near", "middle"}
    for name in ("table.md", "pooled.md", "reliability.png"):
        assert (out / name).stat().st_size > 0
    monkeypatch.setattr(deeppointmap, "register_in_stages", None)
    monkeypatch.setattr(deeppointmap, "evaluate_overlap", None)
    assert run(dpm_evaluate, "--resume", "-o", out) == EXIT_OK
    assert read_rows(out) == rows


def rows_of(drive: str) -> list[dict]:
    """Rows of 30 pairs: all refined ones right, the first 20 by the network alone, the first 25 by the search."""
    return [
        {
            **{"drive": drive, "band": "near", "pair": pair, "refined_right": True, "refined_m": 0.1 * pair},
            **{"network_right": pair < NUM_NETWORK, "network_m": float(pair), "search_right": pair < NUM_SEARCH},
        }
        for pair in range(NUM_PAIRS)
    ]


def test_drives_are_pooled_with_and_without_those_that_were_watched() -> None:
    names, shares = ["a", MONITORED[0], "b"], ("network_right", "refined_right", "search_right")
    rows = [row for name in names for row in rows_of(name)]
    pooled = pool_drives([*rows, *rows_of("not recorded")], names)
    sets = list(dict.fromkeys(row["drives"] for row in pooled))
    assert [sum(row["drives"] == one for row in pooled) for one in sets] == [3 * NUM_PAIRS, 2 * NUM_PAIRS]
    assert MONITORED[0] in sets[1]
    # The search is right on all pairs but five a drive, which refined ones are right on, too.
    p_value = stats.binomtest(0, 15).pvalue
    assert f"search {p_value:.2g}" in compare_methods(pooled, shares)[0]
    assert len({row["drives"] for row in pool_drives(rows_of("a"), ["a"])}) == 1


def test_errors_are_medians_of_right_motions() -> None:
    far = [row | {"band": "far"} for row in rows_of("a")]
    rows, overlap = rows_of("a") + far, [{"drive": "a", "auc": 0.9}]
    (summary,) = summarize_pairs(rows, overlap)
    assert (summary["band"], summary["overlap_auc"]) == ("near", 0.9)
    assert summary["network_m"] == np.median(np.arange(NUM_NETWORK))
    assert summary["refined_m"] == pytest.approx(0.1 * np.median(np.arange(NUM_PAIRS)))
    assert summary["network_right"] == pytest.approx(NUM_NETWORK / NUM_PAIRS)
