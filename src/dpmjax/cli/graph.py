"""Optimises a pose graph in the plane or in space: files of g2o and TORO, edges alone, too.

    dpmjax graph parking-garage.g2o               least squares
    dpmjax graph city.g2o --outlier-chi2 10       wrong edges are rejected (Geman-McClure)
    dpmjax graph edges.g2o --nearest-psd          mends information matrices that are not positive semidefinite

The start is the poses of the file or the chordal relaxation, whichever has the lower cost; a file of edges alone starts
along a spanning tree. Results go to results/graph/<time>/ (latest links to the newest): graph.g2o, trajectory_tum.txt
(stamps are the numbers of the nodes), metrics.json and trajectory.png.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax.cli.command import check_least, run_command
from dpmjax.cli.run_folder import OutputOptions, RunFolder, open_run_folder, recording, write_metrics
from dpmjax.sequences import InputError

if TYPE_CHECKING:
    from dpmjax.pose_graph import OptimizedPoseGraph, PoseGraph

NAME = "graph"
# Edges below this weight count as rejected.
LET_GO = 0.5


@dataclass(frozen=True, kw_only=True)
class Config(OutputOptions):
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
        check_least(self, iterations=1, outlier_chi2=1e-9)
        if self.graph == Path():
            raise ValueError("give a pose graph, a file of g2o or TORO")


def main(config: Config) -> dict[str, Any]:
    """Reads, optimises, writes; returns the content of `metrics.json`."""
    from dpmjax.io.g2o import read_g2o
    from dpmjax.pose_graph import PoseGraphConfig, optimize_pose_graph

    started = time.perf_counter()
    graph = read_g2o(config.graph, nearest_psd=config.nearest_psd)
    settings = PoseGraphConfig(outlier_chi2=config.outlier_chi2, max_iterations=config.iterations)
    folder = open_run_folder(config, NAME)
    with recording(folder):
        found = optimize_pose_graph(graph, settings)
        metrics = {"graph": config.graph.name, **numbers_of(found), "wall_s": time.perf_counter() - started}
        write_results(folder, found.graph)
        write_metrics(folder, metrics)
        draw(folder, config.graph.stem, graph, found)
        print(report(metrics), f"results in {folder.path}", sep="\n")
        if not found.is_converged:
            advice = "give more --iterations, or a kernel by --outlier-chi2"
            raise InputError(config.graph, f"no minimum after {found.iterations} iterations", advice)
    return metrics


def numbers_of(found: OptimizedPoseGraph) -> dict[str, Any]:
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


def write_results(folder: RunFolder, graph: PoseGraph) -> None:
    """Writes graph.g2o and trajectory_tum.txt."""
    from dpmjax.io import write_tum
    from dpmjax.io.g2o import write_g2o

    write_g2o(folder / "graph.g2o", graph)
    write_tum(folder / "trajectory_tum.txt", graph.poses, times=graph.ids.astype(np.float64), frame="T_world_node")


def draw(folder: RunFolder, name: str, graph: PoseGraph, found: OptimizedPoseGraph) -> None:
    """Draws trajectory.png: the poses before and after."""
    from dpmjax import viz

    def positions(poses: np.ndarray) -> np.ndarray:
        return np.column_stack([poses[:, :2], 0 * poses[:, 0]]) if poses.ndim == 2 else poses[:, :3, 3]

    tracks = [
        viz.Track(f"start, chi2 {found.chi2_initial:.4g}", positions(graph.poses)),
        viz.Track(f"optimised, chi2 {found.chi2:.4g}", positions(found.graph.poses)),
    ]
    title = f"{name}: {len(graph.poses)} nodes, {len(graph.edges.source)} edges"
    viz.save_figure(viz.trajectory_figure(title, tracks, None, np.zeros((0, 2, 3))), folder / "trajectory.png")


def report(metrics: dict[str, Any]) -> str:
    """Returns the last lines on the console."""
    let_go = f", {metrics['num_edges_let_go']} of them let go" if metrics["num_edges_let_go"] else ""
    return (
        f"{metrics['num_nodes']} nodes, {metrics['num_edges']} edges{let_go}\n"
        f"chi2 {metrics['chi2_initial']:.6g} -> {metrics['chi2']:.6g} in {metrics['iterations']} iterations"
    )


def run(args: Sequence[str] | None = None) -> int:
    """Runs the subcommand; returns the exit code."""
    return run_command(main, Config, name=NAME, description=__doc__, args=args)
