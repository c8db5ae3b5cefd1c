"""Pictures of pairs of scans from above: both scans under motions, and matches between their points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from dpmjax.viz.figures import INK, WRONG, Edges, Layer, Panel, Points, Track, figure

# These colours and black differ in lightness too, so that they differ in grey.
SOURCE, TARGET = "#3a86c0", "#f0a840"
# Points farther out than this share of them do not set the distance of two scans side by side.
_SHOWN_SHARE = 0.995
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
    end_of_a, start_of_b = (np.quantile(each[:, 0], q) for each, q in ((a, _SHOWN_SHARE), (b, 1 - _SHOWN_SHARE)))
    apart = np.array([end_of_a - start_of_b + 5.0, 0.0])
    lines = np.stack([starts, ends + apart], axis=1)
    layers: list[Layer] = [Points(a, SOURCE, pair.names[0]), Points(b + apart, TARGET, pair.names[1])]
    layers += [_match_lines(lines[right], "right", INK, "-"), _match_lines(lines[~right], "wrong", WRONG, "--")]
    return figure([Panel(pair.title, layers), Panel(label, _layers(pair, T))])


def _match_lines(lines: NDArray[np.float64], kind: str, color: str, style: str) -> Edges:
    label = f"{len(lines)} {kind} match" + "es" * (len(lines) != 1)
    if len(lines) > _MAX_LINES:
        label += f", {_MAX_LINES} drawn"
    return Edges(np.random.default_rng(0).permutation(lines)[:_MAX_LINES], color, label, style)


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
