"""Several SLAM methods on several drives: small maps of trajectories, and how maps grow (DeepPointMap figure 4)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dpmjax.viz.drives import plane_limits
from dpmjax.viz.figures import INK, MUTED, add_scale_bar, frame_map, new_figure, style_axes

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLUMNS = 4
_CURVE_COLORS = ("#8a929b", "#e08a1e", "#1f4e8c", "#4f8fcf", "#2a9d5c")
_MARGIN = 0.12
_PANEL_IN, _LEGEND_IN, _ENTRY_IN = 3.1, 0.6, 1.9
# A lost method must not make the remaining trajectories small.
_SHARE_OUTSIDE = 0.5


class TrackPanel(NamedTuple):
    """The trajectories of one drive, all in one frame.

    Attributes:
        tracks: (n, 3) positions by method, metres.
        reference: (n, 3) true positions; None where there are none.
    """

    tracks: Mapping[str, Float[np.ndarray, "n 3"]]
    reference: Float[np.ndarray, "n 3"] | None


def trajectories_figure(panels: Mapping[str, TrackPanel], colors: Mapping[str, str]) -> Figure:
    """Draws a small panel for each drive, from above, with all methods and the reference.

    Args:
        panels: by name of the drive.
        colors: by method; the legend has their order.

    Returns:
        The figure.

    Raises:
        ValueError: no panel, or a method without a colour.
    """
    methods = {method for panel in panels.values() for method in panel.tracks}
    if not panels or not methods <= set(colors):
        raise ValueError(f"expected panels, and colours of {sorted(methods)}; got colours of {sorted(colors)}")
    figure, grid = _panels(len(panels), _PANEL_IN)
    for axes, (name, panel) in zip(grid, panels.items(), strict=True):
        if panel.reference is not None:
            axes.plot(*panel.reference[:, :2].T, color="#b9c0c8", lw=3.6, solid_capstyle="round", label="reference")
        for method in [method for method in colors if method in panel.tracks]:
            axes.plot(*panel.tracks[method][:, :2].T, color=colors[method], lw=1.0, label=method)
        frame_map(axes, plane_limits(_shown(panel), _MARGIN))
        add_scale_bar(axes, plane_limits(_shown(panel), _MARGIN), "m")
        axes.set_title(name, fontsize=8.5, color=INK)
    shown = [zip(*axes.get_legend_handles_labels(), strict=True) for axes in grid]
    entries = {label: handle for handles in shown for handle, label in handles}
    _add_legend(figure, entries)
    return figure


def _panels(num: int, height_in: float, *, is_y_shared: bool = False) -> tuple[Figure, list[Axes]]:
    """Makes a figure of several panels, with space for a legend below them."""
    columns = min(num, _COLUMNS)
    num_rows = math.ceil(num / columns)
    figure = new_figure(_PANEL_IN * columns, height_in * num_rows + _LEGEND_IN)
    grid = figure.subplots(num_rows, columns, squeeze=False, sharey=is_y_shared).ravel().tolist()
    for axes in grid[num:]:
        axes.set_axis_off()
    return figure, grid[:num]


def _add_legend(figure: Figure, entries: Mapping[str, Artist]) -> None:
    """Adds one legend for all panels, below them."""
    figure.tight_layout(rect=(0, _LEGEND_IN / figure.get_figheight(), 1, 1))
    num_columns = max(int(figure.get_figwidth() / _ENTRY_IN), 1)
    figure.legend(
        entries.values(), entries.keys(), loc="lower center", ncols=num_columns, frameon=False, fontsize=8,
        labelcolor=MUTED,
    )  # fmt: skip


def _shown(panel: TrackPanel) -> NDArray[np.float64]:
    """The reference sets the limits; a lost trajectory leaves the panel."""
    everything = np.concatenate([positions[:, :2] for positions in panel.tracks.values()] or [np.zeros((1, 2))])
    if panel.reference is None:
        return np.asarray(everything, np.float64)
    low, high = panel.reference[:, :2].min(axis=0), panel.reference[:, :2].max(axis=0)
    spare = _SHARE_OUTSIDE * (high - low).max()
    return np.vstack([panel.reference[:, :2], np.clip(everything, low - spare, high + spare)])


def growth_figure(
    panels: Mapping[str, Mapping[str, tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]]],
) -> Figure:
    """Draws how many bytes the forms of a map take against metres driven, on a logarithmic axis.

    Args:
        panels: by name of the drive and of the form: metres driven, and bytes.

    Returns:
        The figure.

    Raises:
        ValueError: no panel.
    """
    if not panels:
        raise ValueError("panels: expected at least one")
    figure, grid = _panels(len(panels), 0.85 * _PANEL_IN, is_y_shared=True)
    names = list(dict.fromkeys(name for curves in panels.values() for name in curves))
    colors = {name: _CURVE_COLORS[number % len(_CURVE_COLORS)] for number, name in enumerate(names)}
    entries: dict[str, Artist] = {}
    for axes, (drive, curves) in zip(grid, panels.items(), strict=True):
        for name, (metres, sizes) in curves.items():
            (entries[name],) = axes.plot(metres, sizes / 1e6, "-o", ms=2.5, lw=1.3, color=colors[name])
        axes.set_yscale("log")
        axes.set_xlim(left=0)
        axes.set_title(drive, fontsize=8.5, color=INK)
        axes.set_xlabel("distance driven, m", fontsize=8, color=MUTED)
        style_axes(axes)
    grid[0].set_ylabel("map, MB", fontsize=8, color=MUTED)
    _add_legend(figure, entries)
    return figure
