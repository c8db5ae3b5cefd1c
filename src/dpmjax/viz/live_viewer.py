"""The live viewer of SLAM, by rerun (extra `viewer`)."""

from __future__ import annotations

import os
import sys
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_rgb

from dpmjax.viz.figures import LOOP, PATH
from dpmjax.viz.slam_maps import height_colors


class LiveViewer:
    """Shows scans, keyframes, trajectory and loops while they are found.

    Keyframes are children of their poses: a loop that moves the map moves the picture.

    Args:
        name: name of the recording.
        path: file that is written without a screen, for viewers of the same version only.
    """

    def __init__(self, name: str, path: Path) -> None:
        import rerun

        self._rerun, self._recording = rerun, rerun.RecordingStream(f"dpmjax {name}")
        self._log = partial(rerun.log, recording=self._recording)
        self._T_world_keyframe = np.zeros((0, 4, 4))
        # A Linux machine without a display cannot open a window.
        if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
            rerun.spawn(recording=self._recording)
        else:
            rerun.save(path, recording=self._recording)

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

    def show_map(self, T_world_keyframe: np.ndarray, newest: np.ndarray, loops: np.ndarray) -> None:
        """Shows the map after a new keyframe.

        Args:
            T_world_keyframe: (k, 4, 4) poses of all keyframes, at least one.
            newest: (n, 3) points of the last keyframe, metres, in the frame of the lidar.
            loops: (m, 2, 3) positions of both ends of each accepted loop.
        """
        before, self._T_world_keyframe = self._T_world_keyframe, T_world_keyframe
        for row, T in enumerate(T_world_keyframe):
            if row >= len(before) or not np.array_equal(before[row], T):
                self._log_pose(f"world/keyframes/{row}", T)
        self._log_points(f"world/keyframes/{len(T_world_keyframe) - 1}/points", newest)
        lines = self._rerun.LineStrips3D
        self._log("world/trajectory", lines([T_world_keyframe[:, :3, 3]], colors=[to_rgb(PATH)]))
        self._log("world/loops", lines(loops, colors=[to_rgb(LOOP)]))

    def close(self) -> None:
        """Writes the remaining data."""
        self._recording.flush()

    def _log_pose(self, entity: str, T: Float[np.ndarray, "4 4"]) -> None:
        self._log(entity, self._rerun.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))

    def _log_points(self, entity: str, points: Float[np.ndarray, "n 3"]) -> None:
        self._log(entity, self._rerun.Points3D(points, colors=height_colors(points[:, 2]), radii=[0.04]))
