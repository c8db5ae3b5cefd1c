"""The point pyramid: the points that are kept from level to level, and their neighbours.

Farthest-point order and neighbourhoods depend on coordinates only, so they are built once and apart from the network,
which is a function of its parameters and of this. `build_pyramid` is for one cloud, under jit, vmap and on any device;
`pyramid_host.build_pyramid_on_host` makes the same faster on a CPU.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import as_mask, as_points, require_count, require_positive
from dpmjax.geometry.neighbours import k_nearest
from dpmjax.geometry.sampling import farthest_point_sample
from dpmjax.types import AnyArray, Interpolation, PointPyramid, PyramidLevel

# Relative slack of the radius: quantised points often lie exactly on it, and rounding must not decide.
RADIUS_SLACK = 1 + 1e-6

# Added to squared normalised distances before they are inverted; 1e-4 of the unit, 6 mm.
WEIGHT_EPSILON = 1e-8


@dataclass(frozen=True)
class PyramidStage:
    """One step down the pyramid.

    Attributes:
        num_points: number of points that are kept, by farthest-point sampling.
        radii: radii of the neighbourhoods, normalised: the first block has neighbours in the level before, every later
            block in this level.
        num_neighbours: number of neighbours in each neighbourhood.
    """

    num_points: int
    radii: tuple[float, ...]
    num_neighbours: int

    def __post_init__(self) -> None:
        require_count("num_points", self.num_points)
        require_count("num_neighbours", self.num_neighbours)
        require_count("len(radii)", len(self.radii))
        for radius in self.radii:
            require_positive("radii", radius)


@dataclass(frozen=True)
class PyramidConfig:
    """The stages from fine to coarse (defaults: DeepPointMap's published configuration, radii in units of 60 m).

    Attributes:
        stages: the steps down.
        num_interpolations: number of steps up again, from the coarsest level.
    """

    stages: tuple[PyramidStage, ...] = (
        PyramidStage(4096, (0.05, 0.1), 32),
        PyramidStage(1024, (0.1, 0.2), 32),
        PyramidStage(256, (0.2, 0.4, 0.4), 32),
        PyramidStage(64, (0.4, 0.8), 32),
        PyramidStage(16, (0.8, 1.6), 16),
    )
    num_interpolations: int = 2

    def __post_init__(self) -> None:
        if not 0 <= self.num_interpolations < len(self.stages):
            expected = f"expected from 0 to {len(self.stages) - 1}, fewer than there are stages"
            raise ValueError(f"num_interpolations: {expected}, got {self.num_interpolations}")
        counts = [stage.num_points for stage in self.stages]
        if sorted(counts, reverse=True) != counts:
            raise ValueError(f"stages: expected no stage to have more points than the one before, got {counts}")


def build_pyramid(
    points: Float[AnyArray, "n 3"], mask: Bool[AnyArray, " n"] | None, config: PyramidConfig
) -> PointPyramid:
    """The pyramid of one cloud (DeepPointMap section 3.1; PointNeXt, Qian et al. 2022).

    Farthest-point sampling starts at the first valid point. Rows of a level beyond its points are masked, and their
    indices and weights are 0. Positions have a derivative, choices have none.

    Args:
        points: normalised coordinates, n >= 1.
        mask: False for points that are not there; they may hold anything. All are there for None.
        config: sizes and radii; hashable, so that a second call with it compiles nothing.

    Returns:
        The levels from fine to coarse, and the interpolations from coarse to fine.

    Raises:
        ValueError: there are no points, or the shapes do not match.
    """
    points = as_points("points", points, dimensions=(3,))
    return _build_pyramid(points, as_mask("mask", mask, points.shape[:1]), config=config)


@functools.partial(jax.jit, static_argnames="config")
def _build_pyramid(points: jax.Array, mask: jax.Array, *, config: PyramidConfig) -> PointPyramid:
    points = jnp.where(mask[:, None], points, 0)
    levels = [PyramidLevel(points, mask, jnp.zeros(0, jnp.int32), ())]
    num_valid = jnp.sum(mask)
    for stage in config.stages:
        before = levels[-1]
        if len(levels) == 1:
            chosen = farthest_point_sample(points, stage.num_points, mask)
        else:
            # What is the farthest of all points is the farthest of the chosen ones: the order of the first stage holds.
            chosen = jnp.arange(stage.num_points, dtype=jnp.int32)
        is_there = jnp.arange(stage.num_points) < num_valid
        chosen = jnp.where(is_there, chosen, 0)
        positions = jnp.where(is_there[:, None], before.positions[chosen], 0)
        levels.append(
            PyramidLevel(
                positions=positions,
                mask=is_there,
                sample_indices=chosen,
                neighbours=_neighbours_of_stage(positions, is_there, before, stage),
            )
        )
    steps = range(config.num_interpolations)
    return PointPyramid(tuple(levels), tuple(_interpolate(levels[-2 - step], levels[-1 - step]) for step in steps))


def _neighbours_of_stage(
    positions: Float[Array, "m 3"], mask: Bool[Array, " m"], before: PyramidLevel, stage: PyramidStage
) -> tuple[Int[Array, "m k"], ...]:
    searches = [k_nearest(positions, before.positions, stage.num_neighbours, before.mask)]
    if len(stage.radii) > 1:  # the later blocks all search this level
        searches.append(k_nearest(positions, positions, stage.num_neighbours, mask))
    blocks = []
    for block, radius in enumerate(stage.radii):
        near = searches[min(block, 1)]
        is_within = near.mask & (near.squared_distances <= (radius * RADIUS_SLACK) ** 2)
        indices = jnp.where(is_within, near.indices, near.indices[:, :1])
        blocks.append(jnp.where(mask[:, None], indices, 0))
    return tuple(blocks)


def interpolation_weights(squared: Float[Array, "m 3"], is_used: Bool[Array, "m 3"]) -> Float[Array, "m 3"]:
    """Computes the shares of the nearest points: their inverse squared distances, with sum one.

    Args:
        squared: squared normalised distances; anything where they are not used.
        is_used: False where there are fewer points.

    Returns:
        The shares; zero where they are not used.
    """
    inverse = jnp.where(is_used, 1 / (jnp.where(is_used, squared, 0) + WEIGHT_EPSILON), 0)
    total = jnp.sum(inverse, axis=1, keepdims=True)
    return inverse / jnp.where(total > 0, total, 1)


def _interpolate(fine: PyramidLevel, coarse: PyramidLevel) -> Interpolation:
    near = k_nearest(fine.positions, coarse.positions, 3, coarse.mask)
    is_used = near.mask & fine.mask[:, None]
    return Interpolation(jnp.where(is_used, near.indices, 0), interpolation_weights(near.squared_distances, is_used))
