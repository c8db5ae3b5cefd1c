"""Runs the benchmarks, each in a process of its own, and prints one table.

    python -m benchmarks
    python -m benchmarks --only core deepmapping --quick
    python -m benchmarks -o results.json

Compile time is a row of its own, never part of a run time. Compare numbers of one run only: machines differ, and so
does their load.
"""

from __future__ import annotations

import json
import sys
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from benchmarks import in_new_process, run_benchmark
from dpmjax.cli import format_table, parse_options
from dpmjax.io import write_atomically

# Modules, each with a function `run`.
Benchmark = Literal["core", "deepmapping", "deeppointmap", "pose_graph", "toy"]


@dataclass(frozen=True)
class Config:
    """Options of the benchmarks."""

    only: tuple[Benchmark, ...] = ()
    """Names of the benchmarks to run; all of them if none is given."""
    quick: tyro.conf.FlagCreatePairsOff[bool] = False
    """Smaller cases and fewer repeats: seconds instead of minutes."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """Also write the rows to this file, as JSON."""


def main(config: Config) -> int:
    """Runs the chosen benchmarks; returns 0, or 1 after a failure."""
    records: list[dict[str, Any]] = []
    machine: dict[str, Any] = {}
    failed: list[str] = []
    for name in config.only or get_args(Benchmark):
        print(f"running {name} ...", file=sys.stderr, flush=True)
        try:
            rows, machine = in_new_process(run_benchmark, name, config.quick)
        except Exception:
            traceback.print_exc()
            failed.append(name)
            continue
        records += [{"name": name, **row._asdict()} for row in rows]
    if records:
        versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
        print(f"{machine['cpu']}, {machine['num_cores']} cores; device {machine['device']}\n{versions}")
        print(format_table(records))
    if config.output is not None:
        report = {"environment": machine, "quick": config.quick, "failed": failed, "rows": records}
        write_atomically(config.output, json.dumps(report, indent=2) + "\n")
    if failed:
        print(f"benchmarks: failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        config = parse_options(Config, sys.argv[1:], prog="python -m benchmarks", description=__doc__)
    except ValueError as error:
        print(f"benchmarks: error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    raise SystemExit(main(config))
