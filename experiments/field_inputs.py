"""Runs a command on each of some real inputs that once failed, and writes one row an input: before, after, right value.

    python -m experiments.field_inputs DATA -o out                    DATA holds the folders field_2d and field_3d
    python -m experiments.field_inputs DATA --only CSAIL.g2o w100.graph

Results go to results/field_inputs/<time>/: table.md, metrics.json, and a file for each row; --resume makes the missing
rows.
"""

from __future__ import annotations

import csv
import functools
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli

EXPERIMENT = "field_inputs"


def read_cases() -> dict[tuple[str, str], dict[str, str]]:
    """Reads the inputs by their file or folder below DATA and the words of their command; each {} is that path.

    Returns:
        `before` and `right`: the result when the input was tried first, and the right one. `keys`: the numbers of
        metrics.json that are the result; none: the input is refused, and the message is.
    """
    with Path(__file__).with_suffix(".csv").open(newline="", encoding="utf-8") as file:
        return {(case["data"], case["command"]): case for case in csv.DictReader(file)}


CASES = read_cases()


@dataclass(frozen=True, kw_only=True)
class Config(cli.RunOptions):
    """Options of the table."""

    data: Annotated[Positional[Path], arg(metavar="DATA")]
    """Folder with field_2d and field_3d."""
    only: tuple[str, ...] = ()
    """Names of inputs to run; without them, all."""

    def __post_init__(self) -> None:
        """Checks the folder."""
        if not self.data.is_dir():
            raise ValueError(f"{self.data}: no such folder; give the one that holds field_2d and field_3d")


def main(config: Config) -> list[cli.Row]:
    """Runs the missing rows and writes the table."""
    chosen = (case for case in CASES if not config.only or Path(case[0]).name in config.only)
    named = [{"data": data, "command": command} for data, command in chosen]
    return cli.run_table(config, EXPERIMENT, named, functools.partial(_run, config=config), report)


def report(rows: list[cli.Row]) -> cli.Summary:
    """Adds the results of before and the right ones."""
    cases = [CASES[row["data"], row["command"]] for row in rows]
    compared = [row | {name: case[name] for name in ("before", "right")} for row, case in zip(rows, cases, strict=True)]
    return cli.Summary({}, table_of(compared), rows=compared)


def _run(table: cli.TableRun, data: str, command: str, *, config: Config) -> cli.Row:
    """Returns the exit code, the seconds, the message and the numbers of a run."""
    table.check_stop()
    keys = CASES[data, command]["keys"].split()
    words, started = command.format(*(2 * [str(config.data / data)])).split(), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        ended = subprocess.run([sys.executable, "-m", "dpmjax", *words, "-o", folder], capture_output=True, text=True)
        path = Path(folder) / cli.METRICS
        metrics = cli.load_json(path) if path.exists() else {}
        if "turned_deg" in keys and metrics:
            metrics["turned_deg"] = _turned_deg(np.load(path.with_name("trajectory.npy")))
    # Rows tell nothing about the machine.
    metrics = json.loads(json.dumps(metrics).replace(f"{config.data}/", ""))
    last = ended.stderr.strip().splitlines()[-1:] if ended.returncode else []
    return {
        "exit_code": ended.returncode,
        "wall_s": time.perf_counter() - started,
        "message": "".join(last).replace(str(config.data) + "/", ""),
        "numbers": {key: value for key in keys if (value := _value(metrics, key)) is not None},
    }


def _turned_deg(T: np.ndarray) -> float:
    """Returns the largest angle between a pose and the first one."""
    cosines = (np.einsum("ij,nij->n", T[0, :3, :3], T[:, :3, :3]) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).max())


def _value(metrics: cli.Row, key: str) -> Any:
    """Returns a number by its path, with dots between the names; None where it is missing."""
    names = key.split(".")
    return functools.reduce(lambda found, name: found.get(name) if isinstance(found, dict) else None, names, metrics)


def table_of(rows: list[cli.Row]) -> str:
    """Returns the table as Markdown: of a refused input the message, of others the numbers."""
    lines = []
    for row in rows:
        numbers = ", ".join(f"{name.split('.')[-1]} {_text(value)}" for name, value in row["numbers"].items())
        now = f"exit code {row['exit_code']}: {row['message']}" if row["exit_code"] else numbers
        command = " ".join(row["command"].replace("{}/", "").replace("{}", "").split())
        cells = row["data"], command, row["before"], now, row["right"], f"{row['wall_s']:.0f}"
        lines.append([cell.replace("|", "/") for cell in cells])
    return cli.markdown(("input", "command", "before", "now", "right", "s"), lines)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return "; ".join(value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
