"""The optional live viewer of a SLAM run: rerun, in a window, or in a file where there is no screen."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float

from dpmjax.viz.drives import height_colors

_RADIUS_M = 0.04
_TRAJECTORY, _LOOP = (31, 78, 140), (42, 157, 92)


class LiveViewer:
    """Shows scans, keyframes, trajectory and loops while they are found.

    Keyframes are children of their poses: a loop that moves the map moves the picture.

    Args:
        name: name of the recording.
        path: file that is written without a screen, for viewers of the same version only.

    Raises:
        ValueError: rerun is not installed.
    """

    def __init__(self, name: str, path: Path) -> None:
        self._rerun = _import_rerun()
        self._recording = self._rerun.RecordingStream(f"dpmjax {name}")
        self._T_world_keyframe = np.zeros((0, 4, 4))
        if has_screen():
            self._rerun.spawn(recording=self._recording)
        else:
            self._rerun.save(path, recording=self._recording)

    def show_scan(self, number: int, points: Float[np.ndarray, "n 3"], T_world_scan: Float[np.ndarray, "4 4"]) -> None:
        """Shows the newest scan.

        Args:
            number: number of the scan.
            points: metres, in the frame of the lidar.
            T_world_scan: pose of the scan.
        """
        self._rerun.set_time("scan", sequence=number, recording=self._recording)
        self._log_pose("world/lidar", T_world_scan)
        self._log_points("world/lidar/points", points)

    def show_map(
        self,
        T_world_keyframe: Float[np.ndarray, "k 4 4"],
        newest: Float[np.ndarray, "n 3"],
        loops: Float[np.ndarray, "m 2 3"],
    ) -> None:
        """Shows the map after a new keyframe.

        Args:
            T_world_keyframe: poses of all keyframes.
            newest: points of the last keyframe, metres, in the frame of the lidar.
            loops: positions of both ends of each accepted loop.
        """
        before, self._T_world_keyframe = self._T_world_keyframe, T_world_keyframe
        for row, T in enumerate(T_world_keyframe):
            if row >= len(before) or not np.array_equal(before[row], T):
                self._log_pose(f"world/keyframes/{row}", T)
        if len(T_world_keyframe):
            self._log_points(f"world/keyframes/{len(T_world_keyframe) - 1}/points", newest)
        lines = self._rerun.LineStrips3D
        self._log("world/trajectory", lines([T_world_keyframe[:, :3, 3]], colors=[_TRAJECTORY]))
        self._log("world/loops", lines(loops, colors=[_LOOP]))

    def close(self) -> None:
        """Writes the remaining data."""
        self._recording.flush()

    def _log_pose(self, entity: str, T: Float[np.ndarray, "4 4"]) -> None:
        self._log(entity, self._rerun.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))

    def _log_points(self, entity: str, points: Float[np.ndarray, "n 3"]) -> None:
        self._log(entity, self._rerun.Points3D(points, colors=height_colors(points[:, 2]), radii=[_RADIUS_M]))

    def _log(self, entity: str, shown: object) -> None:
        self._rerun.log(entity, shown, recording=self._recording)


def has_screen() -> bool:
    """Returns True where a window can be opened.

    Returns:
        False on a Linux machine without a display.
    """
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _import_rerun() -> ModuleType:
    try:
        import rerun
    except ImportError as error:
        raise ValueError("the live viewer needs rerun: pip install 'dpmjax[viewer]', or run without it") from error
    return rerun
