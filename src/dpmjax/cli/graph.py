"""Optimises a pose graph in the plane or in space: files of g2o and TORO, edges alone, too.

    dpmjax graph parking-garage.g2o               least squares
    dpmjax graph city.g2o --outlier-chi2 10       wrong edges are rejected (Geman-McClure)
    dpmjax graph edges.g2o --nearest-psd          mends information matrices that are not positive semidefinite

The initial poses are those of the file or of the chordal relaxation, and the lower cost decides. A file of edges alone
gets poses along a spanning tree. Results go to results/graph/<time>/ (latest links to the newest): graph.g2o,
trajectory_tum.txt (stamps are the numbers of the nodes), metrics.json and trajectory.png.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax import cli, io, pose_graph, viz
from dpmjax.sequences import Note

# Edges below this weight are rejected.
LET_GO = 0.5


@dataclass(frozen=True, kw_only=True)
class GraphOptions(cli.OutputOptions):
    """Options of the run."""

    graph: Annotated[Positional[Path], arg(metavar="GRAPH")]
    """Pose graph, a file of g2o or TORO."""
    outlier_chi2: Annotated[float | None, arg(metavar="X"), cli.Bound(0, is_allowed=False)] = None
    """Largest cost of a contradicted edge. Without it, all edges count fully."""
    nearest_psd: FlagCreatePairsOff[bool] = False
    """Replace information matrices that are not positive semidefinite by the nearest positive semidefinite ones."""
    iterations: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 100
    """Largest number of linear solves."""


def main(options: GraphOptions, run: cli.Run) -> cli.Numbers:
    """Optimises a pose graph and writes the results."""
    graph = io.read_g2o(options.graph, nearest_psd=options.nearest_psd)
    settings = pose_graph.PoseGraphConfig(outlier_chi2=options.outlier_chi2, max_iterations=options.iterations)
    run.open()
    found = pose_graph.optimize_pose_graph(graph, settings)
    if found.free_nodes:  # the solver has warned
        run.note([Note(f"{options.graph}: {pose_graph.describe_free_nodes(found.free_nodes)}", is_doubt=True)])
    poses, stamps = found.graph.poses, found.graph.ids.astype(np.float64)
    io.write_g2o(run / "graph.g2o", found.graph)
    io.write_tum(run / "trajectory_tum.txt", poses, times=stamps, frame="T_world_node")
    num_let_go = int((found.weights < LET_GO).sum())
    verdict = f"chi2 {found.chi2_initial:.6g} -> {found.chi2:.6g} in {found.iterations} iterations"
    verdict += f", {num_let_go} edges let go" if num_let_go else ""
    if not found.is_converged:
        verdict = f"no minimum after {found.iterations} iterations: give more --iterations, or a kernel: --outlier-chi2"
    numbers = {
        "graph": options.graph.name,
        "status": "done" if found.is_converged else "failed",
        "verdict": verdict,
        "num_nodes": len(poses),
        "num_edges": len(graph.edges.source),
        "num_held": int(found.graph.held_nodes().sum()),
        "num_edges_let_go": num_let_go,
        "chi2_initial": found.chi2_initial,
        "chi2": found.chi2,
        "iterations": found.iterations,
    }
    run.write_numbers(numbers)  # also where a picture fails
    tracks = []
    shown = (("before", graph, viz.ODOMETRY, found.chi2_initial), ("optimised", found.graph, viz.PATH, found.chi2))
    for name, one, color, chi2 in shown:
        positions = np.pad(one.poses[:, :2], [(0, 0), (0, 1)]) if one.poses.ndim == 2 else one.poses[:, :3, 3]
        tracks.append(viz.Track(positions, color, f"{name}, chi2 {chi2:.4g}"))
    title = f"{options.graph.stem}: {len(poses)} nodes, {len(graph.edges.source)} edges"
    viz.save_figure(viz.trajectory_figure(title, tracks), run / "trajectory.png")
    return numbers
