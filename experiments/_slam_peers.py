"""Other programs on the same scans: KISS-ICP, KISS-SLAM, odometry by small_gicp. Extra `peers`; imported when used.

Each has its own default settings. Only the settings that must fit the place are changed. The largest range is 60 m
outdoors and 30 m indoors, with voxels of a hundredth of it (KISS-ICP's own rule). The voxels of small_gicp are those of
its documentation, and half as large indoors. None of them corrects scans for the motion of the lidar, as ours does not
either.

A program takes the scans in order by `step`, (n, 3) float64, not empty. `finish` returns (n, 4, 4) poses of all scans,
and the loops. Then `map_bytes` returns the bytes of the map of the whole way, with floats of 4 bytes, or None. It takes
the scans again, because KISS-ICP drops far points on the way.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from dpmjax.geometry import rigid

MAX_RANGE_M, INDOOR_MAX_RANGE_M = 60.0, 30.0
# Three coordinates, and a range that drops no point of a map.
POINT_BYTES, UNLIMITED_M = 12, 1e9


class FoundLoop(NamedTuple):
    """A loop that a method has accepted.

    Attributes:
        newer: first and last scan of the newer end: the same scan twice, or those of a whole local map.
        older: the same of the older end.
        T_older_newer: relative pose of the first scans.
    """

    newer: tuple[int, int]
    older: tuple[int, int]
    T_older_newer: np.ndarray


class _Odometry:
    """Poses of a program without loops."""

    def __init__(self) -> None:
        self._poses = list[np.ndarray]()

    def finish(self) -> tuple[np.ndarray, list[FoundLoop]]:
        return np.array(self._poses), []

    def map_bytes(self, scans: Iterable[np.ndarray]) -> int | None:
        return None


class KissIcp(_Odometry):
    """KISS-ICP (Vizzo et al. 2023), with a voxel map of the whole way: the program itself drops far points."""

    def __init__(self, *, is_indoors: bool) -> None:
        super().__init__()
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP

        self._config = load_config(None)
        _set_range(self._config.data, self._config.mapping, is_indoors)
        self._odometry = KissICP(self._config)

    def step(self, points: np.ndarray) -> None:
        self._odometry.register_frame(points, np.zeros(0))
        self._poses.append(self._odometry.last_pose)

    def map_bytes(self, scans: Iterable[np.ndarray]) -> int:
        from kiss_icp.mapping import VoxelHashMap

        mapping, odometry = self._config.mapping, self._odometry
        whole = VoxelHashMap(mapping.voxel_size, UNLIMITED_M, mapping.max_points_per_voxel)
        for points, T in zip(scans, self._poses, strict=True):
            frame = odometry.preprocessor.preprocess(points, np.zeros(0), np.eye(4))
            whole.add_points(odometry.voxelize(frame)[1] @ T[:3, :3].T + T[:3, 3])
        return POINT_BYTES * len(whole.point_cloud())


class KissSlam:
    """KISS-SLAM (Guadagnino et al. 2025): the same odometry, local maps of 100 m, loops between them, a pose graph."""

    def __init__(self, *, is_indoors: bool) -> None:
        from kiss_slam.config import load_config
        from kiss_slam.slam import KissSLAM

        config = load_config(None)
        _set_range(config.odometry.preprocessing, config.odometry.mapping, is_indoors)
        self._slam = KissSLAM(config)
        self._slam.closer = self._closer = _RecordedCloser(self._slam.closer)

    def step(self, points: np.ndarray) -> None:
        self._slam.process_scan(points, np.zeros(0))

    def finish(self) -> tuple[np.ndarray, list[FoundLoop]]:
        self._slam.generate_new_node()
        graph = self._slam.local_map_graph
        graph.erase_last_local_map()
        poses, _ = self._slam.fine_grained_optimization()
        # A local map begins with the last scan of the one before.
        lengths = [len(local_map.local_trajectory) for local_map in graph.local_maps()]
        first = np.concatenate([[0], np.cumsum(np.array(lengths) - 1)])
        loops = [
            FoundLoop((first[newer], first[newer + 1]), (first[older], first[older + 1]), rigid.inverse(T_newer_older))
            for older, newer, T_newer_older in self._closer.found
        ]
        return np.array(poses), loops

    def map_bytes(self, scans: Iterable[np.ndarray]) -> int:
        clouds = [local_map.pcd for local_map in self._slam.local_map_graph.local_maps() if local_map.pcd is not None]
        return POINT_BYTES * sum(len(cloud.point.positions) for cloud in clouds)


class SmallGicp(_Odometry):
    """Odometry by small_gicp (Koide 2024): each scan onto its incremental Gaussian voxel map, from a steady motion."""

    def __init__(self, *, is_indoors: bool) -> None:
        super().__init__()
        import small_gicp

        self._library, self._threads = small_gicp, os.cpu_count() or 1
        self._point_m = 0.125 if is_indoors else 0.25
        self._map = small_gicp.GaussianVoxelMap(4 * self._point_m)

    def step(self, points: np.ndarray) -> None:
        scan, T = self._library.preprocess_points(points, self._point_m, num_threads=self._threads)[0], np.eye(4)
        if self._poses:
            before, last = (self._poses * 2)[-2:]
            # The transpose would treble the rounding errors of the rotations at each scan.
            start = last @ np.linalg.inv(before) @ last if len(self._poses) > 1 else last
            T = self._library.align(self._map, scan, start, num_threads=self._threads).T_target_source
        self._map.insert(scan, T)
        self._poses.append(T)


# The peers by name: the module that must be there, and the class.
PEERS: dict[str, tuple[str, Any]] = {
    "KISS-ICP": ("kiss_icp.kiss_icp", KissIcp),
    "KISS-SLAM": ("kiss_slam.slam", KissSlam),
    "small_gicp": ("small_gicp", SmallGicp),
}


class _RecordedCloser:
    """The loop closer of KISS-SLAM, with a record of the loops that it accepts."""

    def __init__(self, closer: Any) -> None:
        self._closer = closer
        self.found: list[tuple[int, int, np.ndarray]] = []

    def compute(self, *arguments: Any) -> Any:
        is_good, older, newer, T_newer_older = answer = self._closer.compute(*arguments)
        if is_good:
            self.found.append((int(older), int(newer), np.asarray(T_newer_older)))
        return answer


def _set_range(data: Any, mapping: Any, is_indoors: bool) -> None:
    data.max_range = INDOOR_MAX_RANGE_M if is_indoors else MAX_RANGE_M
    mapping.voxel_size, data.deskew = data.max_range / 100.0, False
