"""Methods side by side: grids of their success over two settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dpmjax.viz.figures import INK, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
