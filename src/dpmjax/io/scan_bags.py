"""Scans in bags of ROS: planar ones, and drives of 3-D scans."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.bags import Bag
from dpmjax.io.clouds import TimedCloud
from dpmjax.io.files import refusing
from dpmjax.io.messages import log_notes
from dpmjax.io.poses import interpolate_poses
from dpmjax.io.ros_messages import (
    LASER_SCAN,
    LIVOX_CLOUDS,
    MULTI_ECHO_SCAN,
    ODOMETRY,
    POINT_CLOUD,
    TRANSFORMS,
    LaserBeams,
    beams_of,
    cloud_of,
    matrix_of,
    stamp_of,
)
from dpmjax.io.scan_file import check_scan, unit_note
from dpmjax.sequences import FloatArray, LidarSequence, Note, ScanSequence, has_angular_order

# Frames whose motion against the robot is the result of a mapping, not odometry.
_MAP_FRAMES = ("map", "world", "earth")
# Odometry may end this long before or after a scan, s, for this share of the scans at least.
_SLACK_S, _LEAST_SHARE = 0.2, 0.9
_KINDS = (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError)


class _Motions(NamedTuple):
    """Poses of a frame in its parent: `T_parent_child` (n, 4, 4) at times (n,) s."""

    times: FloatArray
    T_parent_child: FloatArray


def read_scan_bag(path: Path, topic: str | None = None) -> ScanSequence:
    """Reads the planar scans of a bag.

    The odometry is that of the transforms (/tf) up to the odometry frame, or of the only topic of Odometry. A laser
    with a pose on the robot in /tf_static gets its own poses. Beams of a laser mounted upside down are mirrored.

    Args:
        path: a bag, see `Bag`.
        topic: topic of the scans; None: the only one of LaserScan or MultiEchoLaserScan.

    Returns:
        The scans in the order of their headers, in metres, with times in seconds since 1970 and odometry where the bag
        has any.

    Raises:
        InputError: a damaged bag, no topic of planar scans, or several.
    """
    bag = Bag(path)
    chosen = bag.choose((LASER_SCAN, MULTI_ECHO_SCAN), topic, "planar scans")
    with refusing(path, "a broken message ({error})", "record the topic again", _KINDS):
        found = [(stamp_of(m), m.header.frame_id, beams_of(m, chosen.kind)) for m in bag.messages(chosen.name)]
        if any(stamp <= 0 for stamp, _, _ in found):
            recorded = bag.stamps(chosen.name).astype(np.float64) * 1e-9
            found = [(stamp, *scan[1:]) for stamp, scan in zip(recorded.tolist(), found, strict=True)]
        found.sort(key=lambda scan: scan[0])
        times = np.array([stamp for stamp, _, _ in found])
        frame = found[0][1].strip("/")
        edges = _transforms(bag)
        T_odom_laser, note = _odometry(bag, edges, frame, times)
    points, mask = _points([beams for _, _, beams in found])
    if _is_upside_down(edges, frame, T_odom_laser):
        points = points * np.array([1, -1], np.float32)
    odometry = None
    if T_odom_laser is not None:
        heading = np.arctan2(T_odom_laser[:, 1, 0], T_odom_laser[:, 0, 0])
        odometry = np.column_stack([T_odom_laser[:, :2, 3], heading])
    name, is_organised = path.resolve().stem, has_angular_order(points, mask)
    notes = () if note is None else (note,)
    return ScanSequence(name, points, mask, "m", is_organised, None, odometry, times, notes)


def _points(scans: list[LaserBeams]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Computes end points (n, b, 2) and mask (n, b); scans of fewer beams are padded with masked ones."""
    num_beams = max(len(beams.ranges) for beams in scans)
    points = np.zeros((len(scans), num_beams, 2), np.float32)
    mask = np.zeros((len(scans), num_beams), bool)
    for row, (ranges, angles) in enumerate(scans):
        is_echo = np.isfinite(ranges)
        ends = np.where(is_echo, ranges, 0)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        points[row, : len(ranges)], mask[row, : len(ranges)] = ends, is_echo
    return points, mask


def _transforms(bag: Bag) -> dict[str, tuple[str, _Motions]]:
    """Reads the parent of each frame, and the pose of the frame in the parent, from /tf and /tf_static."""
    rows: dict[tuple[str, str], list[tuple[float, FloatArray]]] = {}
    for topic in bag.of_kinds(*TRANSFORMS):
        for message in bag.messages(topic.name):
            for each in message.transforms:
                T = matrix_of(each.transform.translation, each.transform.rotation)
                ends = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
                rows.setdefault(ends, []).append((stamp_of(each), T))
    # Of a frame with several parents, the one of the most transforms.
    ordered = sorted(rows.items(), key=lambda entry: len(entry[1]))
    return {child: (parent, _as_motions(found)) for (parent, child), found in ordered}


