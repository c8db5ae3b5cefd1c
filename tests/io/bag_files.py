"""Bags of ROS 1 and 2, written by rosbags: clouds by the conventions of several drivers, planar scans, odometry."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.optional import import_or_skip

EPOCH_NS = 1_600_000_000_000_000_000
KINDS = ("bag", "mcap", "db3")
# Names of fields, their types, offsets and the size of a point, as the drivers lay them out.
LAYOUTS: dict[str, tuple[list[tuple[str, str, int]], int]] = {
    "ouster": (
        [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8), ("intensity", "f4", 16), ("t", "u4", 20),
         ("reflectivity", "u2", 24), ("ring", "u1", 26), ("ambient", "u2", 28), ("range", "u4", 32)],
        48,
    ),
    "velodyne": (
        [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8), ("intensity", "f4", 12), ("ring", "u2", 16),
         ("time", "f4", 18)],
        22,
    ),
    "hesai": (
        [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8), ("intensity", "f4", 16), ("timestamp", "f8", 24),
         ("ring", "u2", 32)],
        48,
    ),
    "livox": (
        [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8), ("intensity", "f4", 12), ("tag", "u1", 16), ("line", "u1", 17),
         ("timestamp", "f8", 18)],
        26,
    ),
    "doubles, z first": ([("z", "f8", 0), ("y", "f8", 8), ("x", "f8", 16)], 24),
}  # fmt: skip
_NUMBERS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
# Unit and start of the times of points.
TIMES = {"ouster": ("t", 1e9, 0.0), "velodyne": ("time", 1.0, 0.0), "hesai": ("timestamp", 1.0, 1.6e9),
         "livox": ("timestamp", 1e9, 1.6e18)}  # fmt: skip


class BagWriter:
    """Writes messages of the standard types to a path without an ending: a bag of ROS 1, mcap or db3 of ROS 2."""

    def __init__(self, path: Path, kind: str) -> None:
        import_or_skip("rosbags.highlevel")
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.is_ros1 = kind == "bag"
        self.types = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        kind_of_transforms = "tf2_msgs/msg/TFMessage"
        if kind_of_transforms not in self.types.types:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.types.register(get_types_from_msg(text, kind_of_transforms))
        self.parse = get_types_from_msg
        self.path = path.with_suffix(".bag") if self.is_ros1 else path
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self._writer: Any = Writer1(self.path) if self.is_ros1 else Writer2(self.path, version=9, storage_plugin=plugin)
        self._connections: dict[str, Any] = {}

    def __enter__(self):
        self._writer.open()
        return self

    def __exit__(self, *error: object) -> None:
        self._writer.close()

    def make(self, kind: str, *values: Any) -> Any:
        return self.types.types[kind](*values)

    def header(self, stamp_ns: int, frame: str = "lidar") -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)
        return self.make("std_msgs/msg/Header", *([0] if self.is_ros1 else []), stamp, frame)

    def write(self, topic: str, kind: str, stamp_ns: int, message: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.types)
        serialize = self.types.serialize_ros1 if self.is_ros1 else self.types.serialize_cdr
        self._writer.write(self._connections[topic], stamp_ns, serialize(message, kind))

    def write_cloud(
        self,
        points: np.ndarray,
        stamp_ns: int,
        layout="ouster",
        times_s=None,
        topic="/points",
        delay_ns=20_000_000,
        row_tail=0,
        is_bigendian=False,
        num_rows=1,
    ) -> None:
        """Writes a cloud by the conventions of a driver; it is recorded a while after its stamp."""
        fields, step = LAYOUTS[layout]
        order = ">" if is_bigendian else "<"
        kinds = {"names": [f[0] for f in fields], "formats": [order + f[1] for f in fields]}
        records = np.zeros(len(points), np.dtype({**kinds, "offsets": [f[2] for f in fields], "itemsize": step}))
        for axis, column in zip("xyz", points.T, strict=True):
            records[axis] = column
        if times_s is not None:
            name, unit, start = TIMES[layout]
            records[name] = start + times_s * unit
        entries = [self.make("sensor_msgs/msg/PointField", name, at, _NUMBERS[kind], 1) for name, kind, at in fields]
        width = len(points) // num_rows
        rows = records.view(np.uint8).reshape(num_rows, width * step)
        data = np.concatenate([rows, np.full((num_rows, row_tail), 255, np.uint8)], axis=1).ravel()
        kind, header = "sensor_msgs/msg/PointCloud2", self.header(stamp_ns)
        shape = (num_rows, width, entries, is_bigendian, step, width * step + row_tail)
        self.write(topic, kind, stamp_ns + delay_ns, self.make(kind, header, *shape, data, False))

    def write_livox(self, points: np.ndarray, stamp_ns: int, times_ns: np.ndarray) -> None:
        """Writes Livox's own message: a list of points with times in nanoseconds from its header."""
        kind, point_kind = "livox_ros_driver/msg/CustomMsg", "livox_ros_driver/msg/CustomPoint"
        if kind not in self.types.types:
            point_text = (
                "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
            )
            text = "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
            text += "CustomPoint[] points"
            self.types.register(self.parse(point_text, point_kind) | self.parse(text, kind))
        rows = zip(times_ns.tolist(), points.tolist(), strict=True)
        entries = [self.make(point_kind, time, *point, 9, 0, 1) for time, point in rows]
        values = (stamp_ns, len(points), 1, np.zeros(3, np.uint8), entries)
        self.write("/livox/lidar", kind, stamp_ns, self.make(kind, self.header(stamp_ns), *values))

    def write_scan(self, ranges: np.ndarray, stamp_ns: int, *, delay_ns: int = 0) -> None:
        step = 2 * np.pi / len(ranges)
        limits = (-np.pi, np.pi - step, step, 0.0, 0.1, 0.1, 30.0)
        values = (ranges.astype(np.float32), np.zeros(0, np.float32))
        message = self.make("sensor_msgs/msg/LaserScan", self.header(stamp_ns, "laser"), *limits, *values)
        self.write("/scan", "sensor_msgs/msg/LaserScan", stamp_ns + delay_ns, message)

    def _vector(self, values: Sequence[float]) -> Any:
        return self.make("geometry_msgs/msg/Vector3", *map(float, values))

    def _turn(self, heading: float, *, is_upside_down: bool = False) -> Any:
        half = float(heading) / 2
        numbers = (np.cos(half), np.sin(half), 0.0, 0.0) if is_upside_down else (0.0, 0.0, np.sin(half), np.cos(half))
        return self.make("geometry_msgs/msg/Quaternion", *map(float, numbers))

    def write_odometry(self, pose: np.ndarray, stamp_ns: int, *, delay_ns: int = 0) -> None:
        point = self.make("geometry_msgs/msg/Point", float(pose[0]), float(pose[1]), 0.0)
        zeros = np.zeros(36)
        covered = self.make("geometry_msgs/msg/Pose", point, self._turn(pose[2]))
        twist = self.make("geometry_msgs/msg/Twist", self._vector([0, 0, 0]), self._vector([0, 0, 0]))
        message = self.make(
            "nav_msgs/msg/Odometry",
            self.header(stamp_ns, "odom"),
            "base_link",
            self.make("geometry_msgs/msg/PoseWithCovariance", covered, zeros),
            self.make("geometry_msgs/msg/TwistWithCovariance", twist, zeros),
        )
        self.write("/odom", "nav_msgs/msg/Odometry", stamp_ns + delay_ns, message)

    def write_transform(
        self, frames: tuple[str, str], pose: np.ndarray, stamp_ns: int, *, topic="/tf", is_upside_down=False
    ) -> None:
        """Writes x, y, heading of a child frame in its parent."""
        parent, child = frames
        turn = self._turn(pose[2], is_upside_down=is_upside_down)
        transform = self.make("geometry_msgs/msg/Transform", self._vector([pose[0], pose[1], 0.5]), turn)
        stamped = self.make("geometry_msgs/msg/TransformStamped", self.header(stamp_ns, parent), child, transform)
        self.write(topic, "tf2_msgs/msg/TFMessage", stamp_ns, self.make("tf2_msgs/msg/TFMessage", [stamped]))
