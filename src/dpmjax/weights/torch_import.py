"""The published PyTorch checkpoints of DeepPointMap, read without PyTorch and without running code of the file.

A file that PyTorch saved is a ZIP archive of raw storages and one pickle that maps tensors to parts of storages. The
pickle may name only tensors and dictionaries; anything else is refused. Names of the tensors are mapped to ours, and
their shapes give the configuration.
"""

from __future__ import annotations

import io
import json
import math
import pickle
import re
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.geometry.pyramid import PyramidConfig, PyramidStage
from dpmjax.nets.decoder import DecoderConfig
from dpmjax.nets.point_encoder import EncoderConfig
from dpmjax.weights.model_file import model_from_arrays

Tensors = dict[str, np.ndarray]

# Each published name is one of these patterns and then `weight` or `bias`; `(\d+)` is carried over.
_RESIDUAL, _OUR_RESIDUAL = r"downsampler\.(\d+)\.irm\.(\d+)", r"stage_\1.inverted_residual_\2"
ENCODER_NAMES = {
    r"point_mlp0\.": "stem.",
    r"downsampler\.(\d+)\.sa\.mlp\.0\.": r"stage_\1.set_abstraction.",
    r"downsampler\.(\d+)\.sa\.mlp\.1\.ln\.": r"stage_\1.set_abstraction.norm_",
    rf"{_RESIDUAL}\.la\.mlp\.0\.": rf"{_OUR_RESIDUAL}.neighbourhood.",
    rf"{_RESIDUAL}\.la\.mlp\.1\.ln\.": rf"{_OUR_RESIDUAL}.neighbourhood.norm_",
    rf"{_RESIDUAL}\.pw_conv\.0\.": rf"{_OUR_RESIDUAL}.expand.",
    rf"{_RESIDUAL}\.pw_conv\.1\.ln\.": rf"{_OUR_RESIDUAL}.expand_norm.",
    rf"{_RESIDUAL}\.pw_conv\.3\.": rf"{_OUR_RESIDUAL}.contract.",
    rf"{_RESIDUAL}\.pw_conv\.4\.ln\.": rf"{_OUR_RESIDUAL}.contract_norm.",
    **{rf"upsampler\.(\d+)\.mlp\.{3 * i}\.": rf"propagation_\1.linear_{i}." for i in range(2)},
    **{rf"upsampler\.(\d+)\.mlp\.{3 * i + 1}\.ln\.": rf"propagation_\1.norm_{i}." for i in range(2)},
}
_LAYER, _OUR_LAYER = r"descriptor_attention\.(\d+)", r"layer_\1"
# Networks whose linear layers have the numbers 0, 2, 4 in the published files, and 0, 1, 2 here.
_SEQUENCES = {
    rf"{_LAYER}\.mlp": rf"{_OUR_LAYER}.network",
    "similarity_head": "similarity_head",
    "coarse_pairing_head": "coarse_head",
    r"offset_head\.mlp": "offset_head",
    r"loop_head\.mlp": "overlap_head.network",
    r"loop_head\.projection": "overlap_head.classifier",
}
DECODER_NAMES = {
    r"projection\.": "projection.",
    rf"{_LAYER}\.(self|cross)_attn\.in_proj_": rf"{_OUR_LAYER}.\2_attention.in_",
    rf"{_LAYER}\.(self|cross)_attn\.out_proj\.": rf"{_OUR_LAYER}.\2_attention.out.",
    **{
        rf"{_LAYER}\.norm{i}\.": rf"{_OUR_LAYER}.{name}_norm."
        for i, name in ((1, "self"), (2, "cross"), (3, "network"))
    },
    r"offset_head\.downsample\.": "offset_head.short_cut.",
    r"offset_head\.head\.": "offset_head.output.",
    **{rf"{theirs}\.{2 * i}\.": f"{ours}.linear_{i}." for theirs, ours in _SEQUENCES.items() for i in range(3)},
}

_CODES = {"Double": "<f8", "Float": "<f4", "Half": "<f2", "Long": "<i8", "Int": "<i4", "Short": "<i2"}
_CODES |= {"Char": "i1", "Byte": "u1", "Bool": "?"}
STORAGE_DTYPES = {f"{name}Storage": np.dtype(code) for name, code in _CODES.items()}
STORAGE_DTYPES["BFloat16Storage"] = np.dtype(jnp.bfloat16)


def import_torch_checkpoint(path: str | Path) -> Model:
    """Reads a model from a published checkpoint: `{"encoder": state_dict, "decoder": state_dict}`.

    The shapes of the tensors give widths, depths and numbers of blocks. Radii, numbers of points and numbers of
    neighbours come from a `config.json` beside the file: keys `npoint`, `radius_list`, `nsample_list` and
    `upsample_layers` under `encoder`, and `coordinate_scale`. Without that file they are those of the paper. Attention
    has eight heads.

    Args:
        path: the `.pth` file.

    Returns:
        The model, parameters in float32.

    Raises:
        ValueError: if the file cannot be read, or has another layout.
    """
    path = Path(path)
    content = read_torch_file(path)
    if not isinstance(content, dict) or not {"encoder", "decoder"} <= content.keys():
        raise ValueError(f"{path}: not a checkpoint of DeepPointMap: expected a dictionary of encoder and decoder")
    arrays: Tensors = {}
    for part, names in (("encoder", ENCODER_NAMES), ("decoder", DECODER_NAMES)):
        named = _renamed(content[part], names, f"{path}: {part}")
        arrays |= {f"{part}.{name}": array for name, array in named.items()}
    try:
        config = _derived_config(arrays, *_sampling(path.with_name("config.json")))
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}: {'lacks the tensor ' * isinstance(error, KeyError)}{error}") from error
    return model_from_arrays(arrays, config, str(path))