def _as_motions(rows: list[tuple[float, FloatArray]]) -> _Motions:
    times, first = np.unique([time for time, _ in rows], return_index=True)
    return _Motions(times, np.array([rows[i][1] for i in first]))


def _odometry(
    bag: Bag, edges: dict[str, tuple[str, _Motions]], frame: str, times: FloatArray
) -> tuple[FloatArray | None, Note | None]:
    """Returns `T_odom_laser` at the times of the scans, None where the bag has no odometry, and a note on it."""
    T, moving, seen = np.tile(np.eye(4), (len(times), 1, 1)), False, {frame}
    top = frame
    while top in edges and edges[top][0] not in (*_MAP_FRAMES, *seen):
        parent, motions = edges[top]
        if len(motions.times) > 1:
            if not _covers(motions.times, times):
                break
            moving = True
        T = interpolate_poses(motions.times, motions.T_parent_child, times) @ T
        top = parent
        seen.add(top)
    if moving:
        return T, Note(f"{bag.path}: odometry of the transforms from {top} to {frame}")
    topics = bag.of_kinds(ODOMETRY)
    if len(topics) != 1:
        names = ", ".join(topic.name for topic in topics)
        text = f"{bag.path}: {len(topics)} topics of odometry ({names}), none is used"
        return None, Note(text, is_doubt=True) if topics else None
    rows = []
    for message in bag.messages(topics[0].name):
        pose = message.pose.pose
        rows.append((stamp_of(message), matrix_of(pose.position, pose.orientation)))
    motions = _as_motions(rows)
    name = topics[0].name
    if not _covers(motions.times, times):
        text = f"{bag.path}: the odometry of {name} is not of the times of the scans; it is not used"
        return None, Note(text, is_doubt=True)
    # The traversed transforms are constant: the pose of the laser on the robot.
    T_odom_base = interpolate_poses(motions.times, motions.T_parent_child, times)
    return np.asarray(T_odom_base @ T), Note(f"{bag.path}: odometry of {name}")


def _covers(times: FloatArray, wanted: FloatArray) -> bool:
    is_near = (wanted >= times[0] - _SLACK_S) & (wanted <= times[-1] + _SLACK_S)
    return len(times) > 1 and float(is_near.mean()) >= _LEAST_SHARE


def _is_upside_down(edges: dict[str, tuple[str, _Motions]], frame: str, T_odom_laser: FloatArray | None) -> bool:
    """Returns True if the z axis of the laser points down, in the odometry or on the robot."""
    if T_odom_laser is not None:
        return bool(np.median(T_odom_laser[:, 2, 2]) < 0)
    return frame in edges and bool(np.median(edges[frame][1].T_parent_child[:, 2, 2]) < 0)


def open_lidar_bag(path: Path, topic: str | None = None) -> LidarSequence:
    """Opens the clouds of a bag; a scan is read on demand.

    The bag is read through once for the times of the clouds.

    Args:
        path: a bag, see `Bag`.
        topic: topic of the clouds; None: the only one of PointCloud2 or Livox's CustomMsg.

    Returns:
        The sequence in the order of the headers' times, with times in seconds since 1970 and times of points.

    Raises:
        InputError: a damaged bag, or no topic of clouds, or several.
    """
    bag = Bag(path)
    chosen = bag.choose((POINT_CLOUD, *LIVOX_CLOUDS), topic, "point clouds")
    times = bag.stamps(chosen.name).astype(np.float64) * 1e-9
    sources = tuple(f"{path} {chosen.name} {index}" for index in range(len(times)))

    def read(index: int) -> TimedCloud:
        advice, kinds = "record the topic again", (ValueError, KeyError, TypeError, AttributeError, OverflowError)
        message = bag.read(chosen.name, index)
        with refusing(sources[index], "a broken message ({error})", advice, kinds):
            cloud = cloud_of(message, chosen.kind)
        return check_scan(cloud, sources[index])

    def read_scan(index: int) -> np.ndarray:
        points = read(index).points
        if index == 0 and (note := unit_note(points, sources[0])) is not None:
            log_notes([note])
        return points

    name = path.resolve().stem
    return LidarSequence(name, sources, read_scan, None, times, lambda index: read(index).times)
