"""Whether a map of lidar scans can be trusted, without ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from dpmjax.sequences import counted

# Of 120 scans of a sound drive up to five are guessed; 53 blind ones ended metres off.
_MAX_GUESSED_SHARE = 0.1


class MapAssessment(NamedTuple):
    """Trust in a map of SLAM.

    Attributes:
        is_trusted: True if measured motions join the map, and no more than a tenth of the scans, or one, are uncertain.
        uncertain_scans: numbers of the scans that were not aligned in all directions.
        num_parts: number of parts that measured motions join; the relative pose of two parts is a guess.
        fault: why there is no map; None if there is one.
    """

    is_trusted: bool
    uncertain_scans: tuple[int, ...]
    num_parts: int
    fault: str | None


def assess_map(statuses: Sequence[str], num_parts: int) -> MapAssessment:
    """Assesses a map by how its scans were placed.

    Args:
        statuses: `ScanReport.status` of each scan.
        num_parts: number of parts that measured motions join.

    Returns:
        The assessment.
    """
    uncertain = tuple(row for row, name in enumerate(statuses) if name not in ("first", "tracked", "network"))
    count, fault = len(statuses), None
    if count and all(name == "empty" for name in statuses):
        fault = f"{count} of {counted(count, 'scan')} without enough points, no map was made"
    elif count > 1 and not {"tracked", "network", "coasting"} & set(statuses):
        fault = f"none of {counted(count, 'scan')} could be aligned with those before, the trajectory is no result"
    is_trusted = fault is None and num_parts < 2 and len(uncertain) <= max(1, _MAX_GUESSED_SHARE * count)
    return MapAssessment(is_trusted, uncertain, num_parts, fault)
