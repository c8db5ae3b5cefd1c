"""Runs `dpmjax map2d` on the logs of some folders and on simulated corridors, and writes one table.

    python -m experiments.deepmapping_logs path/to/logs -o out
    python -m experiments.deepmapping_logs path/to/recordings --inits auto --corrected path/to/logs
    python -m experiments.deepmapping_logs path/to/logs path/to/scans.npz --corridors 100 101 102 --inits auto icp-plane

Each run keeps its own folder below OUT, with its pictures; a run that is finished already is not done again. A log that
has hand-checked relations beside it (aces.clf.gz, aces.relations) is measured by them too, and a recording by the log
of the same name in `--corrected`. A map is right where no scan is farther than half a metre from its reference pose.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from dpmjax.cli import EXIT_BAD_INPUT, METRICS, RunFolder, load_json, run_command, spans_of, write_metrics
from dpmjax.registration2d import DEEPMAPPING
from experiments._corridor_logs import write_corridor_log

EXPERIMENT = "deepmapping_logs"
ENDINGS = (".log", ".clf", ".log.gz", ".clf.gz", ".npz")
_RIGHT_M = 0.5


@dataclass(frozen=True)
class Config:
    """Options of the table."""

    logs: Positional[tuple[Path, ...]] = ()
    """Folders of .log or .clf files, plain or .gz, or of .npz arrays; or single files."""
    corridors: tuple[int, ...] = ()
    """Seeds of simulated corridors."""
    output: Annotated[Path, arg(aliases=["-o"], metavar="OUT")] = Path("results/deepmapping_logs")
    """Folder for the runs and metrics.json."""
    inits: tuple[str, ...] = ("odometry", "icp-plane", "global")
    """Starts to try."""
    corrected: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Folder of logs with corrected poses, which measure recordings of the same name at scans of the same time."""
    steps: int | None = None
    """Steps of each fit; without it, the preset decides."""
    seed: int = 0
    """Seed of every run."""


def main(config: Config) -> list[dict[str, Any]]:
    """Runs the missing rows and prints the table."""
    logs = [log for path in config.logs for log in ([path] if path.is_file() else logs_of(path))]
    made = config.output / "corridors"
    logs += [write_corridor_log(made / f"corridor{seed}.npz", seed) for seed in config.corridors]
    if not logs:
        raise ValueError("no log: name a folder of logs, a log, or --corridors")
    if len(names := {log.name.removesuffix(".gz") for log in logs}) < len(logs):
        raise ValueError(f"{len(logs)} logs have {len(names)} different names; a name has one row for each start")
    corrected = {} if config.corrected is None else {drive_of(log): log for log in logs_of(config.corrected)}
    rows: list[dict[str, Any]] = []
    for log, init in itertools.product(logs, config.inits):
        if (metrics := _run(log, init, corrected.get(drive_of(log)), config)) is not None:
            # A row has the commit of its own run, which may be an earlier one.
            rows.append({"log": log.name.removesuffix(".gz"), "init": init, **metrics})
            write_metrics(RunFolder(config.output, is_resumed=True), {}, seed=config.seed, rows=rows)
    print(markdown(rows), *trust_lines(rows), sep="\n")
    return rows


def logs_of(folder: Path) -> list[Path]:
    """Returns the logs of a folder, by name."""
    if not (logs := sorted(p for p in folder.glob("*") if p.name.endswith(ENDINGS))):
        raise ValueError(f"{folder}: no {', '.join(ENDINGS)} file there; name a folder of logs")
    return logs


def drive_of(log: Path) -> str:
    """Returns the name of a log without its endings."""
    return log.name.split(".")[0]


def _run(log: Path, init: str, corrected: Path | None, config: Config) -> dict[str, Any] | None:
    """Returns the metrics of one run, in a process with a peak memory of its own; None where the log lacks odometry."""
    folder = config.output / f"{log.name.removesuffix('.gz')}_{init}"
    if not (folder / METRICS).exists():
        command = [sys.executable, "-m", "dpmjax", "map2d", str(log), "-o", str(folder), "--force"]
        command += ["--init", init, "--seed", str(config.seed)]
        command += [] if config.steps is None else ["--steps", str(config.steps)]
        relations = log.with_name(drive_of(log) + ".relations")
        command += ["--relations", str(relations)] if relations.exists() else []
        command += [] if corrected in (None, log) else ["--corrected", str(corrected)]
        code = subprocess.run(command).returncode
        if code == EXIT_BAD_INPUT:
            return None
        if code != 0:
            raise RuntimeError(f"{log} from {init}: the run ended with exit code {code}")
    return load_json(folder / METRICS)


def is_right(row: dict[str, Any]) -> bool | None:
    """Returns True where no scan of the kept map is far from its reference; None without a reference."""
    return row["worst_scan_m"] < _RIGHT_M if "worst_scan_m" in row else None


def trust_lines(rows: list[dict[str, Any]]) -> list[str]:
    """Returns the shares of trusted maps that are right, and of right maps that are trusted."""
    known = [(is_right(row), row["assessment"]["is_trusted"]) for row in rows if is_right(row) is not None]
    both = sum(bool(right and trusted) for right, trusted in known)
    counts = (("trusted", "right", sum(t for _, t in known)), ("right", "trusted", sum(bool(r) for r, _ in known)))
    return [f"{both} of {count} maps that are {first} are {second}" for first, second, count in counts]


def markdown(rows: list[dict[str, Any]]) -> str:
    """Returns the table as Markdown; an empty cell is a number that the log has no reference for."""
    lines = [
        "| log | scans (registered) | start | ATE before, m | DeepMapping, m | ATE after, m | worst scan, m "
        "| relations before | relations after | kept | trusted | uncertain scans | s | GB |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        relations = (
            f"{row[f'relations{when}_m']:.3f} m, {row[f'relations{when}_deg']:.2f} deg" if "relations_m" in row else ""
            for when in ("_initial", "")
        )
        kind = "ate_corrected" if "ate_corrected_m" in row else "ate"
        fit = row["candidates"].get(DEEPMAPPING, {}).get("ate_m")
        ates = [row.get(f"{kind}_initial_m"), fit, row.get(f"{kind}_m"), row.get("worst_scan_m")]
        cells = (
            row["log"],
            f"{row['num_scans']} ({row['num_registered']})",
            row["init"],
            *("" if ate is None else f"{ate:.2f}" for ate in ates),
            *relations,
            row["kept"],
            "yes" if row["assessment"]["is_trusted"] else "no",
            ", ".join(spans_of(row["assessment"]["uncertain_scans"])),
            f"{row['wall_s']:.0f}",
            f"{row['peak_rss_gb']:.1f}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))
