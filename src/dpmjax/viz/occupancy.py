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
    picture: tuple[ArrayLike, ArrayLike, tuple[float, float, float, float]],
    trajectory_world: ArrayLike | None,
    unit: str,
    *,
    T_view_world: ArrayLike | None = None,
    limits: Limits | None = None,
) -> Figure:
    """Draws an occupancy map in the manner of DeepMapping, Figure 5.

    Args:
        picture: (h, w) probability that a cell is occupied, row 0 at the smallest y; (h, w) True where a beam passed or
            ended; and x_min, x_max, y_min, y_max of the grid's outer edges in the world, in `unit`.
        trajectory_world: (n, 2) sensor positions, or None.
        unit: unit of lengths, "px" or "m".
        T_view_world: (3, 3) rigid motion into the frame of the picture; None draws the world as it is.
        limits: what is shown of that frame; None shows the grid.

    Returns:
        The figure.

    Raises:
        ValueError: where the shapes do not fit, or the extent is empty.
    """
    from matplotlib.transforms import Affine2D

    probability, explored = np.asarray(picture[0], np.float64), np.asarray(picture[1], bool)
    if probability.ndim != 2 or explored.shape != probability.shape:
        raise ValueError(f"expected two arrays (h, w); got probability {probability.shape}, explored {explored.shape}")
    extent = Limits(*(float(edge) for edge in picture[2]))
    if not (extent.width > 0.0 and extent.height > 0.0):
        raise ValueError(f"expected an extent (x_min, x_max, y_min, y_max) with min < max; got {tuple(extent)}")
    T = np.eye(3) if T_view_world is None else np.asarray(T_view_world, np.float64)
    limits = limits or extent

    scale_in = LONGER_SIDE_IN / max(limits.width, limits.height)
    width_in, height_in = limits.width * scale_in, limits.height * scale_in
    total_width_in, total_height_in = width_in + 2.0 * GAP_IN, height_in + 2.0 * GAP_IN
    figure = new_figure(total_width_in, total_height_in)
    axes = figure.add_axes(
        (GAP_IN / total_width_in, GAP_IN / total_height_in, width_in / total_width_in, height_in / total_height_in)
    )
    brightness = np.where(explored, 1.0 - np.clip(probability, 0.0, 1.0), UNEXPLORED_GREY)
    axes.set_facecolor(str(UNEXPLORED_GREY))
    image = axes.imshow(brightness, cmap="gray", vmin=0.0, vmax=1.0, origin="lower", extent=extent)
    image.set_interpolation("nearest")
    image.set_transform(Affine2D(T) + axes.transData)
    if trajectory_world is not None:
        draw_trajectory(axes, np.asarray(trajectory_world, np.float64) @ T[:2, :2].T + T[:2, 2], ACCENT)
    frame_map(axes, limits)
    add_scale_bar(axes, limits, unit)
    return figure
