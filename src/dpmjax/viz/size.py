"""Time (in the log-log plane) and memory against the number of scans."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from dpmjax.viz.figures import FRAME, INK, MUTED, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = ("#30638e", "#d1495b", "#2a9d6f", "#e09f3e")


def size_figure(curves: Mapping[str, ArrayLike], *, memory_limit_gb: float) -> Figure:
    """Draws seconds on the left and memory on the right.

    Args:
        curves: "num_scans" (k,), and by name other (k,) values: in GB where the name ends so, else in seconds.
        memory_limit_gb: a line on the right.

    Raises:
        ValueError: no size, or a curve of another length.
    """
    sizes = np.asarray(curves["num_scans"], np.float64)
    others = {name: np.asarray(values, np.float64) for name, values in curves.items() if name != "num_scans"}
    if len(sizes) == 0 or any(values.shape != sizes.shape for values in others.values()):
        raise ValueError(f"curves: expected one or more sizes and curves as long; got {len(sizes)} sizes")
    figure = new_figure(9.0, 3.9)
    left, right = figure.subplots(1, 2)
    times = [name for name in others if not name.endswith("(GB)")]
    for name, color in zip(times, COLORS * len(times), strict=False):
        left.plot(sizes, others[name], "-o", ms=4, lw=1.4, color=color, label=name)
    for name in (name for name in others if name.endswith("(GB)")):
        right.plot(sizes, others[name], "-o", ms=4, lw=1.4, color=COLORS[0], label=name)
    right.axhline(memory_limit_gb, color=MUTED, ls=":", lw=1.0)
    right.set_ylim(bottom=0.0, top=1.15 * memory_limit_gb)
    left.set_yscale("log")
    for axes in (left, right):
        axes.set_xscale("log", base=2)
        axes.set_xlabel("scans", fontsize=9, color=INK)
        axes.set_xticks(sizes, [f"{int(size)}" for size in sizes])
        axes.grid(color=FRAME, lw=0.6)
        axes.tick_params(colors=MUTED, labelsize=8)
        axes.legend(fontsize=8, frameon=False)
        for spine in axes.spines.values():
            spine.set_color(FRAME)
    figure.tight_layout()
    return figure
