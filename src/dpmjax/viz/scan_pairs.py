"""Pictures of pairs of scans from above: both scans under motions, and matches between their points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from dpmjax.viz import figures
from dpmjax.viz.figures import ACCENT, INK, Limits

# These colours and black differ in lightness too, so that they differ in grey.
SOURCE, TARGET = "#3a86c0", "#f0a840"
# Points farther out than this share of them are outside of the picture.
SHOWN_SHARE = 0.99
GAP_IN, ABOVE_IN, BELOW_IN = 0.2, 0.65, 0.55
_APART_M, _LOW_IN = 5.0, 4.2
# Most lines of matches of one kind; hundreds would hide the scans.
_MAX_LINES = 30


class RegisteredPair(NamedTuple):
    """Two scans and the motions between them.

    Attributes:
        title: title of the row.
        source: (n, 3) points, metres.
        target: (m, 3) points, metres.
        motions: (4, 4) `T_target_source` by the title of its panel, from left to right.
        names: names of source and target for the legend.
    """

    title: str
    source: NDArray[np.float32]
    target: NDArray[np.float32]
    motions: Mapping[str, NDArray[np.float64]]
    names: tuple[str, str] = ("source", "target")


def registered_pairs_figure(pairs: Sequence[RegisteredPair]) -> Figure:
    """Draws pairs of scans from above, the source under each of the motions; cells with points of both scans are black.

    Args:
        pairs: one row each; at least one.

    Returns:
        The figure; the panels of a row have the same limits.
    """
    limits = [_limits_of(pair) for pair in pairs]
    sizes = [figures.size_in(each) for each in limits]
    widths_in = [len(pair.motions) * (size[0] + GAP_IN) for pair, size in zip(pairs, sizes, strict=True)]
    figure = figures.new_figure(max(widths_in) + GAP_IN, sum(size[1] + ABOVE_IN + BELOW_IN for size in sizes))
    bottom_in = figure.get_figheight()
    for pair, each, (panel_in, height_in) in zip(pairs, limits, sizes, strict=True):
        bottom_in -= ABOVE_IN + height_in
        for column, (label, T) in enumerate(pair.motions.items()):
            left_in = GAP_IN + column * (panel_in + GAP_IN)
            axes = figures.add_axes(figure, (left_in, bottom_in, panel_in, height_in))
            entries = _draw_overlap(axes, pair, T, each)
            figures.set_title(axes, label, loc="left")
            if not column:
                figures.annotate_corner(axes, pair.title, (0, 22), fontsize=11, fontweight="bold", color=INK)
                figures.add_legend(axes, handles=entries, columns=len(entries))
        bottom_in -= BELOW_IN
    return figure


def matches_figure(
    pair: RegisteredPair, source_matched: ArrayLike, target_matched: ArrayLike, is_right: ArrayLike
) -> Figure:
    """Draws two scans from above: side by side with lines between matches, and together by the estimated motion.

    Lines of right matches are black, those of wrong ones red and dashed; at most 30 of each kind are drawn.

    Args:
        pair: both scans and the estimated motion.
        source_matched: (k, 3) matched points of the source.
        target_matched: (k, 3) matched points of the target, row for row.
        is_right: (k,) True where the true motion maps the two points of a match onto each other.

    Returns:
        The figure.
    """
    a, b, starts, ends = (
        np.asarray(x, np.float64)[:, :2] for x in (pair.source, pair.target, source_matched, target_matched)
    )
    right, ((label, T),) = np.asarray(is_right, bool), pair.motions.items()
    a_corners, b_corners = np.concatenate([_corners(a), starts]), np.concatenate([_corners(b), ends])
    apart = np.array([a_corners[:, 0].max(initial=0) - b_corners[:, 0].min(initial=0) + _APART_M, 0.0])
    both = figures.plane_limits(np.concatenate([a_corners, b_corners + apart]), 0.03), _limits_of(pair)
    widths_in = [_LOW_IN * limits.width / limits.height for limits in both]
    figure = figures.new_figure(sum(widths_in) + 3 * GAP_IN, _LOW_IN + ABOVE_IN + BELOW_IN)
    side_by_side = figures.add_axes(figure, (GAP_IN, BELOW_IN, widths_in[0], _LOW_IN))
    overlaid = figures.add_axes(figure, (widths_in[0] + 2 * GAP_IN, BELOW_IN, widths_in[1], _LOW_IN))
    figures.show_clouds(side_by_side, [a, b + apart], [SOURCE, TARGET], both[0])
    lines = np.stack([starts, ends + apart], axis=1)
    _draw_matches(side_by_side, lines[right], "right", INK, "-")
    _draw_matches(side_by_side, lines[~right], "wrong", ACCENT, "--")
    figures.frame_map(side_by_side, both[0], "m")
    source, target, *others = _draw_overlap(overlaid, pair, T, both[1])
    figures.add_legend(side_by_side, handles=[source, target, *side_by_side.collections], columns=4)
    figures.add_legend(overlaid, handles=others, columns=2)
    figures.set_title(side_by_side, pair.title, loc="left")
    figures.set_title(overlaid, label, loc="left")
    return figure


def _draw_matches(axes: Axes, lines: NDArray[np.float64], kind: str, color: str, style: str) -> None:
    label = f"{len(lines)} {kind} match" + "es" * (len(lines) != 1)
    if len(lines) > _MAX_LINES:
        label += f", {_MAX_LINES} drawn"
    drawn = np.random.default_rng(0).permutation(lines)[:_MAX_LINES]
    axes.add_collection(LineCollection(list(drawn), colors=color, linestyles=style, linewidths=0.9, label=label))


def _draw_overlap(
    axes: Axes, pair: RegisteredPair, T_target_source: NDArray[np.float64], limits: Limits
) -> list[Artist]:
    """Draws both scans in the frame of the target, black where they meet, and both lidars.

    Returns:
        The entries of the legend: source, target, both, lidar of the source, lidar of the target.
    """
    moved = pair.source @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    side = figures.show_clouds(axes, [moved, pair.target], [SOURCE, TARGET], limits)
    figures.frame_map(axes, limits, "m")
    cells = [figures.cell_entry(color, name) for color, name in zip((SOURCE, TARGET), pair.names, strict=True)]
    labels = [f"lidar of {name}" for name in pair.names]
    style: dict[str, Any] = {"mec": "white", "mew": 0.8, "ls": "none", "zorder": 10}
    x, y = T_target_source[:2, 3]
    # Where both lidars are at one place, the triangle lies on the larger disc.
    of_target = axes.plot([0.0], [0.0], "o", color=TARGET, ms=10, label=labels[1], **style)
    of_source = axes.plot([x], [y], "^", color=SOURCE, ms=6.5, label=labels[0], **style)
    return [*cells, figures.cell_entry(INK, f"both in one cell of {side:.2g} m"), *of_source, *of_target]


def _limits_of(pair: RegisteredPair) -> Limits:
    """Returns limits that show both lidars and nearly all points under every motion."""
    moved = [pair.source @ T[:3, :3].T + T[:3, 3] for T in pair.motions.values()]
    corners = [_corners(pair.target), *(_corners(points) for points in moved)]
    lidars = [np.zeros(2), *(T[:2, 3] for T in pair.motions.values())]
    return figures.plane_limits(np.concatenate([lidars, *corners]), 0.03)


def _corners(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Returns two corners (x, y) of a box round nearly all points; far points would shrink the picture."""
    if not len(points):
        return np.zeros((0, 2))
    shares = 0.5 - SHOWN_SHARE / 2, 0.5 + SHOWN_SHARE / 2
    return np.asarray(np.quantile(points[:, :2], shares, axis=0), np.float64)
