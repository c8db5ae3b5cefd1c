"""Joint refinement of the poses of many scans by their surfaces (Borrmann et al. 2008: globally consistent scans).

Near scans are aligned pair by pair from their present poses, and all these motions make a pose graph. So all scans with
a common surface constrain a pose. In a chain of alignments, a single scan would constrain it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import are_near
from dpmjax.pose_graph.graph import Edges, PoseGraph
from dpmjax.pose_graph.optimize import ROBUST, optimize_pose_graph
from dpmjax.scans.align import AlignmentLevel, align_on_host
from dpmjax.scans.pairs import nearest_planes
from dpmjax.scans.surfaces import Surface
from dpmjax.scans.weak_directions import scattered_information, with_least_covariance
from dpmjax.types import Information, Pose, Poses

# Alignment of a pair from nearly right poses. A larger radius joins different surfaces.
NEAR = (AlignmentLevel(1.0, 3000, 8), AlignmentLevel(0.4, 6000, 10))

# Scans are near where their distance is less than this share of their median ranges. A smaller share joins fewer scans.
NEAR_SHARE = 1.0

# Rounds of alignment and optimisation: after the second the poses move by millimetres.
NUM_ROUNDS = 2

# An alignment that moves farther from the present poses than this has found other surfaces.
LARGEST_MOVE = (1.0, math.radians(5.0))

# Least standard deviation of an aligned pair: systematic errors of the lidar.
FLOOR_M, FLOOR_RAD = 0.01, math.radians(0.05)

# Elements of the pairs whose residuals give the information, and their largest distance.
NUM_SAMPLES, RADIUS_M = 3000, 0.5


def refine_jointly(surfaces: Sequence[Surface], T_world_scan: Poses, pairs: Int[np.ndarray, "p 2"]) -> Poses:
    """Refines the poses of scans by the alignments of pairs that see the same surfaces.

    Args:
        surfaces: surface of each of n scans.
        T_world_scan: (n, 4, 4) poses, right within about a metre and 5 degrees relative to each other.
        pairs: rows of scans that overlap; each pair once.

    Returns:
        The poses. The first scan keeps its pose, and so do scans without a pair.
    """
    T_world = np.array(T_world_scan, np.float64)
    for _ in range(NUM_ROUNDS):
        found = [(pair, align_pair(surfaces, T_world, pair)) for pair in pairs.tolist()]
        kept = [(pair, *edge) for pair, edge in found if edge is not None]
        if not kept:
            break
        ends, T, information = zip(*kept, strict=True)
        source, target = np.array(ends).T
        edges = Edges(source, target, np.stack(T), np.stack(information))
        T_before = T_world[0]
        T_world = optimize_pose_graph(PoseGraph.create(T_world, edges), ROBUST).graph.poses
        T_world = T_before @ rigid.inverse(T_world[0]) @ T_world
    return T_world


def scans_in_reach(surfaces: Sequence[Surface], T_world_scan: Poses) -> Int[np.ndarray, "p 2"]:
    """Finds scans that are nearer to each other than the median range of both.

    Args:
        surfaces: surface of each of n scans.
        T_world_scan: (n, 4, 4) their poses.

    Returns:
        Rows of each pair, the later scan first.
    """
    extents = np.array([np.median(np.linalg.norm(surface.points, axis=1)) for surface in surfaces])
    apart = np.linalg.norm(T_world_scan[:, None, :3, 3] - T_world_scan[:, :3, 3], axis=-1)
    return np.argwhere(np.tril(apart < NEAR_SHARE * np.minimum.outer(extents, extents), k=-1))


def align_pair(
    surfaces: Sequence[Surface], T_world_scan: Poses, pair: Sequence[int]
) -> tuple[Pose, Information] | None:
    """Aligns two scans from their present poses.

    Args:
        surfaces: surface of each scan.
        T_world_scan: present poses.
        pair: rows of the source and the target.

    Returns:
        T_target_source and its information; None if the result is far from the present poses.
    """
    source, target = (surfaces[row] for row in pair)
    T_start = rigid.inverse(T_world_scan[pair[1]]) @ T_world_scan[pair[0]]
    found = align_on_host(source, target, T_start[None], NEAR)
    T = found.T_target_source[0]
    if not np.isfinite(found.rmse[0]) or not are_near(T_start, T, *LARGEST_MOVE):
        return None
    planes = nearest_planes(source, target, T[None], RADIUS_M, NUM_SAMPLES).take(0)
    information = scattered_information(planes.take(planes.is_paired), T)
    return T, with_least_covariance(information, FLOOR_M, FLOOR_RAD)
