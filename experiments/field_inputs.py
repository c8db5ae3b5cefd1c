"""Runs a command on each of some real inputs that once failed, and writes one row an input: before, after, right value.

    python -m experiments.field_inputs DATA -o out                    DATA holds the folders field_2d and field_3d
    python -m experiments.field_inputs DATA --only CSAIL.g2o w100.graph

Results go to results/field_inputs/<time>/: table.md, metrics.json, and a file for each row; --resume makes the missing
rows.
"""

from __future__ import annotations

import functools
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from tyro.conf import Positional, arg

from dpmjax.cli import METRICS, RunOptions, Summary, TableRun, load_json, markdown, run_command, run_table

EXPERIMENT = "field_inputs"


class Case(NamedTuple):
    """An input.

    Attributes:
        data: file or folder below DATA.
        command: words of the command; each {} is that path.
        before: result when the input was tried first.
        right: right result.
        keys: numbers of metrics.json that are the result; none: the input is refused, and the message is.
    """

    data: str
    command: str
    before: str
    right: str
    keys: tuple[str, ...] = ()


_MAP = ("ate_m", "worst_scan_m", "assessment.is_trusted", "assessment.fault")
_PAIR = ("translation_m", "confidence")
_TURNED = "a wrong map, not trusted"
CASES = (
    Case("field_2d/aca_corridor.npz", "map2d {}", "0.792 m, trusted; odometry 0.355 m", "below the odometry", _MAP),
    Case("field_2d/aca_inf.npz", "map2d {}", "0.559 m, worst scan 3.4 m, trusted", "every scan within 0.5 m", _MAP),
    Case("field_2d/aca_mirror80.npz", "map2d {}", "mirrored map, trusted", "named, not trusted", _MAP),
    Case("field_2d/aca_degrees.npz", "map2d {}", _TURNED, "as aca_inf", _MAP),
    Case("field_2d/aca_odo_degrees.npz", "map2d {}", "mended by ICP", "as aca_inf", _MAP),
    Case("field_2d/aca_maxwall.npz", "map2d {}", "not trusted, 2.06 m", "readings of 8 m are no walls", _MAP),
    Case("field_2d/aca_dup.npz", "map2d {}", "not trusted, no refinement", "as aca_inf", _MAP),
    Case("field_2d/johnhbell_scans.npz", "map2d {}", "not recorded", "-1 is no wall", ("assessment.is_trusted",)),
    Case("field_2d/points_inf.npy", "map2d {}", "refused", "infinite points are no echo", ("assessment.is_trusted",)),
    Case("field_2d/CSAIL.g2o", "graph {}", "refused: no poses", "chi2 40.55", ("chi2",)),
    Case("field_2d/w100.graph", "graph {}", "refused: TORO", "read", ("chi2",)),
    Case("field_2d/cubicle_2edges.g2o", "graph {}", "edge not named", "edge and line named"),
    Case("field_2d/cubicle_2edges.g2o", "graph {} --nearest-psd", "no such option", "optimised", ("chi2",)),
    Case("field_2d/landmark_xy.g2o", "graph {}", "line 1 blamed", "line 3 named"),
    Case("field_2d/switchable.g2o", "graph {}", "line 1 blamed", "the line that is not read"),
    Case("field_2d/maxmix.g2o", "graph {}", "line 1 blamed", "the line that is not read"),
    Case("field_2d/g2o311_decimal_comma.g2o", "graph {}", "not recorded", "the line named"),
    Case("field_2d/g2o311_prior.g2o", "graph {}", "not recorded", "the line that is not read"),
    Case("field_2d/g2o345_trackxyz.g2o", "graph {}", "not recorded", "the line that is not read"),
    Case("field_2d/sclio22_no_information.g2o", "graph {}", "not recorded", "the line named"),
    Case(
        "field_2d/slambook_ch5",
        "depth {}",
        "no command; ATE 0.042 m, points 1.191 m",
        "points as near as the cameras",
        ("ate_m", "point_distance_m", "largest_turn_error_deg"),
    ),
    Case("field_3d/corridor_pair", "register {}/28.npy {}/16.npy", "0 m, .96", "7.54 m", _PAIR),
    Case("field_3d/corridor_pair", "register {}/18.npy {}/10.npy", "opposite direction, .995", "4.52 m", _PAIR),
    Case("field_3d/street_first_step", "slam {}", "y -0.66 m", "7.48 m driven", ("path_m", "status")),
    Case("field_3d/nuscenes_5_columns", "slam {}", "read as 4 columns", "5 columns, said", ("input_notes",)),
    Case("field_3d/tum_reference_of_another_rate", "slam {}", "ATE 1.112 m", "0.01 m", ("ate_m", "status")),
    Case("field_3d/pcd_padding_count_0/000950.pcd", "register {} {}", "refused", "0 m", _PAIR),
    Case(
        "field_3d/pcd_binary_compressed/samp24-utm.pcd",
        "register {} {}",
        "refused",
        "read, UTM said",
        (*_PAIR, "input_notes"),
    ),
    Case("field_3d/livox_ascii_pcd_char_fields/10.pcd", "register {} {}", "refused", "0 m", _PAIR),
    Case("field_3d/os0_8_beams_slow", "slam {}", "turned by 3.7 degrees", "at most 1 degree", ("turned_deg", "status")),
)


