"""The map that M-Net learned: black where it is occupied, white where it is free, grey where nobody looked."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from dpmjax.viz.figures import ACCENT, Limits, add_scale_bar, draw_trajectory, frame_map, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

UNEXPLORED_GREY = 0.74
LONGER_SIDE_IN = 6.4
GAP_IN = 0.12


def occupancy_figure(
    probability: ArrayLike,
    explored: ArrayLike,
    extent: tuple[float, float, float, float],
    trajectory_world: ArrayLike | None,
    unit: str,
) -> Figure:
    """Draws an occupancy map in the manner of DeepMapping, Figure 5.

    Args:
        probability: (h, w) that a cell is occupied; row 0 is the smallest y.
        explored: (h, w) True where a beam passed or ended.
        extent: x_min, x_max, y_min, y_max of the grid's outer edges in the world, in `unit`.
        trajectory_world: (n, 2) sensor positions, or None.
        unit: unit of lengths, "px" or "m".

    Raises:
        ValueError: where the shapes do not fit, or the extent is empty.
    """
    probability, explored = np.asarray(probability, np.float64), np.asarray(explored, bool)
    if probability.ndim != 2 or explored.shape != probability.shape:
        raise ValueError(f"expected two arrays (h, w); got probability {probability.shape}, explored {explored.shape}")
    limits = Limits(*(float(edge) for edge in extent))
    if not (limits.width > 0.0 and limits.height > 0.0):
        raise ValueError(f"expected an extent (x_min, x_max, y_min, y_max) with min < max; got {tuple(extent)}")

    scale_in = LONGER_SIDE_IN / max(limits.width, limits.height)
    width_in, height_in = limits.width * scale_in, limits.height * scale_in
    total_width_in, total_height_in = width_in + 2.0 * GAP_IN, height_in + 2.0 * GAP_IN
    figure = new_figure(total_width_in, total_height_in)
    axes = figure.add_axes(
        (GAP_IN / total_width_in, GAP_IN / total_height_in, width_in / total_width_in, height_in / total_height_in)
    )
    brightness = np.where(explored, 1.0 - np.clip(probability, 0.0, 1.0), UNEXPLORED_GREY)
    axes.imshow(brightness, cmap="gray", vmin=0.0, vmax=1.0, origin="lower", extent=limits, interpolation="nearest")
    if trajectory_world is not None:
        draw_trajectory(axes, np.asarray(trajectory_world, np.float64), ACCENT)
    frame_map(axes, limits)
    add_scale_bar(axes, limits, unit)
    return figure
