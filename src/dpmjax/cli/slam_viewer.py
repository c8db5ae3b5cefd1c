"""The live viewer of `dpmjax slam`: shows each scan and the map so far."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from dpmjax.cli.run_folder import RunFolder

if TYPE_CHECKING:
    from dpmjax.slam import ScanReport, SlamState
    from dpmjax.slam.front_end import AnyScan

    OnScan = Callable[[AnyScan, SlamState, ScanReport], None]


@contextmanager
def live_viewer(folder: RunFolder, name: str, *, is_on: bool) -> Iterator[OnScan | None]:
    """Opens the viewer; yields what shows a scan, or None where the viewer is off."""
    if not is_on:
        yield None
        return
    from dpmjax import viz
    from dpmjax.slam.front_end import corrected_points

    viewer = viz.LiveViewer(name, folder / "slam.rrd")

    def show(scan: AnyScan, state: SlamState, report: ScanReport) -> None:
        slam_map = state.slam_map
        if not len(slam_map):
            return
        points, T = corrected_points(scan, report.T_turn), slam_map.T_world_keyframe[report.keyframe]
        viewer.show_scan(report.scan, points, T @ report.T_keyframe_scan)
        if report.is_keyframe:
            ends = [(loop.source, loop.target) for loop in state.loops.loops if loop.status == "accepted"]
            positions = slam_map.T_world_keyframe[np.array(ends, np.int64).reshape(-1, 2), :3, 3]
            viewer.show_map(slam_map.T_world_keyframe, points, positions)

    try:
        yield show
    finally:
        viewer.close()