BY_NAME = {(case.data, case.command): case for case in CASES}


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the table."""

    data: Annotated[Positional[Path], arg(metavar="DATA")]
    """Folder with field_2d and field_3d."""
    only: tuple[str, ...] = ()
    """Names of inputs to run; without them, all."""

    def __post_init__(self) -> None:
        """Checks the folder."""
        if not self.data.is_dir():
            raise ValueError(f"{self.data}: no such folder; give the one that holds field_2d and field_3d")


def main(config: Config) -> list[dict[str, Any]]:
    """Runs the missing rows and writes the table."""
    chosen = (case for case in CASES if not config.only or Path(case.data).name in config.only)
    named = [{"data": case.data, "command": case.command} for case in chosen]
    return run_table(config, EXPERIMENT, named, functools.partial(_run, config=config), report)


def report(rows: list[dict[str, Any]]) -> Summary:
    """Adds the results of before and the right ones."""
    cases = [BY_NAME[row["data"], row["command"]] for row in rows]
    compared = [row | {"before": case.before, "right": case.right} for row, case in zip(rows, cases, strict=True)]
    return Summary({}, table_of(compared), rows=compared)


def _run(table: TableRun, data: str, command: str, *, config: Config) -> dict[str, Any]:
    """Returns the exit code, the seconds, the message and the numbers of a run."""
    table.check_stop()
    case = BY_NAME[data, command]
    words, started = command.format(*(2 * [str(config.data / data)])).split(), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        ended = subprocess.run([sys.executable, "-m", "dpmjax", *words, "-o", folder], capture_output=True, text=True)
        path = Path(folder) / METRICS
        metrics = load_json(path) if path.exists() else {}
        if "turned_deg" in case.keys and metrics:
            metrics["turned_deg"] = _turned_deg(np.load(path.with_name("trajectory.npy")))
    # Rows tell nothing about the machine.
    metrics = json.loads(json.dumps(metrics).replace(f"{config.data}/", ""))
    last = ended.stderr.strip().splitlines()[-1:] if ended.returncode else []
    return {
        "exit_code": ended.returncode,
        "wall_s": time.perf_counter() - started,
        "message": "".join(last).replace(str(config.data) + "/", ""),
        "numbers": {key: value for key in case.keys if (value := _value(metrics, key)) is not None},
    }


def _turned_deg(T: np.ndarray) -> float:
    """Returns the largest angle between a pose and the first one."""
    cosines = (np.einsum("ij,nij->n", T[0, :3, :3], T[:, :3, :3]) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).max())


def _value(metrics: dict[str, Any], key: str) -> Any:
    """Returns a number by its path, with dots between the names; None where it is missing."""
    names = key.split(".")
    return functools.reduce(lambda found, name: found.get(name) if isinstance(found, dict) else None, names, metrics)


def table_of(rows: list[dict[str, Any]]) -> str:
    """Returns the table as Markdown: of a refused input the message, of others the numbers."""
    lines = []
    for row in rows:
        numbers = ", ".join(f"{name.split('.')[-1]} {_text(value)}" for name, value in row["numbers"].items())
        now = f"exit code {row['exit_code']}: {row['message']}" if row["exit_code"] else numbers
        command = " ".join(row["command"].replace("{}/", "").replace("{}", "").split())
        cells = row["data"], command, row["before"], now, row["right"], f"{row['wall_s']:.0f}"
        lines.append([cell.replace("|", "/") for cell in cells])
    return markdown(("input", "command", "before", "now", "right", "s"), lines)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return "; ".join(value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))
