"""The files of a map of planar scans: trajectories, and pictures of the candidates and of M-Net's occupancy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dpmjax import deepmapping, io, registration2d, viz
from dpmjax import metrics as trajectory_metrics
from dpmjax.cli.run_folder import RunFolder

if TYPE_CHECKING:
    from dpmjax.registration2d import RegisteredScans
    from dpmjax.sequences import ScanSequence
    from dpmjax.types import ScanSet


def scan_set_of(sequence: ScanSequence) -> ScanSet:
    """Returns the scans without their name, unit and poses."""
    import jax.numpy as jnp

    from dpmjax.types import ScanSet

    return ScanSet(jnp.asarray(sequence.points), jnp.asarray(sequence.mask))


def registered_scans(sequence: ScanSequence, result: RegisteredScans) -> ScanSequence:
    """Returns the scans that were registered."""
    chosen = result.recording.chosen
    return sequence if len(chosen) == len(sequence) else sequence.take(chosen)


def write_trajectories(folder: RunFolder, sequence: ScanSequence, poses: NDArray[np.float64]) -> None:
    """Writes T_world_scan of every scan: trajectory.npy, trajectory_tum.txt, trajectory_kitti.txt."""
    io.write_poses_npy(folder / "trajectory.npy", poses)
    io.write_tum(folder / "trajectory_tum.txt", poses, times=sequence.times, unit=sequence.unit)
    io.write_kitti(folder / "trajectory_kitti.txt", poses)


def draw_map(
    folder: RunFolder, registered: ScanSequence, result: RegisteredScans, metrics: Mapping[str, Any]
) -> viz.Limits:
    """Draws map.png: the start, DeepMapping if it was trained, the kept one, the reference; returns its limits."""
    scans, unit = scan_set_of(registered), registered.unit
    panels = []
    titles = dict(zip(result.candidates, metrics["candidates"], strict=True))
    for name in dict.fromkeys((result.start, registration2d.DEEPMAPPING, result.kept)):
        if name not in result.candidates:
            continue
        title, numbers = titles[name], metrics["candidates"][titles[name]]
        ate, distance = numbers.get(f"ate_{unit}"), numbers.get(f"point_distance_{unit}")
        title = title[0].upper() + title[1:] + (" (kept)" if name == result.kept else "")
        panels.append(viz.Panel(title, scans, result.candidates[name].poses, ate=ate, point_distance=distance))
    if registered.reference_poses is None:
        panels = [replace(panel, is_reference=panel.title.endswith(" (kept)")) for panel in panels]
    else:
        panels.append(viz.Panel("Reference", scans, registered.reference_poses, is_reference=True))
    figure = viz.registered_scans_figure(panels, unit)
    viz.save_figure(figure, folder / "map.png")
    return viz.Limits(*figure.axes[0].get_xlim(), *figure.axes[0].get_ylim())


def draw_occupancy(folder: RunFolder, registered: ScanSequence, result: RegisteredScans, limits: viz.Limits) -> None:
    """Draws occupancy.png: the occupancy that M-Net predicts, in the frame and within the limits of map.png."""
    picture = deepmapping.map_picture(result.fitted, registered.points, registered.mask)
    kept, reference = result.candidates[result.kept].poses, registered.reference_poses
    anchor, trajectory = kept if reference is None else reference, result.fitted.poses[:, :2]
    T_view_fit = trajectory_metrics.align_rigid(trajectory, anchor[:, :2])
    figure = viz.occupancy_figure(picture, trajectory, registered.unit, T_view_world=T_view_fit, limits=limits)
    viz.save_figure(figure, folder / "occupancy.png")
