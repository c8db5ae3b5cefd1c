"""Curves: a fit over its run time, a training over its steps, the reliability of a confidence."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray

from dpmjax.viz import figures
from dpmjax.viz.figures import ACCENT, FRAME, INK, MUTED

Floats = NDArray[np.floating]

PHASE_COLORS = ("#eef2f7", "#fbf3e6", "#ecf5ee", "#f6eef6")
LOSS_COLOR = "#30638e"
RATIO_FOR_LOG_AXIS = 10.0
_FEW_DECADES = 2
SMOOTHED_PART = 0.03
NUM_BINS = 10


def history_figure(seconds: Floats, loss: Floats, names: Sequence[str], ate: Floats, unit: str) -> Figure:
    """Draws loss and ATE over run time, the phases of the fit shaded and named.

    The loss line breaks between phases, because each phase has an objective of its own. A value axis is logarithmic
    where all its values are positive and span more than a factor of ten.

    Args:
        seconds: (k,) run time of each record of the fit, never decreasing, compile time left out.
        loss: (k,) value of the phase's own objective; NaN where there is none.
        names: (k,) name of the phase of each record ("L-Net", "free poses", "polish").
        ate: (k,) absolute trajectory error, NaN where not measured.
        unit: unit of the ATE.

    Returns:
        The figure.

    Raises:
        ValueError: no record, or columns of different lengths.
    """
    lengths = [len(column) for column in (seconds, loss, names, ate)]
    if len(set(lengths)) != 1 or lengths[0] == 0:
        raise ValueError(f"expected one or more records and columns of one length; got lengths {lengths}")

    is_known = np.isfinite(ate)
    has_ate = bool(is_known.any())
    figure = figures.new_figure(8.0, 5.2 if has_ate else 3.0)
    rows = figure.subplots(2 if has_ate else 1, 1, sharex=True, squeeze=False)[:, 0]
    phases = _phases(names)
    for axes in rows:
        for number, phase in enumerate(phases):
            begin, end = seconds[max(0, phase.start - 1)], seconds[phase.stop - 1]
            axes.axvspan(begin, end, color=PHASE_COLORS[number % len(PHASE_COLORS)], linewidth=0, zorder=0)
    for phase in phases:
        _draw_line(rows[0], seconds[phase], loss[phase], LOSS_COLOR)
    _finish_value_axis(rows[0], loss, "loss")
    if has_ate:
        _draw_line(rows[1], seconds[is_known], ate[is_known], ACCENT)
        _finish_value_axis(rows[1], ate, f"ATE ({unit})")
        last = seconds[is_known][-1], ate[is_known][-1]
        style: Any = {"va": "center", "fontsize": 9, "color": ACCENT, "annotation_clip": False}
        rows[1].annotate(figures.format_length(last[1], unit), last, xytext=(7, 0), textcoords="offset points", **style)
    _name_phases(rows[0], phases, names, seconds)
    rows[-1].set_xlabel("run time (s)", color=INK)
    first, last = seconds[0], seconds[-1]
    rows[-1].set_xlim(first, last if last > first else first + 1.0)
    top, bottom = (0.93, 0.1) if has_ate else (0.89, 0.17)
    figure.subplots_adjust(left=0.12, right=0.9, top=top, bottom=bottom, hspace=0.08)
    return figure


def _phases(names: Sequence[str]) -> list[slice]:
    """Returns the records of each phase, runs of equal names; it lasts from the last record before to its own last."""
    borders = [0, *(k for k in range(1, len(names)) if names[k] != names[k - 1]), len(names)]
    return [slice(first, last) for first, last in itertools.pairwise(borders)]


def _name_phases(axes: Axes, phases: Sequence[slice], names: Sequence[str], seconds: Floats) -> None:
    """Writes the names above the first row; a name that would run into its left neighbour moves right of it."""
    first, last = seconds[0], seconds[-1]
    taken_until = 0.0
    for phase in phases:
        name, begin = names[phase.start], seconds[max(0, phase.start - 1)]
        start = max((begin - first) / max(last - first, 1e-9), taken_until)
        style: Any = {"xycoords": "axes fraction", "textcoords": "offset points", "fontsize": 9.5, "color": MUTED}
        axes.annotate(name, (start, 1), xytext=(2, 5), **style)
        taken_until = start + 0.0135 * (len(name) + 2)


def _draw_line(axes: Axes, seconds: Floats, values: Floats, color: str) -> None:
    # A phase of one record has no line: it shows as a dot.
    axes.plot(seconds, values, "-" if len(seconds) > 1 else "o", color=color, linewidth=1.6, markersize=4, zorder=3)


def _finish_value_axis(axes: Axes, values: Floats, label: str) -> None:
    known = values[np.isfinite(values)]
    if len(known) and known.min() > 0.0 and known.max() > RATIO_FOR_LOG_AXIS * known.min():
        axes.set_yscale("log")
        _label_log_axis(axes, known)
    axes.set_ylabel(label, color=INK)
    axes.grid(axis="y", color=FRAME, linewidth=0.6, zorder=1)
    axes.tick_params(which="both", colors=MUTED, labelsize=9, length=3)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(FRAME)


def _label_log_axis(axes: Axes, values: Floats) -> None:
    # Plain numbers at powers of ten; over few decades also at 2 and 5 times these. Other ticks have no label.
    is_short = values.max() < RATIO_FOR_LOG_AXIS**_FEW_DECADES * values.min()
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if is_short else (1.0,), numticks=8))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def curves_figure(steps: ArrayLike, curves: Mapping[str, ArrayLike]) -> Figure:
    """Draws each curve over the steps in a row of its own; NaN is left out.

    Args:
        steps: numbers of the steps.
        curves: one value for each step, by name.

    Returns:
        The figure.

    Raises:
        ValueError: if there is no step, no curve, or a curve of another length.
    """
    x = np.asarray(steps, np.float64)
    values = {name: np.asarray(curve, np.float64) for name, curve in curves.items()}
    if len(x) == 0 or not values or any(len(curve) != len(x) for curve in values.values()):
        raise ValueError(f"expected one or more steps and curves as long; got {len(x)} steps, {len(values)} curves")
    figure = figures.new_figure(8.0, 1.0 + 1.5 * len(values), layout="tight")
    rows = figure.subplots(len(values), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, curve) in zip(rows, values.items(), strict=True):
        is_known = np.isfinite(curve)
        many = int(is_known.sum()) > 40
        style: dict[str, Any] = {"alpha": 0.3} if many else {"marker": "."}
        axes.plot(x[is_known], curve[is_known], color=LOSS_COLOR, lw=1, **style)
        if many:
            axes.plot(x[is_known], _smoothed(curve[is_known]), color=LOSS_COLOR, lw=1.6)
        figures.style_axes(axes, "step" if axes is rows[-1] else "", name)
    return figure


def _smoothed(values: Floats) -> Floats:
    # Running mean over a small part of the curve; at the ends, of the values that are there.
    width = max(3, int(SMOOTHED_PART * len(values)))
    ones = np.ones(width)
    return np.convolve(values, ones, "same") / np.convolve(np.ones_like(values), ones, "same")


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
    bins = np.minimum((confidence * NUM_BINS).astype(int), NUM_BINS - 1)
    figure = figures.new_figure(4.6, 5.0, layout="tight")
    axes = figure.subplots()
    figures.style_axes(axes, *labels)
    axes.plot([0, 1], [0, 1], color=MUTED, lw=1, ls="--", label="calibrated: share equals confidence")
    counts = np.bincount(bins, minlength=NUM_BINS)
    used = counts > 0
    x, y = (np.bincount(bins, values, NUM_BINS)[used] / counts[used] for values in (confidence, right))
    axes.plot(x, y, "o-", color=ACCENT, lw=1.4, ms=4, label="measured, with the number of pairs")
    for count, left, up in zip(counts[used], x, y, strict=True):
        axes.annotate(str(count), (left, up), xytext=(5, -10), textcoords="offset points", fontsize=7, color=MUTED)
    brier = float(np.mean((confidence - right) ** 2)) if len(right) else float("nan")
    figures.set_title(axes, f"{title}\n{len(right)} pairs, Brier score {brier:.3f} (0: perfect)")
    figures.add_legend(axes, columns=1, loc="upper center", bbox_to_anchor=(0.5, -0.13))
    return figure
