"""M-Net: a place goes in, the log odds of its being occupied come out (DeepMapping sections 3.2 and 3.3).

`MapMLP` is the paper's, `MapResMLP` the residual one that it is compared to (supplement A). `MapGrid` is a network of
one layer over multi-resolution hat functions: a sum of learned grids from coarse to fine, each interpolated between its
nodes. It is as continuous as the MLP, a sample costs four reads (in 3-D eight) a level instead of half a million
multiplications, a step changes the map only where the sample is, and switching the levels on one after the other widens
the basin of the poses first and sharpens it later.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_HE_LIKE = nn.initializers.variance_scaling(2.0, "fan_avg", "uniform")


@dataclass(frozen=True)
class OccupancyConfig:
    """Shape of M-Net.

    Attributes:
        kind: "mlp" (the paper's), "resmlp" (supplement A) or "grid".
        features: channels of the hidden layers of the MLP, or of the residual blocks.
        resolutions: cells along a side of each level of the grid.
    """

    kind: Literal["mlp", "resmlp", "grid"] = "mlp"
    features: tuple[int, ...] = (64, 512, 512, 256, 128)
    resolutions: tuple[int, ...] = (16, 32, 64, 128, 256, 512)

    @property
    def num_levels(self) -> int:
        """Levels that can be switched on one after the other."""
        return len(self.resolutions) if self.kind == "grid" else 1


class MapMLP(nn.Module):
    """The paper's M-Net."""

    features: tuple[int, ...]

    @nn.compact
    def __call__(self, points: Float[Array, "n d"], level_weights: Float[Array, " l"]) -> Float[Array, " n"]:
        """Logits at points of the world, about -1 to 1; `level_weights` has no meaning here."""
        del level_weights
        x = points
        for features in self.features:
            x = nn.relu(nn.Dense(features, kernel_init=_HE_LIKE)(x))
        return nn.Dense(1, kernel_init=_HE_LIKE)(x)[:, 0]


class MapResMLP(nn.Module):
    """M-Net of residual blocks of two layers each; where the width changes, the way around is a linear map."""

    features: tuple[int, ...]

    @nn.compact
    def __call__(self, points: Float[Array, "n d"], level_weights: Float[Array, " l"]) -> Float[Array, " n"]:
        """Logits at points of the world, about -1 to 1; `level_weights` has no meaning here."""
        del level_weights
        x = points
        for features in self.features:
            y = nn.relu(nn.Dense(features, kernel_init=_HE_LIKE)(x))
            y = nn.Dense(features, kernel_init=_HE_LIKE)(y)
            around = x if x.shape[-1] == features else nn.Dense(features, kernel_init=_HE_LIKE)(x)
            x = nn.relu(y + around)
        return nn.Dense(1, kernel_init=_HE_LIKE)(x)[:, 0]


def interpolate_volume(grid: Float[Array, "r r r"], points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Trilinear interpolation; points outside of [-1, 1] continue the border."""
    cells = grid.shape[0] - 1
    position = jnp.clip(0.5 * (points + 1.0), 0.0, 1.0) * cells
    corner = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, cells - 1)
    part = position - corner
    total = jnp.zeros(points.shape[0], points.dtype)
    for step in product((0, 1), repeat=3):
        at = corner + jnp.asarray(step)
        weight = jnp.prod(jnp.where(jnp.asarray(step, bool), part, 1.0 - part), axis=-1)
        total = total + weight * grid[at[:, 0], at[:, 1], at[:, 2]]
    return total


def interpolate_grid(grid: Float[Array, "r r"], points: Float[Array, "n 2"]) -> Float[Array, " n"]:
    """Bilinear interpolation; points outside of [-1, 1] continue the border."""
    cells = grid.shape[0] - 1
    position = jnp.clip(0.5 * (points + 1.0), 0.0, 1.0) * cells
    corner = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, cells - 1)
    part = position - corner
    row, column = corner[:, 0], corner[:, 1]
    x, y = part[:, 0], part[:, 1]
    low = (1.0 - y) * grid[row, column] + y * grid[row, column + 1]
    high = (1.0 - y) * grid[row + 1, column] + y * grid[row + 1, column + 1]
    return (1.0 - x) * low + x * high


class MapGrid(nn.Module):
    """M-Net of multi-resolution hat functions over the square [-1, 1]^2, or the cube."""

    resolutions: tuple[int, ...]

    @nn.compact
    def __call__(self, points: Float[Array, "n d"], level_weights: Float[Array, " l"]) -> Float[Array, " n"]:
        """Logits at points of the world.

        Args:
            points: (n, 2) or (n, 3), -1 to 1.
            level_weights: 0 (off) to 1 for each level, coarse to fine.

        Returns:
            Logits; 0 (unknown) where no sample has ever been.
        """
        dimensions = points.shape[1]
        interpolate = interpolate_grid if dimensions == 2 else interpolate_volume
        logits = jnp.zeros(points.shape[0], points.dtype)
        for level, cells in enumerate(self.resolutions):
            grid = self.param(f"level_{cells}", nn.initializers.zeros, (cells + 1,) * dimensions)
            logits = logits + level_weights[level] * interpolate(grid, points)
        return logits


def make_map_net(config: OccupancyConfig) -> MapMLP | MapResMLP | MapGrid:
    """The M-Net of a configuration."""
    if config.kind == "grid":
        return MapGrid(config.resolutions)
    return (MapMLP if config.kind == "mlp" else MapResMLP)(config.features)


def init_map_net(config: OccupancyConfig, *, key: jax.Array, num_dimensions: int = 2) -> Any:
    """Fresh parameters."""
    return make_map_net(config).init(key, jnp.zeros((1, num_dimensions)), jnp.ones(config.num_levels))
