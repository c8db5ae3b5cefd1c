"""Multiway registration by Open3D, a baseline of DeepMapping: `pip install dpmjax[baselines]`.

Pairs are registered by iterated closest points. Neighbours in time are sure edges of a pose graph, all further pairs
uncertain ones. A line process removes wrong edges (Choi, Zhou and Koltun, Robust Reconstruction of Indoor Scenes, CVPR
2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from dpmjax import ScanSet
from dpmjax.geometry import rigid, se2, typical_range

Floats = NDArray[np.float64]


# Largest distances of matched points in the first round, and in the second round and the graph, in typical ranges of
# the scans: from a rough start, and from a good one.
_FROM_ROUGH, _FROM_GOOD = (0.09, 0.0225), (0.03, 0.01)
# Scans that the start puts nearer than this share of the typical range are matched too.
_RADIUS = 0.3
# Doubtful edges below this confidence are removed.
_PRUNE = 0.25
# Points of a lidar cloud are thinned to this share of the typical range: 0.3 m in a street.
_VOXEL_SHARE = 0.01


def multiway(scans: ScanSet) -> Floats:
    """Returns poses of planar scans by Open3D's multiway registration; a ModuleNotFoundError without Open3D.

    Args:
        scans: n scans in order of time.

    Returns:
        (n, 3) T_world_scan, x, y, heading; the first one zero.
    """
    unit = typical_range(scans.points, scans.mask)
    points = [p[m] for p, m in zip(np.asarray(scans.points), np.asarray(scans.mask), strict=True)]
    flat = [np.concatenate([p, np.zeros((len(p), 1))], axis=1) for p in points]
    clouds = [_cloud(p) for p in flat]
    poses = _registered(clouds, unit, _FROM_ROUGH, is_planar=True)
    planar = np.stack([poses[:, 0, 3], poses[:, 1, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])], -1)
    return se2.relative(planar[0], planar)


def multiway_images(
    points: Float[np.ndarray, "n h w 3"], mask: Bool[np.ndarray, "n h w"]
) -> Float[NDArray[np.float64], "n 4 4"]:
    """Returns poses of depth images by Open3D's multiway registration; a ModuleNotFoundError without Open3D.

    Args:
        points: points of n images in order of time, each in the frame of its camera.
        mask: True where something was measured.

    Returns:
        T_world_camera, the first one the identity.
    """
    unit = typical_range(points, mask)
    clouds = [_cloud(p[m]) for p, m in zip(np.asarray(points), np.asarray(mask), strict=True)]
    for cloud in clouds:
        cloud.estimate_normals()
    return _registered(clouds, unit, _FROM_ROUGH, is_planar=False)


def multiway_clouds(
    clouds: Sequence[Float[NDArray[np.floating], "_n 3"]],
    T_world_cloud: Float[NDArray[np.float64], "n 4 4"],
) -> Float[NDArray[np.float64], "n 4 4"]:
    """Polishes the poses of lidar clouds by Open3D's multiway registration; a ModuleNotFoundError without Open3D.

    Args:
        clouds: points of n clouds in order of time, each in the frame of its lidar.
        T_world_cloud: where they start.

    Returns:
        T_world_cloud; the first one stays.
    """
    unit = float(np.median([np.percentile(np.linalg.norm(points, axis=1), 90) for points in clouds]))
    thinned = [_cloud(points).voxel_down_sample(_VOXEL_SHARE * unit) for points in clouds]
    for cloud in thinned:
        cloud.estimate_normals()
    T_first_cloud = rigid.inverse(T_world_cloud[0]) @ T_world_cloud
    return T_world_cloud[0] @ _registered(thinned, unit, _FROM_GOOD, is_planar=False, start=T_first_cloud)


def _registered(
    clouds: list[Any], unit: float, shares: tuple[float, float], *, is_planar: bool, start: Floats | None = None
) -> Floats:
    """Returns the poses of clouds, (n, 4, 4), the first one the identity; flat ones by points, others by planes.

    Without a start, each cloud is matched from where the one before is.
    """
    import open3d

    coarse, fine = (share * unit for share in shares)
    registration = open3d.pipelines.registration
    estimation = registration.TransformationEstimationPointToPlane()
    if is_planar:  # planes of flat clouds leave three directions open
        estimation = registration.TransformationEstimationPointToPoint()
    graph = registration.PoseGraph()
    T_world = [np.eye(4)]
    graph.nodes.append(_node(T_world[0]))
    for scan in range(1, len(clouds)):
        guess = np.eye(4) if start is None else rigid.inverse(start[scan]) @ start[scan - 1]
        graph.edges.append(_edge(clouds, (scan - 1, scan), guess, (coarse, fine), estimation, is_doubtful=False))
        # An edge maps its source, the earlier scan, into the later one.
        T_world.append(T_world[-1] @ np.linalg.inv(graph.edges[-1].transformation))
        graph.nodes.append(_node(T_world[-1]))
    placed = np.stack(T_world) if start is None else start
    apart = np.linalg.norm(placed[:, None, :3, 3] - placed[None, :, :3, 3], axis=-1)
    for source, target in np.argwhere(np.triu(apart < _RADIUS * unit, k=2)).tolist():
        guess = rigid.inverse(placed[target]) @ placed[source]
        graph.edges.append(_edge(clouds, (source, target), guess, (coarse, fine), estimation, is_doubtful=True))
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        registration.global_optimization(
            graph,
            registration.GlobalOptimizationLevenbergMarquardt(),
            registration.GlobalOptimizationConvergenceCriteria(),
            registration.GlobalOptimizationOption(
                max_correspondence_distance=fine, edge_prune_threshold=_PRUNE, reference_node=0
            ),
        )
    return np.stack([node.pose for node in graph.nodes])


def _cloud(points: NDArray[np.floating]) -> Any:
    import open3d

    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))


def _node(T_world_scan: Floats) -> Any:
    import open3d

    return open3d.pipelines.registration.PoseGraphNode(T_world_scan)


def _edge(
    clouds: list[Any],
    pair: tuple[int, int],
    T_guess: Floats,
    distances: tuple[float, float],
    estimation: Any,
    *,
    is_doubtful: bool,
) -> Any:
    """Returns the motion of a pair of source and target, with its information."""
    import open3d

    registration = open3d.pipelines.registration
    source, target = (clouds[row] for row in pair)
    T = T_guess
    for distance in distances:
        T = registration.registration_icp(source, target, distance, T, estimation).transformation
    information = registration.get_information_matrix_from_point_clouds(source, target, distances[-1], T)
    return registration.PoseGraphEdge(*pair, T, information, uncertain=is_doubtful)
