"""The sizes of the maps in a sample: a few fixed layouts for each stage, so that no step computes on empty rows.

Attention over padded maps costs 5 times as much as over the scans that are there with groups of up to 4 scans, and 13
times with 16. So the sizes of the groups are not drawn for each step. The layouts of a stage together hold them in the
proportions of the published draw, and the steps take the layouts in turn. Each layout compiles one step.
"""

from __future__ import annotations

import functools

import numpy as np

from dpmjax.deeppointmap.training.curriculum import SamplingConfig

PAIR_PROBABILITY = 0.34
"""Probability that a group is one pair of scans, in every stage."""

GroupShape = tuple[int, int]
"""Number of scans in the first and in the second map of a group."""

Layout = tuple[GroupShape, ...]
"""The groups of one sample, small ones first."""

NUM_LAYOUTS = 4
GOLDEN = 0.6180339887498949
"""Its multiples, modulo 1, spread evenly however many there are."""


@functools.cache
def stage_layouts(max_group: int, config: SamplingConfig) -> tuple[Layout, ...]:
    """Makes the layouts of a stage.

    The published draw of a group: two scans with `pair_probability`, else 2 to `max_group`, each number equally likely.
    One half of the groups is split into one scan against all others; the second half is split anywhere. The two maps of
    a group may change places, as the losses are symmetric; the smaller one is the first.

    Args:
        max_group: scans in both maps of a group together, at most.
        config: capacity of a sample, and proportions.

    Returns:
        From 1 to `NUM_LAYOUTS` different layouts of at most `config.num_scans` scans each.
    """
    sizes = np.arange(2, max_group + 1)
    shares = np.full(len(sizes), (1 - PAIR_PROBABILITY) / len(sizes))
    shares[0] += PAIR_PROBABILITY
    num_groups = max(1, round(NUM_LAYOUTS * config.num_scans / float(sizes @ shares)))
    drawn = np.searchsorted(np.cumsum(shares) / shares.sum(), (np.arange(num_groups) + 0.5) / num_groups)
    layouts: list[list[GroupShape]] = [[] for _ in range(NUM_LAYOUTS)]
    room = [config.num_scans] * NUM_LAYOUTS
    for number, size in enumerate(sorted(sizes[drawn].tolist(), reverse=True)):
        emptiest = int(np.argmax(room))
        # Where the last large group does not fit, a smaller one takes its place.
        size = min(size, room[emptiest])
        if size >= 2:
            layouts[emptiest].append(_split(size, (number * GOLDEN) % 1, config))
            room[emptiest] -= size
    for layout, left in zip(layouts, room, strict=True):
        layout.extend([(1, 1)] * (left // 2))
    return tuple(dict.fromkeys(tuple(sorted(layout)) for layout in layouts))


def _split(size: int, draw: float, config: SamplingConfig) -> GroupShape:
    least, most = max(1, size - config.max_side), min(size - 1, config.max_side)
    if least == 1 and draw < 0.5:
        return 1, size - 1
    first = least + int((2 * draw % 1) * (most - least + 1))
    return min(first, size - first), max(first, size - first)
