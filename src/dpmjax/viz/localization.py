"""Picture of scans that were found in a map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from dpmjax.viz.figures import ACCENT, INK, MUTED, Limits, add_scale_bar, frame_map, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RIGHT = "#2a9d5c"
LONGER_SIDE_IN, HEAD_SHARE = 7.0, 0.02


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
    limits = _limits(np.concatenate([points[:, :2], path[:, :2], T[:, :2, 3]]))
    scale_in = LONGER_SIDE_IN / max(limits.width, limits.height)
    figure = new_figure(limits.width * scale_in + 0.3, limits.height * scale_in + 0.8)
    axes = figure.subplots()
    axes.scatter(points[:, 0], points[:, 1], s=0.4, color=MUTED, alpha=0.35, linewidths=0, rasterized=True)
    axes.plot(path[:, 0], path[:, 1], ".", color=INK, ms=3, label=f"{len(path)} keyframes", zorder=4)
    head = HEAD_SHARE * max(limits.width, limits.height)
    for mask, color, label in ((~wrong, RIGHT, "found"), (wrong, ACCENT, "found elsewhere than the reference")):
        if mask.any():
            (x, y), (dx, dy) = T[mask, :2, 3].T, T[mask, :2, 0].T
            axes.quiver(x, y, dx, dy, color=color, scale=1 / head, scale_units="xy", width=0.004, zorder=6)
            axes.plot(x, y, "o", color=color, ms=3.5, label=f"{mask.sum()} {label}", zorder=5)
    frame_map(axes, limits)
    add_scale_bar(axes, limits, "m")
    axes.legend(loc="upper right", fontsize=8, framealpha=0.85)
    axes.set_title(title, fontsize=10, color=INK)
    figure.tight_layout()
    return figure


def _limits(points: np.ndarray) -> Limits:
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    margin = 0.06 * max(*(high - low), 1.0)
    return Limits(low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin)
