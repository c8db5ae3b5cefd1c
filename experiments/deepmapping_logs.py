"""Runs `dpmjax map2d` on the logs of some folders and on simulated corridors, and writes one table.

    python -m experiments.deepmapping_logs path/to/logs -o out
    python -m experiments.deepmapping_logs path/to/recordings --inits auto --corrected path/to/logs
    python -m experiments.deepmapping_logs path/to/logs path/to/scans.npz --corridors 100 101 102 --inits auto icp-plane

Each run keeps its own folder below OUT/drives, with its pictures; --resume makes the missing rows. A log that has
hand-checked relations beside it (aces.clf.gz, aces.relations) is measured by them too, and a recording by the log of
the same name in `--corrected`. A map is right where no scan is farther than half a metre from its reference pose. In a
simulated corridor niches and rooms lie far apart, and the lidar sees a half-circle of short reach.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli
from dpmjax.geometry import se2
from dpmjax.registration2d import DEEPMAPPING, START_NAMES
from dpmjax.simulation import scan_world, simulate_odometry

EXPERIMENT = "deepmapping_logs"
ENDINGS = (".log", ".clf", ".log.gz", ".clf.gz", ".npz")
COLUMNS = (
    "log", "scans (registered)", "start", "ATE before, m", "DeepMapping, m", "ATE after, m", "worst scan, m",
    "relations before", "relations after", "kept", "trusted", "uncertain scans", "s", "GB",
)  # fmt: skip
_RIGHT_M = 0.5
# Simulated corridors.
METRES_A_PX = 0.05
_LENGTH_PX, _HEIGHT_PX, _WIDTH_PX = 1600, 600, 60
_REACH_PX, _RANGE_NOISE_PX, _NUM_BEAMS = 160.0, 0.6, 360
_NUM_SCANS = 60
# Share of the sections with a niche or a room, and the lengths of sections.
_ROOM_SHARE, _SECTION_PX = 0.35, (60, 320)


@dataclass(frozen=True, kw_only=True)
class Config(cli.RunOptions):
    """Options of the table."""

    may_change: ClassVar[frozenset[str]] = frozenset({"logs", "corridors", "inits"})

    logs: Positional[tuple[Path, ...]] = ()
    """Folders of .log or .clf files, plain or .gz, or of .npz arrays; or single files."""
    corridors: tuple[int, ...] = ()
    """Seeds of simulated corridors."""
    inits: tuple[str, ...] = ("odometry", "icp-plane", "global")
    """Starts to try."""
    corrected: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Folder of logs with corrected poses, which measure recordings of the same name at scans of the same time."""
    steps: int | None = None
    """Steps of each fit; without it, the preset decides."""


def main(config: Config) -> list[cli.Row]:
    """Runs the missing rows and writes the table."""
    logs = [log for path in config.logs for log in ([path] if path.is_file() else logs_of(path))]
    names = [_name(log) for log in logs] + [f"corridor{seed}.npz" for seed in config.corridors]
    if not names:
        raise ValueError("no log: name a folder of logs, a log, or --corridors")
    if len(set(names)) < len(names):
        raise ValueError(f"{len(names)} logs have {len(set(names))} different names; a name has one row for each start")
    cli.check_names("--inits", config.inits, ("auto", *START_NAMES))
    corrected = {} if config.corrected is None else {drive_of(log): log for log in logs_of(config.corrected)}
    by_name: dict[str, Path | int] = dict(zip(names, (*logs, *config.corridors), strict=True))

    def work(run: cli.TableRun, log: str, init: str) -> cli.Row:
        path = by_name[log]
        if isinstance(path, int):
            path = write_corridor_log(run.folder.part("drives", "corridors") / log, path)
        return _run(run, path, init, corrected.get(drive_of(path)), config)

    cases = [{"log": name, "init": init} for name, init in itertools.product(names, config.inits)]
    rows = cli.run_table(config, EXPERIMENT, cases, work, report)
    if not any("num_scans" in row for row in rows):
        raise ValueError("every run was refused, for the reasons above")
    return rows


def logs_of(folder: Path) -> list[Path]:
    """Returns the logs of a folder, by name."""
    if not (logs := sorted(p for p in folder.glob("*") if p.name.endswith(ENDINGS))):
        raise ValueError(f"{folder}: no {', '.join(ENDINGS)} file there; name a folder of logs")
    return logs


def drive_of(log: Path) -> str:
    """Returns the name of a log without its endings."""
    return log.name.split(".")[0]


def _name(log: Path) -> str:
    return log.name.removesuffix(".gz")


def _run(table: cli.TableRun, log: Path, init: str, corrected: Path | None, config: Config) -> cli.Row:
    """Returns the metrics of one run, in a process with a peak memory of its own; none where the log lacks odometry."""
    folder = table.folder.part("drives", f"{_name(log)}_{init}").path
    command = [sys.executable, "-m", "dpmjax", "map2d", str(log), "-o", str(folder), "--force"]
    command += ["--init", init, "--seed", str(config.seed)]
    command += [] if config.steps is None else ["--steps", str(config.steps)]
    relations = log.with_name(drive_of(log) + ".relations")
    command += ["--relations", str(relations)] if relations.exists() else []
    command += [] if corrected in (None, log) else ["--corrected", str(corrected)]
    code = subprocess.run(command).returncode
    table.check_stop()
    if code not in (0, cli.EXIT_BAD_INPUT):
        raise RuntimeError(f"{log} from {init}: the run ended with exit code {code}")
    return {} if code else cli.load_json(folder / cli.METRICS)


