"""L-Net: the pose of the sensor of a scan or a depth image (DeepMapping sections 3.3, 4.2); the network of the toy."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, Literal, get_args

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dpmjax.checks import require_one_of

HE_LIKE = nn.initializers.variance_scaling(2.0, "fan_avg", "uniform")
"""Xavier-uniform with the gain of ReLU, as in the published networks."""


@dataclass(frozen=True)
class LocalizationNetConfig:
    """Shape of L-Net. The defaults are the paper's (section 4.1).

    Attributes:
        kind: "conv" for beams or pixels in order, "point" (PointNet, supplement A) for any set of points.
        features: channels of the layers before the maximum over the beams.
        strides: strides of the same layers; "point" ignores them.
        is_circular: the last beam is the neighbour of the first (a full turn); else zeros follow.
        hidden: channels of the layers after the maximum.
        output_scale: factor on the initial weights of the last layer; a small one lets all poses begin near zero.
    """

    kind: Literal["conv", "point"] = "conv"
    features: tuple[int, ...] = (64, 128, 1024)
    strides: tuple[int, ...] = (1, 1, 1)
    is_circular: bool = False
    hidden: tuple[int, ...] = (512, 256)
    output_scale: float = 1.0

    def __post_init__(self) -> None:
        if self.kind == "conv" and len(self.strides) != len(self.features):
            raise ValueError(f"strides: expected one for each of {len(self.features)} layers, got {self.strides}")


# Distance of the three taps of a convolution along each axis, in beams or pixels: that of the published program.
_DILATION = 3


class DilatedConvolution(nn.Module):
    """A dilated convolution of three taps along each axis: 3 for beams, 3 x 3 for an image.

    It is one matrix product: XLA's own convolution is ten times slower on CPUs.
    """

    features: int
    stride: int
    is_circular: bool

    @nn.compact
    def __call__(self, x: Float[Array, "*size c"]) -> Float[Array, "*size_out f"]:
        """The output has the size of the input divided by the stride.

        Args:
            x: channels of the beams (b, c) or of the pixels (h, w, c).

        Returns:
            Channels of every `stride`-th beam or pixel.
        """
        *size, _ = x.shape
        padded = jnp.pad(
            x, [(_DILATION, _DILATION)] * len(size) + [(0, 0)], mode="wrap" if self.is_circular else "constant"
        )
        taps = [
            padded[tuple(slice(k * _DILATION, k * _DILATION + n, self.stride) for k, n in zip(tap, size, strict=True))]
            for tap in itertools.product(range(3), repeat=len(size))
        ]
        return nn.Dense(self.features, kernel_init=HE_LIKE)(jnp.concatenate(taps, axis=-1))


class LocalizationNet(nn.Module):
    """L-Net for one scan or depth image; `vmap` over the set."""

    config: LocalizationNetConfig
    num_outputs: int = 3

    @nn.compact
    def __call__(self, points: Float[Array, "*size d"], mask: Bool[Array, "*size"]) -> Float[Array, " o"]:
        """Pose of the sensor.

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
                x = DilatedConvolution(features, stride, config.is_circular)(x)
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


Initialization = Literal["xavier-relu", "xavier", "he", "lecun", "pytorch"]

# Scale, fan and distribution of `variance_scaling`.
_KERNELS: dict[str, tuple[float, Any, Any]] = {
    "xavier-relu": (2.0, "fan_avg", "uniform"),
    "xavier": (1.0, "fan_avg", "uniform"),
    "he": (2.0, "fan_in", "normal"),
    "lecun": (1.0, "fan_in", "truncated_normal"),
    "pytorch": (1.0 / 3.0, "fan_in", "uniform"),
}


@dataclass(frozen=True)
class ScalarNetConfig:
    """Shape of the network. The features are the paper's; its initialisation is unpublished.

    Attributes:
        features: channels of the hidden layers, each followed by an ELU.
        initialization: "xavier-relu": Xavier-uniform with the gain of ReLU, as in the published L-Net; "xavier":
            without the gain; "he"; "lecun" (Flax's default); "pytorch": PyTorch's default. Biases are zero, or for
            "pytorch" uniform like the weights.
    """

    features: tuple[int, ...] = (10, 20, 30, 40)
    initialization: Initialization = "xavier-relu"

    def __post_init__(self) -> None:
        require_one_of("initialization", self.initialization, get_args(Initialization))


class ScalarNet(nn.Module):
    """A multi-layer perceptron from one number to one number."""

    config: ScalarNetConfig

    @nn.compact
    def __call__(self, z: Float[Array, ""]) -> Float[Array, ""]:
        """The value x that the auxiliary variable z stands for."""
        x = z[None]
        for features in self.config.features:
            x = nn.elu(self._linear(features, x))
        return self._linear(1, x)[0]

    def _linear(self, features: int, x: Float[Array, " c"]) -> Float[Array, " f"]:
        kernel_init = nn.initializers.variance_scaling(*_KERNELS[self.config.initialization])
        bound = x.shape[0] ** -0.5 if self.config.initialization == "pytorch" else 0.0

        def bias_init(key: jax.Array, shape: Any, dtype: Any = float) -> Array:
            return jax.random.uniform(key, shape, dtype, -bound, bound)

        return nn.Dense(features, kernel_init=kernel_init, bias_init=bias_init)(x)
