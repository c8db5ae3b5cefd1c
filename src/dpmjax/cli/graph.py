"""Optimises a pose graph in the plane or in space: files of g2o and TORO, edges alone, too.

    dpmjax graph parking-garage.g2o               least squares
    dpmjax graph city.g2o --outlier-chi2 10       wrong edges are rejected (Geman-McClure)
    dpmjax graph edges.g2o --nearest-psd          mends information matrices that are not positive semidefinite

The initial poses are those of the file or of the chordal relaxation, whichever have the lower cost; a file of edges
alone gets poses along a spanning tree. Results go to results/graph/<time>/ (latest links to the newest): graph.g2o,
trajectory_tum.txt (stamps are the numbers of the nodes), metrics.json and trajectory.png.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax import cli, io, pose_graph, viz
from dpmjax.sequences import InputError, Note

NAME = "graph"
# Edges below this weight are rejected.
LET_GO = 0.5


@dataclass(frozen=True, kw_only=True)
class Config(cli.OutputOptions):
    """Options of the run."""

    graph: Annotated[Positional[Path], arg(metavar="GRAPH", help_behavior_hint="required")] = Path()
    """Pose graph, a file of g2o or TORO."""
    outlier_chi2: Annotated[float | None, arg(metavar="X")] = None
    """The most that a contradicted edge costs; without it, all edges count fully."""
    nearest_psd: FlagCreatePairsOff[bool] = False
    """Replace information matrices that are not positive semidefinite by the nearest ones that are."""
    iterations: Annotated[int, arg(metavar="N")] = 100
    """At most N linear solves."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, iterations=1)
        if self.outlier_chi2 is not None and not self.outlier_chi2 > 0.0:
            raise ValueError(f"--outlier-chi2: expected more than 0, got {self.outlier_chi2}")
        if self.graph == Path():
            raise ValueError("give a pose graph, a file of g2o or TORO")


def main(config: Config) -> None:
    """Optimises a pose graph and writes the results."""
    started = time.perf_counter()
    graph = io.read_g2o(config.graph, nearest_psd=config.nearest_psd)
    settings = pose_graph.PoseGraphConfig(outlier_chi2=config.outlier_chi2, max_iterations=config.iterations)
    folder = cli.open_run_folder(config, NAME)
    with cli.recording(folder):
        found = pose_graph.optimize_pose_graph(graph, settings)
        free = found.free_nodes
        # A doubt: the solver has logged it, so that the console shows it already.
        doubts = [Note(f"{config.graph}: {pose_graph.describe_free_nodes(free)}", is_doubt=True)] if free else []
        notes = cli.report_notes(doubts)
        metrics = {"graph": config.graph.name, **graph_numbers(found), **notes, "wall_s": time.perf_counter() - started}
        poses, stamps = found.graph.poses, found.graph.ids.astype(np.float64)
        io.write_g2o(folder / "graph.g2o", found.graph)
        io.write_tum(folder / "trajectory_tum.txt", poses, times=stamps, frame="T_world_node")
        cli.write_metrics(folder, metrics)
        title = f"{config.graph.stem}: {len(graph.poses)} nodes, {len(graph.edges.source)} edges"
        tracks = [
            viz.Track(positions(graph.poses), viz.ODOMETRY, f"before, chi2 {found.chi2_initial:.4g}"),
            viz.Track(positions(poses), viz.PATH, f"optimised, chi2 {found.chi2:.4g}"),
        ]
        viz.save_figure(viz.trajectory_figure(title, tracks), folder / "trajectory.png")
        let_go = f", {metrics['num_edges_let_go']} of them let go" if metrics["num_edges_let_go"] else ""
        print(f"{metrics['num_nodes']} nodes, {metrics['num_edges']} edges{let_go}")
        print(f"chi2 {found.chi2_initial:.6g} -> {found.chi2:.6g} in {found.iterations} iterations")
        print(f"results in {folder.path}")
        if not found.is_converged:
            advice = "give more --iterations, or a kernel by --outlier-chi2"
            raise InputError(config.graph, f"no minimum after {found.iterations} iterations", advice)


def graph_numbers(found: pose_graph.OptimizedPoseGraph) -> dict[str, Any]:
    """Returns the numbers of an optimisation."""
    return {
        "status": "done" if found.is_converged else "failed",
        "num_nodes": len(found.graph.poses),
        "num_edges": len(found.graph.edges.source),
        "num_held": int(found.graph.held_nodes().sum()),
        "num_edges_let_go": int((found.weights < LET_GO).sum()),
        "chi2_initial": found.chi2_initial,
        "chi2": found.chi2,
        "iterations": found.iterations,
    }


def positions(poses: np.ndarray) -> np.ndarray:
    """Returns (n, 3) positions of poses in the plane or in space."""
    return np.column_stack([poses[:, :2], 0 * poses[:, 0]]) if poses.ndim == 2 else poses[:, :3, 3]
