"""Merges saved maps into one if they show common places (DeepPointMap, section 4).

    dpmjax merge monday/map.npz tuesday/map.npz -o both
    dpmjax merge robot_1.npz robot_2.npz robot_3.npz
    dpmjax merge a.npz b.npz --weights my_model.safetensors

Maps are files of `dpmjax.save_map`, such as map.npz of `dpmjax slam`, all made with the same weights. Loops between
them are found by the appearance of places; no position is needed. A merged map has the frame of its first map.

Results go to results/merge/<time>/ (latest links to the newest): map.npz, loops.csv, graph.g2o, metrics.json and
map.png. The file loops.csv has each candidate of a loop between two maps and its outcome. The picture map.png shows all
maps from above, each in its colour, with the loops. Maps without a common place stay separate, as map_1.npz, map_2.npz
and so on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, io, saved_maps, slam, viz, weights
from dpmjax.cli import slam_results
from dpmjax.sequences import counted

# Points below this height above the lidar are the ground.
GROUND_M = -1.0


@dataclass(frozen=True, kw_only=True)
class MergeOptions(cli.ModelOptions, cli.OutputOptions):
    """Options of the run."""

    maps: Annotated[Positional[tuple[Path, ...]], arg(metavar="MAP MAP ...", help_behavior_hint="required")] = ()
    """Two or more maps, files of dpmjax.save_map."""

    def __post_init__(self) -> None:
        """Checks the maps."""
        if len(self.maps) < 2:
            raise ValueError(f"give two or more maps, files of dpmjax.save_map; got {len(self.maps)}")
        for number, path in enumerate(self.maps):
            if path.resolve() in [before.resolve() for before in self.maps[:number]]:
                raise ValueError(f"{path} is given twice; give each map once")


def main(options: MergeOptions, run: cli.Run) -> cli.Numbers:
    """Merges maps and writes the results."""
    methods = slam.make_methods(weights.load_model(options.weights), weights=options.weights)
    maps = [cli.open_map(path, methods) for path in options.maps]
    run.open()
    with cli.counting_bar("loops between maps", " keyframes") as on_keyframe:
        merged = slam.merge_maps(methods, *maps, on_keyframe=on_keyframe)
    write_maps(run, maps, merged)
    numbers = {"weights": options.weights, **merge_numbers(options.maps, maps, merged)}
    run.write_numbers(numbers)  # also where a picture fails
    parts = len(merged.maps)
    title = f"{len(maps)} maps" + (f", {parts} after merging" if parts > 1 else " in one")
    panels = [panel_of(options.maps, merged, part) for part in range(parts)]
    viz.save_figure(viz.figure(panels, title=title), run / "map.png")
    return numbers


def write_maps(run: cli.Run, maps: Sequence[slam.KeyframeMap], merged: slam.MergedMaps) -> None:
    """Writes the maps, the graph and the table of loops."""
    for part, slam_map in enumerate(merged.maps, start=1):
        saved_maps.save_map(run / map_name(part, len(merged.maps)), slam_map)
    io.write_g2o(run / "graph.g2o", slam.as_pose_graph(merged.joined.slam_map))
    ends = [
        {"map": number, "scan": keyframe.scan}
        for number, each in enumerate(maps, start=1)
        for keyframe in each.keyframes
    ]
    cli.write_loops(run / "loops.csv", merged.loops, ends)


def map_name(part: int, num_parts: int) -> str:
    """Returns the name of the file of a part, counted from 1."""
    return "map.npz" if num_parts == 1 else f"map_{part}.npz"


def short_name(path: Path) -> str:
    """Returns the name of a map with its folder, because most maps are called map.npz."""
    return str(Path(*path.parts[-2:]))


def merge_numbers(paths: Sequence[Path], maps: Sequence[slam.KeyframeMap], merged: slam.MergedMaps) -> cli.Numbers:
    """Returns the content of `metrics.json`: connected maps, and the numbers of loops and keyframes."""
    parts: list[cli.Numbers] = [
        {
            "file": map_name(part, len(merged.maps)),
            "maps": [number for number, component in enumerate(merged.component, start=1) if component == part - 1],
            "num_keyframes": len(slam_map),
            "num_measured_parts": slam_results.count_parts(slam_map),
        }
        for part, slam_map in enumerate(merged.maps, start=1)
    ]
    is_measured = all(part["num_measured_parts"] < 2 for part in parts)
    ends = cli.accepted_ends(merged.loops)
    meetings = Counter(map(tuple, np.sort(merged.joined.map_of_keyframe[ends] + 1, axis=1).tolist()))
    numbers = {
        "status": "done" if is_measured else "uncertain",
        "num_maps": len(maps),
        "num_parts": len(parts),
        "num_loops": len(ends),
        "num_candidates": len(merged.loops),
        "num_keyframes": len(merged.joined.slam_map),
        "parts": parts,
        "maps": [
            {"map": number, "file": short_name(path), "num_keyframes": len(each)}
            for number, (path, each) in enumerate(zip(paths, maps, strict=True), start=1)
        ],
        "loops_between": [{"maps": list(pair), "num_loops": number} for pair, number in sorted(meetings.items())],
    }
    return {"verdict": merge_text(numbers), **numbers}


def panel_of(paths: Sequence[Path], merged: slam.MergedMaps, part: int) -> viz.Panel:
    """Returns the panel of a part: its maps with their surfaces and keyframes, and the loops between them."""
    members = [number for number, component in enumerate(merged.component) if component == part]
    ends = cli.accepted_ends(merged.loops)
    ends = ends[np.isin(merged.joined.map_of_keyframe[ends[:, 0]], members)]
    is_joined = len(members) > 1
    text = f"in the frame of {short_name(paths[members[0]])}" if is_joined else "no common place with another map"
    layers = [layer for number in members for layer in layers_of(paths[number], merged, number)]
    loops = merged.joined.slam_map.T_world_keyframe[ends, :3, 3]
    return viz.Panel(text, [*layers, viz.Edges(loops, viz.INK, "loops between them")])


def layers_of(path: Path, merged: slam.MergedMaps, number: int) -> list[viz.Layer]:
    """Returns the keyframes of a map and the points of their surfaces, in its colour."""
    slam_map = merged.joined.slam_map
    rows = np.flatnonzero(merged.joined.map_of_keyframe == number)
    T_world_keyframe = slam_map.T_world_keyframe[rows]
    cloud = cli.gather_map(T_world_keyframe, lambda row: slam.keyframe_points(slam_map, int(rows[row])))
    color = viz.AGENTS[number % len(viz.AGENTS)]
    label = f"{short_name(path)}, {counted(len(rows), 'keyframe')}"
    surface = viz.Points(cloud.points[cloud.heights_m > GROUND_M], color)
    return [surface, viz.Track(T_world_keyframe[:, :3, 3], color, label)]


def merge_text(metrics: cli.Numbers) -> str:
    """Returns the verdict: one phrase for each part, with the maps in it."""
    names = {entry["map"]: entry["file"] for entry in metrics["maps"]}
    texts = [
        f"{counted(metrics['num_loops'], 'loop')} between maps, of {counted(metrics['num_candidates'], 'candidate')}"
    ]
    for part in metrics["parts"]:
        members = ", ".join(names[number] for number in part["maps"])
        text = "one map now" if len(part["maps"]) > 1 else "no common place with another map"
        if (num_parts := part["num_measured_parts"]) > 1:
            text += f", in {num_parts} parts whose relative poses are guesses"
        texts.append(f"{members}: {text}, {counted(part['num_keyframes'], 'keyframe')}, {part['file']}")
    return "; ".join(texts)
