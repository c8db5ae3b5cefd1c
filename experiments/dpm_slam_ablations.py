"""Maps drives with parts of SLAM left out, one row a drive and a setting (DeepPointMap, Table 2).

    python -m experiments.dpm_slam_ablations path/to/drive kitti_07.txt
    python -m experiments.dpm_slam_ablations --resume              go on where the last run stopped, or was killed

A path is any folder of scans with poses, or a file of poses (TUM, KITTI): a town is simulated along it. Results go to
results/dpm_slam_ablations/<time>/: table.md, metrics.json (ATE, loops, their recall, keyframes, bytes of the map).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from dpmjax.cli import (
    DriveSelection,
    RunOptions,
    StopFlag,
    check_least,
    do_row,
    open_run_folder,
    recording,
    run_command,
    write_metrics,
)

if TYPE_CHECKING:
    from dpmjax import Model
    from dpmjax.slam import SlamMethods
    from experiments._slam_evaluation import Drive

EXPERIMENT = "dpm_slam_ablations"
NUM_ELEMENTS = (64, 128, 256, 512, 1024)
WHOLE, NETWORK, DECODER = "whole", "network proposes every pose", "decoder alone, without surface elements"
NEAREST, NO_OFFSETS = "features of the nearest keyframe alone", ", without the offset head"
SETTINGS = (
    WHOLE,
    NEAREST,
    *(f"{num} elements" for num in NUM_ELEMENTS),
    *(f"{proposer}{offsets}" for proposer in (NETWORK, DECODER) for offsets in ("", NO_OFFSETS)),
)


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    paths: Annotated[Positional[tuple[str, ...]], arg(metavar="PATH ...")]
    """Folders of scans with poses, or files of poses."""
    weights: Annotated[str, arg(metavar="NAME|FILE")] = "dpm_small"
    """Name of a shipped model, or a .safetensors file."""
    n_scans: Annotated[int | None, arg(aliases=["-n"], metavar="N")] = None
    """Number of scans of each drive."""
    jump: Annotated[int, arg(aliases=["-j"], metavar="N")] = 1
    """Use every Nth scan."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_least(self, n_scans=1, jump=1, seed=0)


def main(config: Config) -> list[dict[str, Any]]:
    """Makes the rows that are missing, and writes table and numbers."""
    from dpmjax import load_model
    from experiments import _slam_comparison as comparison
    from experiments._slam_evaluation import StoppedError, open_folder

    model = load_model(config.weights)
    selection = DriveSelection(num_scans=config.n_scans, jump=config.jump, seed=config.seed)
    sequences = comparison.open_drives(comparison.DriveChoice(paths=config.paths, selection=selection))
    folder = open_run_folder(config, EXPERIMENT)
    rows: list[dict[str, Any]] = []
    with recording(folder), StopFlag() as stop:
        drives = [open_folder(folder, sequence, lambda: stop.is_requested) for sequence in sequences]
        for drive, setting in ((drive, setting) for drive in drives for setting in SETTINGS):
            case = {"sequence": drive.sequence.name, "setting": setting}
            try:
                rows.append(do_row(folder.path, case, partial(evaluate, drive, model, setting), seed=config.seed))
            except StoppedError:
                break
            write_metrics(folder, {"weights": config.weights}, seed=config.seed, rows=rows)
        (folder / "table.md").write_text(table(rows) + "\n", encoding="utf-8")
        print(f"{table(rows)}\nresults in {folder.path}")
    return rows


def evaluate(drive: Drive, model: Model, setting: str) -> dict[str, Any]:
    """Maps a drive with a setting, and measures trajectory, loops and map."""
    from dpmjax import save_map
    from experiments._slam_evaluation import PRECISIONS, file_name, map_path, map_row

    part = drive.folder.part("methods", file_name(setting))
    result, row = map_row(drive, part, setting, ablated(model, setting))
    sizes = {name: save_map(map_path(part.path, name), result.map, name).stat().st_size for name in PRECISIONS}
    return {**row, **{f"map_bytes_{name}": size for name, size in sizes.items()}}


def ablated(model: Model, setting: str) -> SlamMethods:
    """Returns the methods of a setting."""
    from dpmjax.slam import make_methods
    from experiments._slam_elements import with_fewer_elements, with_network, without_elements

    if setting.endswith(NO_OFFSETS):
        decoder = replace(model.config.decoder, predicts_offsets=False)
        model = replace(model, config=replace(model.config, decoder=decoder))
    methods, setting = make_methods(model), setting.removesuffix(NO_OFFSETS)
    if setting == NETWORK:
        return with_network(methods)
    if setting == DECODER:
        return without_elements(methods)
    if setting == NEAREST:
        front_end = replace(methods.config.front_end, num_submap=1)
        return methods._replace(config=replace(methods.config, front_end=front_end))
    return methods if setting == WHOLE else with_fewer_elements(model, int(setting.split()[0]))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns the table as Markdown."""
    lines = [
        "| drive | setting | ATE, m | t_rel, % | loops (wrong) | recall of loops | keyframes | map int8, float32, MB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    return "\n".join([*lines, *map(_line, rows)])


def _line(row: dict[str, Any]) -> str:
    from experiments._slam_comparison import number

    sizes = ", ".join(f"{row[f'map_bytes_{precision}'] / 1e6:.2f}" for precision in ("int8", "float32"))
    return (
        f"| {row['sequence']} | {row['setting']} | {number(row.get('ate_m'), 3)} | {number(row.get('t_rel_percent'))} "
        f"| {row['num_loops']} ({row.get('num_wrong_loops', '-')}) | {number(row.get('loop_recall'))} "
        f"| {row['num_keyframes']} | {sizes} |"
    )


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))
