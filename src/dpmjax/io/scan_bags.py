"""Scans in bags of ROS: planar ones with odometry, and drives of 3-D scans."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpmjax.io.array_files import to_float32
from dpmjax.io.bags import LASER_SCAN, LIVOX_CLOUDS, MULTI_ECHO_SCAN, POINT_CLOUD, Bag
from dpmjax.io.clouds import TimedCloud, cloud_of
from dpmjax.io.files import refusing
from dpmjax.io.lidar_file import check_scan
from dpmjax.io.poses import interpolate_poses
from dpmjax.sequences import FloatArray, LidarSequence, Note, ScanSequence, has_angular_order, homogeneous, pad_scans

_ODOMETRY, _TRANSFORMS = "nav_msgs/msg/Odometry", ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
# sensor_msgs/PointField: the numbers of its data types.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# Frames whose motion against the robot is the result of a mapping, not odometry.
_MAP_FRAMES = ("map", "world", "earth")
# Odometry may end this long before or after a scan, s, for this share of the scans at least.
_SLACK_S, _LEAST_SHARE = 0.2, 0.9
_KINDS = (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError)


class _Motions(NamedTuple):
    """Poses of a frame in its parent: `T_parent_child` (n, 4, 4) at times (n,) s."""

    times: FloatArray
    T_parent_child: FloatArray

    @classmethod
    def of(cls, rows: list[tuple[float, FloatArray]]) -> _Motions:
        times, first = np.unique([time for time, _ in rows], return_index=True)
        return cls(times, np.array([rows[i][1] for i in first]))

    def at(self, wanted: FloatArray) -> FloatArray:
        return interpolate_poses(self.times, self.T_parent_child, wanted)

    def covers(self, wanted: FloatArray) -> bool:
        is_near = (wanted >= self.times[0] - _SLACK_S) & (wanted <= self.times[-1] + _SLACK_S)
        return len(self.times) > 1 and float(is_near.mean()) >= _LEAST_SHARE


_Edges = dict[str, tuple[str, _Motions]]


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
        frames, stamps, scans = [], [], []
        for message in bag.messages(chosen.name):
            frames.append(message.header.frame_id.strip("/"))
            stamps.append(_stamp_of(message))
            scans.append(_ends_of(message, chosen.kind))
        if min(stamps) <= 0:
            stamps = [place.stamp_ns * 1e-9 for place in bag.places(chosen.name)]
        order = np.argsort(stamps, kind="stable")
        times, frame = np.array(stamps)[order], frames[order[0]]
        edges = _transforms(bag)
        T_odom_laser, note = _odometry(bag, edges, frame, times)
    points, mask = pad_scans([scans[index] for index in order])
    odometry = None
    # The z axis of the laser points down, in the odometry or on the robot.
    upright = edges[frame][1].T_parent_child if frame in edges else np.eye(4)[None]
    if T_odom_laser is not None:
        upright = T_odom_laser
        heading = np.arctan2(T_odom_laser[:, 1, 0], T_odom_laser[:, 0, 0])
        odometry = np.column_stack([T_odom_laser[:, :2, 3], heading])
    if np.median(upright[:, 2, 2]) < 0:
        points = points * np.array([1, -1], np.float32)
    name, is_organised = path.resolve().stem, has_angular_order(points, mask)
    notes = () if note is None else (note,)
    return ScanSequence(name, points, mask, "m", is_organised, None, odometry, times, notes)


def _ends_of(message: Any, kind: str) -> FloatArray:
    """Computes the end points (b, 2) of a planar scan, of several echoes the first.

    NaN stands for a range below `range_min`, of `range_max` or more, or not finite.

    Returns:
        End points, m.

    Raises:
        ValueError: angles that are not finite.
    """
    if kind == MULTI_ECHO_SCAN:
        echoes = [np.asarray(echo.echoes, np.float64)[:1] for echo in message.ranges]
        ranges = np.array([echo[0] if len(echo) else np.nan for echo in echoes], np.float64)
    else:
        ranges = np.array(message.ranges, np.float64)
    with np.errstate(invalid="ignore"):
        is_echo = np.isfinite(ranges) & (ranges > 0) & (ranges >= message.range_min)
        if message.range_max > message.range_min:
            is_echo &= ranges < message.range_max
    angles = message.angle_min + message.angle_increment * np.arange(len(ranges))
    if not np.isfinite(angles).all():
        raise ValueError("angles that are not finite")
    return np.where(is_echo, ranges, np.nan)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _stamp_of(message: Any) -> float:
    """Returns the time of a message with a header, s since 1970."""
    return float(message.header.stamp.sec) + 1e-9 * float(message.header.stamp.nanosec)


def _pose_of(position: Any, orientation: Any) -> FloatArray:
    """Builds a pose (4, 4); a ValueError for a quaternion of length 0, or a number that is not finite."""
    numbers = [position.x, position.y, position.z, orientation.x, orientation.y, orientation.z, orientation.w]
    values = np.array(numbers, np.float64)
    if not np.isfinite(values).all() or not 0.5 < np.linalg.norm(values[3:]) < 2.0:
        raise ValueError("a pose without a rotation, or with a number that is not finite")
    return homogeneous(Rotation.from_quat(values[3:]).as_matrix(), values[:3])


def _transforms(bag: Bag) -> _Edges:
    """Reads the parent of each frame, and the pose of the frame in the parent, from /tf and /tf_static."""
    rows: dict[tuple[str, str], list[tuple[float, FloatArray]]] = {}
    for topic in bag.of_kinds(_TRANSFORMS):
        for message in bag.messages(topic.name):
            for each in message.transforms:
                T = _pose_of(each.transform.translation, each.transform.rotation)
                ends = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
                rows.setdefault(ends, []).append((_stamp_of(each), T))
    # Of a frame with several parents, the one of the most transforms.
    ordered = sorted(rows.items(), key=lambda entry: len(entry[1]))
    return {child: (parent, _Motions.of(found)) for (parent, child), found in ordered}


def _odometry(bag: Bag, edges: _Edges, frame: str, times: FloatArray) -> tuple[FloatArray | None, Note | None]:
    """Returns `T_odom_laser` at the times of the scans, None where the bag has no odometry, and a note on it."""
    T, moving, seen, top = np.tile(np.eye(4), (len(times), 1, 1)), False, {frame}, frame
    while top in edges and edges[top][0] not in (*_MAP_FRAMES, *seen):
        parent, motions = edges[top]
        if len(motions.times) > 1:
            if not motions.covers(times):
                break
            moving = True
        T = motions.at(times) @ T
        top = parent
        seen.add(top)
    if moving:
        return T, Note(f"{bag.path}: odometry of the transforms from {top} to {frame}")
    topics = bag.of_kinds((_ODOMETRY,))
    if len(topics) != 1:
        names = ", ".join(topic.name for topic in topics)
        text = f"{bag.path}: {len(topics)} topics of odometry ({names}), none is used"
        return None, Note(text, is_doubt=True) if topics else None
    name = topics[0].name
    poses = [(_stamp_of(message), message.pose.pose) for message in bag.messages(name)]
    motions = _Motions.of([(stamp, _pose_of(pose.position, pose.orientation)) for stamp, pose in poses])
    if not motions.covers(times):
        text = f"{bag.path}: the odometry of {name} is not of the times of the scans; it is not used"
        return None, Note(text, is_doubt=True)
    # The traversed transforms are constant: the pose of the laser on the robot.
    return np.asarray(motions.at(times) @ T), Note(f"{bag.path}: odometry of {name}")


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
    places = bag.places(chosen.name)
    times = np.array([place.stamp_ns for place in places], np.float64) * 1e-9
    sources = tuple(f"{path} {chosen.name} {index}" for index in range(len(places)))

    def read(index: int) -> TimedCloud:
        message = bag.read(chosen.name, places[index])
        with refusing(sources[index], "a broken message ({error})", "record the topic again", _KINDS):
            cloud = _cloud_of(message, chosen.kind)
        return check_scan(cloud, sources[index])

    name = path.resolve().stem
    return LidarSequence(name, sources, lambda i: read(i).points, None, times, lambda i: read(i).times)


def _cloud_of(message: Any, kind: str) -> TimedCloud:
    """Reads the points of a PointCloud2 (any order and type of fields, padding), or of Livox's CustomMsg."""
    if kind in LIVOX_CLOUDS:
        rows = [(point.x, point.y, point.z, point.offset_time) for point in message.points]
        table = np.array(rows, np.float64).reshape(-1, 4)
        return TimedCloud(to_float32(table[:, :3]), table[:, 3])
    records = _records(message)
    columns = {name: records[name] for name in records.dtype.names or ()}
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise ValueError(f"a cloud without {' '.join(missing)}, its fields are {' '.join(columns) or 'none'}")
    return cloud_of(columns)


def _records(message: Any) -> NDArray[Any]:
    """Reads the points of a PointCloud2 as records of their fields."""
    step, width, height = int(message.point_step), int(message.width), int(message.height)
    order = ">" if message.is_bigendian else "<"
    fields = {f.name: (order + _TYPES[f.datatype], int(f.offset)) for f in message.fields if f.datatype in _TYPES}
    formats, offsets = zip(*fields.values(), strict=True) if fields else ((), ())
    layout = np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": step})
    data = np.ascontiguousarray(message.data, np.uint8)
    row = width * step
    # A row may have a tail; drivers leave row_step unset for clouds of one row.
    row_step = int(message.row_step) if height > 1 and int(message.row_step) > row else row
    needed = row_step * (height - 1) + row if height else 0
    if len(data) < needed or step < 1:
        raise ValueError(f"{height} x {width} points of {step} bytes need {needed} bytes, {len(data)} are there")
    rows = [data[i * row_step : i * row_step + row] for i in range(height)] if row else []
    return (np.concatenate(rows) if rows else data[:0]).view(layout)
