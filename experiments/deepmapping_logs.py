"""Runs deepmapping_2d on every CARMEN log of a folder, from ICP and from raw odometry, and writes one table.

    python -m experiments.deepmapping_logs path/to/logs -o out

Each run keeps its own folder below OUT, with its pictures; a run that is finished already is not done again.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from experiments._command import run_command
from experiments._json import load_json
from experiments._run_folder import METRICS, RunFolder, write_metrics

EXPERIMENT = "deepmapping_logs"
_BAD_INPUT = 2


@dataclass(frozen=True)
class Config:
    """Options of the table."""

    logs: Positional[Path]
    """Folder of .log, .log.gz or .clf files."""
    output: Annotated[Path, arg(aliases=["-o"], metavar="OUT")] = Path("results/deepmapping_logs")
    """Folder for the runs and metrics.json."""
    inits: tuple[str, ...] = ("icp-plane", "odometry")
    """Starts to try."""
    steps: int | None = None
    """Steps of each fit; without it, the preset decides."""
    seed: int = 0
    """Seed of every run."""


def main(config: Config) -> list[dict[str, Any]]:
    """Runs what is missing and prints the table."""
    logs = sorted(p for p in config.logs.glob("*") if p.name.endswith((".log", ".log.gz", ".clf")))
    if not logs:
        raise ValueError(f"{config.logs}: no .log, .log.gz or .clf file there; name a folder of CARMEN logs")
    rows = []
    for log in logs:
        for init in config.inits:
            metrics = _run(log, init, config)
            if metrics is not None:
                # A row has the commit of its own run, which may be an earlier one.
                rows.append({"log": log.name.split(".")[0], "init": init, **metrics})
                write_metrics(RunFolder(config.output, is_resumed=True), {}, seed=config.seed, rows=rows)
    print(markdown(rows))
    return rows


def _run(log: Path, init: str, config: Config) -> dict[str, Any] | None:
    """Metrics of one run in a process of its own, whose peak memory is its own; None where the log lacks odometry."""
    folder = config.output / f"{log.name.split('.')[0]}_{init}"
    if not (folder / METRICS).exists():
        command = [sys.executable, "-m", "experiments.deepmapping_2d", str(log), "-o", str(folder), "--force"]
        command += ["--init", init, "--seed", str(config.seed)]
        command += [] if config.steps is None else ["--steps", str(config.steps)]
        code = subprocess.run(command).returncode
        if code == _BAD_INPUT:
            return None
        if code != 0:
            raise RuntimeError(f"{log} from {init}: the run ended with exit code {code}")
    return load_json(folder / METRICS)


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table as README text."""
    lines = ["| log | scans | start | ATE before, m | ATE after, m | kept |", "|---|---|---|---|---|---|"]
    for row in rows:
        before, after = row["ate_initial_m"], row["ate_m"]
        lines.append(
            f"| {row['log']} | {row['num_scans']} | {row['init']} | {before:.2f} | {after:.2f} | {row['kept']} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, experiment=EXPERIMENT, description=__doc__))
