"""Pairs of scans of one drive at given distances, each scan turned by a random yaw, with the true motions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from dpmjax.geometry import se2
from dpmjax.geometry.rigid import inverse
from dpmjax.metrics.drives import path_lengths
from dpmjax.sequences import LidarSequence
from dpmjax.types import Pose, Poses

# Distances between the scans of a pair; scans of "far" do not overlap.
DISTANCE_BANDS_M = {"near": (2.0, 10.0), "middle": (10.0, 20.0), "far": (60.0, np.inf)}

PAIR_STREAM = 4127

# Share of the path of a drive, at its end, that is held out of training.
HELD_OUT_SHARE = 0.1

# Scans within this distance of a held-out one see the same place, and are not trained on either.
HELD_OUT_MARGIN_M = 20.0


class ScanPair(NamedTuple):
    """Two scans and the true motion between them.

    Attributes:
        source: points, metres, in the frame of the turned lidar.
        target: points of the second scan.
        T_target_source: the true motion.
    """

    source: Float[np.ndarray, "n 3"]
    target: Float[np.ndarray, "m 3"]
    T_target_source: Pose


class PlaceSplit(NamedTuple):
    """Numbers of the scans of a drive that are trained on, and of those of held-out places.

    Attributes:
        training: scans that are trained on.
        held_out: scans of the last places; empty where too little would remain.
    """

    training: Int[np.ndarray, " n"]
    held_out: Int[np.ndarray, " m"]


def split_places(drive: LidarSequence) -> PlaceSplit:
    """Holds out the last tenth of the path of a drive, and leaves out all scans near it, earlier passes included.

    The margin is 20 m, or a tenth of the path if that is shorter. If less than half of the scans would remain, as in a
    room, nothing is held out.

    Args:
        drive: scans with true poses.

    Returns:
        The numbers of the scans.

    Raises:
        ValueError: if the drive has no poses.
    """
    rows = np.flatnonzero(drive.has_reference)
    poses = true_poses(drive)[rows]
    path = path_lengths(poses)
    length_m = float(path.max(initial=0.0))
    is_held_out = path > (1 - HELD_OUT_SHARE) * length_m
    margin_m = min(HELD_OUT_MARGIN_M, HELD_OUT_SHARE * length_m)
    positions = poses[:, :3, 3]
    # Without held-out scans all distances are infinite.
    is_near = np.asarray(cKDTree(positions[is_held_out]).query(positions)[0]) < margin_m
    is_trained = ~is_held_out & ~is_near
    if np.sum(is_trained) < len(rows) / 2 or np.sum(is_held_out) < 2:
        return PlaceSplit(rows, rows[:0])
    return PlaceSplit(rows[is_trained], rows[is_held_out])


def draw_scan_pairs(drive: LidarSequence, band: str, num_pairs: int, *, seed: int = 0) -> Int[np.ndarray, "p 2"]:
    """Draws pairs of scans at the distances of a band, without repetition.

    Args:
        drive: scans with true poses.
        band: one of `DISTANCE_BANDS_M`.
        num_pairs: number of pairs.
        seed: seed of the draw; each band has draws of its own.

    Returns:
        Numbers of the scans; fewer pairs where the drive has fewer.

    Raises:
        ValueError: if the drive has no poses.
    """
    number = list(DISTANCE_BANDS_M).index(band)
    rng = np.random.default_rng([PAIR_STREAM, number, seed])
    return draw_rows_apart(scan_distances(drive), *DISTANCE_BANDS_M[band], num_pairs, rng)


def read_scan_pairs(drive: LidarSequence, pairs: Int[np.ndarray, "p 2"], *, seed: int = 0) -> Iterator[ScanPair]:
    """Reads the scans of pairs, each turned by a random yaw.

    Args:
        drive: scans with true poses.
        pairs: numbers of the scans.
        seed: seed of the yaws.

    Yields:
        The pairs in order.

    Raises:
        ValueError: if the drive has no poses, or a scan cannot be read.
    """
    poses = true_poses(drive)
    rng = np.random.default_rng([PAIR_STREAM, len(DISTANCE_BANDS_M), seed])
    for pair in pairs:
        (source, T_source), (target, T_target) = (turn_scan(drive.read_scan(int(row)), poses[row], rng) for row in pair)
        yield ScanPair(source, target, inverse(T_target) @ T_source)


def turn_scan(
    points: Float[np.ndarray, "n 3"], T_world_lidar: Pose, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Pose]:
    """Turns a scan about the vertical by a random yaw, as if the lidar had another heading.

    Args:
        points: metres, in the frame of the lidar.
        T_world_lidar: true pose.
        rng: source of the yaw.

    Returns:
        float32 points in the turned frame, and its pose.
    """
    T = np.eye(4)
    T[:2, :2] = se2.rotation(np.asarray(rng.uniform(-np.pi, np.pi)))
    return (points @ T[:3, :3].T).astype(np.float32), T_world_lidar @ inverse(T)


def true_poses(drive: LidarSequence) -> Poses:
    """Returns the true poses of a drive.

    Args:
        drive: scans with poses.

    Returns:
        `T_world_lidar`, metres.

    Raises:
        ValueError: if it has none.
    """
    if drive.T_world_lidar is None:
        raise ValueError(f"drive: expected a true pose for each scan, got none in {drive.name}")
    return drive.T_world_lidar


def scan_distances(drive: LidarSequence) -> Float[np.ndarray, "n n"]:
    """Computes the distances between all scans of a drive.

    Args:
        drive: scans with true poses.

    Returns:
        Metres between the positions of the lidar.

    Raises:
        ValueError: if the drive has no poses.
    """
    positions = true_poses(drive)[:, :3, 3]
    return np.linalg.norm(positions[:, None] - positions[None], axis=2)


def draw_rows_apart(
    distances_m: Float[np.ndarray, "n n"], least_m: float, most_m: float, num_pairs: int, rng: np.random.Generator
) -> Int[np.ndarray, "p 2"]:
    """Draws pairs of scans at a distance of each other, without repetition.

    Args:
        distances_m: distances between all scans, metres.
        least_m: smallest distance of a pair, metres.
        most_m: largest one.
        num_pairs: number of pairs.
        rng: source of the draws.

    Returns:
        Rows of the scans; fewer pairs where there are fewer.
    """
    return draw_rows(np.argwhere((distances_m >= least_m) & (distances_m <= most_m)), num_pairs, rng)


def draw_rows(candidates: Int[np.ndarray, "k 2"], num_pairs: int, rng: np.random.Generator) -> Int[np.ndarray, "p 2"]:
    """Draws some of the candidates, without repetition.

    Args:
        candidates: rows of the scans of each.
        num_pairs: number of pairs.
        rng: source of the draws.

    Returns:
        The drawn ones; fewer where there are fewer.
    """
    if len(candidates) == 0:
        return candidates
    return candidates[rng.choice(len(candidates), min(num_pairs, len(candidates)), replace=False)]
