"""The model: its configuration and its parameters, and what it says of point pyramids and descriptor clouds.

All functions are for one scan or one pair; `vmap` over the clouds batches them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dpmjax.checks import require_positive, require_shape
from dpmjax.deeppointmap.matching import MatchConfig
from dpmjax.geometry.pyramid import PyramidConfig
from dpmjax.nets.decoder import DecoderConfig, DescriptorDecoder
from dpmjax.nets.layers import ComputeDtype
from dpmjax.nets.point_encoder import EncoderConfig, PointEncoder
from dpmjax.scans.preprocess import PreprocessConfig
from dpmjax.types import DescriptorCloud, Interpolation, PointPyramid, PyramidLevel


@dataclass(frozen=True)
class ModelConfig:
    """What a model is made of; the defaults are the published configuration.

    Attributes:
        pyramid: which points are kept and which are neighbours.
        encoder: its widths.
        decoder: its widths.
        scale_m: metres in one unit of the pyramid's normalised coordinates.
        preprocess: what is kept of a raw scan, in training and in use alike.
        matching: which pairs of descriptors are chosen and believed.
    """

    pyramid: PyramidConfig = field(default_factory=PyramidConfig)
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    scale_m: float = 60.0
    preprocess: PreprocessConfig = field(default_factory=PreprocessConfig)
    matching: MatchConfig = field(default_factory=MatchConfig)

    def __post_init__(self) -> None:
        require_positive("scale_m", self.scale_m)
        if self.decoder.input_channels != self.encoder.output_channels:
            expected = f"expected the encoder's output_channels {self.encoder.output_channels}"
            raise ValueError(f"decoder.input_channels: {expected}, got {self.decoder.input_channels}")

    @property
    def num_descriptors(self) -> int:
        """How many descriptors the encoder makes of a scan."""
        return self.pyramid.stages[-1 - self.pyramid.num_interpolations].num_points

    def with_compute_dtype(self, compute_dtype: ComputeDtype) -> ModelConfig:
        """The same with other matrix products: "float32" or "bfloat16". Geometry stays in float32."""
        return replace(
            self,
            encoder=replace(self.encoder, compute_dtype=compute_dtype),
            decoder=replace(self.decoder, compute_dtype=compute_dtype),
        )


@flax.struct.dataclass
class Model:
    """A configuration and its parameters.

    Attributes:
        params: {"encoder": ..., "decoder": ...}, each as Flax holds parameters.
        config: static.
    """

    params: dict[str, Any]
    config: ModelConfig = flax.struct.field(pytree_node=False)


def init_model(key: PRNGKeyArray, config: ModelConfig) -> Model:
    """A model with random parameters: matrices N(0, 1 / rows), scales one, all else zero; float32."""
    shapes = model_shapes(config)
    # One long draw, cut up on the host: a draw for each of the 200 arrays would take ten seconds to compile.
    num_numbers = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    draw = np.asarray(jax.random.normal(key, (num_numbers,)))
    ends = iter(np.cumsum([leaf.size for leaf in jax.tree.leaves(shapes)]))

    def start(path: tuple[Any, ...], leaf: jax.ShapeDtypeStruct) -> jax.Array:
        end = next(ends)
        if leaf.ndim == 2:
            return jnp.asarray(draw[end - leaf.size : end].reshape(leaf.shape) / np.float32(leaf.shape[0]) ** 0.5)
        return jnp.asarray(np.full(leaf.shape, path[-1].key.endswith("scale"), np.float32))

    return Model(jax.tree_util.tree_map_with_path(start, shapes), config)


def model_shapes(config: ModelConfig) -> dict[str, Any]:
    """The parameters of a model as shapes and dtypes, without numbers."""
    key = jax.random.key(0)
    num, channels = config.num_descriptors, config.decoder.input_channels
    cloud = DescriptorCloud(jnp.zeros((num, 3)), jnp.zeros((num, channels)), jnp.ones(num, bool))
    encoder = jax.eval_shape(_encoder(config).init, key, _blank_pyramid(config.pyramid))
    decoder = jax.eval_shape(DescriptorDecoder(config.decoder).init, key, cloud, cloud)
    return {"encoder": encoder["params"], "decoder": decoder["params"]}


def encode_pyramid(model: Model, pyramid: PointPyramid) -> DescriptorCloud:
    """One scan to descriptors in metres, in the frame of the lidar (DeepPointMap section 3.1).

    Args:
        model: its `config.pyramid` is what the pyramid was built with.
        pyramid: in normalised coordinates, of one scan.

    Returns:
        `config.num_descriptors` descriptors. Those that are not there have zero position and features; what the
        masked points of the pyramid hold changes nothing.

    Raises:
        ValueError: the pyramid has other stages than the model.
    """
    stages = model.config.pyramid.stages
    if len(pyramid.levels) != len(stages) + 1:
        raise ValueError(f"pyramid: expected {len(stages) + 1} levels, got {len(pyramid.levels)}")
    for number, (stage, level) in enumerate(zip(stages, pyramid.levels[1:], strict=True), start=1):
        if len(level.neighbours) != len(stage.radii):
            expected = f"expected {len(stage.radii)} neighbourhoods"
            raise ValueError(f"pyramid.levels[{number}]: {expected}, got {len(level.neighbours)}")
    return _encode_pyramid(model, pyramid)


def correlate(model: Model, a: DescriptorCloud, b: DescriptorCloud) -> tuple[DescriptorCloud, DescriptorCloud]:
    """Both clouds with features that know of each other (DeepPointMap section 3.2, figure 2b).

    Positions and masks stay as they are (zero where masked). Clouds of scans and of maps are treated alike.

    Raises:
        ValueError: features have another number of channels than the model takes.
    """
    _require_features("a", a, model.config.decoder.input_channels)
    _require_features("b", b, model.config.decoder.input_channels)
    return _correlate(model, a, b)


def overlap_probability(model: Model, a: DescriptorCloud, b: DescriptorCloud) -> Float[Array, ""]:
    """Probability that two clouds see the same place, less than 20 m apart (DeepPointMap section 3.2).

    Args:
        model: encoder and decoder.
        a: uncorrelated descriptors.
        b: the same; the order matters a little.

    Raises:
        ValueError: features have another number of channels than the model takes.
    """
    return jax.nn.sigmoid(overlap_logit(model, *correlate(model, a, b)))


@jax.jit
def overlap_logit(model: Model, a: DescriptorCloud, b: DescriptorCloud) -> Float[Array, ""]:
    """Logit of the overlap probability, from correlated clouds."""
    return _decode(model, a, b, method="overlap_logit")


@jax.jit
def similarity_features(model: Model, correlated: DescriptorCloud) -> Float[Array, "m c"]:
    """Features whose cosine tells how likely descriptors of two correlated clouds are partners."""
    return _decode(model, correlated.features, method="similarity_features")


@jax.jit
def coarse_features(model: Model, cloud: DescriptorCloud) -> Float[Array, "m c"]:
    """Features of an uncorrelated cloud that the coarse pairing loss compares (DeepPointMap eq. 5)."""
    return _decode(model, cloud.features, method="coarse_features")


@jax.jit
def predict_offsets(
    model: Model, features: Float[Array, "... c"], partners: Float[Array, "... c"]
) -> Float[Array, "... 3"]:
    """Metres from each descriptor to its partner, in the frame of the first cloud (DeepPointMap section 3.2).

    Args:
        model: encoder and decoder.
        features: correlated features of the first cloud, one row for each pair.
        partners: correlated features of the other, row for row.
    """
    return _decode(model, features, partners, method="offsets")


@jax.jit
def _encode_pyramid(model: Model, pyramid: PointPyramid) -> DescriptorCloud:
    features: Any = _encoder(model.config).apply({"params": model.params["encoder"]}, pyramid)
    level = pyramid.levels[-1 - len(pyramid.interpolation)]
    positions = jnp.where(level.mask[:, None], level.positions, 0) * model.config.scale_m
    return DescriptorCloud(positions, features, jnp.asarray(level.mask))


@jax.jit
def _correlate(model: Model, a: DescriptorCloud, b: DescriptorCloud) -> tuple[DescriptorCloud, DescriptorCloud]:
    return _decode(model, a, b, method="correlate")


def _encoder(config: ModelConfig) -> PointEncoder:
    return PointEncoder(config.encoder, tuple(stage.radii for stage in config.pyramid.stages))


def _decode(model: Model, *arguments: Any, method: str) -> Any:
    return DescriptorDecoder(model.config.decoder).apply({"params": model.params["decoder"]}, *arguments, method=method)


def _blank_pyramid(config: PyramidConfig) -> PointPyramid:
    """One of the right structure: the sizes of parameters depend on nothing else."""

    def level(num: int, num_blocks: int) -> PyramidLevel:
        indices = jnp.zeros(num, jnp.int32)
        return PyramidLevel(jnp.zeros((num, 3)), jnp.ones(num, bool), indices, (indices[:, None],) * num_blocks)

    levels = [level(1, 0), *(level(stage.num_points, len(stage.radii)) for stage in config.stages)]
    steps = [
        Interpolation(jnp.zeros((len(fine.mask), 3), jnp.int32), jnp.ones((len(fine.mask), 3)))
        for fine in levels[-2 : -2 - config.num_interpolations : -1]
    ]
    return PointPyramid(tuple(levels), tuple(steps))


def _require_features(name: str, cloud: DescriptorCloud, num_channels: int) -> None:
    require_shape(f"{name}.features", cloud.features, (cloud.positions.shape[0], num_channels))
