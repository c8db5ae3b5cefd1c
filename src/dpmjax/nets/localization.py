"""L-Net: a scan goes in, the pose of its sensor comes out (DeepMapping section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

_HE_LIKE = nn.initializers.variance_scaling(2.0, "fan_avg", "uniform")
"""Xavier-uniform with the gain of ReLU."""


@dataclass(frozen=True)
class LocalizationConfig:
    """Shape of L-Net. The defaults are the paper's (section 4.1) with the dilation of the published program.

    Attributes:
        kind: "conv" for scans whose beams are in order, "point" (PointNet) for any set of points.
        features: channels of the layers before the maximum over the beams.
        strides: of the same layers; "point" ignores them.
        dilation: distance of the three taps of a convolution, in beams.
        is_circular: the last beam is the neighbour of the first (a full turn); else zeros follow.
        hidden: channels of the layers after the maximum.
    """

    kind: Literal["conv", "point"] = "conv"
    features: tuple[int, ...] = (64, 128, 1024)
    strides: tuple[int, ...] = (1, 1, 1)
    dilation: int = 3
    is_circular: bool = False
    hidden: tuple[int, ...] = (512, 256)

    def __post_init__(self) -> None:
        if self.kind == "conv" and len(self.strides) != len(self.features):
            raise ValueError(f"strides: expected one for each of {len(self.features)} layers, got {self.strides}")


class BeamConvolution(nn.Module):
    """A dilated convolution of three taps along the beams.

    It is one matrix product: XLA's own convolution is ten times slower on CPUs.
    """

    features: int
    stride: int
    dilation: int
    is_circular: bool

    @nn.compact
    def __call__(self, x: Float[Array, "b c"]) -> Float[Array, "b_out f"]:
        """Same length as the input, divided by the stride."""
        num_beams = x.shape[0]
        pad = (self.dilation, self.dilation)
        padded = jnp.pad(x, (pad, (0, 0)), mode="wrap" if self.is_circular else "constant")
        taps = [padded[k * self.dilation : k * self.dilation + num_beams : self.stride] for k in range(3)]
        return nn.Dense(self.features, kernel_init=_HE_LIKE)(jnp.concatenate(taps, axis=-1))


class LocalizationNet(nn.Module):
    """L-Net for one scan; `vmap` over the set."""

    config: LocalizationConfig
    num_outputs: int = 3

    @nn.compact
    def __call__(self, points: Float[Array, "b d"], mask: Bool[Array, " b"]) -> Float[Array, " o"]:
        """Pose of the sensor.

        Args:
            points: in the sensor frame, about -1 to 1.
            mask: False for beams that measured nothing.

        Returns:
            For planar scans x, y, heading in radians.
        """
        config = self.config
        x = jnp.where(mask[:, None], points, 0.0)
        for layer, features in enumerate(config.features):
            if config.kind == "conv":
                stride = config.strides[layer]
                x = BeamConvolution(features, stride, config.dilation, config.is_circular)(x)
                mask = mask[::stride]
            else:
                x = nn.Dense(features, kernel_init=_HE_LIKE)(x)
            if layer < len(config.features) - 1:
                x = nn.relu(x)
        # The published network has no activation before the maximum.
        x = jnp.where(mask.any(), jnp.max(jnp.where(mask[:, None], x, -jnp.inf), axis=0, initial=-1e30), 0.0)
        for features in config.hidden:
            x = nn.relu(nn.Dense(features, kernel_init=_HE_LIKE)(x))
        return nn.Dense(self.num_outputs, kernel_init=_HE_LIKE)(x)
