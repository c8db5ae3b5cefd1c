"""Geometry: a scan is registered point to plane against a local map of recent scans, on the host.

Where the predicted pose is nearly right, one alignment suffices. Where its result is worse than usual, other starts
are tried: the robot stood still, went faster, or turned.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from dpmjax.deeppointmap.verification import MeasuredScan
from dpmjax.geometry import rigid
from dpmjax.geometry.host_tree import HostTree
from dpmjax.scans.free_space import range_image, view_points
from dpmjax.scans.plane_information import plane_information, with_least_covariance
from dpmjax.scans.preprocess import first_of_each_voxel
from dpmjax.scans.surface_alignment import AlignmentLevel, PlanePairs, align_surfaces_from, pair_with_planes
from dpmjax.scans.surfaces import MIN_FLATNESS, Surface, SurfaceConfig, scan_surface
from dpmjax.slam.alignment import Alignment, PosePrior
from dpmjax.slam.columns import Arrays
from dpmjax.slam.config import OdometryConfig
from dpmjax.slam.keyframes import Pose, orthonormal, turn_rad

MAX_LOCAL_POINTS = 4000
"""Points of the local map that are compared with the free space of a scan."""

NUM_FINE = 3
"""So many of the other starts are aligned finely."""


class MapFrame(NamedTuple):
    """A scan of the local map.

    Attributes:
        T_start_scan: its pose where the local map began.
        scan: its number.
    """

    T_start_scan: Pose
    scan: int


class LocalMap(NamedTuple):
    """Recent scans and their common surface, which stays in the frame of the scan that the local map began with.

    Attributes:
        frames: oldest first.
        surface: flat points of all, of each voxel the first of the newest scan.
        scans: (n,) number of the scan of each point.
        voxel_m: side of the voxels.
        T_map_start: the frame of the surface in that of the map, which `move` changes.
    """

    frames: tuple[MapFrame, ...]
    surface: Surface
    scans: Int[np.ndarray, " n"]
    voxel_m: float
    T_map_start: Pose


class SurfaceGeometry:
    """Point-to-plane alignment against the surfaces of recent scans.

    Args:
        config: settings; None takes the defaults.
    """

    def __init__(self, config: OdometryConfig | None = None) -> None:
        self.config = config or OdometryConfig()

    def measure(self, points: Float[np.ndarray, "n 3"]) -> MeasuredScan | None:
        """Measures surface and free space; see `Geometry`.

        Args:
            points: metres, in the frame of the lidar.

        Returns:
            The measured scan; None if it is empty.
        """
        config, ranges = self.config, np.linalg.norm(np.asarray(points, np.float64), axis=1)
        is_within = (ranges >= config.min_range_m) & (ranges <= config.max_range_m)
        if is_within.sum() < config.min_num_points:
            return None
        voxel_m = self._voxel_m(float(np.median(ranges[is_within])))
        radius_m = 5 * voxel_m
        surface = scan_surface(
            points,
            SurfaceConfig(
                config.min_range_m,
                config.max_range_m,
                voxel_m,
                neighbour_radius_m=radius_m,
                sparse_radius_share=config.sparse_radius_share,
            ),
        )
        if len(surface.samples) < config.min_num_points:
            return None
        return MeasuredScan(surface, range_image(surface.points))

    def extent_m(self, measured: MeasuredScan) -> float:
        """Returns the median range of the thinned points; see `Geometry`.

        Args:
            measured: the scan.

        Returns:
            Metres.
        """
        return float(np.median(np.linalg.norm(measured.surface.points, axis=1)))

    def insert(self, local_map: LocalMap | None, measured: MeasuredScan, T_map_scan: Pose, scan: int) -> LocalMap:
        """Adds a scan that is far enough from the last one; see `Geometry`.

        Args:
            local_map: None for an empty one.
            measured: the scan.
            T_map_scan: its pose.
            scan: its number.

        Returns:
            The local map.
        """
        config, extent_m = self.config, self.extent_m(measured)
        if local_map is None:
            local_map = _empty_map(self._voxel_m(extent_m), T_map_scan)
        T_start_scan = orthonormal(rigid.inverse(local_map.T_map_start) @ T_map_scan)
        if local_map.frames:
            T_last_scan = rigid.inverse(local_map.frames[-1].T_start_scan) @ T_start_scan
            apart_m = float(np.linalg.norm(T_last_scan[:3, 3]))
            if apart_m < config.frame_share * extent_m and turn_rad(T_last_scan) < config.frame_rad:
                return local_map
        return _with_frame(local_map, MapFrame(T_start_scan, scan), measured, config.num_frames)

    def move(self, local_map: LocalMap, T_new_map: Pose) -> LocalMap:
        """Changes the frame in which poses are told, and moves no point; see `Geometry`.

        Args:
            local_map: the map.
            T_new_map: the old frame in the new one.

        Returns:
            The map in its new frame.
        """
        return local_map._replace(T_map_start=orthonormal(T_new_map @ local_map.T_map_start))

    def align(self, local_map: LocalMap, measured: MeasuredScan, starts: PosePrior) -> Alignment:
        """Aligns from the prediction, and from other starts where the result is worse than usual; see `Geometry`.

        Args:
            local_map: the map.
            measured: the scan.
            starts: the prediction.

        Returns:
            The best pose by points that meet planes and points in free space.
        """
        T_start_last = rigid.inverse(local_map.T_map_start) @ starts.T_map_last
        found = self._align_in_start(local_map, measured, starts._replace(T_map_last=T_start_last))
        return found._replace(T_map_scan=local_map.T_map_start @ found.T_map_scan)

    def _align_in_start(self, local_map: LocalMap, measured: MeasuredScan, starts: PosePrior) -> Alignment:
        """Aligns where the map frame is that of the surface."""
        config = self.config
        (best,) = self._aligned(local_map, measured, (starts.T_map_last @ starts.T_last_scan)[None])
        wanted = config.good_share * starts.usual_score
        if best.score >= wanted or starts.is_sure:
            return best
        others = starts.T_map_last @ _other_motions(starts.T_last_scan, self.extent_m(measured), config)
        coarse, num_samples = [], config.num_samples // 3
        for found in align_surfaces_from(measured.surface, local_map.surface, others, config.wide):
            pairs = self._pairs(local_map, measured, found.T_target_source, num_samples)
            coarse.append((self._matched_share(pairs, measured, num_samples), found.T_target_source))
        coarse.sort(key=lambda entry: -entry[0])
        fine = self._aligned(local_map, measured, np.array([T for _, T in coarse[:NUM_FINE]]))
        best = max(best, *fine, key=lambda found: found.score)
        return best._replace(num_starts=1 + len(others))

    def pack(self, local_map: LocalMap) -> Arrays:
        """Keeps numbers and poses of the frames; see `Geometry`.

        Args:
            local_map: the map.

        Returns:
            Arrays by name.
        """
        return {
            "scan": np.array([frame.scan for frame in local_map.frames]),
            "T_start_scan": np.array([frame.T_start_scan for frame in local_map.frames]),
            "T_map_start": local_map.T_map_start,
            "voxel_m": np.array(local_map.voxel_m),
        }

    def unpack(self, arrays: Arrays, measure_again: Callable[[int], MeasuredScan]) -> LocalMap:
        """Merges the frames again; see `Geometry`.

        Args:
            arrays: from `pack`.
            measure_again: gives the measured scan of a number.

        Returns:
            The local map.
        """
        local_map = _empty_map(float(arrays["voxel_m"]), arrays["T_map_start"])
        for T, scan in zip(arrays["T_start_scan"], arrays["scan"].tolist(), strict=True):
            local_map = _with_frame(local_map, MapFrame(T, scan), measure_again(scan), len(arrays["scan"]))
        return local_map

    def _voxel_m(self, extent_m: float) -> float:
        sizes = [size for size in self.config.voxel_sizes_m if size <= self.config.voxel_share * extent_m]
        return max(sizes, default=min(self.config.voxel_sizes_m))

    def _aligned(
        self, local_map: LocalMap, measured: MeasuredScan, starts: Float[np.ndarray, "s 4 4"]
    ) -> list[Alignment]:
        surface, map_surface, starts = measured.surface, local_map.surface, orthonormal(starts)
        found = align_surfaces_from(surface, map_surface, starts, self.config.narrow)
        return [self._judged(local_map, measured, each.T_target_source) for each in found]

    def _judged(self, local_map: LocalMap, measured: MeasuredScan, T: Pose) -> Alignment:
        config = self.config
        pairs = self._pairs(local_map, measured, T, config.num_samples)
        matched = self._matched_share(pairs, measured, config.num_samples)
        contradicted = _contradicted_share(local_map, measured, T)
        score = matched - config.contradiction_weight * contradicted
        information = plane_information(pairs, T, max_residual_m=config.plane_distance_m)
        information = with_least_covariance(information, config.floor_m, config.floor_rad)
        return Alignment(T, matched, contradicted, score, information)

    def _pairs(self, local_map: LocalMap, measured: MeasuredScan, T_map_scan: Pose, num_samples: int) -> PlanePairs:
        level = AlignmentLevel(5 * local_map.voxel_m, num_samples, 1)
        return pair_with_planes(measured.surface, local_map.surface, T_map_scan, level)

    def _matched_share(self, pairs: PlanePairs, measured: MeasuredScan, num_samples: int) -> float:
        config = self.config
        meets = (np.abs(pairs.residuals) < config.plane_distance_m) & (pairs.cosines > config.min_cosine)
        return float(meets.sum()) / max(min(num_samples, len(measured.surface.samples)), 1)


def _empty_map(voxel_m: float, T_map_start: Pose) -> LocalMap:
    nothing = np.zeros((0, 3))
    surface = Surface(nothing, nothing, np.zeros(0), np.zeros(0, np.int64), HostTree(nothing))
    return LocalMap((), surface, np.zeros(0, np.int64), voxel_m, T_map_start)


def _with_frame(local_map: LocalMap, frame: MapFrame, measured: MeasuredScan, num_frames: int) -> LocalMap:
    """Adds the flat points of a scan, and drops those of scans before the last `num_frames`."""
    frames = (*local_map.frames, frame)[-num_frames:]
    old, new, R = local_map.surface, measured.surface, frame.T_start_scan[:3, :3]
    is_flat, is_recent = new.flatness > MIN_FLATNESS, local_map.scans >= frames[0].scan
    points = np.concatenate([new.points[is_flat] @ R.T + frame.T_start_scan[:3, 3], old.points[is_recent]])
    kept = first_of_each_voxel(points, local_map.voxel_m)
    points = points[kept]
    scans = np.concatenate([np.full(int(is_flat.sum()), frame.scan), local_map.scans[is_recent]])
    surface = Surface(
        points=points,
        normals=np.concatenate([new.normals[is_flat] @ R.T, old.normals[is_recent]])[kept],
        flatness=np.concatenate([new.flatness[is_flat], old.flatness[is_recent]])[kept],
        samples=np.random.default_rng(0).permutation(len(points)),
        tree=HostTree(points),
    )
    return LocalMap(frames, surface, scans[kept], local_map.voxel_m, local_map.T_map_start)


def _contradicted_share(local_map: LocalMap, measured: MeasuredScan, T_map_scan: Pose) -> float:
    """Returns the share of visible points of the map that lie in the free space of the scan."""
    points = local_map.surface.points[local_map.surface.samples[:MAX_LOCAL_POINTS]]
    in_scan = (points - T_map_scan[:3, 3]) @ T_map_scan[:3, :3]
    views = view_points(measured.image, in_scan)
    return float(views.is_contradicted.sum()) / max(int(views.is_visible.sum()), 1)


def _other_motions(T_last_scan: Pose, extent_m: float, config: OdometryConfig) -> Float[np.ndarray, "s 4 4"]:
    """Returns the predicted step, shorter, longer and turned, and steps straight ahead and back."""
    R = T_last_scan[:3, :3]
    motions = [(R, factor * T_last_scan[:3, 3]) for factor in config.step_factors]
    motions += [(R, np.array([share * extent_m, 0.0, 0.0])) for share in config.ahead_shares]
    for turn_deg in config.turns_deg:
        turned = R @ Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
        motions += [(turned, np.zeros(3)), (turned, T_last_scan[:3, 3])]
    # A vehicle that rocks does not turn on: its tilt comes back.
    motions.append((np.eye(3), T_last_scan[:3, 3]))
    for axis, tilt_deg in itertools.product("xy", config.tilts_deg):
        tilt = Rotation.from_euler(axis, tilt_deg, degrees=True).as_matrix()
        motions += [(R @ tilt, T_last_scan[:3, 3]), (tilt, T_last_scan[:3, 3])]
    found = np.tile(np.eye(4), (len(motions), 1, 1))
    for T, (rotation, translation) in zip(found, motions, strict=True):
        T[:3, :3], T[:3, 3] = rotation, translation
    return found
