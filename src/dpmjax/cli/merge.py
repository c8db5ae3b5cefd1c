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

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tqdm import tqdm
from tyro.conf import Positional, arg

from dpmjax import cli, io, saved_maps, slam, viz, weights
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
    with tqdm(desc="loops between maps", unit=" keyframes", dynamic_ncols=True) as bar:

        def on_keyframe(num_done: int, _: int) -> None:
            bar.update(num_done - bar.n)

        merged = slam.merge_maps(methods, *maps, on_keyframe=on_keyframe)
    num_parts = len(merged.maps)
    files = ["map.npz"] if num_parts == 1 else [f"map_{part}.npz" for part in range(1, num_parts + 1)]
    for file, slam_map in zip(files, merged.maps, strict=True):
        saved_maps.save_map(run / file, slam_map)
    io.write_g2o(run / "graph.g2o", slam.as_pose_graph(merged.slam_map))
    ends = [
        {"map": row, "scan": keyframe.scan} for row, each in enumerate(maps, start=1) for keyframe in each.keyframes
    ]
    cli.write_loops(run / "loops.csv", merged.loops, ends)
    # Most maps are called map.npz, so their folders are named, too.
    names = [str(Path(*path.parts[-2:])) for path in options.maps]
    numbers = {"weights": options.weights, **merge_numbers(names, files, merged)}
    run.write_numbers(numbers)  # also where a picture fails
    title = f"{len(maps)} maps" + (f", {num_parts} after merging" if num_parts > 1 else " in one")
    panels = [panel_of(names, merged, part) for part in range(num_parts)]
    viz.save_figure(viz.figure(panels, title=title), run / "map.png")
    return numbers


def merge_numbers(names: Sequence[str], files: Sequence[str], merged: slam.MergedMaps) -> cli.Numbers:
    """Returns status, verdict, connected maps, and the numbers of loops and keyframes."""
    ends = cli.accepted_ends(merged.loops)
    parts: list[cli.Numbers] = []
    texts = [f"{counted(len(ends), 'loop')} between maps, of {counted(len(merged.loops), 'candidate')}"]
    for part, (file, slam_map) in enumerate(zip(files, merged.maps, strict=True)):
        members = [number for number, component in enumerate(merged.component, start=1) if component == part]
        num_measured, counts = len(set(slam.measured_parts(slam_map).tolist())), {"num_keyframes": len(slam_map)}
        parts.append({"file": file, "maps": members, **counts, "num_measured_parts": num_measured})
        text = "one map now" if len(members) > 1 else "no common place with another map"
        text += f", in {num_measured} parts whose relative poses are guesses" if num_measured > 1 else ""
        shown = ", ".join(names[number - 1] for number in members)
        texts.append(f"{shown}: {text}, {counted(len(slam_map), 'keyframe')}, {file}")
    return {
        "status": "done" if all(part["num_measured_parts"] < 2 for part in parts) else "uncertain",
        "verdict": "; ".join(texts),
        "num_maps": len(names),
        "num_parts": len(parts),
        "num_loops": len(ends),
        "num_candidates": len(merged.loops),
        "num_keyframes": len(merged.slam_map),
        "parts": parts,
        "maps": names,
    }


def panel_of(names: Sequence[str], merged: slam.MergedMaps, part: int) -> viz.Panel:
    """Returns the panel of a part: its maps, each with its surface and keyframes, and the loops between them."""
    slam_map, map_of_keyframe = merged.slam_map, merged.map_of_keyframe
    members = [number for number, component in enumerate(merged.component) if component == part]
    layers: list[viz.Layer] = []
    for number in members:
        rows, color = np.flatnonzero(map_of_keyframe == number), viz.AGENTS[number % len(viz.AGENTS)]
        T = slam_map.T_world_keyframe[rows]
        points = [slam.keyframe_points(slam_map, int(row)) for row in rows]
        cloud = cli.gather_map(T, points.__getitem__)
        label = f"{names[number]}, {counted(len(rows), 'keyframe')}"
        surface = viz.Points(cloud.points[cloud.heights_m > GROUND_M], color)
        layers += [surface, viz.Track(T[:, :3, 3], color, label)]
    ends = cli.accepted_ends(merged.loops)
    ends = ends[np.isin(map_of_keyframe[ends[:, 0]], members)]
    loops = viz.Edges(slam_map.T_world_keyframe[ends, :3, 3], viz.INK, "loops between them")
    is_joined = len(members) > 1
    text = f"in the frame of {names[members[0]]}" if is_joined else "no common place with another map"
    return viz.Panel(text, [*layers, loops])
