"""Pictures of a training: curves over steps, and two scans with lines between their matches."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.viz.figures import ACCENT, FRAME, INK, MUTED, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CURVE_COLOR, RIGHT_COLOR = "#30638e", "#2a9d6f"
SMOOTHED_PART = 0.03


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
    figure = new_figure(8.0, 1.0 + 1.5 * len(values))
    rows = figure.subplots(len(values), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, curve) in zip(rows, values.items(), strict=True):
        is_known = np.isfinite(curve)
        many = int(is_known.sum()) > 40
        axes.plot(
            x[is_known],
            curve[is_known],
            color=CURVE_COLOR,
            alpha=0.3 if many else 1.0,
            lw=1,
            marker="" if many else ".",
        )
        if many:
            axes.plot(x[is_known], _smoothed(curve[is_known]), color=CURVE_COLOR, lw=1.6)
        axes.set_ylabel(name, color=INK, fontsize=9)
        axes.grid(color=FRAME, lw=0.6)
        axes.tick_params(colors=MUTED, labelsize=8)
        for spine in axes.spines.values():
            spine.set_color(FRAME)
    rows[-1].set_xlabel("step", color=INK, fontsize=9)
    figure.tight_layout()
    return figure


class MatchedScans(NamedTuple):
    """Two scans and the matches between them, metres.

    Attributes:
        source: (n, 3) points in the source frame.
        target: (m, 3) points in the target frame.
        source_matched: (k, 3) matched points of the source.
        target_matched: (k, 3) matched points of the target, row for row.
        is_right: (k,) whether the true motion brings the two points of a match together.
    """

    source: ArrayLike
    target: ArrayLike
    source_matched: ArrayLike
    target_matched: ArrayLike
    is_right: ArrayLike


def matches_figure(scans: MatchedScans, T_target_source: ArrayLike, *, title: str) -> Figure:
    """Draws two scans side by side from above with lines between matches, and overlaid by the estimated motion.

    Args:
        scans: both scans and their matches.
        T_target_source: (4, 4) the estimated motion, metres.
        title: title of the picture.

    Returns:
        The figure.
    """
    a, b, T = (np.asarray(x, np.float64) for x in (scans.source, scans.target, T_target_source))
    pa, pb = np.asarray(scans.source_matched, np.float64), np.asarray(scans.target_matched, np.float64)
    figure = new_figure(12.0, 4.6)
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    shift = np.array([a[:, 0].max(initial=0) - b[:, 0].min(initial=0) + 5.0, 0.0])
    _dots(left, a[:, :2], CURVE_COLOR)
    _dots(left, b[:, :2] + shift, MUTED)
    for start, end, fits in zip(pa[:, :2], pb[:, :2] + shift, np.asarray(scans.is_right, bool), strict=True):
        left.plot(*zip(start, end, strict=True), color=RIGHT_COLOR if fits else ACCENT, lw=0.6, alpha=0.7)
    left.set_title(title, fontsize=10, color=INK)
    _dots(right, b[:, :2], MUTED)
    _dots(right, a[:, :2] @ T[:2, :2].T + a[:, 2:] @ T[:2, 2:3].T + T[:2, 3], CURVE_COLOR)
    right.set_title("source laid onto target", fontsize=10, color=INK)
    for axes in (left, right):
        axes.set_aspect("equal")
        axes.set_axis_off()
    figure.tight_layout()
    return figure


def _dots(axes: Axes, points: NDArray[np.float64], color: str) -> None:
    axes.plot(points[:, 0], points[:, 1], ",", color=color, alpha=0.6)


def _smoothed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    # Running mean over a small part of the curve; at the ends, of the values that are there.
    width = max(3, int(SMOOTHED_PART * len(values)))
    ones = np.ones(width)
    return np.convolve(values, ones, "same") / np.convolve(np.ones_like(values), ones, "same")
