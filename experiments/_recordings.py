"""Planar logs of which a part is registered: which scans, poses of all the others, errors by hand-checked relations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dpmjax import metrics, registration

if TYPE_CHECKING:
    from dpmjax.sequences import Relations, ScanSequence

Floats = NDArray[np.float64]
# Scans so far apart are registered, where that leaves out more than every other one.
MIN_DISTANCE_M, MIN_TURN_RAD = 0.5, 0.35


@dataclass(frozen=True)
class Recording:
    """The scans of a run.

    Attributes:
        whole: all scans.
        chosen: rows of those that are registered.
    """

    whole: ScanSequence
    chosen: NDArray[np.integer]

    @property
    def registered(self) -> ScanSequence:
        """Returns the scans that are registered."""
        return self.whole if self._is_all else self.whole.take(self.chosen)

    @property
    def title(self) -> str:
        """Returns the number of scans in words."""
        count = f"{len(self.chosen)} scans of {self.whole.points.shape[1]} beams"
        return count if self._is_all else f"{count}, chosen of {len(self.whole)} by their motion"

    def all_poses(self, poses: Floats) -> Floats:
        """Returns poses of all scans, by those of the registered ones."""
        if self._is_all:
            return poses
        assert self.whole.odometry_poses is not None
        between = registration.fill_between(self.chosen, poses, self.whole.odometry_poses)
        return registration.align_between(self.planar, self.chosen, between)

    def relation_numbers(self, relations: Relations | None, candidates: Mapping[str, Floats]) -> dict[str, float]:
        """Returns the mean errors of poses, by their suffix, against hand-checked relations, if there are any."""
        numbers: dict[str, float] = {}
        if relations is None:
            return numbers
        if self.whole.times is None:
            raise ValueError(f"{self.whole.name}: its scans have no times, which relations need")
        for suffix, poses in candidates.items():
            found = metrics.relation_errors(relations, self.whole.times, self.all_poses(poses))
            numbers[f"relations{suffix}_m"] = float(found.translation_m.mean())
            numbers[f"relations{suffix}_deg"] = float(found.rotation_deg.mean())
            numbers["num_relations"] = int(found.is_used.sum())
        return numbers

    @cached_property
    def planar(self) -> registration.PlanarScans:
        """Returns all scans with a line at every beam."""
        return registration.planar_scans(self.whole.points, self.whole.mask)

    @property
    def _is_all(self) -> bool:
        return len(self.chosen) == len(self.whole)


def choose_scans(whole: ScanSequence, *, is_ordered: bool = True) -> Recording:
    """Returns which scans are registered: all, where most lie apart or where there is no odometry to tell."""
    everything = np.arange(len(whole))
    if whole.odometry_poses is None or whole.unit != "m" or not is_ordered:
        return Recording(whole, everything)
    chosen = registration.choose_by_motion(whole.odometry_poses, MIN_DISTANCE_M, MIN_TURN_RAD)
    return Recording(whole, chosen if 2 * len(chosen) < len(whole) else everything)
