"""The encoder: a point pyramid to a few hundred descriptors (DeepPointMap section 3.1, after PointNeXt).

Down the pyramid each stage gathers what lies around its points (set abstraction) and refines it (inverted residual
blocks); then the features of the coarse levels are carried up again (feature propagation).

A linear map of [feature_j, (position_j - position_i) / r] is a map of j's features and one of three numbers. So the
large matrix products run over points, and what is done for each neighbour is one sum, norm and maximum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import flax.linen as nn
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from dpmjax.checks import require_count
from dpmjax.nets.layers import ComputeDtype, layer_norm, linear, require_compute_dtype
from dpmjax.nets.neighbourhood import maximum_of_normalised
from dpmjax.types import AnyArray, Interpolation, PointPyramid

Frame = Literal["lidar", "bearing"]


@dataclass(frozen=True)
class EncoderConfig:
    """Widths of the encoder (defaults: DeepPointMap's published configuration).

    Attributes:
        stem_channels: of the input level; each stage down doubles them.
        expansion: of the hidden layer in inverted residual blocks.
        output_channels: of a descriptor.
        frame: in which directions are seen: "lidar", its axes (the published networks, which have to learn that a
            scan may be turned), or "bearing", along and across the ray from the lidar to each point; descriptors then
            do not change when the scan is turned about the vertical.
        compute_dtype: of the matrix products over features.
    """

    stem_channels: int = 16
    expansion: int = 4
    output_channels: int = 128
    frame: Frame = "lidar"
    compute_dtype: ComputeDtype = "float32"

    def __post_init__(self) -> None:
        require_count("stem_channels", self.stem_channels)
        require_count("expansion", self.expansion)
        require_count("output_channels", self.output_channels)
        if self.frame not in get_args(Frame):
            raise ValueError(f"frame: expected one of {', '.join(get_args(Frame))}, got {self.frame!r}")
        require_compute_dtype(self.compute_dtype)


class NeighbourhoodMaximum(nn.Module):
    """For each query the maximum over its neighbours j of relu(norm(linear([feature_j, offset_j / radius]))).

    Attributes:
        num_features: channels of the result.
        radius: of the neighbourhood, normalised.
        frame: in which offsets are seen.
        compute_dtype: of the matrix product over features; the part of the positions is float32.
    """

    num_features: int
    radius: float
    frame: Frame = "lidar"
    compute_dtype: ComputeDtype = "float32"

    @nn.compact
    def __call__(
        self,
        features: Float[Array, "n c"],
        positions: Float[Array, "n 3"],
        queries: Float[Array, "m 3"],
        neighbours: Int[AnyArray, "m k"],
    ) -> Float[Array, "m f"]:
        """Features (n, c) and positions (n, 3) of the level searched; queries (m, 3); rows of neighbours (m, k)."""
        num_channels, num_features = features.shape[1], self.num_features
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (num_channels + 3, num_features))
        bias = self.param("bias", nn.initializers.zeros_init(), (num_features,))
        scale = self.param("norm_scale", nn.initializers.ones_init(), (num_features,))
        norm_bias = self.param("norm_bias", nn.initializers.zeros_init(), (num_features,))
        # The norm removes the mean over channels: removed from the weights, there is none left to compute.
        kernel, bias = kernel - kernel.mean(axis=1, keepdims=True), bias - bias.mean()
        dtype = jnp.dtype(self.compute_dtype)
        from_features = jnp.matmul(
            features.astype(dtype), kernel[:-3].astype(dtype), preferred_element_type=jnp.float32
        )
        offsets = (positions[neighbours] - queries[:, None]) / self.radius
        if self.frame == "bearing":
            offsets = turn_to_bearing(offsets, queries[:, None])
        # relu grows with its argument, so it may follow the maximum.
        maximum = maximum_of_normalised(from_features + bias, offsets, kernel[-3:], neighbours, scale)
        return nn.relu(maximum + norm_bias)


def turn_to_bearing(vectors: Float[Array, "... 3"], positions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Vectors at positions as seen along the ray from the lidar: x away from it, y to the left, z up.

    A turn of the lidar about its z axis changes nothing in them. On the axis itself x stays x.
    """
    squared = jnp.sum(positions[..., :2] ** 2, axis=-1)
    is_off_axis = squared > 0
    inverse = lax.rsqrt(jnp.where(is_off_axis, squared, 1))
    cosine = jnp.where(is_off_axis, positions[..., 0] * inverse, 1)
    sine = jnp.where(is_off_axis, positions[..., 1] * inverse, 0)
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return jnp.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1)


