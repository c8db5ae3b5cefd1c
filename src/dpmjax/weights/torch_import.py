"""The published PyTorch checkpoints of DeepPointMap: their names to ours, and their sizes to a configuration."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import flax.traverse_util
import jax.numpy as jnp
import numpy as np

from dpmjax.deeppointmap.model import Model, ModelConfig, model_shapes
from dpmjax.geometry.pyramid import PyramidConfig, PyramidStage
from dpmjax.nets.decoder import DecoderConfig
from dpmjax.nets.point_encoder import EncoderConfig
from dpmjax.weights.torch_file import read_torch_file

Tensors = dict[str, np.ndarray]

# Each of their names is one of these patterns and then `weight` or `bias`; `(\d+)` is carried over.
ENCODER_NAMES = {
    r"point_mlp0\.": "stem.",
    r"downsampler\.(\d+)\.sa\.mlp\.0\.": r"stage_\1.set_abstraction.",
    r"downsampler\.(\d+)\.sa\.mlp\.1\.ln\.": r"stage_\1.set_abstraction.norm_",
    r"downsampler\.(\d+)\.irm\.(\d+)\.la\.mlp\.0\.": r"stage_\1.inverted_residual_\2.neighbourhood.",
    r"downsampler\.(\d+)\.irm\.(\d+)\.la\.mlp\.1\.ln\.": r"stage_\1.inverted_residual_\2.neighbourhood.norm_",
    r"downsampler\.(\d+)\.irm\.(\d+)\.pw_conv\.0\.": r"stage_\1.inverted_residual_\2.expand.",
    r"downsampler\.(\d+)\.irm\.(\d+)\.pw_conv\.1\.ln\.": r"stage_\1.inverted_residual_\2.expand_norm.",
    r"downsampler\.(\d+)\.irm\.(\d+)\.pw_conv\.3\.": r"stage_\1.inverted_residual_\2.contract.",
    r"downsampler\.(\d+)\.irm\.(\d+)\.pw_conv\.4\.ln\.": r"stage_\1.inverted_residual_\2.contract_norm.",
    r"upsampler\.(\d+)\.mlp\.0\.": r"propagation_\1.linear_0.",
    r"upsampler\.(\d+)\.mlp\.1\.ln\.": r"propagation_\1.norm_0.",
    r"upsampler\.(\d+)\.mlp\.3\.": r"propagation_\1.linear_1.",
    r"upsampler\.(\d+)\.mlp\.4\.ln\.": r"propagation_\1.norm_1.",
}
DECODER_NAMES = {
    r"projection\.": "projection.",
    r"descriptor_attention\.(\d+)\.(self|cross)_attn\.in_proj_": r"layer_\1.\2_attention.in_",
    r"descriptor_attention\.(\d+)\.(self|cross)_attn\.out_proj\.": r"layer_\1.\2_attention.out.",
    r"descriptor_attention\.(\d+)\.mlp\.0\.": r"layer_\1.network.linear_0.",
    r"descriptor_attention\.(\d+)\.mlp\.2\.": r"layer_\1.network.linear_1.",
    r"descriptor_attention\.(\d+)\.norm1\.": r"layer_\1.self_norm.",
    r"descriptor_attention\.(\d+)\.norm2\.": r"layer_\1.cross_norm.",
    r"descriptor_attention\.(\d+)\.norm3\.": r"layer_\1.network_norm.",
    r"similarity_head\.0\.": "similarity_head.linear_0.",
    r"similarity_head\.2\.": "similarity_head.linear_1.",
    r"coarse_pairing_head\.0\.": "coarse_head.linear_0.",
    r"coarse_pairing_head\.2\.": "coarse_head.linear_1.",
    r"offset_head\.mlp\.0\.": "offset_head.linear_0.",
    r"offset_head\.mlp\.2\.": "offset_head.linear_1.",
    r"offset_head\.mlp\.4\.": "offset_head.linear_2.",
    r"offset_head\.downsample\.": "offset_head.short_cut.",
    r"offset_head\.head\.": "offset_head.output.",
    r"loop_head\.mlp\.0\.": "overlap_head.network.linear_0.",
    r"loop_head\.mlp\.2\.": "overlap_head.network.linear_1.",
    r"loop_head\.projection\.0\.": "overlap_head.classifier.linear_0.",
    r"loop_head\.projection\.2\.": "overlap_head.classifier.linear_1.",
}


def import_torch_checkpoint(path: str | Path) -> Model:
    """A model from a published checkpoint: `{"encoder": state_dict, "decoder": state_dict}`.

    Widths, depths and numbers of blocks are derived from the tensors. Radii, numbers of points and of neighbours are
    not in there: they come from a `config.json` beside the file where there is one (keys `npoint`, `radius_list`,
    `nsample_list`, `upsample_layers` under `encoder`, and `coordinate_scale`), and are the paper's otherwise. Attention
    has eight heads.

    Raises:
        ValueError: the file cannot be read, or is of another layout.
    """
    path = Path(path)
    content = read_torch_file(path)
    if not isinstance(content, dict) or not {"encoder", "decoder"} <= content.keys():
        raise ValueError(f"{path}: not a checkpoint of DeepPointMap: expected a dictionary of encoder and decoder")
    tensors = {
        "encoder": _renamed(content["encoder"], ENCODER_NAMES, f"{path}: encoder"),
        "decoder": _renamed(content["decoder"], DECODER_NAMES, f"{path}: decoder"),
    }
    arrays = {f"{part}.{name}": array for part, named in tensors.items() for name, array in named.items()}
    try:
        config = _derived_config(arrays, *_sampling(path.with_name("config.json")))
    except KeyError as error:
        raise ValueError(f"{path}: lacks the tensor that becomes {error}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    shapes = flax.traverse_util.flatten_dict(model_shapes(config), sep=".")
    for name in sorted(shapes.keys() | arrays.keys()):
        wanted = shapes[name].shape if name in shapes else "none"
        found = arrays[name].shape if name in arrays else "none"
        if wanted != found:
            raise ValueError(f"{path}: the tensor that becomes {name} should have shape {wanted}, and has {found}")
    params = {name: jnp.asarray(array, jnp.float32) for name, array in arrays.items()}
    return Model(flax.traverse_util.unflatten_dict(params, sep="."), config)


def _renamed(tensors: Any, names: dict[str, str], where: str) -> Tensors:
    if not isinstance(tensors, dict):
        raise ValueError(f"{where}: expected a dictionary of tensors, got {type(tensors).__name__}")
    return dict(_converted(str(name), np.asarray(tensor), names, where) for name, tensor in tensors.items())


def _converted(name: str, tensor: np.ndarray, names: dict[str, str], where: str) -> tuple[str, np.ndarray]:
    for pattern, ours in names.items():
        match = re.fullmatch(rf"(?:module\.)?{pattern}(weight|bias)", name)
        if match is None:
            continue
        prefix = match.expand(ours)
        if match[match.re.groups] == "bias":
            return f"{prefix}bias", tensor
        if tensor.ndim < 2:
            return f"{prefix}scale", tensor
        # A convolution with a kernel of one is a matrix (output, input, 1, ..); ours map rows.
        return f"{prefix}kernel", tensor.reshape(tensor.shape[:2]).T
    raise ValueError(f"{where}: unknown tensor {name}: another network")


def _sampling(path: Path) -> tuple[tuple[PyramidStage, ...], float]:
    """The stages and the scale in metres that a published configuration tells; the paper's without one."""
    if not path.is_file():
        return PyramidConfig().stages, ModelConfig().scale_m
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
        encoder = settings["encoder"]
        lists = (encoder["npoint"], encoder["radius_list"], encoder["nsample_list"])
        stages = tuple(
            PyramidStage(num_points, tuple(map(float, radii)), _only(num_neighbours))
            for num_points, radii, num_neighbours in zip(*lists, strict=True)
        )
        return stages, float(settings.get("coordinate_scale", ModelConfig().scale_m))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not a configuration of DeepPointMap ({error})") from error


