"""L-Net and M-Net: the pose of a scan, and the occupancy of the map (DeepMapping sections 3.2 to 3.4, 4.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from dpmjax.checks import require_fields, require_one_of

# Xavier-uniform with the gain of ReLU, as in the published networks.
HE_LIKE = nn.initializers.variance_scaling(2.0, "fan_avg", "uniform")


@dataclass(frozen=True)
class LocalizationNetConfig:
    """Shape of L-Net. The defaults are the paper's (section 4.1).

    Attributes:
        kind: "conv" for beams or pixels in order, "point" (PointNet, supplement A) for any set of points.
        features: channels of the layers before the maximum over the beams.
        strides: strides of the same layers; "point" ignores them.
        dilation: distance of the three taps of a convolution along each axis, in beams or pixels.
        is_circular: the last beam is the neighbour of the first (a full turn); else zeros follow.
        hidden: channels of the layers after the maximum.
        output_scale: factor on the initial weights of the last layer; a small one lets all poses begin near zero.
    """

    kind: Literal["conv", "point"] = "conv"
    features: tuple[int, ...] = (64, 128, 1024)
    strides: tuple[int, ...] = (1, 1, 1)
    dilation: int = 2
    is_circular: bool = False
    hidden: tuple[int, ...] = (512, 256)
    output_scale: float = 1.0

    def __post_init__(self) -> None:
        require_one_of("kind", self.kind, ("conv", "point"))
        require_fields(self, "dilation", low=1)
        if self.kind == "conv" and len(self.strides) != len(self.features):
            raise ValueError(f"strides: expected one for each of {len(self.features)} layers, got {self.strides}")


class DilatedConvolution(nn.Module):
    """A dilated convolution of three taps along each axis: 3 for beams, 3 x 3 for an image.

    It is one matrix product: XLA's own convolution is ten times slower on CPUs.
    """

    features: int
    stride: int
    dilation: int
    is_circular: bool

    @nn.compact
    def __call__(self, x: Float[Array, "*size c"]) -> Float[Array, "*size_out f"]:
        """Convolves; the output has the size of the input divided by the stride.

        Args:
            x: channels of the beams (b, c) or of the pixels (h, w, c).

        Returns:
            Channels of every `stride`-th beam or pixel.
        """
        *size, _ = x.shape
        apart = self.dilation
        padded = jnp.pad(x, [(apart, apart)] * len(size) + [(0, 0)], mode="wrap" if self.is_circular else "constant")
        taps = [
            padded[tuple(slice(k * apart, k * apart + n, self.stride) for k, n in zip(tap, size, strict=True))]
            for tap in product(range(3), repeat=len(size))
        ]
        return nn.Dense(self.features, kernel_init=HE_LIKE)(jnp.concatenate(taps, axis=-1))


class LocalizationNet(nn.Module):
    """L-Net for one scan or depth image; `vmap` over the set."""

    config: LocalizationNetConfig
    num_outputs: int = 3

    @nn.compact
    def __call__(self, points: Float[Array, "*size d"], mask: Bool[Array, "*size"]) -> Float[Array, " o"]:
        """Predicts the pose of the sensor.

        Args:
            points: (b, 2) or (h, w, 3) in the sensor frame, about -1 to 1.
            mask: False for beams that measured nothing.

        Returns:
            For planar scans x, y, heading in radians; for depth images the numbers of a motion.
        """
        config = self.config
        x = jnp.where(mask[..., None], points, 0.0)
        for layer, features in enumerate(config.features):
            if config.kind == "conv":
                stride = config.strides[layer]
                x = DilatedConvolution(features, stride, config.dilation, config.is_circular)(x)
                mask = mask[(slice(None, None, stride),) * mask.ndim]
            else:
                x = nn.Dense(features, kernel_init=HE_LIKE)(x)
            if layer < len(config.features) - 1:
                x = nn.relu(x)
        # The published network has no activation before the maximum.
        axes = tuple(range(mask.ndim))
        x = jnp.max(jnp.where(mask[..., None], x, -jnp.inf), axis=axes, initial=-1e30)
        x = jnp.where(mask.any(), x, 0.0)
        for features in config.hidden:
            x = nn.relu(nn.Dense(features, kernel_init=HE_LIKE)(x))
        last = nn.initializers.variance_scaling(2.0 * config.output_scale**2, "fan_avg", "uniform")
        return nn.Dense(self.num_outputs, kernel_init=last)(x)


@dataclass(frozen=True)
class OccupancyConfig:
    """Shape of M-Net.

    Attributes:
        kind: "mlp" (the paper's), "resmlp" (supplement A) or "grid".
        features: channels of the hidden layers of the MLP, or of the residual blocks.
        resolutions: number of cells along a side of each level of the grid, each twice the one before, the first even.
    """

    kind: Literal["mlp", "resmlp", "grid"] = "mlp"
    features: tuple[int, ...] = (64, 512, 512, 256, 128)
    resolutions: tuple[int, ...] = (16, 32, 64, 128, 256, 512)

    def __post_init__(self) -> None:
        require_one_of("kind", self.kind, ("mlp", "resmlp", "grid"))
        expected = tuple(self.resolutions[0] * 2**level for level in range(len(self.resolutions)))
        if not expected or self.resolutions != expected or expected[0] % 2:
            raise ValueError(f"resolutions: expected an even number and its doubles, got {self.resolutions}")

    @property
    def num_levels(self) -> int:
        """Number of levels that can be switched on."""
        return len(self.resolutions) if self.kind == "grid" else 1


class MapMLP(nn.Module):
    """The paper's M-Net, or residual blocks of two layers each (supplement A).

    A residual block that changes the width has a linear map as its short cut.
    """

    features: tuple[int, ...]
    is_residual: bool = False

    @nn.compact
    def __call__(self, points: Float[Array, "n d"], level_weights: Float[Array, " l"]) -> Float[Array, " n"]:
        """Computes logits at points of the world, about -1 to 1.

        Args:
            points: (n, 2) or (n, 3).
            level_weights: ignored.

        Returns:
            Logits.
        """
        x = points
        for features in self.features:
            y = nn.relu(nn.Dense(features, kernel_init=HE_LIKE)(x))
            if self.is_residual:
                y = nn.Dense(features, kernel_init=HE_LIKE)(y)
                around = x if x.shape[-1] == features else nn.Dense(features, kernel_init=HE_LIKE)(x)
                y = nn.relu(y + around)
            x = y
        return nn.Dense(1, kernel_init=HE_LIKE)(x)[:, 0]


def interpolate_grid(grid: Float[Array, "*size"], points: Float[Array, "n d"]) -> Float[Array, " n"]:
    """Interpolates linearly along each axis; points outside of [-1, 1] continue the border.

    Args:
        grid: values at the nodes, r + 1 along each of d axes.
        points: (n, d), d = 2 or 3.

    Returns:
        The value at each point.
    """
    num_cells, dimensions = grid.shape[0] - 1, grid.ndim
    position = jnp.clip(0.5 * (points + 1.0), 0.0, 1.0) * num_cells
    corner = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, num_cells - 1)
    part, strides, nodes = position - corner, (num_cells + 1) ** np.arange(dimensions)[::-1], grid.reshape(-1)
    # The two nodes along the last axis lie side by side: one read for both, and on the way back one write.
    read = jax.vmap(lambda first: jax.lax.dynamic_slice(nodes, (first,), (2,)))
    total = jnp.zeros((points.shape[0], 2), points.dtype)
    for sides in product((0, 1), repeat=dimensions - 1):
        shares = [part[:, axis] if side else 1.0 - part[:, axis] for axis, side in enumerate(sides)]
        share = math.prod(shares, start=jnp.ones(len(points), points.dtype))
        total += share[:, None] * read((corner + jnp.array([*sides, 0])) @ strides)
    return total[:, 0] + part[:, -1] * (total[:, 1] - total[:, 0])


def double_resolution(grid: Float[Array, "*size"]) -> Float[Array, "*size_out"]:
    """Represents the same function on cells of half the size.

    Args:
        grid: values at the nodes, r + 1 along each axis.

    Returns:
        Values at 2 r + 1 nodes along each axis.
    """
    for axis in range(grid.ndim):
        # Zeros between the nodes, and half of each node on either side of it.
        place = [(int(k == axis), int(k == axis), int(k == axis)) for k in range(grid.ndim)]
        spread = jax.lax.pad(grid, jnp.zeros((), grid.dtype), place)
        middle = jax.lax.slice_in_dim(spread, 1, -1, axis=axis)
        sides = jax.lax.slice_in_dim(spread, 0, -2, axis=axis) + jax.lax.slice_in_dim(spread, 2, None, axis=axis)
        grid = middle + 0.5 * sides
    return grid


class MapGrid(nn.Module):
    """M-Net of multi-resolution hat functions over the square [-1, 1]^2, or the cube: the sum of learned grids.

    Each level has twice the cells of the one before, so that the sum is one grid of the finest level. It is as
    continuous as the MLP. A sample costs four reads (in 3-D eight) instead of half a million multiplications, and a
    step changes the map only near the samples. The levels are switched on from coarse to fine, because
    coarse levels give the poses a wide basin of convergence, and fine levels a sharp map.
    """

    resolutions: tuple[int, ...]

    @nn.compact
    def __call__(self, points: Float[Array, "n d"], level_weights: Float[Array, " l"]) -> Float[Array, " n"]:
        """Computes logits at points of the world.

        Args:
            points: (n, 2) or (n, 3), -1 to 1.
            level_weights: 0 (off) to 1 for each level, coarse to fine.

        Returns:
            Logits; 0 (unknown) where no sample has ever been.
        """
        total = jnp.zeros((self.resolutions[0] // 2 + 1,) * points.shape[1], points.dtype)
        for level, cells in enumerate(self.resolutions):
            grid = self.param(f"level_{cells}", nn.initializers.zeros, (cells + 1,) * points.shape[1])
            total = double_resolution(total) + level_weights[level] * grid
        return interpolate_grid(total, points)


def make_map_net(config: OccupancyConfig) -> MapMLP | MapGrid:
    """Makes the M-Net of a configuration.

    Args:
        config: shape of M-Net.

    Returns:
        The module: `apply(params, points, level_weights)`.
    """
    if config.kind == "grid":
        return MapGrid(config.resolutions)
    return MapMLP(config.features, is_residual=config.kind == "resmlp")


def init_map_net(config: OccupancyConfig, *, key: jax.Array, num_dimensions: int = 2) -> Any:
    """Makes random parameters of M-Net.

    Args:
        config: shape of M-Net.
        key: key for the weights.
        num_dimensions: number of dimensions of the world, 2 or 3.

    Returns:
        Parameters for `make_map_net(config).apply`.
    """
    return make_map_net(config).init(key, jnp.zeros((1, num_dimensions)), jnp.ones(config.num_levels))