def _renamed(tensors: Any, names: dict[str, str], where: str) -> Tensors:
    if not isinstance(tensors, dict):
        raise ValueError(f"{where}: expected a dictionary of tensors, got {type(tensors).__name__}")
    renamed = {}
    for name, value in tensors.items():
        matches = ((re.fullmatch(rf"(?:module\.)?{theirs}(weight|bias)", str(name)), names[theirs]) for theirs in names)
        match, ours = next((found for found in matches if found[0]), (None, ""))
        if match is None:
            raise ValueError(f"{where}: unknown tensor {name}: another network")
        tensor = np.asarray(value)
        kind = "bias" if match[match.re.groups] == "bias" else "scale" if tensor.ndim < 2 else "kernel"
        # A convolution with a kernel of one is a matrix (output, input, 1, ..); ours map rows.
        renamed[f"{match.expand(ours)}{kind}"] = tensor.reshape(tensor.shape[:2]).T if kind == "kernel" else tensor
    return renamed


def _sampling(path: Path) -> tuple[tuple[PyramidStage, ...], float]:
    # The stages, and the scale in metres, of a published configuration; those of the paper without one.
    if not path.is_file():
        return PyramidConfig().stages, ModelConfig().scale_m
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
        lists = (settings["encoder"][key] for key in ("npoint", "radius_list", "nsample_list"))
        stages = []
        for num_points, radii, numbers in zip(*lists, strict=True):
            if len(set(numbers)) != 1:
                raise ValueError(f"nsample_list: expected one number for all blocks of a stage, got {numbers}")
            stages.append(PyramidStage(num_points, tuple(map(float, radii)), numbers[0]))
        return tuple(stages), float(settings.get("coordinate_scale", ModelConfig().scale_m))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not a configuration of DeepPointMap ({error})") from error


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
    inputs, width = arrays["decoder.projection.kernel"].shape
    decoder = DecoderConfig(input_channels=inputs, model_channels=width, num_layers=count(r"decoder\.layer_\d+"))
    pyramid = PyramidConfig(stages, num_steps)
    return ModelConfig(pyramid, encoder, decoder, scale_m, trained=("registration", "overlap"))


def read_torch_file(path: str | Path) -> Any:
    """Reads what `torch.save` wrote, since PyTorch 1.6.

    Args:
        path: the file.

    Returns:
        Dictionaries, lists and numbers, with NumPy arrays for tensors.

    Raises:
        ValueError: if the file is broken or holds other objects.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            (content,) = (name for name in archive.namelist() if name.endswith("/data.pkl"))
            root = content.removesuffix("data.pkl")
            if f"{root}byteorder" in archive.namelist() and archive.read(f"{root}byteorder") != b"little":
                raise ValueError("numbers are stored in big-endian order")
            return _TensorUnpickler(archive, root).load()
    except Exception as error:  # a broken pickle raises anything at all
        raise ValueError(f"{path}: not a checkpoint of PyTorch 1.6 or later that can be read ({error})") from error


class _TensorUnpickler(pickle.Unpickler):
    """Loads tensors and dictionaries, and refuses every other class or function."""

    def __init__(self, archive: zipfile.ZipFile, root: str) -> None:
        super().__init__(io.BytesIO(archive.read(f"{root}data.pkl")))
        self._archive, self._root = archive, root

    def find_class(self, module: str, name: str) -> Any:
        if module == "torch" and name in STORAGE_DTYPES:
            return name
        known = {
            ("collections", "OrderedDict"): OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2"): _tensor,
            ("torch._utils", "_rebuild_parameter"): lambda tensor, *_: tensor,
        }
        if (module, name) not in known:
            raise pickle.UnpicklingError(f"it holds a {module}.{name}, which is no tensor")
        return known[module, name]

    def persistent_load(self, pid: Any) -> np.ndarray:
        kind, storage_class, key, _, num_numbers = pid
        if kind != "storage" or storage_class not in STORAGE_DTYPES or not str(key).isalnum():
            raise pickle.UnpicklingError("a storage of an unknown kind")
        dtype = STORAGE_DTYPES[storage_class]
        content = self._archive.read(f"{self._root}data/{key}")
        if len(content) != num_numbers * dtype.itemsize:
            raise pickle.UnpicklingError(f"storage {key} has {len(content)} bytes for {num_numbers} numbers")
        return np.frombuffer(content, dtype)


def _tensor(storage: Any, offset: int, shape: tuple[int, ...], strides: tuple[int, ...], *_: Any) -> np.ndarray:
    # A tensor is a strided part of a storage, and must lie within it.
    is_storage = isinstance(storage, np.ndarray) and storage.ndim == 1
    if not is_storage or len(shape) != len(strides) or min((offset, *shape, *strides)) < 0:
        raise pickle.UnpicklingError("a tensor that is not part of a storage")
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    if math.prod(shape) > 0 and last >= storage.size:
        raise pickle.UnpicklingError("a tensor that reaches beyond its storage")
    byte_strides = tuple(stride * storage.itemsize for stride in strides)
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, byte_strides).copy()