def _only(numbers: list[int]) -> int:
    if len(set(numbers)) != 1:
        raise ValueError(f"nsample_list: expected one number for all blocks of a stage, got {numbers}")
    return numbers[0]


def _derived_config(arrays: Tensors, stages: tuple[PyramidStage, ...], scale_m: float) -> ModelConfig:
    def count(pattern: str) -> int:
        return len({match[0] for name in arrays if (match := re.match(pattern, name))})

    num_stages = count(r"encoder\.stage_\d+")
    if num_stages != len(stages):
        raise ValueError(f"the checkpoint has {num_stages} stages, and {len(stages)} are configured")
    num_steps = count(r"encoder\.propagation_\d+")
    expand = arrays["encoder.stage_0.inverted_residual_0.expand.kernel"]
    encoder = EncoderConfig(
        stem_channels=arrays["encoder.stem.kernel"].shape[1],
        expansion=expand.shape[1] // expand.shape[0],
        output_channels=arrays[f"encoder.propagation_{num_steps - 1}.linear_1.kernel"].shape[1],
    )
    input_channels, model_channels = arrays["decoder.projection.kernel"].shape
    decoder = DecoderConfig(
        input_channels=input_channels, model_channels=model_channels, num_layers=count(r"decoder\.layer_\d+")
    )
    return ModelConfig(PyramidConfig(stages, num_steps), encoder, decoder, scale_m)
