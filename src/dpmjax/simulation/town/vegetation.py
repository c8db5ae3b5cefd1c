"""Woods, trees and undergrowth: trunks, and soft volumes that beams enter before they are reflected."""

from __future__ import annotations

import numpy as np

from dpmjax.sequences import BoolArray, FloatArray
from dpmjax.simulation.town.kinds import Kind, Span
from dpmjax.simulation.town.objects import Collection
from dpmjax.simulation.town.primitives import CELL_M
from dpmjax.simulation.town.terrain import Plots

_FARTHEST_M = 65.0  # Largest distance of plants from the nearest kerb.
_PATCH_M = 14.0
_NUM_TUFTS = 5
_BASE = 0.15  # Most of a conifer's crown begins at this part of its height.


def plant_land(into: Collection, rng: np.random.Generator, plots: Plots, kind: Kind) -> None:
    """Adds plants on the free land outside of streets and plots, in patches.

    Args:
        into: where to.
        rng: source of all choices.
        plots: free ground.
        kind: kind of place, with densities of plants.
    """
    is_wooded = _patches(rng, plots.terrain.heights.shape, kind.woodland)
    for density, clear in ((kind.trees_per_ha, 2.5), (kind.bushes_per_ha, 1.6)):
        places = _scatter(rng, plots, density, is_wooded)
        places = places[plots.are_free(places, clear)]
        if clear == 2.5:
            plant_trees(into, rng, _on_ground(plots, places), kind.tree_height, conifers=kind.conifers)
        else:
            plant_bushes(into, rng, _on_ground(plots, places))


def _patches(rng: np.random.Generator, shape: tuple[int, ...], share: float) -> BoolArray:
    from scipy.ndimage import gaussian_filter, zoom

    coarse = rng.normal(size=tuple(-(-size // 8) for size in shape))
    field = gaussian_filter(coarse, _PATCH_M / (8 * CELL_M))
    return zoom(field <= np.quantile(field, share), 8, order=0)[: shape[0], : shape[1]]


def _scatter(rng: np.random.Generator, plots: Plots, per_ha: float, is_wooded: BoolArray) -> FloatArray:
    """Draws positions (n, 2) in woods near streets."""
    terrain = plots.terrain
    size = CELL_M * (np.array(terrain.heights.shape)[::-1] - 1)
    places = rng.uniform(0, 1, (rng.poisson(per_ha * size.prod() / 1e4), 2)) * size
    column, row = np.round(places / CELL_M).astype(int).T
    return terrain.origin + places[is_wooded[row, column] & (terrain.street_distance[row, column] < _FARTHEST_M)]


def _on_ground(plots: Plots, places: FloatArray) -> FloatArray:
    return np.column_stack([places, plots.terrain.height_at(places)]) if len(places) else np.zeros((0, 3))


def plant_trees(
    into: Collection, rng: np.random.Generator, feet: FloatArray, height: Span, *, conifers: float = 0.0
) -> None:
    """Adds trees of random shape: a trunk, and a crown of tufts.

    Args:
        into: where to.
        rng: source of their shapes.
        feet: (n, 3) places on the ground.
        height: lowest and highest of the trees, m.
        conifers: share of trees with a narrow crown from near the ground.
    """
    count = len(feet)
    tall, is_conifer = rng.uniform(*height, count), rng.random(count) < conifers
    radius = np.where(is_conifer, 0.13, rng.uniform(0.16, 0.3, count)) * tall
    base = np.where(is_conifer, _BASE, rng.uniform(0.15, 0.4, count)) * tall
    thick = rng.uniform(0.012, 0.022, count) * tall
    zero = np.zeros(count)
    trunk = 0.5 * (base + tall)
    middle = feet + np.column_stack([zero, zero, 0.5 * trunk - 0.2])
    into.cylinders.extend(map(tuple, np.column_stack([middle, thick, thick, 0.5 * trunk + 0.2, zero, zero, zero])))
    for index in range(_NUM_TUFTS):
        part = (index + rng.uniform(0.2, 0.8, count)) / _NUM_TUFTS
        level = base + part * (tall - base)
        # A conifer narrows upwards; another crown is widest in its middle.
        wide = np.where(is_conifer, 1.1 - part, 0.35 + 0.65 * np.sin(np.pi * part)) * radius
        angle, out = rng.uniform(0, 2 * np.pi, count), np.where(is_conifer, 0.1, rng.uniform(0.2, 0.9, count)) * wide
        at = feet + np.column_stack([out * np.cos(angle), out * np.sin(angle), level])
        size, high = wide * rng.uniform(0.5, 0.9, count), (tall - base) / _NUM_TUFTS * rng.uniform(0.6, 1.1, count)
        softness = rng.uniform(0.7, 2.2, count)
        into.spheroids.extend(map(tuple, np.column_stack([at, size, size, high, zero, softness, zero])))


def plant_bushes(into: Collection, rng: np.random.Generator, feet: FloatArray) -> None:
    """Adds bushes, undergrowth and tall grass: one tuft each.

    Args:
        into: where to.
        rng: source of their shapes.
        feet: (n, 3) places on the ground.
    """
    count = len(feet)
    radius, zero = rng.uniform(0.4, 1.7, count), np.zeros(count)
    high = rng.uniform(0.25, 0.9, count) * radius
    at = feet + np.column_stack([zero, zero, 0.6 * high])
    softness = rng.uniform(0.15, 0.7, count)
    into.spheroids.extend(map(tuple, np.column_stack([at, radius, radius, high, zero, softness, zero])))
