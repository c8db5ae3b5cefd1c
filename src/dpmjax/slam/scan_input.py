"""The input of SLAM: raw scans, perhaps with times, and the work on them that needs no map, done one scan ahead."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.prepared_scans import CompactScan
from dpmjax.scans.corrections import deskew
from dpmjax.slam.interfaces import SlamMethods, ThinnedScan
from dpmjax.slam.keyframe_map import Pose
from dpmjax.types import AnyArray

Item = TypeVar("Item")
Result = TypeVar("Result")


class TimedScan(NamedTuple):
    """A raw scan with the time of each point, to be deskewed by the predicted motion.

    Attributes:
        points: (n, 3) metres, each in the frame of the lidar at its own moment.
        offsets: (n,) times since the scan's pose, as shares of the time between scans; see `scans.deskew`.
    """

    points: Float[AnyArray, "n 3"]
    offsets: Float[AnyArray, " n"]


AnyScan = Float[AnyArray, "_n 3"] | TimedScan


class PreparedInput(NamedTuple):
    """A scan after the work that needs no map.

    Attributes:
        num_points: number of points of the raw scan.
        thinned: the thinned scan; None if it is empty.
        T_turn: predicted motion that a scan with times was deskewed by; None for a scan without times.
        compact: the encoded scan; None where it was not encoded.
    """

    num_points: int
    thinned: ThinnedScan | None
    T_turn: Pose | None = None
    compact: CompactScan | None = None


def prepare_input(methods: SlamMethods, scan: AnyScan, T_turn: Pose | None = None) -> PreparedInput:
    """Does the work on a scan that needs no map: thins it, and encodes it where each scan is encoded.

    Args:
        methods: matcher, geometry, settings.
        scan: points in metres, in the frame of the lidar, perhaps with times.
        T_turn: predicted motion, by which a scan with times is deskewed; None for a scan without times.

    Returns:
        The prepared scan.

    Raises:
        ValueError: if the shape is not (n, 3).
    """
    points = scan.points if isinstance(scan, TimedScan) else scan
    if len(np.shape(points)) != 2 or np.shape(points)[1] != 3:
        raise ValueError(f"scan: expected shape (n, 3), got {np.shape(points)}")
    thinned, compact = methods.geometry.thin(corrected_points(scan, T_turn)), None
    if thinned is not None and methods.config.odometry.proposer == "network":
        compact = methods.matcher.encode(thinned)
    return PreparedInput(len(points), thinned, T_turn, compact)


def corrected_points(scan: AnyScan, T_turn: Pose | None) -> Float[np.ndarray, "n 3"]:
    """Returns the finite points of a scan, and undoes the motion of the lidar where the scan has times.

    Args:
        scan: points in metres, in the frame of the lidar, perhaps with times.
        T_turn: motion from one scan to the next; None leaves the points unchanged.

    Returns:
        The points.
    """
    points = np.asarray(scan.points if isinstance(scan, TimedScan) else scan)
    is_finite = np.isfinite(points).all(axis=1)
    if not isinstance(scan, TimedScan) or T_turn is None:
        return points[is_finite]
    return deskew(points[is_finite], np.asarray(scan.offsets)[is_finite], T_turn)


def prepare_ahead(methods: SlamMethods, scan: AnyScan) -> PreparedInput | TimedScan:
    """Prepares a scan before those in front of it have poses, for instance in another thread.

    Args:
        methods: methods from `make_methods`.
        scan: see `step_slam`.

    Returns:
        The input of `step_slam`; a scan with times is unchanged, because the motion before it is not known yet.

    Raises:
        ValueError: if the shape is not (n, 3).
    """
    return scan if isinstance(scan, TimedScan) else prepare_input(methods, scan)


def in_advance(work: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result, None, None]:
    """Works on each item in a thread, the next one while the caller uses this one.

    Args:
        work: called with one item after another.
        items: the items, taken one ahead by the thread of the caller.

    Yields:
        The results, in order; an error of the work is raised in place of its result.
    """
    with ThreadPoolExecutor(1) as pool:
        done: Future[Result] | None = None
        for item in items:
            begun = pool.submit(work, item)
            if done is not None:
                yield done.result()
            done = begun
        if done is not None:
            yield done.result()
