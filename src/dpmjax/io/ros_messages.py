"""Messages of ROS as arrays: clouds, planar scans and poses."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.clouds import TimedCloud, find_time_field
from dpmjax.io.files import to_float32
from dpmjax.io.poses import homogeneous
from dpmjax.sequences import FloatArray

POINT_CLOUD, LIVOX_CLOUDS = (
    "sensor_msgs/msg/PointCloud2",
    ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg"),
)
LASER_SCAN, MULTI_ECHO_SCAN = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
# sensor_msgs/PointField: the numbers of its data types.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


class LaserBeams(NamedTuple):
    """The beams of a planar scan.

    Attributes:
        ranges: (b,) m; NaN for beams without a hit.
        angles: (b,) radians, in the frame of the laser.
    """

    ranges: FloatArray
    angles: FloatArray


def cloud_of(message: Any, kind: str) -> TimedCloud:
    """Reads the points of a cloud.

    Args:
        message: a PointCloud2 (any order and type of fields, padding, rows with a tail), or Livox's CustomMsg.
        kind: its type.

    Returns:
        The points, with the times of the first field of a known name, in its unit; NaN stays.

    Raises:
        ValueError: fields outside of a point, no x, y, z, or fewer bytes than points.
    """
    if kind in LIVOX_CLOUDS:
        rows = [(point.x, point.y, point.z, point.offset_time) for point in message.points]
        table = np.array(rows, np.float64).reshape(-1, 4)
        return TimedCloud(to_float32(table[:, :3]), table[:, 3])
    records = _records(message)
    columns = records.dtype.names or ()
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise ValueError(f"a cloud without {' '.join(missing)}, its fields are {' '.join(columns) or 'none'}")
    points = np.stack([to_float32(records[axis]) for axis in "xyz"], axis=1)
    name = find_time_field(columns)
    return TimedCloud(points, None if name is None else np.asarray(records[name], np.float64))


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


def beams_of(message: Any, kind: str) -> LaserBeams:
    """Reads the beams of a planar scan.

    Args:
        message: a LaserScan or MultiEchoLaserScan, of which the first echo is taken.
        kind: its type.

    Returns:
        The beams; a range below `range_min`, of `range_max` or more, or not finite is NaN.

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
    return LaserBeams(np.where(is_echo, ranges, np.nan), angles)


def matrix_of(position: Any, orientation: Any) -> FloatArray:
    """Builds a pose of a position and a quaternion.

    Args:
        position: position with x, y, z.
        orientation: orientation with x, y, z, w.

    Returns:
        (4, 4).

    Raises:
        ValueError: a quaternion of length 0, or a number that is not finite.
    """
    from scipy.spatial.transform import Rotation

    numbers = [position.x, position.y, position.z, orientation.x, orientation.y, orientation.z, orientation.w]
    values = np.array(numbers, np.float64)
    if not np.isfinite(values).all() or not 0.5 < np.linalg.norm(values[3:]) < 2.0:
        raise ValueError("a pose without a rotation, or with a number that is not finite")
    return homogeneous(Rotation.from_quat(values[3:]).as_matrix(), values[:3])


def stamp_of(message: Any) -> float:
    """Returns the time of a message with a header, s since 1970."""
    return float(message.header.stamp.sec) + 1e-9 * float(message.header.stamp.nanosec)
