"""Scans in bags of ROS 1 and ROS 2, by rosbags (extra `ros`): planar ones with odometry, and drives of 3-D scans."""

from __future__ import annotations

import collections
import logging
import re
import struct
import threading
import weakref
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax.geometry import rigid, se2
from dpmjax.io.clouds import TimedCloud, cloud_of
from dpmjax.io.files import import_for, natural_key, refusing, to_float32
from dpmjax.io.lidar_file import check_scan
from dpmjax.io.poses import interpolate_poses
from dpmjax.sequences import FloatArray, LidarSequence, Note, ScanSequence, homogeneous, pad_scans, require

_log = logging.getLogger(__name__)
_CLOUDS = ("sensor_msgs/msg/PointCloud2", "livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
_PLANAR_SCANS = ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan")
_ODOMETRY, _TRANSFORMS = ("nav_msgs/msg/Odometry",), ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_SUFFIXES = (".bag", ".mcap", ".db3")
# sensor_msgs/PointField: the numbers of its data types.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# Frames whose motion against the robot is the result of a mapping, not odometry.
_MAP_FRAMES = ("map", "world", "earth")
# Odometry may end this long before or after a scan, s, for this share of the scans at least.
_SLACK_S, _LEAST_SHARE = 0.2, 0.9
_KINDS = (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError)


class _Place(NamedTuple):
    """A message in a bag: time of its header, of its recording, and its number among those of the same time, ns."""

    stamp_ns: int
    recorded_ns: int
    number: int


class _Motion(NamedTuple):
    """Poses of a frame in its parent: `T_parent_child` (n, 4, 4) at times (n,) s."""

    parent: str
    times: FloatArray
    T_parent_child: FloatArray

    @property
    def is_constant(self) -> bool:
        """True for a mounting, also where it is published again and again."""
        return float(np.ptp(self.T_parent_child, axis=0).max()) < 1e-9


def is_bag(path: Path) -> bool:
    """Returns True for a bag of ROS: a file .bag, .mcap or .db3, or a folder of these."""
    return path.suffix.lower() in _SUFFIXES if path.is_file() else path.is_dir() and bool(_bag_files(path))


def _bag_files(path: Path) -> list[Path]:
    """Lists the files of a bag; the folder itself where it has ROS 2's metadata.yaml, and the files that it names."""
    if not path.is_dir():
        return [path]
    metadata = path / "metadata.yaml"
    text = metadata.read_text("utf-8", "replace") if metadata.is_file() else ""
    # Another program's metadata.yaml lies beside its scans; that of a renamed bag names files that are not there.
    is_bag_2 = "rosbag2_bagfile_information" in text
    named = re.findall(r"[^\s'\"\[\],]+\.(?:db3|mcap)\b", text)
    if is_bag_2 and all((path / name).is_file() for name in named):
        return [path]
    parts = (sorted(path.glob(f"*{suffix}"), key=lambda file: natural_key(file.name)) for suffix in _SUFFIXES)
    return next((found for found in parts if found), [path] if is_bag_2 else [])


class _Bag:
    """An open bag, which is closed with its last reference; errors of damaged bags are `InputError`s.

    The path is a file .bag, .mcap or .db3, a folder of the parts of a bag, or a folder with metadata.yaml.
    """

    def __init__(self, path: Path) -> None:
        highlevel = import_for(path, "rosbags.highlevel", "ros")
        typesys = import_for(path, "rosbags.typesys", "ros")
        self.path = path
        self._lock = threading.Lock()
        files = _bag_files(path)
        if path.is_dir() and files != [path] and (path / "metadata.yaml").is_file():
            names = ", ".join(file.name for file in files)
            _log.warning("%s: metadata.yaml names files that are not there; %s is read", path, names)
        with _refusing_bag(path):
            # A bag without definitions of its types has the standard ones.
            types = typesys.get_typestore(typesys.Stores.LATEST)
            self._reader: Any = highlevel.AnyReader(files, default_typestore=types)
            self._reader.open()
            weakref.finalize(self, self._reader.close)
            # Type and number of messages by name.
            self.topics = {name: (str(it.msgtype), int(it.msgcount)) for name, it in self._reader.topics.items()}

    def of_kinds(self, kinds: Collection[str]) -> list[str]:
        """Finds the topics of these types that have messages."""
        return [name for name, (kind, count) in self.topics.items() if kind in kinds and count > 0]

    def choose(self, kinds: Collection[str], topic: str | None, what: str) -> str:
        """Chooses the topic of scans of these types: the one that the user names, else the only one."""
        types = {name: kind.rpartition("/")[2] for name, (kind, _) in self.topics.items()}
        held = ", ".join(f"{name} ({kind})" for name, kind in types.items()) or "none"
        named = [name for name in types if topic is None or name.strip("/") == topic.strip("/")]
        found = f"no topic {topic}, it has {held}"
        require(topic is None or len(named) > 0, self.path, found, "name one of those with --topic")
        wanted = [name for name in named if self.topics[name][0] in kinds]
        found = f"no {what}{'' if topic is None else f' in topic {topic}'}; its topics are {held}"
        advice = "dpmjax map2d reads LaserScan, dpmjax slam PointCloud2 and CustomMsg; raw packets need their driver"
        require(len(wanted) > 0, self.path, found, advice)
        fitting = [name for name in wanted if self.topics[name][1] > 0]
        found = f"the topic {', '.join(wanted)} has no message"
        require(len(fitting) > 0, self.path, found, "record it again while the driver runs")
        found = f"{len(fitting)} topics of {what}: {', '.join(fitting)}"
        require(len(fitting) == 1, self.path, found, "name one with --topic")
        return fitting[0]

    def read(self, topic: str, place: _Place) -> Any:
        """Reads a message at one of the `places` of its topic."""
        with self._lock, _refusing_bag(self.path):
            found = list(self._messages(topic, start=place.recorded_ns, stop=place.recorded_ns + 1))
            connection, _, content = found[place.number]
            return self._reader.deserialize(content, connection.msgtype)

    def recorded(self, topic: str) -> Iterator[tuple[float, Any]]:
        """Reads the times of the recording, s, and the messages of a topic, in the order of the recording."""
        with self._lock, _refusing_bag(self.path):
            for connection, recorded_ns, content in self._messages(topic):
                yield 1e-9 * recorded_ns, self._reader.deserialize(content, connection.msgtype)

    def _messages(self, topic: str, **times: int) -> Iterator[Any]:
        return self._reader.messages([each for each in self._reader.connections if each.topic == topic], **times)

    def places(self, topic: str) -> tuple[list[_Place], tuple[Note, ...]]:
        """Finds the messages of a topic, which begin with a header, in the order of the times of their headers.

        The times of the recording are taken if a header has no time, or if a clock was set back.

        Returns:
            The places, and a note on the fault of the headers' times, if any.
        """
        places: list[_Place] = []
        with self._lock, _refusing_bag(self.path):
            seen: collections.Counter[int] = collections.Counter()
            for _, recorded_ns, content in self._messages(topic):
                # The time of the header follows a number (ROS 1), or the encoding (ROS 2).
                order = ">" if self._reader.is2 and content[1] == 0 else "<"
                seconds, nanoseconds = struct.unpack_from(f"{order}II", content, 4)
                places.append(_Place(seconds * 10**9 + nanoseconds, recorded_ns, seen[recorded_ns]))
                seen[recorded_ns] += 1
        stamps, recorded = 1e-9 * np.array([place[:2] for place in places], np.float64).reshape(-1, 2).T
        notes = _fault_of_stamps(stamps, recorded, self.path)
        if notes:
            places = [place._replace(stamp_ns=place.recorded_ns) for place in places]
        return sorted(places), notes


def _fault_of_stamps(stamps: FloatArray, recorded: FloatArray, path: Path) -> tuple[Note, ...]:
    """Tells why the times (n,) of headers, s, give no order; messages that overtook each other are no fault."""
    back, ahead = np.diff(stamps), stamps - recorded
    # After a clock was set back, all stamps are behind the recording; a message that was overtaken is alone.
    is_set = [
        back[i] < -1.0 or (back[i] < 0 and np.median(ahead[i + 1 : i + 6]) - np.median(ahead[: i + 1][-5:]) < back[i])
        for i in range(len(back))
    ]
    if len(stamps) and stamps.min() <= 0:
        fault = "a header without a time"
    elif any(is_set):
        first = is_set.index(True)
        fault = f"the stamps step back by {-back[first]:.3g} s at message {first + 1}"
    else:
        return ()
    return (Note(f"{path}: {fault}; the order of the recording is used", is_doubt=True),)


def _refusing_bag(path: Path) -> Any:
    """Turns all errors of rosbags on damaged bags into an `InputError`."""
    advice = "copy the bag again, or repair it (rosbag reindex, ros2 bag reindex, mcap recover)"
    return refusing(path, "cannot be read as a bag of ROS ({kind}: {error})", advice, (Exception,))


def read_scan_bag(path: Path, topic: str | None = None) -> ScanSequence:
    """Reads the planar scans of a bag.

    The odometry is that of the only topic of Odometry; without such a topic, that of the transform (/tf) that moves. A
    laser with a constant pose on the robot gets its own poses. Beams of a laser mounted upside down are mirrored.

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
    chosen = bag.choose(_PLANAR_SCANS, topic, "planar scans")
    with refusing(path, "a broken message ({error})", "record the topic again", _KINDS):
        messages = [
            (_stamp_of(message), recorded_s, message.header.frame_id.strip("/"), _ends_of(message))
            for recorded_s, message in bag.recorded(chosen)
        ]
        stamps, recorded, frames, scans = zip(*messages, strict=True)
        notes = _fault_of_stamps(np.array(stamps), np.array(recorded), path)
        for odometry_topic in bag.of_kinds(_ODOMETRY):
            notes = notes or bag.places(odometry_topic)[1]
        times = np.array(recorded if notes else stamps)
        order = np.argsort(times, kind="stable")
        T_odom_laser, is_upside_down, found = _odometry(bag, frames[order[0]], times[order], by_recording=bool(notes))
    points, mask = pad_scans([scans[index] for index in order])
    if is_upside_down:
        points = points * np.array([1, -1], np.float32)
    odometry = None if T_odom_laser is None else se2.from_matrix(T_odom_laser[:, [[0], [1], [3]], [0, 1, 3]])
    name = path.resolve().stem
    return ScanSequence(name, points, mask, "m", None, odometry, times[order], (*notes, *found))


def _ends_of(message: Any) -> FloatArray:
    """Computes the end points (b, 2) of a planar scan, of several echoes the first.

    NaN stands for a range below `range_min`, of `range_max` or more, or not finite.

    Returns:
        End points, m.

    Raises:
        ValueError: angles that are not finite.
    """
    # Of a MultiEchoLaserScan, each beam has a list of echoes.
    firsts = [np.append(each.echoes, np.nan)[0] if hasattr(each, "echoes") else each for each in message.ranges]
    ranges = np.array(firsts, np.float64)
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


def _motions(bag: _Bag, topics: list[str], *, by_recording: bool) -> dict[str, _Motion]:
    """Reads the motion of each frame in its parent by transforms or odometry; of several parents, that of the most."""
    rows: dict[tuple[str, str], list[tuple[float, FloatArray]]] = {}
    for topic in topics:
        for recorded_s, message in bag.recorded(topic):
            for each in getattr(message, "transforms", [message]):
                if hasattr(each, "transform"):
                    T = _pose_of(each.transform.translation, each.transform.rotation)
                else:
                    T = _pose_of(each.pose.pose.position, each.pose.pose.orientation)
                ends = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
                rows.setdefault(ends, []).append((recorded_s if by_recording else _stamp_of(each), T))
    motions = {}
    for (parent, child), found in sorted(rows.items(), key=lambda entry: len(entry[1])):
        times, first = np.unique([time for time, _ in found], return_index=True)
        motions[child] = _Motion(parent, times, np.array([found[i][1] for i in first]))
    return motions


def _odometry(
    bag: _Bag, frame: str, times: FloatArray, *, by_recording: bool
) -> tuple[FloatArray | None, bool, tuple[Note, ...]]:
    """Computes the odometry of the laser: the motion of the robot after the chain of constant transforms to the laser.

    Returns:
        T_odom_laser at the times of the scans, None where the bag has no odometry; True where the laser is upside down;
        and notes.
    """
    motions = _motions(bag, bag.of_kinds(_TRANSFORMS), by_recording=by_recording)
    T_top_laser, top = np.eye(4), frame
    for _ in range(len(motions)):  # transforms may form a circle
        if top in motions and motions[top].is_constant and motions[top].parent not in _MAP_FRAMES:
            T_top_laser, top = motions[top].T_parent_child[0] @ T_top_laser, motions[top].parent
    topics, moving = bag.of_kinds(_ODOMETRY), motions.get(top)
    above = motions.get(moving.parent) if moving else None
    is_chain = above is not None and not above.is_constant and above.parent not in _MAP_FRAMES
    what, is_upside_down = f"odometry of the transforms to {frame}", bool(T_top_laser[2, 2] < 0)
    if len(topics) == 1 and not is_chain:
        what = f"odometry of {topics[0]}"
        *_, moving = _motions(bag, topics, by_recording=by_recording).values()
    elif moving is None or is_chain or moving.is_constant or moving.parent in _MAP_FRAMES:
        found = f"no odometry, of {len(topics)} topics ({', '.join(topics)}) and moving transforms to {frame}"
        notes = (Note(f"{bag.path}: {found}", is_doubt=True),) if topics or is_chain else ()
        return None, is_upside_down, notes
    is_near = (times >= moving.times[0] - _SLACK_S) & (times <= moving.times[-1] + _SLACK_S)
    if len(moving.times) < 2 or is_near.mean() < _LEAST_SHARE:
        text = f"{bag.path}: the {what} is not of the times of the scans; it is not used"
        return None, is_upside_down, (Note(text, is_doubt=True),)
    T = np.asarray(_continued(moving, times) @ T_top_laser)
    return T, bool(np.median(T[:, 2, 2]) < 0), (Note(f"{bag.path}: {what}"),)


def _continued(moving: _Motion, times: FloatArray) -> FloatArray:
    # Interpolated poses. Before the first one and after the last one, the motion goes on: a robot whose odometry has
    # late stamps does not stand there.
    inside = np.clip(times, moving.times[0], moving.times[-1])
    T, mirrored = (interpolate_poses(moving.times, moving.T_parent_child, at) for at in (inside, 2 * inside - times))
    is_outside = (times != inside)[:, None, None]
    return np.where(is_outside, T @ rigid.inverse(mirrored) @ T, T)


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
    chosen = bag.choose(_CLOUDS, topic, "point clouds")
    places, notes = bag.places(chosen)
    times = np.array([place.stamp_ns for place in places], np.float64) * 1e-9
    sources = tuple(f"{path} {chosen} {index}" for index in range(len(places)))

    def read(index: int) -> TimedCloud:
        message = bag.read(chosen, places[index])
        with refusing(sources[index], "a broken message ({error})", "record the topic again", _KINDS):
            cloud = _cloud_of(message)
        return check_scan(cloud, sources[index])

    name = path.resolve().stem
    return LidarSequence(name, sources, lambda i: read(i).points, None, times, lambda i: read(i).times, notes)


def _cloud_of(message: Any) -> TimedCloud:
    """Reads the points of a PointCloud2 (any order and type of fields, padding), or of Livox's CustomMsg."""
    if hasattr(message, "points"):
        rows = [(point.x, point.y, point.z, point.offset_time) for point in message.points]
        table = np.array(rows, np.float64).reshape(-1, 4)
        return TimedCloud(to_float32(table[:, :3]), table[:, 3])
    step, width, height = int(message.point_step), int(message.width), int(message.height)
    order = ">" if message.is_bigendian else "<"
    fields = {f.name: (order + _TYPES[f.datatype], int(f.offset)) for f in message.fields if f.datatype in _TYPES}
    if not {"x", "y", "z"} <= set(fields):
        raise ValueError(f"a cloud without x, y or z, its fields are {' '.join(fields) or 'none'}")
    formats, offsets = zip(*fields.values(), strict=True)
    record = np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": step})
    # A row may have a tail; drivers leave row_step unset for clouds of one row.
    row_step = max(int(message.row_step), width * step) if height > 1 else width * step
    data = np.ascontiguousarray(message.data, np.uint8)
    records = np.ndarray((height, width), record, data, strides=(row_step, step)).ravel()
    return cloud_of({name: records[name] for name in fields})
