"""Pictures of SLAM from above: trajectories with loops, the map by height, scans found in it."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from dpmjax.sequences import counted
from dpmjax.viz.figures import INK, LOOP, PATH, POINTS, Bar, Edges, Layer, Panel, Points, Track, figure

# Heights above the lidar that the colours of maps span.
HEIGHTS_M = (-2.5, 5.5)
# Length of an arrow as a share of the extent of the map.
_ROOF_M = 1.0


def trajectory_figure(
    title: str,
    tracks: Sequence[Track],
    reference: Float[np.ndarray, "n 3"] | None = None,
    loops: Float[np.ndarray, "m 2 3"] | None = None,
) -> Figure:
    """Draws trajectories from above with the reference and the loops.

    Args:
        title: title of the picture.
        tracks: the last one is the result, drawn on those before; all are in one frame.
        reference: positions in the same frame; None where there is none.
        loops: positions of both ends of each accepted loop.

    Returns:
        The figure.
    """
    ends = np.zeros((0, 2, 3)) if loops is None else loops
    # Wider than the result, so that they are seen where all agree.
    others = [track._replace(width=4.0) for track in tracks[:-1]]
    layers: list[Layer] = [*others, *tracks[-1:], Edges(ends, LOOP, counted(len(ends), "loop"))]
    return figure([Panel("", layers, reference)], title=title)


def height_map_figure(
    title: str, points: Float[np.ndarray, "n 3"], heights_m: Float[np.ndarray, " n"], path: Float[np.ndarray, "k 3"]
) -> Figure:
    """Draws a map from above: the highest point of each cell, by its height above the lidar that passed there.

    Under a roof, points more than a metre above the lidar are left out, so that the walls are visible.

    Args:
        title: title of the picture.
        points: metres, in the world.
        heights_m: of each point above the lidar.
        path: positions of the lidar.

    Returns:
        The figure.
    """
    is_shown = heights_m < _ROOF_M if _is_roofed(points, heights_m, path) else np.ones(len(points), bool)
    order = np.flatnonzero(is_shown)[np.argsort(heights_m[is_shown], kind="stable")]
    cloud = Points(points[order], height_colors(heights_m[order]))
    bar = Bar("height above the lidar, m", _height_colormap(), *HEIGHTS_M)
    return figure([Panel("", [cloud, Track(path, PATH, "path of the lidar")])], title=title, bar=bar)


def localization_figure(
    points_map: ArrayLike, T_map_keyframe: ArrayLike, T_map_scan: ArrayLike, *, title: str
) -> Figure:
    """Draws a map from above, the keyframes' positions, and the poses of the scans that were found as arrows.

    Args:
        points_map: (n, 3) points of the map, metres.
        T_map_keyframe: (k, 4, 4) at least one.
        T_map_scan: (s, 4, 4) of the scans that were found.
        title: title of the picture.

    Returns:
        The figure.
    """
    points, keyframes = np.asarray(points_map, float).reshape(-1, 3), np.asarray(T_map_keyframe, float)[:, :3, 3]
    T = np.asarray(T_map_scan, float).reshape(-1, 4, 4)
    shown = np.concatenate([points, keyframes])
    length_m = 0.04 * float(np.ptp(np.quantile(shown[:, :2], [0.005, 0.995], axis=0), axis=0).max())
    ends = np.stack([T[:, :3, 3], T[:, :3, 3] + length_m * T[:, :3, 0]], axis=1)
    # Crosses are wider than the marks of scans: a keyframe under a scan is visible.
    layers: list[Layer] = [Points(points, POINTS), Track(keyframes, INK, counted(len(keyframes), "keyframe"), "x", 7)]
    found = f"{len(T)} found (line: forward)" if len(T) else ""
    return figure([Panel("", [*layers, Edges(ends, PATH), Track(ends[:, 0], PATH, found, "o", 6)])], title=title)


def height_colors(heights_m: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    """Returns the colours of heights above the lidar, for maps.

    Args:
        heights_m: metres.

    Returns:
        Red, green, blue from 0 to 255.
    """
    share = (np.asarray(heights_m, np.float64) - HEIGHTS_M[0]) / (HEIGHTS_M[1] - HEIGHTS_M[0])
    return np.asarray(_height_colormap()(np.clip(share, 0, 1), bytes=True))[:, :3]


def _height_colormap() -> Colormap:
    # The ground is pale on white paper; what stands on it goes from blue over violet to amber.
    high = matplotlib.colormaps["plasma"](np.linspace(0.05, 0.85, 8))
    colors = [(0.0, "#e3e7ec"), (0.15, "#cfd6de"), *zip(np.linspace(0.24, 1.0, 8), high, strict=True)]
    return LinearSegmentedColormap.from_list("dpmjax_height", colors)


def _is_roofed(
    points: Float[np.ndarray, "n 3"], heights_m: Float[np.ndarray, " n"], path: Float[np.ndarray, "k 3"]
) -> bool:
    """Returns True where points lie above most of the path, within a metre."""
    above = np.unique(np.floor(points[heights_m > _ROOF_M, :2]).astype(np.int64), axis=0)
    cells = np.unique(np.floor(path[:, :2]).astype(np.int64), axis=0)
    num_below = len(cells) + len(above) - len(np.unique(np.vstack([cells, above]), axis=0))
    return num_below > 0.7 * len(cells)
