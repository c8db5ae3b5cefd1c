"""Depth images from above, and box plots of errors in the manner of DeepMapping figures 6 and 9 to 13."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.viz.figures import FRAME, INK, MUTED, Limits, add_scale_bar, frame_map, new_figure
from dpmjax.viz.maps import time_colormap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BOX, MEDIAN = "#30638e", "#d1495b"


def from_above_figure(
    panels: Sequence[tuple[str, ArrayLike]], points: ArrayLike, mask: ArrayLike, *, below_m: float = -0.9
) -> Figure:
    """Draws x and z of all points that lie lower than the ceiling, one colour an image, for several sets of poses.

    Args:
        panels: title and (n, 4, 4) T_world_camera in metres; the last is the frame that the others are laid onto.
        points: (n, h, w, 3) in the camera frames (y down).
        mask: (n, h, w).
        below_m: points with a smaller y than this are the ceiling.

    Raises:
        ValueError: no panel.
    """
    if not panels:
        raise ValueError("panels: expected at least one")
    clouds, sensors = [], []
    cloud, valid = np.asarray(points, np.float64), np.asarray(mask, bool)
    # The first camera is level in every panel: laying the first poses onto each other is enough to compare.
    anchor = np.asarray(panels[-1][1], np.float64)[0]
    for _, poses in panels:
        T = anchor @ np.linalg.inv(np.asarray(poses, np.float64)[0]) @ np.asarray(poses, np.float64)
        clouds.append(np.einsum("nij,nhwj->nhwi", T[:, :3, :3], cloud) + T[:, None, None, :3, 3])
        sensors.append(T[:, :3, 3])
    low, high = np.quantile(clouds[-1][valid][:, [0, 2]], [0.002, 0.998], axis=0)
    places = sensors[-1][:, [0, 2]]
    low, high = np.minimum(low, places.min(0)), np.maximum(high, places.max(0))
    margin = 0.12 * float((high - low).max())
    limits = Limits(low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin)
    figure = new_figure(4.4 * len(panels), 4.4 * limits.height / limits.width + 0.5)
    colors = time_colormap()(np.linspace(0.0, 1.0, len(cloud)))
    axes_row = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (title, _), world, places in zip(axes_row, panels, clouds, sensors, strict=True):
        for image, color in enumerate(colors):
            shown = world[image][valid[image] & (world[image][..., 1] > below_m)]
            axes.plot(shown[:, 0], shown[:, 2], ".", ms=1.2, mew=0, color=color)
        axes.plot(places[:, 0], places[:, 2], "-o", color=INK, ms=3, lw=1)
        frame_map(axes, limits)
        axes.set_title(title, fontsize=10, color=INK, loc="left")
    add_scale_bar(axes_row[0], limits, "m")
    figure.tight_layout()
    return figure


def box_plots_figure(
    groups: Mapping[str, Mapping[str, Sequence[float] | NDArray[np.floating]]], label: str, threshold: float | None
) -> Figure:
    """Draws a box plot a group: quartiles, median in red, whiskers of 1.5 ranges, logarithmic.

    Args:
        groups: values by method, by title of the group.
        label: of the axis of values.
        threshold: a line at what counts as success, or None.

    Raises:
        ValueError: no group, or an empty one.
    """
    if not groups or any(not len(values) for group in groups.values() for values in group.values()):
        raise ValueError("groups: expected one or more, each with values")
    widths = [max(2.9, 0.5 * len(group)) for group in groups.values()]
    figure = new_figure(max(5.0, sum(widths)), 3.9)
    axes_row = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for axes, (title, group) in zip(axes_row, groups.items(), strict=True):
        axes.boxplot(
            [np.maximum(np.asarray(values, np.float64), 1e-9) for values in group.values()],
            tick_labels=list(group),
            boxprops={"color": BOX},
            medianprops={"color": MEDIAN, "lw": 1.8},
            whiskerprops={"color": MUTED},
            capprops={"color": MUTED},
            flierprops={"marker": ".", "ms": 3, "markeredgecolor": MUTED},
        )
        axes.set_yscale("log")
        if threshold is not None:
            axes.axhline(threshold, color=MUTED, lw=0.9, ls=":")
        axes.set_title(title, fontsize=10, color=INK)
        axes.tick_params(colors=MUTED, labelsize=8, axis="both")
        axes.tick_params(axis="x", rotation=25)
        axes.grid(color=FRAME, lw=0.6, axis="y")
        for spine in axes.spines.values():
            spine.set_color(FRAME)
    axes_row[0].set_ylabel(label, fontsize=9, color=INK)
    figure.tight_layout()
    return figure
