"""Runs the benchmarks, each in a process of its own, and prints one table.

    python -m benchmarks
    python -m benchmarks --only core deepmapping --quick
    python -m benchmarks -o results.json

Compile time is a row of its own, never part of a run time. Compare numbers of one run only: machines differ, and so
does their load.
"""

from __future__ import annotations

import importlib
import json
import pkgutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

import benchmarks
from benchmarks.rows import COLUMNS, Row, format_table


@dataclass(frozen=True)
class Config:
    """Options of the benchmarks."""

    only: tuple[str, ...] = ()
    """Names of the benchmarks to run; all of them if none is given."""
    quick: tyro.conf.FlagCreatePairsOff[bool] = False
    """Smaller cases and fewer repeats: seconds instead of minutes."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """Also write the rows to this file, as JSON."""


def main(config: Config) -> int:
    """Runs the chosen benchmarks; returns 0, 1 after a failure, 2 for an unknown name."""
    modules = discover()
    unknown = sorted(set(config.only) - set(modules))
    if unknown:
        print(f"benchmarks: error: no benchmark {', '.join(unknown)}; there are {', '.join(modules)}", file=sys.stderr)
        return 2
    if config.output is not None and not config.output.absolute().parent.is_dir():
        print(f"benchmarks: error: there is no folder {config.output.absolute().parent}", file=sys.stderr)
        return 2
    named_rows: list[tuple[str, Row]] = []
    environment: dict[str, Any] = {}
    failed: list[str] = []
    for name in config.only or modules:
        print(f"running {name} ...", file=sys.stderr, flush=True)
        report = run_in_child(modules[name], config.quick)
        if report is None:
            failed.append(name)
            continue
        environment = report["environment"]
        named_rows += [(name, Row(*row)) for row in report["rows"]]
    if named_rows:
        print(describe(environment))
        print(format_table(named_rows))
    if config.output is not None:
        records = [dict(zip(COLUMNS, (name, *row), strict=True)) for name, row in named_rows]
        report = {"environment": environment, "quick": config.quick, "failed": failed, "rows": records}
        config.output.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    if failed:
        print(f"benchmarks: failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def discover() -> dict[str, str]:
    """Module of each benchmark by its name: the modules of this package that have a `NAME`."""
    found = {}
    for module in pkgutil.iter_modules(benchmarks.__path__):
        if module.name.startswith("_") or module.name == "child":
            continue
        path = f"benchmarks.{module.name}"
        name = getattr(importlib.import_module(path), "NAME", None)
        if name is not None:
            found[name] = path
    return found


def run_in_child(module: str, quick: bool) -> dict[str, Any] | None:
    """Runs one benchmark in a fresh process; None where it failed, with a message on stderr."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "rows.json"
        command = [sys.executable, "-m", "benchmarks.child", module, str(output), "quick" if quick else "full"]
        if subprocess.run(command, cwd=Path(__file__).parents[1]).returncode != 0:
            return None
        return json.loads(output.read_text(encoding="utf-8"))


def describe(environment: dict[str, Any]) -> str:
    """Machine and versions in two lines."""
    versions = ", ".join(f"{name} {version}" for name, version in environment["versions"].items())
    return f"{environment['cpu']}, {environment['num_cores']} cores; device {environment['device']}\n{versions}"


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Config, prog="python -m benchmarks", description=__doc__)))
