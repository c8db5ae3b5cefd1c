"""Pictures of pairs of scans from above, under motions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dpmjax.viz.figures import Layer, Panel, Points, Track, figure

# These colours and black differ in lightness too, so that they differ in grey.
SOURCE, TARGET = "#3a86c0", "#f0a840"


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
        pairs: one row each, with the same number of motions; at least one.

    Returns:
        The figure; the panels of a row have the same limits.
    """
    panels = [
        Panel(f"{pair.title}\n{label}" if not column else f"\n{label}", _layers(pair, T))
        for pair in pairs
        for column, (label, T) in enumerate(pair.motions.items())
    ]
    return figure(panels, num_columns=max(len(pair.motions) for pair in pairs), is_shared=True)


def _layers(pair: RegisteredPair, T_target_source: NDArray[np.float64]) -> list[Layer]:
    """Returns both scans in the frame of the target, and both lidars."""
    moved = pair.source @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    source, target = pair.names
    # Where both lidars are at one place, the triangle lies on the larger disc.
    return [
        Points(moved, SOURCE, source),
        Points(pair.target, TARGET, target),
        Track(np.zeros((1, 3)), TARGET, f"lidar of {target}", "o", 10),
        Track(T_target_source[None, :3, 3], SOURCE, f"lidar of {source}", "^", 7),
    ]
