"""Scans in bags of ROS 1 and ROS 2, by rosbags (extra `ros`): planar ones with odometry, and drives of 3-D scans."""

from __future__ import annotations

import struct
import threading
import weakref
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpmjax.geometry import se2
from dpmjax.io.clouds import TimedCloud, cloud_of
from dpmjax.io.files import import_for, natural_key, refusing, to_float32
from dpmjax.io.lidar_file import check_scan
from dpmjax.io.poses import interpolate_poses
from dpmjax.sequences import FloatArray, LidarSequence, Note, ScanSequence, homogeneous, pad_scans, require

_POINT_CLOUD, _LASER_SCAN = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/LaserScan"
_LIVOX_CLOUDS = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
_MULTI_ECHO_SCAN = "sensor_msgs/msg/MultiEchoLaserScan"
_SUFFIXES = (".bag", ".mcap", ".db3")
_ADVICE = "copy the bag again, or repair it (rosbag reindex, ros2 bag reindex, mcap recover)"
# Advice for bags without scans of the wanted kind, by the types that they have.
_OTHER_KINDS = {
    ("LaserScan", "MultiEchoLaserScan"): "planar scans are mapped by dpmjax map2d",
    ("PointCloud2", "CustomMsg"): "clouds are mapped by dpmjax slam",
    ("VelodyneScan", "PacketMsg", "VelodynePacket", "RslidarPacket", "UdpFrame", "HesaiScan", "PandarScan"): (
        "raw packets are not read: play them through the driver and record its PointCloud2"
    ),
}
_ODOMETRY, _TRANSFORMS = "nav_msgs/msg/Odometry", ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
# sensor_msgs/PointField: the numbers of its data types.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# Frames whose motion against the robot is the result of a mapping, not odometry.
_MAP_FRAMES = ("map", "world", "earth")
# Odometry may end this long before or after a scan, s, for this share of the scans at least.
_SLACK_S, _LEAST_SHARE = 0.2, 0.9
_KINDS = (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError)


class _Topic(NamedTuple):
    """A topic of a bag: its name, type and number of messages, such as /points of sensor_msgs/msg/PointCloud2."""

    name: str
    kind: str
    num_messages: int

    @property
    def short_kind(self) -> str:
        """The type without its package."""
        return self.kind.rpartition("/")[2]


class _Place(NamedTuple):
    """A message in a bag: time of its header, of its recording, and its number among those of the same time, ns."""

    stamp_ns: int
    recorded_ns: int
    number: int


def is_bag(path: Path) -> bool:
    """Returns True for a bag of ROS: a file .bag, .mcap or .db3, or a folder of these."""
    return path.suffix.lower() in _SUFFIXES if path.is_file() else path.is_dir() and bool(_bag_files(path))


def _bag_files(path: Path) -> list[Path]:
    """Lists the files of a bag; the folder itself where it has ROS 2's metadata.yaml."""
    if not path.is_dir():
        return [path]
    metadata = path / "metadata.yaml"
    # Another program's metadata.yaml lies beside its scans.
    if metadata.is_file() and b"rosbag2_bagfile_information" in metadata.read_bytes():
        return [path]
    parts = (sorted(path.glob(f"*{suffix}"), key=lambda file: natural_key(file.name)) for suffix in _SUFFIXES)
    return next((found for found in parts if found), [])


class _Bag:
    """An open bag, which is closed with its last reference; errors of damaged bags are `InputError`s.

    The path is a file .bag, .mcap or .db3, a folder of the parts of a bag, or a folder with metadata.yaml.
    """

    def __init__(self, path: Path) -> None:
        highlevel = import_for(path, "rosbags.highlevel", "ros")
        typesys = import_for(path, "rosbags.typesys", "ros")
        self.path = path
        self._lock = threading.Lock()
        with _refusing_bag(path):
            # A bag without definitions of its types has the standard ones.
            types = typesys.get_typestore(typesys.Stores.LATEST)
            self._reader: Any = highlevel.AnyReader(_bag_files(path), default_typestore=types)
            self._reader.open()
            weakref.finalize(self, self._reader.close)
            topics = self._reader.topics.items()
            self.topics = [_Topic(name, str(info.msgtype), int(info.msgcount)) for name, info in topics]

    def of_kinds(self, kinds: Collection[str]) -> list[_Topic]:
        """Finds the topics of these types that have messages."""
        return [each for each in self.topics if each.kind in kinds and each.num_messages > 0]

    def choose(self, kinds: Collection[str], topic: str | None, what: str) -> _Topic:
        """Chooses the topic of scans of these types: the one that the user names, else the only one."""
        held = ", ".join(f"{each.name} ({each.short_kind})" for each in self.topics) or "none"
        fitting = self.of_kinds(kinds)
        if topic is not None:
            named = [each for each in self.topics if each.name.strip("/") == topic.strip("/")]
            found = f"no topic {topic}, it has {held}"
            require(len(named) > 0, self.path, found, "name one of those with --topic")
            found = f"topic {topic} has messages {named[0].kind} ({named[0].num_messages})"
            require(named[0] in fitting, self.path, found, f"name a topic of {what}; the bag has {held}")
            return named[0]
        present = {each.short_kind for each in self.topics}
        advices = (advice for others, advice in _OTHER_KINDS.items() if present.intersection(others))
        advice = next(advices, "record LaserScan, PointCloud2 or Livox's CustomMsg")
        require(len(fitting) > 0, self.path, f"no {what}; its topics are {held}", advice)
        names = ", ".join(each.name for each in fitting)
        require(len(fitting) == 1, self.path, f"{len(fitting)} topics of {what}: {names}", "name one with --topic")
        return fitting[0]

    def read(self, topic: str, place: _Place) -> Any:
        """Reads a message at one of the `places` of its topic."""
        with self._lock, _refusing_bag(self.path):
            found = list(self._messages(topic, start=place.recorded_ns, stop=place.recorded_ns + 1))
            connection, _, content = found[place.number]
            return self._reader.deserialize(content, connection.msgtype)

    def messages(self, topic: str) -> Iterator[Any]:
        """Reads all messages of a topic in the order of the recording."""
        with self._lock, _refusing_bag(self.path):
            for connection, _, content in self._messages(topic):
                yield self._reader.deserialize(content, connection.msgtype)

    def _messages(self, topic: str, **times: int) -> Iterator[Any]:
        return self._reader.messages([each for each in self._reader.connections if each.topic == topic], **times)

    def places(self, topic: str) -> list[_Place]:
        """Finds the messages of a topic, which begin with a header, in the order of the times of their headers.

        Where a header has no time, the times of the recording are taken.

        Returns:
            The places.
        """
        places: list[_Place] = []
        with self._lock, _refusing_bag(self.path):
            seen: dict[int, int] = {}
            for _, recorded_ns, content in self._messages(topic):
                number = seen.get(recorded_ns, 0)
                seen[recorded_ns] = number + 1
                # The time of the header follows a number (ROS 1), or the encoding (ROS 2).
                order = ">" if self._reader.is2 and content[1] == 0 else "<"
                seconds, nanoseconds = struct.unpack_from(f"{order}II", content, 4)
                places.append(_Place(seconds * 10**9 + nanoseconds, recorded_ns, number))
        if any(place.stamp_ns <= 0 for place in places):
            places = [place._replace(stamp_ns=place.recorded_ns) for place in places]
        return sorted(places)