class InvertedResidual(nn.Module):
    """Neighbourhood maximum, then a narrow-wide-narrow network of two layers, added to the input.

    Attributes:
        radius: of the neighbourhood, normalised.
        expansion: how much wider the hidden layer is.
        frame: in which offsets are seen.
        compute_dtype: of the matrix products.
    """

    radius: float
    expansion: int
    frame: Frame = "lidar"
    compute_dtype: ComputeDtype = "float32"

    @nn.compact
    def __call__(
        self, features: Float[Array, "m f"], positions: Float[Array, "m 3"], neighbours: Int[AnyArray, "m k"]
    ) -> Float[Array, "m f"]:
        """Features (m, f) and positions (m, 3) of one level, and neighbours (m, k) in it."""
        num_features = features.shape[1]
        x = NeighbourhoodMaximum(num_features, self.radius, self.frame, self.compute_dtype, name="neighbourhood")(
            features, positions, positions, neighbours
        )
        x = linear(num_features * self.expansion, self.compute_dtype, "expand")(x)
        x = nn.relu(layer_norm("expand_norm")(x))
        x = linear(num_features, self.compute_dtype, "contract")(x)
        return nn.relu(layer_norm("contract_norm")(x) + features)


class Stage(nn.Module):
    """One step down the pyramid: set abstraction, then inverted residual blocks.

    Attributes:
        num_features: channels of the result.
        radii: of the set abstraction, and of each block after it.
        expansion: of the blocks.
        frame: in which offsets are seen.
        compute_dtype: of the matrix products.
    """

    num_features: int
    radii: tuple[float, ...]
    expansion: int
    frame: Frame = "lidar"
    compute_dtype: ComputeDtype = "float32"

    @nn.compact
    def __call__(
        self,
        features: Float[Array, "n c"],
        positions: Float[Array, "n 3"],
        queries: Float[Array, "m 3"],
        neighbours: tuple[Int[AnyArray, "m k"], ...],
    ) -> Float[Array, "m f"]:
        """Features and positions of the level before, positions of this one, and the neighbours of each block."""
        first_radius, *radii = self.radii
        rest = (self.frame, self.compute_dtype)
        abstraction = NeighbourhoodMaximum(self.num_features, first_radius, *rest, name="set_abstraction")
        x = abstraction(features, positions, queries, neighbours[0])
        for block, radius in enumerate(radii):
            residual = InvertedResidual(radius, self.expansion, *rest, name=f"inverted_residual_{block}")
            x = residual(x, queries, neighbours[block + 1])
        return x


class FeaturePropagation(nn.Module):
    """One step up the pyramid: what the finer level knows, and the coarser one's features interpolated to it.

    Attributes:
        num_features: channels of the result.
        compute_dtype: of the matrix products.
    """

    num_features: int
    compute_dtype: ComputeDtype = "float32"

    @nn.compact
    def __call__(
        self, fine: Float[Array, "n c"], coarse: Float[Array, "m d"], interpolation: Interpolation
    ) -> Float[Array, "n f"]:
        """Features of both levels, (n, c) and (m, d)."""
        interpolated = jnp.einsum("nk,nkd->nd", interpolation.weights, coarse[interpolation.indices])
        x = jnp.concatenate([fine, interpolated], axis=-1)
        for layer in range(2):
            x = linear(self.num_features, self.compute_dtype, f"linear_{layer}")(x)
            x = nn.relu(layer_norm(f"norm_{layer}")(x))
        return x


class PointEncoder(nn.Module):
    """A point pyramid to the features of the level that its last interpolation reaches.

    Attributes:
        config: the widths.
        radii: of each stage's neighbourhoods, normalised; those the pyramid was built with.
    """

    config: EncoderConfig
    radii: tuple[tuple[float, ...], ...]

    @nn.compact
    def __call__(self, pyramid: PointPyramid) -> Float[Array, "m c"]:
        """Features in float32, one row for each point of that level; zero where its mask is False."""
        config = self.config
        # What is not there may hold anything; cleared here, it cannot reach a gradient.
        positions = [jnp.where(level.mask[:, None], level.positions, 0) for level in pyramid.levels]
        is_turned = config.frame == "bearing"
        seen = turn_to_bearing(positions[0], positions[0]) if is_turned else positions[0]
        features = [linear(config.stem_channels, "float32", "stem")(seen)]
        for stage, radii in enumerate(self.radii):
            num_features = config.stem_channels * 2 ** (stage + 1)
            rest = (config.expansion, config.frame, config.compute_dtype)
            module = Stage(num_features, radii, *rest, name=f"stage_{stage}")
            level = pyramid.levels[stage + 1]
            features.append(module(features[-1], positions[stage], positions[stage + 1], level.neighbours))
        x = features.pop()
        num_steps = len(pyramid.interpolation)
        for step, interpolation in enumerate(pyramid.interpolation):
            fine = features.pop()
            num_features = config.output_channels if step == num_steps - 1 else fine.shape[1]
            propagation = FeaturePropagation(num_features, config.compute_dtype, name=f"propagation_{step}")
            x = propagation(fine, x, interpolation)
        return jnp.where(pyramid.levels[-1 - num_steps].mask[:, None], x, 0)
