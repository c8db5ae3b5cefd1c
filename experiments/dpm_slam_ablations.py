"""Maps drives with parts of SLAM left out, one row a drive and a setting (DeepPointMap, Table 2).

    python -m experiments.dpm_slam_ablations path/to/drive kitti_07.txt
    python -m experiments.dpm_slam_ablations path/to/drive --settings paper whole
    python -m experiments.dpm_slam_ablations --resume              go on where the last run stopped, or was killed

Setting "paper" is section 4 by its own method, with the published limits; "paper, errors up to 2.5 m" has the limit of
the error that suits the shipped weights.

A path is any folder of scans with poses, or a file of poses (TUM, KITTI): a town is simulated along it. Results go to
results/dpm_slam_ablations/<time>/: table.md, metrics.json (ATE, loops, their recall, keyframes, bytes of the map).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import Model, cli, load_model, slam
from experiments._slam_comparison import open_drives
from experiments._slam_evaluation import PRECISIONS, Drive, file_name, map_bytes, map_row, open_folder, with_network

EXPERIMENT = "dpm_slam_ablations"
NUM_ELEMENTS = (64, 128, 256, 512, 1024)
WHOLE, NETWORK, PAPER = "whole", "network proposes every pose", "paper"
PAPER_WIDE, WIDE_M = "paper, errors up to 2.5 m", 2.5
NEAREST, NO_OFFSETS = "features of the nearest keyframe alone", ", without the offset head"
SETTINGS = (
    WHOLE,
    NEAREST,
    *(f"{num} elements" for num in NUM_ELEMENTS),
    PAPER,
    *(f"{proposer}{offsets}" for proposer in (NETWORK, PAPER_WIDE) for offsets in ("", NO_OFFSETS)),
)


@dataclass(frozen=True, kw_only=True)
class Config(cli.DriveOptions):
    """Options of the run."""

    paths: Annotated[Positional[tuple[str, ...]], arg(metavar="PATH ...")]
    """Folders of scans with poses, or files of poses."""
    settings: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = SETTINGS
    """Settings that are run, one row each."""

    def __post_init__(self) -> None:
        """Checks the names."""
        super().__post_init__()
        cli.check_names("--settings", self.settings, SETTINGS)


def main(config: Config) -> list[cli.Row]:
    """Makes the rows that are missing, and writes table and numbers."""
    model = load_model(config.weights)
    sequences = {sequence.name: sequence for sequence in open_drives(config.paths, config)}

    def work(run: cli.TableRun, sequence: str, setting: str) -> cli.Row:
        return evaluate(open_folder(run, sequences[sequence]), model, setting)

    cases = [{"sequence": name, "setting": setting} for name in sequences for setting in config.settings]
    numbers = {"weights": config.weights}
    return cli.run_table(config, EXPERIMENT, cases, work, lambda rows: cli.Summary(numbers, table(rows)))


def evaluate(drive: Drive, model: Model, setting: str) -> cli.Row:
    """Maps a drive with a setting, and measures trajectory, loops and map."""
    part = drive.folder.part("methods", file_name(setting))
    result, row = map_row(drive, part, setting, ablated(model, setting))
    return {**row, **{f"map_bytes_{name}": map_bytes(part.path, result.map, name) for name in PRECISIONS}}


def ablated(model: Model, setting: str) -> slam.SlamMethods:
    """Returns the methods of a setting."""
    if setting.endswith(NO_OFFSETS):
        decoder = replace(model.config.decoder, predicts_offsets=False)
        model = replace(model, config=replace(model.config, decoder=decoder))
    methods, setting = slam.make_methods(model), setting.removesuffix(NO_OFFSETS)
    if setting == NETWORK:
        return with_network(methods)
    if setting in (PAPER, PAPER_WIDE):
        limits = slam.DescriptorConfig() if setting == PAPER else slam.DescriptorConfig(max_rmse_m=WIDE_M)
        return slam.make_methods(model, replace(slam.slam_preset("paper"), descriptors=limits))
    if setting == NEAREST:
        front_end = replace(methods.config.front_end, num_submap=1)
        return methods._replace(config=replace(methods.config, front_end=front_end))
    return methods if setting == WHOLE else with_fewer_elements(model, int(setting.split()[0]))


def table(rows: list[cli.Row]) -> str:
    """Returns the table as Markdown."""

    def cells(row: cli.Row) -> list[object]:
        loops = f"{row['num_loops']} ({row.get('num_wrong_loops', '-')})"
        ate_m, scan_s = row.get("ate_m"), row.get("scan_s")
        share = None if ate_m is None else cli.cell_text(100 * ate_m / row["path_m"], 2)
        speed = None if scan_s is None else cli.cell_text(1 / scan_s, 1)
        errors = (cli.cell_text(ate_m, 3), share, row.get("t_rel_percent"), speed)
        sizes = ", ".join(f"{row[f'map_bytes_{precision}'] / 1e6:.2f}" for precision in ("int8", "float32"))
        return [row["sequence"], row["setting"], *errors, loops, row.get("loop_recall"), row["num_keyframes"], sizes]

    columns = ("drive", "setting", "ATE, m", "of the path, %", "t_rel, %", "scans/s", "loops (wrong)")
    return cli.markdown((*columns, "recall of loops", "keyframes", "map int8, float32, MB"), map(cells, rows))


def with_fewer_elements(model: Model, num_elements: int) -> slam.SlamMethods:
    """Returns methods whose scans and keyframes have at most `num_elements` surface elements.

    Fewer elements of the same surface are farther apart, by the root of the ratio: radii of odometry grow with it.
    """
    factor = max(math.sqrt(model.config.pyramid.stages[0].num_points / num_elements), 1.0)
    whole = slam.make_methods(model, _with_wider_radii(slam.SlamConfig(), factor))

    def encode(scan: slam.ThinnedScan) -> Any:
        """Returns a keyframe with its first elements, in the order of farthest points, and their features."""
        compact = whole.matcher.encode(scan)
        unit_m, *arrays = compact.elements
        elements = type(compact.elements)(unit_m, *(array[:num_elements] for array in arrays))
        described = {
            name: getattr(compact, name)[:num_elements] for name in ("features", "feature_steps", "directions")
        }
        return compact._replace(elements=elements, **described)

    def thin(points: np.ndarray) -> slam.ThinnedScan | None:
        """Returns a scan with its first elements only."""
        scan = whole.geometry.thin(points)
        if scan is None:
            return None
        surface = scan.measured.surface
        # Normals are those of all points, as in a keyframe.
        first = {name: getattr(surface, name)[:num_elements] for name in ("points", "normals", "flatness")}
        samples, tree = surface.samples[surface.samples < num_elements], type(surface.tree)(first["points"])
        few = surface._replace(**first, samples=samples, tree=tree)
        return scan._replace(measured=scan.measured._replace(surface=few))

    matcher, geometry = _Replaced(whole.matcher, encode=encode), _Replaced(whole.geometry, thin=thin)
    return whole._replace(matcher=matcher, geometry=geometry)


def _with_wider_radii(config: slam.SlamConfig, factor: float) -> slam.SlamConfig:
    def wider(alignment: Any) -> Any:
        levels = (replace(level, radius_m=factor * level.radius_m) for level in alignment.levels)
        return replace(alignment, levels=tuple(levels))

    odometry = config.odometry
    radius_m = factor * odometry.plane_radius_m
    odometry = replace(odometry, narrow=wider(odometry.narrow), wide=wider(odometry.wide), plane_radius_m=radius_m)
    return replace(config, odometry=odometry)


class _Replaced:
    """A matcher or a geometry of which some functions are replaced."""

    def __init__(self, wrapped: Any, **functions: Callable[..., Any]) -> None:
        self._wrapped = wrapped
        vars(self).update(functions)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._wrapped, name)


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
