"""Curves: values over steps or seconds, the reliability of a confidence, the toy of DeepMapping (figure 14)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray

from dpmjax.viz.figures import FRAME, INK, MUTED, PATH, WRONG

_NUM_BINS = 10


def curves_figure(
    x: ArrayLike, curves: Mapping[str, ArrayLike], *, x_label: str = "step", phases: Sequence[str] | None = None
) -> Figure:
    """Draws each curve in a row of its own; NaN is left out, and many values get a running mean.

    An axis is logarithmic where all its values are positive and span more than a factor of ten.

    Args:
        x: (k,) numbers of steps, or seconds; never decreasing.
        curves: (k,) values by name.
        x_label: label of x.
        phases: (k,) name of the phase of each value; each begins at a line with its name.

    Returns:
        The figure.

    Raises:
        ValueError: if there is no value, no curve, or a curve of another length.
    """
    at = np.asarray(x, np.float64)
    values = {name: np.asarray(curve, np.float64) for name, curve in curves.items()}
    if len(at) == 0 or not values or any(len(curve) != len(at) for curve in values.values()):
        raise ValueError(f"expected one or more steps and curves as long; got {len(at)} steps, {len(values)} curves")
    figure = Figure((8.0, 1.0 + 1.5 * len(values)), facecolor="white", layout="tight")
    rows = figure.subplots(len(values), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, curve) in zip(rows, values.items(), strict=True):
        is_known = np.isfinite(curve)
        known = curve[is_known]
        is_dense = len(known) > 40
        many = is_dense and phases is None
        style: dict[str, Any] = {"alpha": 0.3 if many else 1.0, "marker": "" if is_dense else "."}
        axes.plot(at[is_known], known, color=PATH, lw=1, **style)
        if many:
            axes.plot(at[is_known], _smoothed(known), color=PATH, lw=1.6)
        if len(known) and known.min() > 0.0 and known.max() > 10.0 * known.min():
            axes.set_yscale("log")
            is_short = known.max() < 100.0 * known.min()
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if is_short else (1.0,)))
            axes.yaxis.set(major_formatter="{x:g}", minor_formatter=NullFormatter())
        _label_axes(axes, x_label if axes is rows[-1] else "", name)
        names = list(phases or [])
        for k in (k for k in range(len(names)) if k == 0 or names[k] != names[k - 1]):
            begin = at[max(k - 1, 0)]
            axes.axvline(begin, color=FRAME, lw=1.5, zorder=1)
            if axes is rows[0]:
                place: Any = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "xytext": (2, 4)}
                axes.annotate(names[k], (begin, 1), fontsize=9, color=MUTED, **place)
    return figure


def _smoothed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes a running mean over a small part of the curve; at the ends, of the values that are there."""
    ones = np.ones(max(3, len(values) // 33))
    return np.convolve(values, ones, "same") / np.convolve(np.ones_like(values), ones, "same")


def _label_axes(axes: Axes, x_label: str, y_label: str) -> None:
    """Adds labels, a light grid, small ticks and a thin frame."""
    axes.set_xlabel(x_label, fontsize=9, color=INK)
    axes.set_ylabel(y_label, fontsize=9, color=INK)
    axes.grid(color=FRAME, lw=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", colors=MUTED, labelsize=8)
    for spine in axes.spines.values():
        spine.set_color(FRAME)


def reliability_figure(
    confidence: ArrayLike,
    is_right: ArrayLike,
    *,
    title: str,
    labels: tuple[str, str] = ("confidence", "share of right registrations"),
) -> Figure:
    """Draws a reliability diagram of probabilities in ten bins; calibrated ones lie on the line.

    Args:
        confidence: (n,) in [0, 1].
        is_right: (n,) True for correct registrations.
        title: title of the picture.
        labels: labels of both axes.

    Returns:
        The figure.
    """
    confidence, right = np.asarray(confidence, float), np.asarray(is_right, bool)
    bins = np.minimum((confidence * _NUM_BINS).astype(int), _NUM_BINS - 1)
    figure = Figure((4.6, 5.0), facecolor="white", layout="tight")
    axes = figure.subplots()
    _label_axes(axes, *labels)
    axes.plot([0, 1], [0, 1], color=MUTED, lw=1, ls="--", label="calibrated: share equals confidence")
    counts = np.bincount(bins, minlength=_NUM_BINS)
    used = counts > 0
    x, y = (np.bincount(bins, values, _NUM_BINS)[used] / counts[used] for values in (confidence, right))
    axes.plot(x, y, "o-", color=PATH, lw=1.4, ms=4, label="measured, with the number of pairs")
    for count, left, up in zip(counts[used], x, y, strict=True):
        axes.annotate(str(count), (left, up), xytext=(5, -10), textcoords="offset points", fontsize=7, color=MUTED)
    brier = float(np.mean((confidence - right) ** 2)) if len(right) else float("nan")
    axes.set_title(f"{title}\n{len(right)} pairs, Brier score {brier:.3f} (0: perfect)", fontsize=10, color=INK)
    axes.legend(loc="upper left", frameon=False, fontsize=8, labelcolor=MUTED)
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
    figure = Figure((8.0, 4.6), facecolor="white", layout="tight")
    axes = figure.add_subplot()
    ends: dict[str, Any] = {"mec": "white", "ls": "none", "zorder": 6}
    axes.plot(x, loss, color=INK, lw=1.2, label="L(x)", zorder=2)
    axes.plot(*map(np.asarray, converted), "--", color="#30638e", lw=1.4, label="L(f(z)), fitted f")
    axes.plot(*map(np.asarray, visited), "*", color="#2a9d6f", ms=7, mew=0, alpha=0.5, label="x visited by the network")
    axes.plot(*direct_end, marker="o", color="#00a6c8", ms=9, label="direct descent ends", **ends)
    axes.plot(network_end_z, network_end[1], marker="P", color=WRONG, ms=10, label="z* of the network", **ends)
    axes.plot(*network_end, marker="o", color=WRONG, ms=9, label="x* = f(z*)", **ends)
    _label_axes(axes, "x, or z for the dashed line", "L")
    axes.legend(fontsize=8, frameon=False, loc="upper left", ncols=2)
    axes.set_xlim(float(x.min()), float(x.max()))
    axes.set_ylim(top=1.5 * float(loss.max()))
    return figure
