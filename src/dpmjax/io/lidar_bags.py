"""A drive of 3-D scans in a bag of ROS."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpmjax.io.bags import Bag
from dpmjax.io.clouds import TimedCloud
from dpmjax.io.files import refusing
from dpmjax.io.notes import log_notes
from dpmjax.io.ros_messages import LIVOX_CLOUDS, POINT_CLOUD, cloud_of
from dpmjax.io.scan_file import check_scan, unit_note
from dpmjax.sequences import LidarSequence


def open_lidar_bag(path: Path, topic: str | None = None) -> LidarSequence:
    """Opens the clouds of a bag; a scan is read when it is wanted.

    The bag is read through once for the times of the clouds.

    Args:
        path: a bag, see `Bag`.
        topic: which clouds; None takes the only topic of PointCloud2 or Livox's CustomMsg.

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
