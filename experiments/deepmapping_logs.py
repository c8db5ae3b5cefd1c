"""Runs `dpmjax map2d` on the logs of some folders, and writes one table.

    python -m experiments.deepmapping_logs path/to/logs -o out
    python -m experiments.deepmapping_logs path/to/recordings --inits auto --corrected path/to/logs

Each run keeps its own folder below OUT/drives, with its pictures; --resume makes the missing rows. A log that has
hand-checked relations beside it (aces.clf.gz, aces.relations) is measured by them too, and a recording by the log of
the same name in `--corrected`. A map is right where no scan is farther than half a metre from its reference pose.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, io, metrics
from dpmjax.slam import DEEPMAPPING, START_NAMES

ENDINGS = (".log", ".clf", ".log.gz", ".clf.gz", ".npz")
RIGHT_M = 0.5
# Numbers of a run in rows.csv and in the table.
NUMBERS = (
    "num_scans", "num_registered", "ate_initial_m", "ate_m", "worst_scan_m", "relations_initial_m",
    "relations_initial_deg", "relations_m", "relations_deg", "ate_corrected_initial_m", "ate_corrected_m", "kept",
    "wall_s", "peak_rss_gb",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class LogOptions(cli.RunOptions):
    """Options of the table."""

    may_change: ClassVar[frozenset[str]] = frozenset({"logs", "inits"})

    logs: Positional[tuple[Path, ...]] = ()
    """Folders of .log or .clf files, plain or .gz, or of .npz arrays; or single files."""
    inits: tuple[str, ...] = ("odometry", "icp-plane", "global")
    """Starts to try."""
    corrected: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Folder of logs with corrected poses, which measure recordings of the same name at scans of the same time."""
    steps: int | None = None
    """Steps of each fit; without it, the preset decides."""


def main(options: LogOptions, run: cli.Run) -> cli.Row:
    """Runs the missing rows and writes the table."""
    logs = [log for path in options.logs for log in ([path] if path.is_file() else list_logs(path))]
    by_name = {log.name.removesuffix(".gz"): log for log in logs}
    if len(by_name) < len(logs):
        raise ValueError(f"{len(logs)} logs have {len(by_name)} different names; a name has one row for each start")
    if not by_name:
        raise ValueError("no log: name a folder of logs, or a log")
    cli.check_names("--inits", options.inits, ("auto", *START_NAMES))
    corrected = {} if options.corrected is None else {name_drive(log): log for log in list_logs(options.corrected)}
    run.open()

    def work(log: str, init: str) -> cli.Row | None:
        path, folder = by_name[log], run / "drives" / f"{log}_{init}"
        folder.mkdir(parents=True, exist_ok=True)
        code = map_log(path, folder, init, options)
        if run.is_stopped:
            return None
        if code not in (0, cli.EXIT_BAD_INPUT):
            raise RuntimeError(f"{log} from {init}: the run ended with exit code {code}")
        return row_of({} if code else measure_run(folder, path, corrected.get(name_drive(path))))

    cases = [{"log": name, "init": init} for name, init in itertools.product(by_name, options.inits)]
    rows = cli.fill_table(run, cases, work)
    done = [row for row in rows if row["num_scans"] is not None]
    if rows and not done:
        raise ValueError("every run was refused, for the reasons above")
    refused = [f"Refused: {row['log']} from {row['init']}." for row in rows if row["num_scans"] is None]
    columns = ("trusted", "right", "right_if_trusted", "trusted_if_right")
    shares = cli.format_table(cli.summarize([row | {"trust": "all"} for row in done], ("trust",), columns))
    summary = [{name: row[name] for name in ("log", "init", *NUMBERS, *columns[:2])} for row in done]
    return cli.write_summary(run, summary, shares, *refused)


def list_logs(folder: Path) -> list[Path]:
    """Returns the logs of a folder, by name."""
    if not (logs := sorted(path for path in folder.glob("*") if path.name.endswith(ENDINGS))):
        raise ValueError(f"{folder}: no {', '.join(ENDINGS)} file there; name a folder of logs")
    return logs


def name_drive(log: Path) -> str:
    """Returns the name of a log without its endings."""
    return log.name.split(".")[0]


def map_log(log: Path, folder: Path, init: str, options: LogOptions) -> int:
    """Maps a log in a process with a peak memory of its own; returns its exit code, 2 where it lacks odometry."""
    command = [sys.executable, "-m", "dpmjax", "map2d", str(log), "-o", str(folder), "--force"]
    command += ["--init", init, "--seed", str(options.seed)]
    command += [] if options.steps is None else ["--steps", str(options.steps)]
    return subprocess.run(command).returncode


def measure_run(folder: Path, log: Path, corrected: Path | None) -> cli.Row:
    """Returns the numbers of a run, with errors of its start and its end against hand-checked relations of the log and
    against a corrected log.
    """
    numbers = cli.load_json(folder / cli.METRICS)
    relations = log.with_name(name_drive(log) + ".relations")
    for name, suffix in (("start", "_initial"), ("trajectory", "")):
        times, poses = np.loadtxt(folder / f"{name}_tum.txt")[:, 0], np.load(folder / f"{name}.npy")
        if relations.exists():
            errors = metrics.relation_errors(io.read_relations(relations), times, poses)
            numbers[f"relations{suffix}_m"] = float(errors.translation_m.mean())
            numbers[f"relations{suffix}_deg"] = float(errors.rotation_deg.mean())
        if corrected not in (None, log):
            numbers[f"ate_corrected{suffix}_m"] = metrics.corrected_ate(times, poses, io.read_sequence(corrected))
    return numbers


def row_of(numbers: cli.Row) -> cli.Row:
    """Returns the row of a run; cells are None for what its log has no reference for, all of a run that was refused."""
    assessment, worst_m = numbers.get("assessment", {}), numbers.get("worst_scan_m")
    trusted, right = assessment.get("is_trusted"), None if worst_m is None else worst_m < RIGHT_M
    return {
        **{name: numbers.get(name) for name in NUMBERS},
        "deepmapping_ate_m": numbers.get("candidates", {}).get(DEEPMAPPING, {}).get("ate_m"),
        "trusted": trusted,
        "right": right,
        "right_if_trusted": right if trusted else None,
        "trusted_if_right": trusted if right else None,
        "uncertain_scans": " ".join(cli.spans_of(assessment.get("uncertain_scans", ()))),
    }


if __name__ == "__main__":
    cli.run_experiment(main)
