"""The model: its parameters, and the functions that apply its networks.

All functions take one scan or one pair; `vmap` over the clouds batches them.
"""

from __future__ import annotations

import functools
import hashlib
from typing import TYPE_CHECKING, Any, Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dpmjax.checks import require_shape, require_value, runs_on_host
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.geometry.bearing import from_ray_frame, ray_directions
from dpmjax.geometry.normals import pyramid_elements
from dpmjax.geometry.pyramid import build_pyramid_on_host
from dpmjax.geometry.traced import typed_jit
from dpmjax.kept_programs import kept_jit
from dpmjax.nets.decoder import DescriptorDecoder
from dpmjax.nets.point_encoder import PointEncoder, frame_directions, without_masked
from dpmjax.types import DescriptorCloud, PointPyramid


@flax.struct.dataclass
class Model:
    """Parameters and their configuration.

    Attributes:
        params: {"encoder": ..., "decoder": ...}, each a tree of Flax parameters.
        config: the configuration; static under jit.
    """

    params: dict[str, Any]
    config: ModelConfig = flax.struct.field(pytree_node=False)

    if TYPE_CHECKING:  # flax makes it, and has no type for it

        def replace(self, **updates: Any) -> Model: ...  # noqa: D102

    def __repr__(self) -> str:
        num = sum(np.size(leaf) for leaf in jax.tree.leaves(self.params))
        channels, trained = self.config.encoder.output_channels, " and ".join(self.config.trained) or "nothing"
        return f"Model({self.config.num_descriptors} x {channels} descriptors, {num:,} parameters, trained: {trained})"


Initialization = Literal["normal", "uniform"]


@runs_on_host("call it outside, and pass its result in")
def init_model(key: PRNGKeyArray, config: ModelConfig, *, distribution: Initialization = "normal") -> Model:
    """Makes a model with random parameters; float32.

    Args:
        key: used once.
        config: configuration of the model.
        distribution: "normal": matrices N(0, 1 / rows), biases zero. "uniform": matrices and their biases are uniform
            within 1 / sqrt(rows), the default of PyTorch's linear layers (DeepPointMap's published program). Scales of
            norms are one and their biases zero with both.

    Returns:
        The model.
    """
    shapes = model_shapes(config)
    # One long draw is cut up on the host; a draw for each of the 200 arrays would take ten seconds to compile.
    num_numbers = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    is_normal = distribution == "normal"
    sample = jax.random.normal if is_normal else functools.partial(jax.random.uniform, minval=-1.0)
    draw = np.asarray(sample(key, (num_numbers,), jnp.float32))
    rows = {path[:-1]: leaf.shape[0] for path, leaf in jax.tree.leaves_with_path(shapes) if leaf.ndim == 2}
    ends = iter(np.cumsum([leaf.size for leaf in jax.tree.leaves(shapes)]))

    def start(path: tuple[Any, ...], leaf: jax.ShapeDtypeStruct) -> jax.Array:
        end = next(ends)
        if leaf.ndim == 2 or (not is_normal and path[-1].key == "bias" and path[:-1] in rows):
            return jnp.asarray(draw[end - leaf.size : end].reshape(leaf.shape) / np.float32(rows[path[:-1]]) ** 0.5)
        return jnp.asarray(np.full(leaf.shape, path[-1].key.endswith("scale"), np.float32))

    return Model(jax.tree_util.tree_map_with_path(start, shapes), config)


def model_shapes(config: ModelConfig) -> dict[str, Any]:
    """Returns the parameters of a model as shapes and dtypes.

    Args:
        config: configuration of the model.

    Returns:
        {"encoder": ..., "decoder": ...}, with `jax.ShapeDtypeStruct` leaves.
    """
    key = jax.random.key(0)
    num, channels = config.num_descriptors, config.decoder.input_channels
    cloud = DescriptorCloud(jnp.zeros((num, 3)), jnp.zeros((num, channels)), jnp.ones(num, bool))
    pyramid = build_pyramid_on_host(np.zeros((1, 3), np.float32), np.ones(1, bool), config.pyramid)
    encoder = jax.eval_shape(_encoder(config).init, key, pyramid)
    decoder = jax.eval_shape(DescriptorDecoder(config.decoder).init, key, cloud, cloud)
    return {"encoder": encoder["params"], "decoder": decoder["params"]}


def model_fingerprint(model: Model) -> str:
    """Identifies the parameters of a model that make and compare descriptors.

    The overlap head is left out, so that a map stays readable when the head is trained later.

    Args:
        model: the model.

    Returns:
        The first 16 hexadecimal digits of a hash of the parameters in float32, the same on every machine.
    """
    digest = hashlib.sha256()
    decoder = {name: part for name, part in model.params["decoder"].items() if name != "overlap_head"}
    params = jax.device_get({**model.params, "decoder": decoder})
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        digest.update(jax.tree_util.keystr(path).encode())
        digest.update(np.ascontiguousarray(leaf, "<f4").tobytes())
    return digest.hexdigest()[:16]


