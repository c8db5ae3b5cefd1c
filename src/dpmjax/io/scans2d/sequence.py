"""What every reader of 2-D scans returns: the scans, and whatever poses their source carries."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ScanSequence:
    """A sequence of planar scans on the host.

    Attributes:
        name: short name of the source, for titles and folders.
        points: (n, b, 2) float32 beam end points in the sensor frame (x forward, y left), in `unit`; zero where masked.
        mask: (n, b) bool, True where the beam measured something.
        unit: unit of lengths.
        is_organised: beams of a scan are ordered by angle, neighbours in the array are neighbours in the world.
        reference_poses: (n, 3) float64 x, y, heading of the sensor in the world (`unit`, radians), or None.
        odometry_poses: (n, 3) float64, raw odometry in its own world, or None where the source has none.
        times: (n,) float64 seconds, or None.

    Raises:
        ValueError: shapes that do not belong together, or a unit other than "px" and "m".
    """

    name: str
    points: NDArray[np.float32]
    mask: NDArray[np.bool_]
    unit: Literal["px", "m"]
    is_organised: bool = True
    reference_poses: NDArray[np.float64] | None = None
    odometry_poses: NDArray[np.float64] | None = None
    times: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if self.unit not in ("px", "m"):
            raise ValueError(f"unit must be 'px' or 'm', got {self.unit!r}")
        if self.points.ndim != 3 or self.points.shape[2] != 2:
            raise ValueError(f"points must be (n, b, 2), got {self.points.shape}")
        if self.mask.shape != self.points.shape[:2]:
            raise ValueError(f"mask must be {self.points.shape[:2]} like points, got {self.mask.shape}")
        count = len(self.points)
        for name, shape in (("reference_poses", (count, 3)), ("odometry_poses", (count, 3)), ("times", (count,))):
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"{name} must be {shape}, got {value.shape}")

    def __len__(self) -> int:
        return len(self.points)


def take_scans(sequence: ScanSequence, selection: slice | NDArray[np.integer]) -> ScanSequence:
    """Some scans of a sequence, poses and times with them.

    Args:
        sequence: the whole.
        selection: start, stop and stride in scans; or rows, in the order wanted.

    Returns:
        The part; of a slice, arrays are views.
    """
    reference, odometry, times = sequence.reference_poses, sequence.odometry_poses, sequence.times
    return replace(
        sequence,
        points=sequence.points[selection],
        mask=sequence.mask[selection],
        reference_poses=None if reference is None else reference[selection],
        odometry_poses=None if odometry is None else odometry[selection],
        times=None if times is None else times[selection],
    )


def has_angular_order(points: NDArray[np.float32], mask: NDArray[np.bool_]) -> bool:
    """Whether the beams of scans are ordered by angle, so that 1-D convolutions and neighbour normals make sense.

    A scan is in order when at least 95 % of the turns from one valid beam to the next go the same way round and
    together they make one turn at most (with 5 % to spare, for noise). The sequence is when at least 90 % of its scans
    are.

    Args:
        points: (n, b, 2) in the sensor frame.
        mask: (n, b).

    Returns:
        True for ordered beams; scans with fewer than three valid beams have no say, and with none left it is False.
    """
    verdicts = []
    for scan, valid in zip(points, mask, strict=True):
        if valid.sum() < 3:
            continue
        angle = np.arctan2(scan[valid, 1], scan[valid, 0])
        turn = (np.diff(angle.astype(np.float64)) + np.pi) % (2 * np.pi) - np.pi
        same_way = max((turn > 0).mean(), (turn < 0).mean())
        verdicts.append(same_way >= 0.95 and np.abs(turn).sum() <= 1.05 * 2 * np.pi)
    return bool(verdicts) and float(np.mean(verdicts)) >= 0.9
