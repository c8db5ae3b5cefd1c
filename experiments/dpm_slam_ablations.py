"""Maps drives with parts of SLAM left out, one row a drive and a setting (DeepPointMap, Table 2).

    python -m experiments.dpm_slam_ablations path/to/drive kitti_07.txt
    python -m experiments.dpm_slam_ablations --resume              go on where the last run stopped, or was killed

A path is any folder of scans with poses, or a file of poses (TUM, KITTI): a town is simulated along it. Results go to
results/dpm_slam_ablations/<time>/: table.md, metrics.json (ATE, loops, their recall, keyframes, bytes of the map).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import Model, cli, load_model, slam
from dpmjax.scans import surface_at
from experiments._slam_comparison import open_drives
from experiments._slam_evaluation import PRECISIONS, Drive, file_name, map_bytes, map_row, open_folder, with_network

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
class Config(cli.DriveOptions):
    """Options of the run."""

    paths: Annotated[Positional[tuple[str, ...]], arg(metavar="PATH ...")]
    """Folders of scans with poses, or files of poses."""


def main(config: Config) -> list[cli.Row]:
    """Makes the rows that are missing, and writes table and numbers."""
    model = load_model(config.weights)
    sequences = {sequence.name: sequence for sequence in open_drives(config.paths, config)}

    def work(run: cli.TableRun, sequence: str, setting: str) -> cli.Row:
        return evaluate(open_folder(run, sequences[sequence]), model, setting)

    cases = [{"sequence": name, "setting": setting} for name in sequences for setting in SETTINGS]
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
    if setting == DECODER:
        return without_elements(methods)
    if setting == NEAREST:
        front_end = replace(methods.config.front_end, num_submap=1)
        return methods._replace(config=replace(methods.config, front_end=front_end))
    return methods if setting == WHOLE else with_fewer_elements(model, int(setting.split()[0]))


def table(rows: Sequence[cli.Row]) -> str:
    """Returns the table as Markdown."""

    def cells(row: cli.Row) -> list[object]:
        loops = f"{row['num_loops']} ({row.get('num_wrong_loops', '-')})"
        errors = (cli.cell_text(row.get("ate_m"), 3), row.get("t_rel_percent"))
        sizes = ", ".join(f"{row[f'map_bytes_{precision}'] / 1e6:.2f}" for precision in ("int8", "float32"))
        return [row["sequence"], row["setting"], *errors, loops, row.get("loop_recall"), row["num_keyframes"], sizes]

    columns = ("drive", "setting", "ATE, m", "t_rel, %", "loops (wrong)", "recall of loops", "keyframes")
    return cli.markdown((*columns, "map int8, float32, MB"), map(cells, rows))


def with_fewer_elements(model: Model, num_elements: int) -> slam.SlamMethods:
    """Returns methods whose scans and keyframes have at most `num_elements` surface elements.

    Fewer elements of the same surface are farther apart, by the root of the ratio: radii of odometry grow with it.
    """
    factor = max(math.sqrt(model.config.pyramid.stages[0].num_points / num_elements), 1.0)
    whole = slam.make_methods(model, _with_wider_radii(slam.SlamConfig(), factor))
    matcher = _FewerOfKeyframes(whole.matcher, num_elements)
    return whole._replace(matcher=matcher, geometry=_FewerOfScans(whole.geometry, num_elements))


def _with_wider_radii(config: slam.SlamConfig, factor: float) -> slam.SlamConfig:
    def wider(alignment: Any) -> Any:
        levels = (replace(level, radius_m=factor * level.radius_m) for level in alignment.levels)
        return replace(alignment, levels=tuple(levels))

    odometry = config.odometry
    radius_m = factor * odometry.plane_radius_m
    odometry = replace(odometry, narrow=wider(odometry.narrow), wide=wider(odometry.wide), plane_radius_m=radius_m)
    return replace(config, odometry=odometry)


def without_elements(methods: slam.SlamMethods) -> slam.SlamMethods:
    """Returns methods without surface elements: each pose and each loop stays as the decoder proposes it."""
    geometry = _Unmoved(methods.geometry)
    return with_network(methods._replace(matcher=_DecoderAlone(methods.matcher), geometry=geometry))


class _Wrapped:
    """A matcher or a geometry of which some functions are replaced."""

    def __init__(self, wrapped: Any) -> None:
        self._wrapped = wrapped

    def __getattr__(self, name: str) -> Any:
        return getattr(self._wrapped, name)


class _FewerOfKeyframes(_Wrapped):
    """A matcher whose keyframes keep the first elements, in the order of farthest points, and their features."""

    def __init__(self, matcher: slam.Matcher, num_elements: int) -> None:
        super().__init__(matcher)
        self._num = num_elements

    def encode(self, scan: slam.ThinnedScan) -> Any:
        whole = self._wrapped.encode(scan)
        unit_m, *arrays = whole.elements
        elements = type(whole.elements)(unit_m, *(array[: self._num] for array in arrays))
        described = {name: getattr(whole, name)[: self._num] for name in ("features", "feature_steps", "directions")}
        return whole._replace(elements=elements, **described)


class _FewerOfScans(_Wrapped):
    """A geometry whose scans have their first elements only."""

    def __init__(self, geometry: slam.Geometry, num_elements: int) -> None:
        super().__init__(geometry)
        self._num = num_elements

    def thin(self, points: np.ndarray) -> slam.ThinnedScan | None:
        whole = self._wrapped.thin(points)
        if whole is None:
            return None
        points = whole.measured.surface.points
        few = surface_at(points, np.arange(min(self._num, len(points))))
        return whole._replace(measured=whole.measured._replace(surface=few))


class _Unmoved(_Wrapped):
    """A geometry that returns the first of the given poses and accepts it."""

    def align(self, local_map: slam.LocalMap, scan: slam.ThinnedScan, T_map_scan: np.ndarray) -> slam.Alignment:
        return slam.Alignment(T_map_scan, 1.0, 0.0, 1.0, slam.DESCRIPTOR_INFORMATION)

    def search(self, local_map: slam.LocalMap, scan: slam.ThinnedScan, T_map_scan: np.ndarray) -> slam.Alignment:
        return self.align(local_map, scan, T_map_scan[0])


class _DecoderAlone(_Wrapped):
    """A matcher that registers the central scans of submaps by their descriptors, and verifies nothing."""

    def register(self, pairs: Sequence[tuple[slam.Submap, slam.Submap]]) -> list[slam.Match]:
        proposals = [self._wrapped.propose(source.scans[0], target.scans[0], 1) for source, target in pairs]
        return [slam.Match(proposal.T_target_source[0], proposal.probability, np.nan) for proposal in proposals]


if __name__ == "__main__":
    raise SystemExit(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
