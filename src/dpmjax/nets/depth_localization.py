"""L-Net for organised depth images: convolutions over rows and columns (DeepMapping section 4.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

_HE_LIKE = nn.initializers.variance_scaling(2.0, "fan_avg", "uniform")


@dataclass(frozen=True)
class DepthLocalizationConfig:
    """Shape of L-Net. The defaults are the paper's (section 4.2) with the dilation of the published program.

    Attributes:
        kind: "conv", or "point" (PointNet, supplement A): each pixel by itself.
        features: channels of the layers before the maximum over the pixels.
        strides: of the same layers; "point" ignores them.
        dilation: distance of the taps of a convolution, in pixels.
        hidden: channels of the layers after the maximum.
    """

    kind: Literal["conv", "point"] = "conv"
    features: tuple[int, ...] = (64, 128, 256, 1024)
    strides: tuple[int, ...] = (1, 1, 1, 1)
    dilation: int = 3
    hidden: tuple[int, ...] = (512, 256)

    def __post_init__(self) -> None:
        if self.kind == "conv" and len(self.strides) != len(self.features):
            raise ValueError(f"strides: expected one for each of {len(self.features)} layers, got {self.strides}")


class ImageConvolution(nn.Module):
    """A dilated 3 x 3 convolution as one matrix product, which is what a CPU is quick at."""

    features: int
    stride: int
    dilation: int

    @nn.compact
    def __call__(self, x: Float[Array, "h w c"]) -> Float[Array, "h_out w_out f"]:
        """Same size as the input, divided by the stride; zeros beyond the border."""
        height, width, _ = x.shape
        gap = self.dilation
        padded = jnp.pad(x, ((gap, gap), (gap, gap), (0, 0)))
        taps = [
            padded[i * gap : i * gap + height : self.stride, j * gap : j * gap + width : self.stride]
            for i in range(3)
            for j in range(3)
        ]
        return nn.Dense(self.features, kernel_init=_HE_LIKE)(jnp.concatenate(taps, axis=-1))


class DepthLocalizationNet(nn.Module):
    """L-Net for one depth image; `vmap` over the set."""

    config: DepthLocalizationConfig
    num_outputs: int = 3

    @nn.compact
    def __call__(self, points: Float[Array, "h w 3"], mask: Bool[Array, "h w"]) -> Float[Array, " o"]:
        """Motion of the camera.

        Args:
            points: in the camera frame, about -1 to 1.
            mask: False for pixels that measured nothing.

        Returns:
            `num_outputs` numbers: 3 for x, z and the angle about y, 6 for a twist.
        """
        config = self.config
        x = jnp.where(mask[..., None], points, 0.0)
        for layer, features in enumerate(config.features):
            if config.kind == "conv":
                stride = config.strides[layer]
                x = ImageConvolution(features, stride, config.dilation)(x)
                mask = mask[::stride, ::stride]
            else:
                x = nn.Dense(features, kernel_init=_HE_LIKE)(x)
            if layer < len(config.features) - 1:
                x = nn.relu(x)
        x = jnp.max(jnp.where(mask[..., None], x, -jnp.inf), axis=(0, 1), initial=-1e30)
        x = jnp.where(mask.any(), x, 0.0)
        for features in config.hidden:
            x = nn.relu(nn.Dense(features, kernel_init=_HE_LIKE)(x))
        return nn.Dense(self.num_outputs, kernel_init=_HE_LIKE)(x)
