"""The drives of a training: the check that something can be learned from each, and their preparation."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from scipy.spatial import cKDTree

from dpmjax.deeppointmap.training.curriculum import SamplingConfig, TrainingConfig
from dpmjax.deeppointmap.training.scan_store import ScanStore, prepare_drive
from dpmjax.sequences import LidarSequence

LOGGER = logging.getLogger("dpmjax.training")
PUBLISHED = SamplingConfig()


def prepare_drives(
    drives: Sequence[LidarSequence], config: TrainingConfig, *, folder: Path | None = None, seed: int = 0
) -> ScanStore:
    """Prepares the scans of all drives, in order.

    Args:
        drives: with poses.
        config: settings of training.
        folder: where prepared scans are kept for later calls; None keeps them in memory.
        seed: seed of the variants.

    Returns:
        The scans of all drives.

    Raises:
        ValueError: if there is no drive, or if `why_useless` gives a reason against one.
    """
    if not drives:
        raise ValueError("drives: expected at least one, got none")
    for drive in drives:
        if (reason := why_useless(drive, config.sampling)) is not None:
            raise ValueError(f"drives: {drive.name}: {reason}")
    prepared = []
    for number, drive in enumerate(drives):
        LOGGER.info("prepares %s, %d scans, drive %d of %d", drive.name, len(drive), number + 1, len(drives))
        prepared.append(prepare_drive(drive, config, folder=folder, seed=seed))
    return ScanStore(prepared)


def why_useless(drive: LidarSequence, sampling: SamplingConfig = PUBLISHED) -> str | None:
    """Finds a reason why nothing can be learned from a drive, or measured on it. Reads scans up to the first good one.

    Args:
        drive: to be checked.
        sampling: distances between the scans of a pair.

    Returns:
        The reason; None where there is none.
    """
    if drive.T_world_lidar is None:
        return "no poses; a pose for each scan is needed"
    positions = drive.T_world_lidar[:, :3, 3]
    tree = cKDTree(positions)
    limits = sampling.min_distance_m, sampling.max_distance_m
    num_too_near, num_near = (tree.count_neighbors(tree, limit) for limit in limits)
    if num_near == num_too_near:
        found = f"{len(positions)} scans, no two of them {limits[0]} to {limits[1]} m apart"
        return f"{found}; such pairs are needed (are the poses in metres?)"
    reason = ""
    for number in range(len(drive)):
        try:
            drive.read_scan(number)
        except ValueError as error:
            reason = reason or str(error)
            continue
        return None
    return f"all {len(drive)} scans are bad; the first, {reason}"
