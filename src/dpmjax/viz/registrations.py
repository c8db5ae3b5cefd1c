"""Pictures of registrations: reliability of a confidence, pairs under estimated and true motions, scans in a map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.viz.figures import ACCENT, INK, MUTED, frame_map, new_figure, plane_limits, size_in, style_axes

if TYPE_CHECKING:
    from matplotlib.figure import Figure


NUM_BINS = 10
SOURCE, TARGET = "#2e6f9e", "#d98c3f"
# Points farther out than this share of them are outside of the picture.
SHOWN_SHARE = 0.99


class RegisteredPair(NamedTuple):
    """Two scans and the motions between them.

    Attributes:
        title: title of the row.
        source: (n, 3) points, metres.
        target: (m, 3) points, metres.
        motions: (4, 4) `T_target_source` by the title of its panel, from left to right.
    """

    title: str
    source: NDArray[np.float32]
    target: NDArray[np.float32]
    motions: Mapping[str, NDArray[np.float64]]


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
    figure = new_figure(4.6, 4.6)
    axes = figure.subplots()
    style_axes(axes, *labels)
    axes.plot([0, 1], [0, 1], color=MUTED, lw=1, ls="--")
    used = [number for number in range(NUM_BINS) if np.any(bins == number)]
    x = [confidence[bins == number].mean() for number in used]
    y = [right[bins == number].mean() for number in used]
    axes.plot(x, y, "o-", color=ACCENT, lw=1.4, ms=4)
    for number, left, up in zip(used, x, y, strict=True):
        count = int(np.sum(bins == number))
        axes.annotate(str(count), (left, up), xytext=(5, -10), textcoords="offset points", fontsize=7, color=MUTED)
    brier = float(np.mean((confidence - right) ** 2)) if len(right) else float("nan")
    axes.set_title(f"{title}\n{len(right)} pairs, Brier score {brier:.3f}", fontsize=10, color=INK)
    figure.tight_layout()
    return figure


def registered_pairs_figure(pairs: Sequence[RegisteredPair]) -> Figure:
    """Draws pairs of scans from above, the source under each of the motions.

    Args:
        pairs: one row each; at least one, each with the same number of motions.

    Returns:
        The figure.
    """
    figure = new_figure(9.0, 4.2 * len(pairs))
    grid = figure.subplots(len(pairs), len(pairs[0].motions), squeeze=False)
    for row, pair in zip(grid, pairs, strict=True):
        for axes, (label, T) in zip(row, pair.motions.items(), strict=True):
            moved = pair.source @ T[:3, :3].T + T[:3, 3]
            for points, color in ((pair.target, TARGET), (moved, SOURCE)):
                axes.plot(points[:, 0], points[:, 1], ".", color=color, ms=1.2, alpha=0.5, mew=0)
            axes.plot([0, T[0, 3]], [0, T[1, 3]], "o-", color=ACCENT, ms=4, lw=1)
            both = np.concatenate([pair.target, moved])[:, :2]
            corners = np.quantile(both, (0.5 - SHOWN_SHARE / 2, 0.5 + SHOWN_SHARE / 2), axis=0)
            frame_map(axes, plane_limits(corners, 0.05))
            axes.set_title(f"{pair.title}\n{label}", fontsize=9, color=INK)
    figure.tight_layout()
    return figure


RIGHT = "#2a9d5c"
HEAD_SHARE = 0.02


def localization_figure(
    points_map: ArrayLike,
    T_map_keyframe: ArrayLike,
    T_map_scan: ArrayLike,
    *,
    is_wrong: ArrayLike | None = None,
    title: str,
) -> Figure:
    """Draws a map from above, the keyframes' positions, and the poses of the scans that were found as arrows.

    Args:
        points_map: (n, 3) points of the map, metres.
        T_map_keyframe: (k, 4, 4) at least one.
        T_map_scan: (s, 4, 4) of the scans that were found.
        is_wrong: (s,) scans that a reference puts elsewhere; None without a reference.
        title: title of the picture.

    Returns:
        The figure.
    """
    points, path = np.asarray(points_map, float).reshape(-1, 3), np.asarray(T_map_keyframe, float)[:, :3, 3]
    T = np.asarray(T_map_scan, float).reshape(-1, 4, 4)
    wrong = np.zeros(len(T), bool) if is_wrong is None else np.asarray(is_wrong, bool)
    # Few far points must not determine the limits.
    shown = np.concatenate([points[:, :2], path[:, :2], T[:, :2, 3]])
    limits = plane_limits(np.percentile(shown, [0.5, 99.5], axis=0), 0.06)
    width_in, height_in = size_in(limits)
    figure = new_figure(width_in + 0.3, height_in + 0.8)
    axes = figure.subplots()
    axes.scatter(points[:, 0], points[:, 1], s=0.4, color=MUTED, alpha=0.35, linewidths=0, rasterized=True)
    axes.plot(path[:, 0], path[:, 1], ".", color=INK, ms=3, label=f"{len(path)} keyframes", zorder=4)
    head = HEAD_SHARE * max(limits.width, limits.height)
    for mask, color, label in ((~wrong, RIGHT, "found"), (wrong, ACCENT, "found elsewhere than the reference")):
        if mask.any():
            (x, y), (dx, dy) = T[mask, :2, 3].T, T[mask, :2, 0].T
            axes.quiver(x, y, dx, dy, color=color, scale=1 / head, scale_units="xy", width=0.004, zorder=6)
            axes.plot(x, y, "o", color=color, ms=3.5, label=f"{mask.sum()} {label}", zorder=5)
    frame_map(axes, limits, "m")
    axes.legend(loc="upper right", fontsize=8, framealpha=0.85)
    axes.set_title(title, fontsize=10, color=INK)
    figure.tight_layout()
    return figure
