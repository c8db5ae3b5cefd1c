"""Pose graphs beside GTSAM's Levenberg-Marquardt on four public graphs: time and final cost in the same run.

The graphs are g2o files in `$DPMJAX_DATA/g2o` (default `../shared/data`). Reading is not timed, compilation is a row of
its own. GTSAM gets a tight prior on the first node, which adds nothing to the cost. Both costs are chi2 by our
residuals: GTSAM 4.3 minimises the same cost in space, and one with the logarithm in the plane.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

import dpmjax
from benchmarks import DATA, Row, Timing, measure
from dpmjax import pose_graph
from dpmjax.cli import why_not_importable

GRAPHS = ("intel", "M3500", "parking-garage", "sphere2500")


def run(quick: bool) -> list[Row]:
    """Optimises each graph with both programs."""
    no_peer = why_not_importable("gtsam")
    if no_peer is not None:
        print(f"no peer: {no_peer}", file=sys.stderr)
    paths = [DATA / "g2o" / f"{name}.g2o" for name in (GRAPHS[:2] if quick else GRAPHS)]
    missing = ", ".join(path.name for path in paths if not path.exists())
    if missing:
        print(f"{missing} not there: skipped; set DPMJAX_DATA", file=sys.stderr)
    there = (path for path in paths if path.exists())
    return [row for path in there for row in compare(path, 2 if quick else 5, has_peer=no_peer is None)]


def compare(path: Path, repeats: int, *, has_peer: bool) -> list[Row]:
    """Returns the rows of one graph."""
    graph = dpmjax.read_g2o(path)
    case = f"{path.stem} {len(graph.poses)} poses, {len(graph.edges.source)} edges"
    ours = measure(lambda: dpmjax.optimize_pose_graph(graph).chi2, repeats=repeats)
    solved = dpmjax.optimize_pose_graph(graph)
    rows = ours.rows(f"{case}: dpmjax")
    metrics = ("chi2_initial", "chi2", "iterations")
    rows += [Row(f"{case}: dpmjax", metric, getattr(solved, metric), "") for metric in metrics]
    if not has_peer:
        return rows
    theirs, poses = gtsam_timing(path, graph, repeats)
    at_theirs = pose_graph.PoseGraph.create(poses, graph.edges)
    chi2 = dpmjax.optimize_pose_graph(at_theirs, pose_graph.PoseGraphConfig(max_iterations=1)).chi2_initial
    rows += theirs.rows(f"{case}: GTSAM", is_compiled=False)
    rows.append(Row(f"{case}: GTSAM", "chi2", chi2, ""))
    rows.append(Row(f"{case}: dpmjax / GTSAM", "median", ours.median_s / theirs.median_s, ""))
    rows.append(Row(f"{case}: dpmjax / GTSAM", "chi2", solved.chi2 / chi2, ""))
    return rows


def gtsam_timing(path: Path, graph: pose_graph.PoseGraph, repeats: int) -> tuple[Timing, np.ndarray]:
    """Returns time and final poses of GTSAM, its settings as they come."""
    import gtsam

    is_spatial = graph.tangent_size == 6
    factors, start = gtsam.readG2o(str(path), is_spatial)
    first = start.keys()[0]
    sigma = gtsam.noiseModel.Isotropic.Sigma(6 if is_spatial else 3, 1e-6)
    held = gtsam.NonlinearFactorGraph(factors)
    pose = start.atPose3(first) if is_spatial else start.atPose2(first)
    held.add((gtsam.PriorFactorPose3 if is_spatial else gtsam.PriorFactorPose2)(first, pose, sigma))

    def optimize() -> Any:
        return gtsam.LevenbergMarquardtOptimizer(held, start, gtsam.LevenbergMarquardtParams()).optimize()

    # The optimised values are no arrays: measured for their time, then computed once more for their poses.
    timing, found = measure(lambda: optimize().size(), repeats=repeats), optimize()
    if is_spatial:
        return timing, np.array([found.atPose3(node).matrix() for node in graph.ids.tolist()])
    poses = (found.atPose2(node) for node in graph.ids.tolist())
    return timing, np.array([(pose.x(), pose.y(), pose.theta()) for pose in poses])
