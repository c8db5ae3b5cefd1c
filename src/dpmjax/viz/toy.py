"""The one-dimensional example as a picture, in the manner of DeepMapping figure 14, and where many seeds end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.viz.figures import FRAME, INK, MUTED, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CURVE, CONVERTED, VISITED, DIRECT, NETWORK = "#1b1f24", "#30638e", "#2a9d6f", "#00a6c8", "#d1495b"


def toy_figure(
    x: ArrayLike,
    loss: ArrayLike,
    z: ArrayLike,
    converted_loss: ArrayLike,
    *,
    visited: tuple[ArrayLike, ArrayLike],
    direct_end: tuple[float, float],
    network_end: tuple[float, float],
    network_end_z: float,
) -> Figure:
    """Draws DeepMapping figure 14.

    Args:
        x: (k,) values of x.
        loss: (k,) L there.
        z: (m,) inputs of the fitted network.
        converted_loss: (m,) L of its output there.
        visited: x and L of the descent of the network form.
        direct_end: x and L where the direct form ends.
        network_end: x and L where the network form ends.
        network_end_z: the input of the network there.

    Returns:
        The figure.
    """
    figure = new_figure(8.0, 4.6)
    axes = figure.add_subplot()
    axes.plot(np.asarray(x), np.asarray(loss), color=CURVE, lw=1.2, label="L(x)", zorder=2)
    axes.plot(np.asarray(z), np.asarray(converted_loss), "--", color=CONVERTED, lw=1.4, label="L(f(z)), fitted f")
    axes.plot(*map(np.asarray, visited), "*", color=VISITED, ms=7, mew=0, alpha=0.5, label="x visited by the network")
    axes.plot(*direct_end, "o", color=DIRECT, ms=9, mec="white", label="direct descent ends", zorder=5)
    axes.plot(
        network_end_z, network_end[1], "P", color=NETWORK, ms=10, mec="white", label="z* of the network", zorder=6
    )
    axes.plot(*network_end, "o", color=NETWORK, ms=9, mec="white", label="x* = f(z*)", zorder=6)
    axes.set_xlabel("x, or z for the dashed line", color=INK, fontsize=9)
    axes.set_ylabel("L", color=INK, fontsize=9)
    _plain(axes)
    axes.legend(fontsize=8, frameon=False, loc="upper left", ncols=2)
    axes.set_xlim(float(np.min(np.asarray(x))), float(np.max(np.asarray(x))))
    axes.set_ylim(top=1.5 * float(np.max(np.asarray(loss))))
    figure.tight_layout()
    return figure


def endings_figure(
    x: ArrayLike, loss: ArrayLike, ends: Mapping[str, NDArray[np.floating]], shares: Mapping[str, float]
) -> Figure:
    """Draws where the seeds end: L on top, then a histogram a method with the share that found the global minimum.

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
    figure = new_figure(8.0, 1.8 + 0.95 * len(ends))
    top, *rows = figure.subplots(1 + len(ends), 1, sharex=True, height_ratios=(1.8, *([1.0] * len(ends))))
    top.plot(shown, np.asarray(loss), color=CURVE, lw=1.2)
    top.set_ylabel("L(x)", fontsize=9, color=INK)
    _plain(top)
    edges = np.linspace(shown.min(), shown.max(), 241)
    for axes, (name, values) in zip(rows, ends.items(), strict=True):
        finite = values[np.isfinite(values)]
        axes.hist(np.clip(finite, edges[0], edges[-1]), edges, color=NETWORK if "network" in name else DIRECT)
        axes.set_yscale("symlog", linthresh=1.0)
        axes.annotate(
            f"{name}: {100 * shares[name]:.1f} % at the global minimum",
            (0, 1),
            xytext=(3, 2),
            xycoords="axes fraction",
            textcoords="offset points",
            fontsize=8.5,
            color=INK,
        )
        _plain(axes)
    rows[-1].set_xlabel("x at the end of a seed", fontsize=9, color=INK)
    figure.tight_layout()
    return figure


def _plain(axes: Axes) -> None:
    axes.grid(color=FRAME, lw=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=MUTED, labelsize=8)
    for spine in axes.spines.values():
        spine.set_color(FRAME)
