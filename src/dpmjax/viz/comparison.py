"""Comparisons: errors of methods (DeepMapping figures 6 and 7), forms of the toy (figure 14)."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from dpmjax.viz import figures
from dpmjax.viz.figures import ACCENT, INK, MUTED, Limits

SOURCE, GREEN, DIRECT = "#30638e", "#2a9d6f", "#00a6c8"
OBSTACLE, TRAJECTORY = "#e4e6e9", "#16c7d9"
GRIDS_IN_A_LINE, LETTERS_IN_A_LINE = 5, 24


def error_boxes_figure(
    panels: Mapping[str, Mapping[str, Sequence[float]]], *, threshold: float | None = None
) -> Figure:
    """Draws box plots of errors on a logarithmic axis: one panel for each measure, one box for each method.

    Args:
        panels: errors by measure (with its unit) and by method.
        threshold: limit of success, drawn as a line in the first panel.

    Returns:
        The figure.
    """
    num_methods = max(len(methods) for methods in panels.values())
    figure = figures.new_figure(1.6 + 0.75 * num_methods * len(panels), 4.4, layout="tight")
    axes = np.atleast_1d(figure.subplots(1, len(panels)))
    for number, (ax, (measure, methods)) in enumerate(zip(axes, panels.items(), strict=True)):
        values = [np.maximum(np.asarray(errors, float), 1e-4) for errors in methods.values()]
        ax.boxplot(values, widths=0.55, medianprops={"color": ACCENT}, showfliers=False, whis=(5, 95))
        for place, errors in enumerate(values, start=1):
            spread = np.linspace(-0.18, 0.18, len(errors)) if len(errors) > 1 else np.zeros(len(errors))
            ax.plot(place + spread, errors, ".", color=MUTED, markersize=3, alpha=0.6)
        ax.set_xticks(range(1, len(methods) + 1), list(methods), rotation=30, ha="right", fontsize=8)
        ax.set_yscale("log")
        ax.set_ylabel(measure, color=INK)
        ax.grid(axis="y", alpha=0.25)
        if threshold is not None and number == 0:
            ax.axhline(threshold, color=ACCENT, linewidth=0.8, linestyle="--", label=f"right below {threshold:g}")
            ax.legend(fontsize=7, frameon=False)
    return figure


def success_grids_figure(
    grids: Mapping[str, NDArray[np.float64]], rows: Mapping[str, Sequence[str]], columns: Mapping[str, Sequence[str]]
) -> Figure:
    """Draws one grid of success rates for each method, five in a line; cells that were not run are empty.

    Args:
        grids: (r, c) rates from 0 to 1 by method, at least one; NaN: not run.
        rows: title of the rows, and the name of each.
        columns: title of the columns, and the name of each.

    Returns:
        The figure.

    Raises:
        ValueError: a grid has another shape than its names.
    """
    ((row_label, row_names),) = rows.items()
    ((column_label, column_names),) = columns.items()
    for method, rates in grids.items():
        if rates.shape != (len(row_names), len(column_names)):
            expected = f"{len(row_names)} rows and {len(column_names)} columns"
            raise ValueError(f"{method}: expected {expected}, got {rates.shape}")
    num_lines = -(-len(grids) // GRIDS_IN_A_LINE)
    num_in_line = -(-len(grids) // num_lines)
    figure = figures.new_figure(1.2 + 2.1 * num_in_line, num_lines * (1.3 + 0.42 * len(row_names)), layout="tight")
    axes = figure.subplots(num_lines, num_in_line, squeeze=False)
    for ax in axes.flat[len(grids) :]:
        ax.remove()
    for ax, (method, rates) in zip(axes.flat, grids.items(), strict=False):
        ax.imshow(rates, vmin=0.0, vmax=1.0, cmap="cividis", aspect="auto")
        for (i, j), rate in np.ndenumerate(rates):
            if np.isfinite(rate):
                ink = INK if rate > 0.5 else "white"
                ax.text(j, i, f"{100 * rate:.0f}", ha="center", va="center", fontsize=8, color=ink)
        figures.set_title(ax, textwrap.fill(method, LETTERS_IN_A_LINE), 9)
        ax.set_xticks(range(len(column_names)), list(column_names), fontsize=8)
        ax.set_yticks([])
        ax.set_xlabel(column_label, fontsize=8)
    for ax in axes[:, 0]:
        ax.set_yticks(range(len(row_names)), list(row_names), fontsize=8)
        ax.set_ylabel(row_label, fontsize=8)
    figure.suptitle("right sets, %", fontsize=9)
    return figure


def toy_figure(
    curve: tuple[ArrayLike, ArrayLike], converted: tuple[ArrayLike, ArrayLike], *, visited: tuple[ArrayLike, ArrayLike],
    direct_end: tuple[float, float], network_end_z: float,
) -> Figure:  # fmt: skip
    """Draws DeepMapping figure 14.

    Args:
        curve: (k,) values of x, and L there.
        converted: (m,) inputs of the fitted network, and L of its output there.
        visited: x and L of the descent of the network form; its last entry is the end.
        direct_end: x and L where the direct form ends.
        network_end_z: the input of the network where the network form ends.

    Returns:
        The figure.
    """
    x, loss = map(np.asarray, curve)
    network_end = tuple(float(np.asarray(values)[-1]) for values in visited)
    figure = figures.new_figure(8.0, 4.6, layout="tight")
    axes = figure.add_subplot()
    ends: dict[str, Any] = {"mec": "white", "ls": "none", "zorder": 6}
    axes.plot(x, loss, color=INK, lw=1.2, label="L(x)", zorder=2)
    axes.plot(*map(np.asarray, converted), "--", color=SOURCE, lw=1.4, label="L(f(z)), fitted f")
    axes.plot(*map(np.asarray, visited), "*", color=GREEN, ms=7, mew=0, alpha=0.5, label="x visited by the network")
    axes.plot(*direct_end, marker="o", color=DIRECT, ms=9, label="direct descent ends", **ends)
    axes.plot(network_end_z, network_end[1], marker="P", color=ACCENT, ms=10, label="z* of the network", **ends)
    axes.plot(*network_end, marker="o", color=ACCENT, ms=9, label="x* = f(z*)", **ends)
    figures.style_axes(axes, "x, or z for the dashed line", "L")
    axes.legend(fontsize=8, frameon=False, loc="upper left", ncols=2)
    axes.set_xlim(float(x.min()), float(x.max()))
    axes.set_ylim(top=1.5 * float(loss.max()))
    return figure


def endings_figure(
    x: ArrayLike, loss: ArrayLike, ends: Mapping[str, NDArray[np.floating]], shares: Mapping[str, float]
) -> Figure:
    """Draws the final x of the seeds: L on top, then a histogram for each method with the share at the global minimum.

    Args:
        x: (k,) values of x; their range is shown.
        loss: (k,) L there.
        ends: x at the end of each seed, by method.
        shares: share of the seeds at the global minimum, by method.

    Returns:
        The figure.

    Raises:
        ValueError: no method, or a share is missing.
    """
    if not ends or set(ends) != set(shares):
        raise ValueError(f"expected shares of the same methods as ends; got {sorted(ends)} and {sorted(shares)}")
    shown = np.asarray(x, np.float64)
    figure = figures.new_figure(8.0, 1.8 + 0.95 * len(ends), layout="tight")
    top, *rows = figure.subplots(1 + len(ends), 1, sharex=True, height_ratios=(1.8, *([1.0] * len(ends))))
    top.plot(shown, np.asarray(loss), color=INK, lw=1.2)
    figures.style_axes(top, y_label="L(x)")
    edges = np.linspace(shown.min(), shown.max(), 241)
    for axes, (name, values) in zip(rows, ends.items(), strict=True):
        finite = values[np.isfinite(values)]
        axes.hist(np.clip(finite, edges[0], edges[-1]), edges, color=ACCENT if "network" in name else DIRECT)
        axes.set_yscale("symlog", linthresh=1.0)
        figures.annotate_corner(axes, f"{name}: {100 * shares[name]:.1f} % at the global minimum", (3, 2), color=INK)
        figures.style_axes(axes, "x at the end of a seed" if axes is rows[-1] else "", "seeds")
    return figure


class ErrorMap(NamedTuple):
    """One panel.

    Attributes:
        title: title of the network.
        subtitle: numbers of the network.
        error: (h, w) distance to the truth; NaN where no scan was taken. Row 0 has the smallest y.
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
    """Draws errors of re-localisation in the manner of DeepMapping figure 7; black is an error of zero.

    Args:
        maps: maps, at least one, all of one shape.
        extent: x_min, x_max, y_min, y_max of the grids' outer edges, in `unit`.
        trajectory_world: (n, 2) where the scans of the fit were taken.
        unit: unit of lengths.
        worst: least error of the last colour.

    Returns:
        The figure; the trajectory of the fit is cyan.

    Raises:
        ValueError: no panel, panels of different shapes, or `worst` is not positive.
    """
    if not maps or len({panel.error.shape for panel in maps}) != 1 or not worst > 0.0:
        raise ValueError(f"expected panels of one shape and worst > 0; got {len(maps)} panels, worst {worst}")
    limits = Limits(*map(float, extent))
    colormap = matplotlib.colormaps["inferno"].with_extremes(bad=OBSTACLE)
    figure = figures.new_figure(4.6 * len(maps) + 0.9, 5.0)
    axes_row = figure.subplots(1, len(maps), squeeze=False)[0]
    for axes, panel in zip(axes_row, maps, strict=True):
        image = figures.show_raster(axes, panel.error, limits, cmap=colormap, vmin=0.0, vmax=worst)
        axes.plot(*np.asarray(trajectory_world).T, ".", color=TRAJECTORY, ms=1.8)
        figures.set_title(axes, f"{panel.title}\n", 11, loc="left", fontweight="bold")
        figures.annotate_corner(axes, panel.subtitle, (0, 6))
        figures.frame_map(axes, limits, unit if panel is maps[0] else None)
    # The bar and its label need about 0.9 inches at the right, whatever the number of maps.
    right = 1.0 - 0.9 / figure.get_figwidth()
    figure.tight_layout(rect=(0.0, 0.0, right, 1.0))
    bar = figure.add_axes((right + 0.005, 0.1, 0.15 / figure.get_figwidth(), 0.75))
    figure.colorbar(image, cax=bar, label=f"error, {unit}", extend="max")
    return figure
