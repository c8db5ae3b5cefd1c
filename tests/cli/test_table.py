"""The table of an experiment: rows are computed once, and the counts of their summary are right."""

import os
import signal
from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from dpmjax import cli
from dpmjax.cli.run import load_json


@dataclass(frozen=True, kw_only=True)
class Options(cli.RunOptions):
    """Options of a toy."""

    may_change = frozenset({"limit"})

    limit: int = 3
    """Number of walks."""


def run(tmp_path, work, *arguments: str) -> int:
    def main(options: Options, run: cli.Run) -> dict:
        run.open()
        cases = [{"walk": walk, "method": method} for walk in range(options.limit) for method in ("a", "b")]
        summary = cli.summarize(cli.fill_table(run, cases, work), ("method",), ("ate_px", "success"))
        return cli.write_summary(run, summary)

    return cli.run_command(main, name="toy", description="Toy.", args=["-o", str(tmp_path / "out"), *arguments])


def row_of(walk: int, method: str) -> dict:
    return {"ate_px": walk + (0.5 if method == "a" else 0.25), "success": walk < 1, "note": "a, b"}


def test_rows_are_computed_once_and_a_killed_row_again(tmp_path) -> None:
    done = []

    def work(**case) -> dict:
        done.append(tuple(case.values()))
        return row_of(**case)

    assert run(tmp_path, work, "--limit", "1") == 0
    rows = tmp_path / "out" / "rows.csv"
    first = rows.read_text()
    rows.write_text(first + "1,a,1.5,Fal")
    assert run(tmp_path, work, "--limit", "2", "--resume") == 0
    assert done == [(0, "a"), (0, "b"), (1, "a"), (1, "b")]
    assert rows.read_text().startswith(first)
    assert len(rows.read_text().splitlines()) == 5
    table = load_json(tmp_path / "out" / "metrics.json")["table"]
    assert [(row["method"], row["num_rows"], row["ate_px"], row["success"]) for row in table] == [
        ("a", 2, 1.0, 0.5),
        ("b", 2, 0.75, 0.5),
    ]


def test_a_signal_keeps_the_rows_before_it(tmp_path) -> None:
    def work(walk: int, method: str) -> dict | None:
        if walk == 1:
            os.kill(os.getpid(), signal.SIGINT)
            return None
        return row_of(walk, method)

    assert run(tmp_path, work) == 130
    assert load_json(tmp_path / "out" / "metrics.json")["status"] == "interrupted"
    assert len((tmp_path / "out" / "rows.csv").read_text().splitlines()) == 3
    assert run(tmp_path, row_of, "--resume") == 0
    assert len((tmp_path / "out" / "rows.csv").read_text().splitlines()) == 7


def test_cells_have_their_values_again(tmp_path) -> None:
    values = {"text": "00", "count": 7, "share": 0.1, "small": 1e-9, "is_right": False, "none": None, "nan": np.nan}
    found = []

    def main(options: cli.RunOptions, run: cli.Run) -> dict:
        run.open()
        found.extend(cli.fill_table(run, [{"drive": "05"}], lambda drive: values))
        return {}

    assert cli.run_command(main, name="toy", description="Toy.", args=["-o", str(tmp_path / "out")]) == 0
    assert len(found[0].pop("commit")) > 6
    assert found == [{"drive": "05", **values, "nan": None}]


def test_summaries_are_medians_and_shares_with_their_intervals() -> None:
    rows = [{"group": "x", "error": error, "right": right} for error, right in ((1.0, True), (2.0, False), (9.0, True))]
    rows.append({"group": "x", "error": None, "right": None})
    (summary,) = cli.summarize(rows, ("group",), ("error", "right", "absent"))
    low, high = stats.binomtest(2, 3).proportion_ci(method="wilson")
    assert summary == {
        "group": "x", "num_rows": 4, "error": 2.0, "right": 2 / 3, "right_low": low, "right_high": high, "absent": None
    }  # fmt: skip
    lines = cli.format_table([summary]).splitlines()
    assert lines[0] == "| group | num_rows | error | right | absent |"
    assert lines[2] == f"| x | 4 | 2 | 0.67 ({low:.2f} to {high:.2f}) | - |"


@pytest.mark.parametrize("rows", [[], [{"group": "x", "error": None}]])
def test_nothing_to_summarize_is_a_dash(rows) -> None:
    summary = cli.summarize(rows, ("group",), ("error",))
    assert [row["error"] for row in summary] == [None] * len(rows)
    assert cli.format_table(summary).count("-") in (0, 10)
