"""The error of re-localisation at every free place of a world, in the manner of DeepMapping figure 7."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.viz.figures import INK, MUTED, Limits, add_scale_bar, frame_map, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OBSTACLE = "#e4e6e9"
TRAJECTORY = "#16c7d9"


class ErrorMap(NamedTuple):
    """One panel.

    Attributes:
        title: what was asked.
        subtitle: its numbers.
        error: (h, w) distance to the truth; NaN where nothing was asked. Row 0 has the smallest y.
    """

    title: str
    subtitle: str
    error: NDArray[np.floating]


def error_maps_figure(
    maps: Sequence[ErrorMap],
    extent: tuple[float, float, float, float],
    trajectory_world: NDArray[np.floating],
    unit: str,
    *,
    worst: float,
) -> Figure:
    """Draws the panels side by side: black is right, the lighter the worse; the trajectory of the fit in cyan.

    Args:
        maps: at least one, all of one shape.
        extent: x_min, x_max, y_min, y_max of the grids' outer edges, in `unit`.
        trajectory_world: (n, 2) where the scans of the fit were taken.
        unit: unit of lengths.
        worst: errors from here on have the last colour.

    Raises:
        ValueError: no panel, panels of different shapes, or `worst` is not positive.
    """
    if not maps or len({panel.error.shape for panel in maps}) != 1 or not worst > 0.0:
        raise ValueError(f"expected panels of one shape and worst > 0; got {len(maps)} panels, worst {worst}")
    import matplotlib

    limits = Limits(*map(float, extent))
    colormap = matplotlib.colormaps["inferno"].with_extremes(bad=OBSTACLE)
    figure = new_figure(4.6 * len(maps) + 0.9, 5.0)
    axes_row = figure.subplots(1, len(maps), squeeze=False)[0]
    for axes, panel in zip(axes_row, maps, strict=True):
        image = axes.imshow(
            panel.error, cmap=colormap, vmin=0.0, vmax=worst, origin="lower", extent=limits, interpolation="nearest"
        )
        axes.plot(*np.asarray(trajectory_world).T, ".", color=TRAJECTORY, ms=1.8)
        frame_map(axes, limits)
        axes.set_title(f"{panel.title}\n", fontsize=11, color=INK, loc="left", fontweight="bold")
        axes.annotate(
            panel.subtitle,
            (0, 1),
            xytext=(0, 6),
            xycoords="axes fraction",
            textcoords="offset points",
            fontsize=8.5,
            color=MUTED,
        )
    add_scale_bar(axes_row[0], limits, unit)
    # The bar and its label need about 0.9 inches at the right, whatever the number of maps.
    right = 1.0 - 0.9 / figure.get_figwidth()
    figure.tight_layout(rect=(0.0, 0.0, right, 1.0))
    bar = figure.add_axes((right + 0.005, 0.1, 0.15 / figure.get_figwidth(), 0.75))
    figure.colorbar(image, cax=bar, label=f"error, {unit}", extend="max")
    return figure