@kept_jit("num_elements")
def encode_pyramid(model: Model, pyramid: PointPyramid, *, num_elements: int | None = None) -> DescriptorCloud:
    """Encodes one scan to descriptors in metres, in the frame of the lidar (DeepPointMap section 3.1).

    Each descriptor is a surface element too: its normal is that of the plane through its neighbours in the first
    block of the encoder.

    Args:
        model: a model whose `config.pyramid` built the pyramid.
        pyramid: one scan in normalised coordinates; masked points may hold anything.
        num_elements: number of surface elements, at most that of the first stage: the points that follow the
            descriptors in the order of farthest points have no features. None for the descriptors alone.

    Returns:
        `config.num_descriptors` descriptors, and the further elements; positions, features and normals are 0 where the
        mask is False.

    Raises:
        ValueError: if the pyramid has other stages than the model, or if `num_elements` is out of range.
    """
    stages = model.config.pyramid.stages
    require_value(len(pyramid.levels) == len(stages) + 1, "pyramid", f"{len(stages) + 1} levels", len(pyramid.levels))
    for number, (stage, level) in enumerate(zip(stages, pyramid.levels[1:], strict=True), start=1):
        num_found, num = len(level.neighbours), len(stage.radii)
        require_value(num_found == num, f"pyramid.levels[{number}]", f"{num} neighbourhoods", num_found)
    features: Any = _encoder(model.config).apply({"params": model.params["encoder"]}, pyramid)
    row = len(pyramid.levels) - 1 - len(pyramid.interpolation)
    finer, level = (without_masked(pyramid.levels[number]) for number in (row - 1, row))
    directions = frame_directions(model.config.encoder.frame, finer, level)
    if directions is None:
        directions = ray_directions(level.positions)
    least = model.config.num_descriptors
    num_elements = least if num_elements is None else num_elements
    require_value(num_elements >= least, "num_elements", f"at least the {least} descriptors", num_elements)
    elements: Any = pyramid_elements(pyramid, num_elements)
    positions = elements.positions * model.config.scale_m
    return DescriptorCloud(positions, features, elements.mask, directions, elements.normals, elements.planarity)


@typed_jit()
def correlate(model: Model, a: DescriptorCloud, b: DescriptorCloud) -> tuple[DescriptorCloud, DescriptorCloud]:
    """Correlates two descriptor clouds by attention (DeepPointMap section 3.2, figure 2b).

    A `ValueError` names an array of another shape.

    Args:
        model: encoder and decoder.
        a: uncorrelated descriptors of a scan or a map.
        b: the same.

    Returns:
        Both clouds with correlated features; positions and masks do not change (zero where masked). Surface elements
        are left out.
    """
    a, b = a.described, b.described
    for name, cloud in (("a", a), ("b", b)):
        _require_descriptor_cloud(name, cloud, model.config.decoder.input_channels)
    return decode(model, a, b, part="correlate")


@jax.jit
def descriptor_similarity(model: Model, a: DescriptorCloud, b: DescriptorCloud) -> Float[Array, "m n"]:
    """Computes the similarity of all pairs of descriptors (DeepPointMap section 3.2).

    Args:
        model: encoder and decoder.
        a: a correlated cloud.
        b: the second correlated cloud.

    Returns:
        Cosines in [-1, 1]; 0 for a descriptor whose features are 0.
    """
    first, second = (unit_rows(decode(model, cloud.features, part="similarity_head")) for cloud in (a, b))
    return jnp.matmul(first, second.T, precision=lax.Precision.HIGHEST)


def unit_rows(features: Float[Array, "m c"]) -> Float[Array, "m c"]:
    """Scales rows to length one.

    Args:
        features: any rows.

    Returns:
        The rows; those of length 0 stay.
    """
    squared = jnp.sum(features.astype(jnp.float32) ** 2, axis=1, keepdims=True)
    return features / jnp.sqrt(jnp.where(squared > 0, squared, 1))


@jax.jit
def predict_offsets(
    model: Model,
    features: Float[Array, "... c"],
    partners: Float[Array, "... c"],
    directions: Float[Array, "... 2"] | None = None,
    partner_rows: Int[Array, "..."] | None = None,
) -> Float[Array, "... 3"]:
    """Predicts the offset from each descriptor to its partner (DeepPointMap section 3.2).

    The head predicts in the frame of the features (`EncoderConfig.frame`).

    Args:
        model: encoder and decoder.
        features: correlated features of the first cloud, one row for each pair.
        partners: correlated features of the second cloud, row for row.
        directions: directions of the frames of the first cloud, row for row (`geometry.bearing.directions_of`). With
            None, and in the frame "lidar", offsets stay as the head predicts them.
        partner_rows: if given, the partners are `partners[partner_rows]`; cheaper where partners are in several pairs.

    Returns:
        Offsets in metres, in the frame of the first cloud; without `directions`, in the frames of the descriptors. All
        are 0 where the decoder predicts none.
    """
    if not model.config.decoder.predicts_offsets:
        others = partners.shape[:-1] if partner_rows is None else partner_rows.shape
        return jnp.zeros((*jnp.broadcast_shapes(features.shape[:-1], others), 3), features.dtype)
    offsets = decode(model, features, partners, partner_rows, part="offset_head")
    if directions is None or model.config.encoder.frame == "lidar":
        return offsets
    return from_ray_frame(offsets, directions)


def _encoder(config: ModelConfig) -> PointEncoder:
    return PointEncoder(config.encoder, tuple(stage.radii for stage in config.pyramid.stages))


def decode(model: Model, *arguments: Any, part: str) -> Any:
    """Applies a method or a head of the decoder, such as "coarse_head" for the coarse pairing loss (eq. 5).

    Args:
        model: encoder and decoder.
        *arguments: arguments of the part.
        part: its name in `DescriptorDecoder`.

    Returns:
        The result of the part.
    """
    return DescriptorDecoder(model.config.decoder).apply(
        {"params": model.params["decoder"]},
        *arguments,
        method=lambda decoder, *arguments: getattr(decoder, part)(*arguments),
    )


def _require_descriptor_cloud(name: str, cloud: DescriptorCloud, num_channels: int) -> None:
    num = cloud.positions.shape[0]
    for part, shape in (("positions", (num, 3)), ("features", (num, num_channels)), ("mask", (num,))):
        require_shape(f"{name}.{part}", getattr(cloud, part), shape)