def report(rows: list[cli.Row]) -> cli.Summary:
    """Returns the table and the shares of trust; runs that were refused are named below it."""
    done = [row for row in rows if "num_scans" in row]
    refused = [f"refused: {row['log']} from {row['init']}" for row in rows if "num_scans" not in row]
    text = "\n".join([cli.markdown(COLUMNS, map(_cells, done)), *trust_lines(done), *refused])
    return cli.Summary({}, text, rows=done)


def is_right(row: cli.Row) -> bool | None:
    """Returns True where no scan of the kept map is far from its reference; None without a reference."""
    return row["worst_scan_m"] < _RIGHT_M if "worst_scan_m" in row else None


def trust_lines(rows: list[cli.Row]) -> list[str]:
    """Returns the shares of trusted maps that are right, and of right maps that are trusted."""
    known = [(is_right(row), row["assessment"]["is_trusted"]) for row in rows if is_right(row) is not None]
    both = sum(bool(right and trusted) for right, trusted in known)
    counts = (("trusted", "right", sum(t for _, t in known)), ("right", "trusted", sum(bool(r) for r, _ in known)))
    return [f"{both} of {count} maps that are {first} are {second}" for first, second, count in counts]


def _cells(row: cli.Row) -> list[Any]:
    """Returns the cells of a row; an empty one is a number that the log has no reference for."""
    relations = (
        f"{row[f'relations{when}_m']:.3f} m, {row[f'relations{when}_deg']:.2f} deg" if "relations_m" in row else ""
        for when in ("_initial", "")
    )
    kind = "ate_corrected" if "ate_corrected_m" in row else "ate"
    fit = row["candidates"].get(DEEPMAPPING, {}).get("ate_m")
    ates = [row.get(f"{kind}_initial_m"), fit, row.get(f"{kind}_m"), row.get("worst_scan_m")]
    return [
        row["log"],
        f"{row['num_scans']} ({row['num_registered']})",
        row["init"],
        *("" if ate is None else ate for ate in ates),
        *relations,
        row["kept"],
        "yes" if row["assessment"]["is_trusted"] else "no",
        ", ".join(cli.spans_of(row["assessment"]["uncertain_scans"])),
        f"{row['wall_s']:.0f}",
        f"{row['peak_rss_gb']:.1f}",
    ]


def write_corridor_log(path: Path, seed: int) -> Path:
    """Simulates a drive along a corridor, 1 to 1.5 m a step.

    Args:
        path: `.npz` to write in a folder that exists: ranges, angles, poses, odometry, times.
        seed: of the world, the drive, and all noise.

    Returns:
        The path.
    """
    rng = np.random.default_rng(seed)
    solid, poses = _make_corridor(rng), _drive(rng)
    points, mask = scan_world(
        solid, poses, num_beams=_NUM_BEAMS, max_range=_REACH_PX, range_noise_px=_RANGE_NOISE_PX, rng=rng
    )
    odometry = simulate_odometry(poses, rng=rng, translation_noise=0.05, rotation_noise_deg=0.6, bias=0.02)
    angles = se2.wrap_angle(2 * np.pi * np.arange(_NUM_BEAMS) / _NUM_BEAMS)
    ahead = np.flatnonzero(np.abs(angles) <= 0.5 * np.pi + 1e-9)
    ahead = ahead[np.argsort(angles[ahead])]
    ranges = np.where(mask, np.linalg.norm(points, axis=2), 0.0)[:, ahead] * METRES_A_PX
    metres = np.array([METRES_A_PX, METRES_A_PX, 1.0])
    arrays = {"ranges": ranges, "angles": angles[ahead], "poses": poses * metres, "odometry": odometry * metres}
    np.savez(path, **arrays, times=np.arange(len(poses), dtype=np.float64))
    return path


def _make_corridor(rng: np.random.Generator) -> np.ndarray:
    solid = np.ones((_HEIGHT_PX, _LENGTH_PX), bool)
    low, high = _HEIGHT_PX // 2, _HEIGHT_PX // 2 + _WIDTH_PX
    solid[low:high, 20 : _LENGTH_PX - 20] = False
    x = 60
    while x < _LENGTH_PX - 120:
        if rng.random() < _ROOM_SHARE:
            width, depth = int(rng.integers(20, 90)), int(rng.integers(10, 120))
            rows = slice(high, high + depth) if rng.random() < 0.5 else slice(low - depth, low)
            solid[rows, x : x + width] = False
        x += int(rng.integers(*_SECTION_PX))
    return solid


def _drive(rng: np.random.Generator) -> np.ndarray:
    """Returns poses along the middle of the corridor, px and radians."""
    x = np.linspace(60.0, _LENGTH_PX - 80.0, _NUM_SCANS) + rng.normal(0.0, 3.0, _NUM_SCANS)
    middle = _HEIGHT_PX / 2 + _WIDTH_PX / 2
    y = middle + np.clip(np.cumsum(rng.normal(0.0, 1.0, _NUM_SCANS)), -15.0, 15.0)
    return np.column_stack([x, y, rng.normal(0.0, 0.08, _NUM_SCANS)])


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
