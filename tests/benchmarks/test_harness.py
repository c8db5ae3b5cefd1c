"""The benchmark harness: compile time apart, one table, memory of each benchmark its own."""

import json
import time

import pytest

from benchmarks import measure
from tests.processes import run_python


def test_first_call_counts_as_compile_time():
    waits = iter([0.05, 0.01, 0.01, 0.01])
    timing = measure(lambda: time.sleep(next(waits)), repeats=3)
    assert timing.compile_s == pytest.approx(0.04, abs=0.02)
    assert 0.01 <= timing.min_s <= timing.median_s
    assert [row.metric for row in timing.rows("sleep")] == ["compile", "median", "min"]


def test_nothing_to_compile_is_never_negative():
    waits = iter([0.0, 0.1, 0.1])
    assert measure(lambda: time.sleep(next(waits)), repeats=2).compile_s == 0.0
    with pytest.raises(ValueError, match="repeats"):
        measure(lambda: None, repeats=0)


@pytest.mark.slow
def test_command_prints_a_table_and_writes_json(tmp_path):
    done = run_python("-m", "benchmarks", "--only", "core", "--quick", "-o", tmp_path / "rows.json")
    assert done.returncode == 0, done.stderr
    assert "cores" in done.stdout.splitlines()[0]
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert {row["metric"] for row in rows} == {"compile", "median", "min", "largest difference", "peak memory"}
    errors = {row["case"].split()[0]: row["value"] for row in rows if row["metric"] == "largest difference"}
    assert errors["weighted_svd"] < 1e-5
    assert errors["info_nce"] < 1e-4
    assert errors["chamfer"] < 1e-3
    (memory,) = (row for row in rows if row["metric"] == "peak memory")
    assert 0.05 < memory["value"] < 4.0


def test_unknown_benchmark_is_refused():
    done = run_python("-m", "benchmarks", "--only", "cores")
    assert done.returncode == 2
    assert done.stderr.startswith("benchmarks: error: ")
    assert "invalid choice 'cores'" in done.stderr
    assert done.stderr.count("\n") == 1
