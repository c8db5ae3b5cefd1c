"""A set of organised depth images, as clouds in their camera frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DepthSequence:
    """Depth images in the order in which they were taken.

    Attributes:
        name: for titles and messages.
        points: (n, h, w, 3) float32 metres in the camera frame (x right, y down, z forward); zero where masked.
        mask: (n, h, w) bool.
        is_planar: the camera moved on a plane: x, z and the angle about y.
        T_world_camera: (n, 4, 4) float64 reference poses, or None.

    Raises:
        ValueError: shapes that do not belong together.
    """

    name: str
    points: NDArray[np.float32]
    mask: NDArray[np.bool_]
    is_planar: bool
    T_world_camera: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if self.points.ndim != 4 or self.points.shape[3] != 3 or self.mask.shape != self.points.shape[:3]:
            raise ValueError(
                f"expected points (n, h, w, 3) and mask (n, h, w), got {self.points.shape} and {self.mask.shape}"
            )
        if self.T_world_camera is not None and self.T_world_camera.shape != (len(self.points), 4, 4):
            raise ValueError(f"T_world_camera: expected {(len(self.points), 4, 4)}, got {self.T_world_camera.shape}")

    def __len__(self) -> int:
        return len(self.points)


def take_frames(sequence: DepthSequence, selection: slice) -> DepthSequence:
    """Cuts a sub-range out of a sequence, poses with it."""
    poses = sequence.T_world_camera
    return replace(
        sequence,
        points=sequence.points[selection],
        mask=sequence.mask[selection],
        T_world_camera=None if poses is None else poses[selection],
    )
