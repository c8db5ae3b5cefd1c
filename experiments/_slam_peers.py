"""Other programs on the same scans: KISS-ICP, KISS-SLAM, odometry by small_gicp. Extra `peers`; imported when used.

Each has its own default settings. Only the settings that must fit the place are changed. The largest range is 60 m
outdoors and 30 m indoors, with voxels of a hundredth of it (KISS-ICP's own rule). The voxels of small_gicp are those of
its documentation, and half as large indoors. None of them corrects scans for the motion of the lidar, as ours does not
either.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from dpmjax.cli import UNKNOWN
from dpmjax.geometry import rigid

MAX_RANGE_M, INDOOR_MAX_RANGE_M = 60.0, 30.0
# Where half of the points are nearer, the place is indoors.
INDOORS_M = 5.0
# Three coordinates; with the six numbers of a covariance.
POINT_BYTES, GAUSSIAN_BYTES = 12, 36
_UNLIMITED_M, _UNLIMITED_SCANS = 1e9, 10**9


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


class Peer:
    """A program that takes scans in their order.

    `step` takes a scan, (n, 3) float64, not empty. `map_bytes` returns the bytes of the map of the whole way so far,
    with floats of 4 bytes.

    Attributes:
        map_name: kind of the map, for the column of its bytes.
    """

    map_name: str
    _poses: list[np.ndarray]

    def grow_map(self, points: np.ndarray) -> None:
        """Adds the last scan to a map of the whole way, where the program drops far points; not timed."""

    def finish(self) -> tuple[np.ndarray, list[FoundLoop]]:
        """Returns (n, 4, 4) poses of all scans, and the loops."""
        return np.array(self._poses), []


class KissIcp(Peer):
    """KISS-ICP (Vizzo et al. 2023), with a voxel map of the whole way: the program itself drops far points."""

    map_name = "voxels"

    def __init__(self, *, is_indoors: bool) -> None:
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP
        from kiss_icp.mapping import VoxelHashMap

        config = load_config(None)
        _set_range(config.data, config.mapping, is_indoors)
        mapping = config.mapping
        self._odometry = KissICP(config)
        self._whole = VoxelHashMap(mapping.voxel_size, _UNLIMITED_M, mapping.max_points_per_voxel)
        self._poses = []

    def step(self, points: np.ndarray) -> None:
        self._odometry.register_frame(points, np.zeros(0))
        self._poses.append(self._odometry.last_pose)

    def grow_map(self, points: np.ndarray) -> None:
        """Adds the last scan to the voxel map of the whole way; see `Peer`."""
        frame = self._odometry.preprocessor.preprocess(points, np.zeros(0), np.eye(4))
        thinned, T = self._odometry.voxelize(frame)[1], self._poses[-1]
        self._whole.add_points(thinned @ T[:3, :3].T + T[:3, 3])

    def map_bytes(self) -> int:
        """Returns the bytes of its points; see `Peer`."""
        return POINT_BYTES * len(self._whole.point_cloud())


class KissSlam(Peer):
    """KISS-SLAM (Guadagnino et al. 2025): the same odometry, local maps of 100 m, loops between them, a pose graph."""

    map_name = "local_maps"

    def __init__(self, *, is_indoors: bool) -> None:
        from kiss_slam.config import load_config
        from kiss_slam.slam import KissSLAM

        config = load_config(None)
        _set_range(config.odometry.preprocessing, config.odometry.mapping, is_indoors)
        self._slam = KissSLAM(config)
        self._slam.closer = self._closer = _RecordedCloser(self._slam.closer)

    def step(self, points: np.ndarray) -> None:
        with _silence():
            self._slam.process_scan(points, np.zeros(0))

    def map_bytes(self) -> int:
        """Returns the bytes of the points of all local maps, without their normals; see `Peer`."""
        clouds = [local_map.pcd for local_map in self._slam.local_map_graph.local_maps() if local_map.pcd is not None]
        num_points = sum(len(cloud.point.positions) for cloud in clouds) + len(self._slam.voxel_grid.point_cloud())
        return POINT_BYTES * num_points

    def finish(self) -> tuple[np.ndarray, list[FoundLoop]]:
        with _silence():
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


class SmallGicp(Peer):
    """Odometry by small_gicp (Koide 2024): each scan onto its incremental Gaussian voxel map, from a steady motion."""

    map_name = "gaussians"

    def __init__(self, *, is_indoors: bool) -> None:
        import small_gicp

        self._library, self._threads = small_gicp, os.cpu_count() or 1
        self._point_m, voxel_m = (0.125, 0.5) if is_indoors else (0.25, 1.0)
        self._map, self._whole = (small_gicp.GaussianVoxelMap(voxel_m) for _ in range(2))
        self._whole.set_lru(horizon=_UNLIMITED_SCANS)
        self._scan: Any = None
        self._poses = []

    def step(self, points: np.ndarray) -> None:
        scan, _ = self._library.preprocess_points(points, self._point_m, num_threads=self._threads)
        T = np.eye(4)
        if self._poses:
            before, last = (self._poses * 2)[-2:]
            # The transpose would treble the rounding errors of the rotations at each scan.
            start = last @ np.linalg.inv(before) @ last if len(self._poses) > 1 else last
            T = self._library.align(self._map, scan, start, num_threads=self._threads).T_target_source
        self._map.insert(scan, T)
        self._poses.append(T)
        self._scan = scan

    def grow_map(self, points: np.ndarray) -> None:
        """Adds the last scan to the Gaussian voxel map of the whole way; see `Peer`."""
        self._whole.insert(self._scan, self._poses[-1])

    def map_bytes(self) -> int:
        """Returns the bytes of the mean and the covariance of each voxel; see `Peer`."""
        return GAUSSIAN_BYTES * int(self._whole.size())


# The peers by name: the module that must be there, and the class.
PEERS: dict[str, tuple[str, Callable[..., Any]]] = {
    "KISS-ICP": ("kiss_icp.kiss_icp", KissIcp),
    "KISS-SLAM": ("kiss_slam.slam", KissSlam),
    "small_gicp": ("small_gicp", SmallGicp),
}


def peer_version(name: str) -> str:
    """Returns the version of a peer."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return UNKNOWN


def is_indoors(points: np.ndarray) -> bool:
    """Returns True for a scan of a room."""
    return bool(len(points) and np.median(np.linalg.norm(points, axis=1)) < INDOORS_M)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Suppresses the output of a program, also of its compiled part."""
    saved = [(number, os.dup(number)) for number in (1, 2)]
    try:
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
            for number, _ in saved:
                os.dup2(nowhere.fileno(), number)
            yield
    finally:
        for number, copy in saved:
            os.dup2(copy, number)
            os.close(copy)


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