def _refusing_bag(path: Path) -> Any:
    """Turns all errors of rosbags on damaged bags into an `InputError`."""
    return refusing(path, "cannot be read as a bag of ROS ({kind}: {error})", _ADVICE, (Exception,))


class _Motions(NamedTuple):
    """Poses of a frame in its parent: `T_parent_child` (n, 4, 4) at times (n,) s."""

    times: FloatArray
    T_parent_child: FloatArray

    @classmethod
    def of(cls, rows: list[tuple[float, FloatArray]]) -> _Motions:
        times, first = np.unique([time for time, _ in rows], return_index=True)
        return cls(times, np.array([rows[i][1] for i in first]))

    def once_if_constant(self) -> _Motions:
        """Returns a single row where all poses are the same, as of a mounting that is published again and again."""
        is_constant = float(np.ptp(self.T_parent_child, axis=0).max()) < _SAME_POSE
        return _Motions(self.times[:1], self.T_parent_child[:1]) if is_constant else self

    def at(self, wanted: FloatArray) -> FloatArray:
        return interpolate_poses(self.times, self.T_parent_child, wanted)

    def covers(self, wanted: FloatArray) -> bool:
        is_near = (wanted >= self.times[0] - _SLACK_S) & (wanted <= self.times[-1] + _SLACK_S)
        return len(self.times) > 1 and float(is_near.mean()) >= _LEAST_SHARE


# Largest difference of the numbers of poses that count as the same.
_SAME_POSE = 1e-9

_Edges = dict[str, tuple[str, _Motions]]


def read_scan_bag(path: Path, topic: str | None = None) -> ScanSequence:
    """Reads the planar scans of a bag.

    The odometry is that of the transforms (/tf) up to the odometry frame, or of the only topic of Odometry. A laser
    with a pose on the robot in /tf_static gets its own poses. Beams of a laser mounted upside down are mirrored.

    Args:
        path: a bag, see `is_bag`.
        topic: topic of the scans; None: the only one of LaserScan or MultiEchoLaserScan.

    Returns:
        The scans in the order of their headers, in metres, with times in seconds since 1970 and odometry where the bag
        has any.

    Raises:
        InputError: a damaged bag, no topic of planar scans, or several.
    """
    bag = _Bag(path)
    chosen = bag.choose((_LASER_SCAN, _MULTI_ECHO_SCAN), topic, "planar scans")
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
        upright, odometry = T_odom_laser, se2.from_matrix(T_odom_laser[:, [[0], [1], [3]], [0, 1, 3]])
    if np.median(upright[:, 2, 2]) < 0:
        points = points * np.array([1, -1], np.float32)
    notes = () if note is None else (note,)
    return ScanSequence(path.resolve().stem, points, mask, "m", None, odometry, times, notes)


def _ends_of(message: Any, kind: str) -> FloatArray:
    """Computes the end points (b, 2) of a planar scan, of several echoes the first.

    NaN stands for a range below `range_min`, of `range_max` or more, or not finite.

    Returns:
        End points, m.

    Raises:
        ValueError: angles that are not finite.
    """
    if kind == _MULTI_ECHO_SCAN:
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


def _transforms(bag: _Bag) -> _Edges:
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
    return {child: (parent, _Motions.of(found).once_if_constant()) for (parent, child), found in ordered}


def _odometry(bag: _Bag, edges: _Edges, frame: str, times: FloatArray) -> tuple[FloatArray | None, Note | None]:
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
        path: a bag, see `is_bag`.
        topic: topic of the clouds; None: the only one of PointCloud2 or Livox's CustomMsg.

    Returns:
        The sequence in the order of the headers' times, with times in seconds since 1970 and times of points.

    Raises:
        InputError: a damaged bag, or no topic of clouds, or several.
    """
    bag = _Bag(path)
    chosen = bag.choose((_POINT_CLOUD, *_LIVOX_CLOUDS), topic, "point clouds")
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
    if kind in _LIVOX_CLOUDS:
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
