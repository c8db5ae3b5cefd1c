"""What every reader of 2-D scans returns: the scans, and whatever poses their source carries."""

from __future__ import annotations

from dataclasses import dataclass
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
    """

    name: str
    points: NDArray[np.float32]
    mask: NDArray[np.bool_]
    unit: Literal["px", "m"]
    is_organised: bool = True
    reference_poses: NDArray[np.float64] | None = None
    odometry_poses: NDArray[np.float64] | None = None
    times: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.points)
