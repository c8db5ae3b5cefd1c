"""The encoder maps a point pyramid to a few hundred descriptors (DeepPointMap section 3.1, after PointNeXt).

Down the pyramid, each stage pools the neighbourhoods of its points (set abstraction) and refines them (inverted
residual blocks). Then feature propagation carries the features of the coarse levels up again.

A linear map of [feature_j, (position_j - position_i) / r] is a map of the features of j plus a map of three numbers.
So the large matrix products run over points, and each neighbour costs one sum, norm and maximum only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from dpmjax.checks import require_fields, require_one_of
from dpmjax.geometry.bearing import ray_directions, to_ray_frame, wall_normals
from dpmjax.nets.layers import layer_norm, linear
from dpmjax.nets.neighbourhood import maximum_of_normalised
from dpmjax.types import AnyArray, Interpolation, PointPyramid, PyramidLevel

Frame = Literal["lidar", "local"]


@dataclass(frozen=True)
class EncoderConfig:
    """Widths of the encoder (defaults: DeepPointMap's published configuration).

    Attributes:
        stem_channels: channels of the input level; each stage down doubles them.
        expansion: width of the hidden layer in inverted residual blocks, relative to its input.
        output_channels: channels of a descriptor.
        frame: frame of the offsets between points. With "lidar" it has the axes of the lidar, as in the published
            networks, which learn rotations by augmentation. With "local" it lies along and across the normal of the
            wall at each point. Descriptors are then invariant to rotations of the scan about the vertical, and offsets
            between descriptors are predicted in these frames, too.
    """

    stem_channels: int = 16
    expansion: int = 4
    output_channels: int = 128
    frame: Frame = "lidar"

    def __post_init__(self) -> None:
        require_fields(self, "stem_channels", "expansion", "output_channels", low=1)
        require_one_of("frame", self.frame, get_args(Frame))


class NeighbourhoodMaximum(nn.Module):
    """The maximum over the neighbours j of each query of relu(norm(linear([feature_j, offset_j / radius]))).

    Attributes:
        num_features: channels of the result.
    """

    num_features: int

    @nn.compact
    def __call__(
        self, features: Float[Array, "n c"], offsets: Float[Array, "m k 3"], neighbours: Int[AnyArray, "m k"]
    ) -> Float[Array, "m f"]:
        """Pools the neighbourhood of each query.

        Args:
            features: features of the level that holds the neighbours.
            offsets: offsets from each query to its neighbours, as a share of the radius.
            neighbours: rows of the neighbours of each query.

        Returns:
            Features of the queries.
        """
        num_channels, num_features = features.shape[1], self.num_features
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (num_channels + 3, num_features))
        bias = self.param("bias", nn.initializers.zeros_init(), (num_features,))
        scale = self.param("norm_scale", nn.initializers.ones_init(), (num_features,))
        norm_bias = self.param("norm_bias", nn.initializers.zeros_init(), (num_features,))
        # The norm removes the mean over channels; removing it from the weights is cheaper.
        kernel, bias = kernel - kernel.mean(axis=1, keepdims=True), bias - bias.mean()
        from_features = jnp.matmul(features.astype(jnp.float32), kernel[:-3])
        # relu grows with its argument, so it may follow the maximum.
        maximum = maximum_of_normalised(from_features + bias, offsets, kernel[-3:], neighbours, scale)
        return nn.relu(maximum + norm_bias)


class InvertedResidual(nn.Module):
    """Neighbourhood maximum, then a narrow-wide-narrow network of two layers, added to the input.

    Attributes:
        config: expansion and type of the matrix products.
    """

    config: EncoderConfig

    @nn.compact
    def __call__(
        self, features: Float[Array, "m f"], offsets: Float[Array, "m k 3"], neighbours: Int[AnyArray, "m k"]
    ) -> Float[Array, "m f"]:
        """Refines the features of one level.

        Args:
            features: features of the level.
            offsets: offsets from each point to its neighbours in the same level, as a share of the radius.
            neighbours: rows of these neighbours.

        Returns:
            New features of the level.
        """
        num_features = features.shape[1]
        x = NeighbourhoodMaximum(num_features, name="neighbourhood")(features, offsets, neighbours)
        x = linear(num_features * self.config.expansion, "expand")(x)
        x = nn.relu(layer_norm("expand_norm")(x))
        x = linear(num_features, "contract")(x)
        return nn.relu(layer_norm("contract_norm")(x) + features)


class Stage(nn.Module):
    """One step down the pyramid: set abstraction, then inverted residual blocks.

    Attributes:
        num_features: channels of the result.
        radii: radius of the set abstraction, then the radius of each block after it.
        config: expansion, frame of the offsets and type of the matrix products.
    """

    num_features: int
    radii: tuple[float, ...]
    config: EncoderConfig

    @nn.compact
    def __call__(self, features: Float[Array, "n c"], finer: PyramidLevel, level: PyramidLevel) -> Float[Array, "m f"]:
        """Computes the features of one level from those of the finer level before it.

        Args:
            features: features of the finer level.
            finer: the level before; positions are 0 where its mask is False.
            level: this level; positions are 0 where its mask is False.

        Returns:
            Features of this level.
        """
        directions = frame_directions(self.config.frame, finer, level)

        def offsets(positions: Float[AnyArray, "n 3"], block: int) -> Float[Array, "m k 3"]:
            offsets = jnp.asarray(positions[level.neighbours[block]] - level.positions[:, None]) / self.radii[block]
            return offsets if directions is None else to_ray_frame(offsets, directions[:, None])

        abstraction = NeighbourhoodMaximum(self.num_features, name="set_abstraction")
        x = abstraction(features, offsets(finer.positions, 0), level.neighbours[0])
        for block in range(1, len(self.radii)):
            residual = InvertedResidual(self.config, name=f"inverted_residual_{block - 1}")
            x = residual(x, offsets(level.positions, block), level.neighbours[block])
        return x


def without_masked(level: PyramidLevel) -> PyramidLevel:
    """Sets positions of masked points, which may hold anything, to zero: they cannot reach a gradient.

    Args:
        level: level of a pyramid.

    Returns:
        The level.
    """
    return replace(level, positions=jnp.where(level.mask[:, None], level.positions, 0))


def frame_directions(frame: Frame, finer: PyramidLevel, level: PyramidLevel) -> Float[Array, "m 2"] | None:
    """Computes the directions of the frames of the points of a level.

    Args:
        frame: see `EncoderConfig`.
        finer: the level before; positions are 0 where its mask is False.
        level: the level; positions are 0 where its mask is False.

    Returns:
        Unit horizontal directions in the frame of the lidar; None for that frame itself.
    """
    if frame == "lidar":
        return None
    offsets = jnp.asarray(finer.positions[level.neighbours[0]] - level.positions[:, None])
    return wall_normals(offsets, ray_directions(level.positions))


class FeaturePropagation(nn.Module):
    """One step up the pyramid: features of the finer level, joined with interpolated features of the coarser one.

    Attributes:
        num_features: channels of the result.
    """

    num_features: int

    @nn.compact
    def __call__(
        self, fine: Float[Array, "n c"], coarse: Float[Array, "m d"], interpolation: Interpolation
    ) -> Float[Array, "n f"]:
        """Joins the features of two levels.

        Args:
            fine: features of the finer level.
            coarse: features of the coarser level.
            interpolation: interpolation from the coarser to the finer level.

        Returns:
            New features of the finer level.
        """
        interpolated = jnp.einsum("nk,nkd->nd", interpolation.weights, coarse[interpolation.indices])
        x = jnp.concatenate([fine, interpolated], axis=-1)
        for layer in range(2):
            x = linear(self.num_features, f"linear_{layer}")(x)
            x = nn.relu(layer_norm(f"norm_{layer}")(x))
        return x


class PointEncoder(nn.Module):
    """Maps a point pyramid to features of the level that its last interpolation reaches.

    Attributes:
        config: widths of the layers.
        radii: radii of the neighbourhoods of each stage, normalised coordinates, as the pyramid was built with.
    """

    config: EncoderConfig
    radii: tuple[tuple[float, ...], ...]

    @nn.compact
    def __call__(self, pyramid: PointPyramid) -> Float[Array, "m c"]:
        """Encodes one pyramid.

        Args:
            pyramid: pyramid in normalised coordinates; masked points may hold anything.

        Returns:
            float32 features, one row for each point of that level; zero where its mask is False.
        """
        config = self.config
        levels = [without_masked(level) for level in pyramid.levels]
        levels = [replace(level, positions=jnp.asarray(level.positions, jnp.float32)) for level in levels]
        seen = jnp.asarray(levels[0].positions)
        if config.frame == "local":
            seen = seen * jnp.array([0, 0, 1])  # heights
        features = [linear(config.stem_channels, "stem")(seen)]
        for stage, radii in enumerate(self.radii):
            module = Stage(config.stem_channels * 2 ** (stage + 1), radii, config, name=f"stage_{stage}")
            features.append(module(features[-1], levels[stage], levels[stage + 1]))
        x = features.pop()
        num_steps = len(pyramid.interpolation)
        for step, interpolation in enumerate(pyramid.interpolation):
            interpolation = replace(interpolation, weights=jnp.asarray(interpolation.weights, jnp.float32))
            fine = features.pop()
            num_features = config.output_channels if step == num_steps - 1 else fine.shape[1]
            propagation = FeaturePropagation(num_features, name=f"propagation_{step}")
            x = propagation(fine, x, interpolation)
        return jnp.where(pyramid.levels[-1 - num_steps].mask[:, None], x, 0)
