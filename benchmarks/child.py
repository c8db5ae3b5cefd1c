"""Runs one benchmark in this process, so that its peak memory is its own. `python -m benchmarks` starts it."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

from benchmarks.rows import Row
from dpmjax.cli import environment, peak_rss_gb


def main(module: str, output: str, effort: str) -> None:
    """Runs the benchmark of `module` and writes rows and environment to `output` as JSON."""
    rows = importlib.import_module(module).run(quick=effort == "quick")
    rows = [*rows, Row("whole process", "peak memory", peak_rss_gb(), "GB")]
    Path(output).write_text(json.dumps({"rows": rows, "environment": environment()}, allow_nan=True), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
