"""Planar logs of which a part is registered: which scans, poses of all the others, and their errors."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax import metrics, registration
from dpmjax.sequences import Relations

if TYPE_CHECKING:
    from dpmjax.sequences import ScanSequence

Floats = NDArray[np.float64]
# Scans so far apart are registered, where that leaves out more than every other one.
MIN_DISTANCE_M, MIN_TURN_RAD = 0.5, 0.35
MAX_WHOLE = 256
"""Up to so many scans are all registered where there is no odometry to tell which lie apart."""
MIN_COMMON = 10


class Recording(NamedTuple):
    """The scans of a run.

    Attributes:
        whole: all scans.
        chosen: rows of those that are registered.
        motion: (n, 3) poses of all scans that tell how they move from one registered scan to the next; None where all
            are registered.
    """

    whole: ScanSequence
    chosen: NDArray[np.integer]
    motion: Floats | None = None

    @property
    def registered(self) -> ScanSequence:
        """Returns the scans that are registered."""
        return self.whole if self._is_all else self.whole.take(self.chosen)

    @property
    def title(self) -> str:
        """Returns the number of scans in words."""
        count = f"{len(self.chosen)} scans of {self.whole.points.shape[1]} beams"
        return count if self._is_all else f"{count}, chosen of {len(self.whole)} by their motion"

    def between(self, poses: Floats) -> Floats:
        """Returns poses of all scans, by those of the registered ones and the motion between them."""
        return poses if self.motion is None else registration.fill_between(self.chosen, poses, self.motion)

    def aligned(self, poses: Floats) -> Floats:
        """Returns the same, each scan aligned with the nearest registered one."""
        if self._is_all:
            return poses
        planar = registration.planar_scans(self.whole.points, self.whole.mask)
        return registration.align_between(planar, self.chosen, self.between(poses))

    def times(self) -> Floats:
        """Returns the times of all scans; a `ValueError` if the log has none."""
        if self.whole.times is None:
            raise ValueError(f"{self.whole.name}: its scans have no times, which relations and a corrected log need")
        return self.whole.times

    @property
    def _is_all(self) -> bool:
        return len(self.chosen) == len(self.whole)


def choose_scans(whole: ScanSequence, *, is_ordered: bool = True, by_scans: bool = False) -> Recording:
    """Returns which scans are registered: those that lie apart, or all where most do.

    Args:
        whole: all scans.
        is_ordered: they lie in the order of time; else all are registered.
        by_scans: odometry is not looked at, only the scans.

    Returns:
        Recording; all scans where they are not in metres, or few and without odometry.
    """
    everything = Recording(whole, np.arange(len(whole)))
    if whole.unit != "m" or not is_ordered:
        return everything
    motion = None if by_scans else whole.odometry_poses
    if motion is None and len(whole) > MAX_WHOLE:
        motion = registration.scan_odometry(registration.planar_scans(whole.points, whole.mask))
    if motion is None:
        return everything
    chosen = registration.choose_by_motion(motion, MIN_DISTANCE_M, MIN_TURN_RAD)
    return Recording(whole, chosen, motion) if 2 * len(chosen) < len(whole) else everything


def relation_numbers(times: Floats, poses: Floats, relations: Relations, suffix: str = "") -> dict[str, float]:
    """Returns the mean errors of the poses of all scans against hand-checked relations."""
    found = metrics.relation_errors(relations, times, poses)
    return {
        f"relations{suffix}_m": float(found.translation_m.mean()),
        f"relations{suffix}_deg": float(found.rotation_deg.mean()),
        "num_relations": int(found.is_used.sum()),
    }


def corrected_numbers(times: Floats, poses: Floats, corrected: ScanSequence, suffix: str = "") -> dict[str, float]:
    """Returns the ATE at scans that a corrected log of the same drive has too, and errors from one to the next.

    The latter are measured like hand-checked relations: the relative poses of successive scans of the corrected log.
    """
    from dpmjax.geometry import se2

    if corrected.reference_poses is None or corrected.times is None:
        raise ValueError(f"{corrected.name}: has no corrected poses with times")
    _, mine, theirs = np.intersect1d(np.round(times, 3), np.round(corrected.times, 3), return_indices=True)
    if len(mine) < MIN_COMMON:
        raise ValueError(
            f"{corrected.name}: {len(mine)} scans have the time of a scan of the recording, not {MIN_COMMON}"
        )
    reference, at = corrected.reference_poses[theirs], times[mine]
    steps = metrics.relation_errors(
        Relations(at[:-1], at[1:], se2.relative(reference[:-1], reference[1:])), at, poses[mine]
    )
    return {
        f"ate_corrected{suffix}_m": metrics.absolute_trajectory_error(poses[mine, :2], reference[:, :2]),
        f"relations_corrected{suffix}_m": float(steps.translation_m.mean()),
        f"relations_corrected{suffix}_deg": float(steps.rotation_deg.mean()),
        "num_corrected": len(mine),
    }
