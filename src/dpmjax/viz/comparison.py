"""Methods side by side: boxes of their errors (DeepMapping figure 6) and grids of their success."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dpmjax.viz.figures import ACCENT, INK, MUTED, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def error_boxes_figure(
    panels: Mapping[str, Mapping[str, Sequence[float]]], *, threshold: float | None = None
) -> Figure:
    """Draws box plots of errors on a logarithmic axis: one panel for each measure, one box for each method.

    Args:
        panels: errors by measure (with its unit) and by method.
        threshold: drawn as a line in the first panel: what counts as success.

    Returns:
        The figure.
    """
    figure = new_figure(1.6 + 0.75 * max(len(methods) for methods in panels.values()) * len(panels), 4.4)
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
            ax.axhline(threshold, color=ACCENT, linewidth=0.8, linestyle="--")
    figure.tight_layout()
    return figure


def success_grids_figure(
    grids: Mapping[str, NDArray[np.float64]], rows: Mapping[str, Sequence[str]], columns: Mapping[str, Sequence[str]]
) -> Figure:
    """Draws one grid of success rates for each method; cells that were not run are empty.

    Args:
        grids: (r, c) rates from 0 to 1 by method; NaN: not run.
        rows: what the rows are, with the name of each.
        columns: what the columns are, with the name of each.

    Returns:
        The figure.

    Raises:
        ValueError: a grid has another shape than its names.
    """
    ((row_label, row_names),) = rows.items()
    ((column_label, column_names),) = columns.items()
    for method, rates in grids.items():
        if rates.shape != (len(row_names), len(column_names)):
            raise ValueError(
                f"{method}: expected {len(row_names)} rows and {len(column_names)} columns, got {rates.shape}"
            )
    figure = new_figure(1.2 + 2.1 * len(grids), 1.3 + 0.42 * len(row_names))
    axes = figure.subplots(1, len(grids), sharey=True, squeeze=False)[0]
    for ax, (method, rates) in zip(axes, grids.items(), strict=True):
        ax.imshow(rates, vmin=0.0, vmax=1.0, cmap="cividis", aspect="auto")
        for (i, j), rate in np.ndenumerate(rates):
            if np.isfinite(rate):
                ink = INK if rate > 0.5 else "white"
                ax.text(j, i, f"{100 * rate:.0f}", ha="center", va="center", fontsize=8, color=ink)
        ax.set_title(method, fontsize=9, color=INK)
        ax.set_xticks(range(len(column_names)), list(column_names), fontsize=8)
        ax.set_yticks(range(len(row_names)), list(row_names), fontsize=8)
        ax.set_xlabel(column_label, fontsize=8)
    axes[0].set_ylabel(row_label, fontsize=8)
    figure.tight_layout()
    return figure
