"""The DeepMapping paper's baseline of incremental ICP: each scan onto the one before, from the identity, composed.

A textbook ICP: nearest points, equal weights, no search, no robust kernel. The steps of `incremental_icp` are searched
where they are unclear, so it is another method.
"""

from __future__ import annotations

import itertools
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dpmjax import ScanSet, estimate_normals
from dpmjax.geometry import se2, typical_range

Floats = NDArray[np.float64]

# Numbers of the published program: a step ends after this many iterations, or when the mean distance changes by less
# than this share of the typical range; a normal is fitted to this many points.
_MAX_ITERATIONS, _TOLERANCE, _NORMAL_NEIGHBOURS = 100, 1e-6, 6


def chain_icp(scans: ScanSet, metric: Literal["point", "plane"]) -> Floats:
    """Registers planar scans by a chain of pairwise ICP.

    Args:
        scans: n scans in the order of time.
        metric: distance to the nearest point (Besl and McKay 1992) or to its line (Chen and Medioni 1992).

    Returns:
        (n, 3) T_world_scan, x, y, heading; the first one zero.
    """
    tolerance = _TOLERANCE * typical_range(scans.points, scans.mask)
    pairs = zip(np.asarray(scans.points, np.float64), np.asarray(scans.mask), strict=True)
    clouds = [points[mask] for points, mask in pairs]
    steps = [align(source, target, metric, tolerance) for target, source in itertools.pairwise(clouds)]
    return se2.chain(np.array(steps).reshape(-1, 3))


def align(source: Floats, target: Floats, metric: Literal["point", "plane"], tolerance: float) -> Floats:
    """Aligns two clouds from the identity by textbook ICP.

    Args:
        source: (n, 2) points.
        target: (m, 2) points.
        metric: distance to the nearest point or to its line.
        tolerance: change of the mean distance below which the iteration ends, unit of the points.

    Returns:
        (3,) T_target_source, x, y, heading.
    """
    from scipy.spatial import KDTree

    tree, pose, before = KDTree(target), np.zeros(3), np.inf
    normals = None
    if metric == "plane":
        normals = np.asarray(estimate_normals(target.astype(np.float32), _NORMAL_NEIGHBOURS).normals, np.float64)
    for _ in range(_MAX_ITERATIONS):
        moved = se2.transform_points(pose, source)
        distance, nearest = tree.query(moved)
        if abs(before - distance.mean()) < tolerance:
            break
        before = distance.mean()
        step = (
            _step_to_points(moved, target[nearest])
            if normals is None
            else _step_to_lines(moved, target[nearest], normals[nearest])
        )
        pose = se2.compose(step, pose)
    return pose


def _step_to_points(source: Floats, matched: Floats) -> Floats:
    """Returns the motion of the least sum of squared distances between points (closed form)."""
    a, b = source - source.mean(axis=0), matched - matched.mean(axis=0)
    heading = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    return np.append(matched.mean(axis=0) - se2.rotation(heading) @ source.mean(axis=0), heading)


def _step_to_lines(source: Floats, matched: Floats, normals: Floats) -> Floats:
    """Returns the motion of the least sum of squared distances to lines, linear in the angle."""
    turning = source[:, 0] * normals[:, 1] - source[:, 1] * normals[:, 0]
    residuals = ((matched - source) * normals).sum(axis=1)
    return np.linalg.lstsq(np.column_stack([normals, turning]), residuals, rcond=None)[0]
