"""Pairs of scans of one drive at given distances, each scan turned by a random yaw, with the true motions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dpmjax.geometry import se2
from dpmjax.geometry.rigid import inverse
from dpmjax.sequences import LidarSequence
from dpmjax.types import Pose, Poses

# Distances between the scans of a pair; scans of "far" do not overlap.
DISTANCE_BANDS_M = {"near": (2.0, 10.0), "middle": (10.0, 20.0), "far": (60.0, np.inf)}

PAIR_STREAM = 4127


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
        scans, T_world_scan = [], []
        for row in pair:
            T = np.eye(4)
            T[:2, :2] = se2.rotation(np.asarray(rng.uniform(-np.pi, np.pi)))
            scans.append((drive.read_scan(int(row)) @ T[:3, :3].T).astype(np.float32))
            T_world_scan.append(poses[row] @ inverse(T))
        yield ScanPair(scans[0], scans[1], inverse(T_world_scan[1]) @ T_world_scan[0])


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
