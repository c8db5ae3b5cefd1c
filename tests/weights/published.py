"""State dictionaries of the published layout, made up at any size, and files of them as PyTorch writes them."""

import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from dpmjax.deeppointmap import ModelConfig

Tensors = dict[str, np.ndarray]


def published_tensors(config: ModelConfig, seed: int = 0) -> dict[str, Tensors]:
    """{"encoder": tensors by name, "decoder": tensors by name}, random, of sizes that keep the size of features."""
    rng = np.random.default_rng(seed)
    shapes = {"encoder": _encoder_shapes(config), "decoder": _decoder_shapes(config)}

    def draw(name: str, shape: tuple[int, ...]) -> np.ndarray:
        values = rng.normal(size=shape)
        if len(shape) == 1:
            values = 0.1 * values + name.endswith(".weight")
        else:
            values /= np.sqrt(shape[1])
        return values.astype(np.float32)

    return {part: {name: draw(name, shape) for name, shape in named.items()} for part, named in shapes.items()}


def write_checkpoint(path: Path, tensors: dict[str, Tensors], config: ModelConfig) -> dict[str, Any]:
    """Writes tensors as `torch.save` does, and the published configuration beside it, which is returned."""
    with zipfile.ZipFile(path, "w") as file:
        content, number = b"", 0
        for part, named in tensors.items():
            of_part = b""
            for name, values in named.items():
                of_part += _pickled(name) + _pickled_tensor(values, str(number))
                file.writestr(f"archive/data/{number}", np.ascontiguousarray(values).tobytes())
                number += 1
            content += _pickled(part) + pickle.EMPTY_DICT + pickle.MARK + of_part + pickle.SETITEMS
        content = pickle.EMPTY_DICT + pickle.MARK + content + pickle.SETITEMS
        file.writestr("archive/data.pkl", pickle.PROTO + b"\x02" + content + pickle.STOP)
    stages = config.pyramid.stages
    encoder = {
        "npoint": [stage.num_points for stage in stages],
        "radius_list": [stage.radii for stage in stages],
        "nsample_list": [[stage.num_neighbours] * len(stage.radii) for stage in stages],
        "upsample_layers": config.pyramid.num_interpolations,
    }
    settings = {"encoder": encoder, "coordinate_scale": config.scale_m}
    path.with_name("config.json").write_text(json.dumps(settings))
    return settings


def _pickled(value: Any) -> bytes:
    """A pickle without its first two and its last byte, which stand once in a file."""
    return pickle.dumps(value, 2)[2:-1]


def _pickled_tensor(values: np.ndarray, key: str) -> bytes:
    """A call of the function that makes a tensor of a storage: offset, shape, strides, and two more arguments."""
    strides = tuple(step // values.itemsize for step in np.ascontiguousarray(values).strides)
    storage = _pickled("storage") + b"ctorch\nFloatStorage\n" + _pickled(key) + _pickled("cpu") + _pickled(values.size)
    hooks = b"ccollections\nOrderedDict\n" + pickle.EMPTY_TUPLE + pickle.REDUCE
    arguments = pickle.MARK + storage + pickle.TUPLE + pickle.BINPERSID + _pickled(0)
    arguments += _pickled(values.shape) + _pickled(strides) + pickle.NEWFALSE + hooks
    return b"ctorch._utils\n_rebuild_tensor_v2\n" + pickle.MARK + arguments + pickle.TUPLE + pickle.REDUCE


def _linear(name: str, num_in: int, num_out: int, num_ones: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (num_out, num_in, *[1] * num_ones), f"{name}.bias": (num_out,)}


def _norm(name: str, num: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (num,), f"{name}.bias": (num,)}


def _encoder_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    width, wider = config.encoder.stem_channels, config.encoder.expansion
    shapes = _linear("point_mlp0", 3, width, 1)
    for s, stage in enumerate(config.pyramid.stages):
        name = f"downsampler.{s}.sa.mlp"
        shapes |= _linear(f"{name}.0", width + 3, 2 * width, 2) | _norm(f"{name}.1.ln", 2 * width)
        width *= 2
        for b in range(len(stage.radii) - 1):
            name = f"downsampler.{s}.irm.{b}"
            shapes |= _linear(f"{name}.la.mlp.0", width + 3, width, 2) | _norm(f"{name}.la.mlp.1.ln", width)
            shapes |= _linear(f"{name}.pw_conv.0", width, wider * width, 1)
            shapes |= _norm(f"{name}.pw_conv.1.ln", wider * width)
            shapes |= _linear(f"{name}.pw_conv.3", wider * width, width, 1) | _norm(f"{name}.pw_conv.4.ln", width)
    for u in range(config.pyramid.num_interpolations):
        name = f"upsampler.{u}.mlp"
        shapes |= _linear(f"{name}.0", width + width // 2, width // 2, 1) | _norm(f"{name}.1.ln", width // 2)
        shapes |= _linear(f"{name}.3", width // 2, width // 2, 1) | _norm(f"{name}.4.ln", width // 2)
        width //= 2
    return shapes


def _decoder_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    narrow, width = config.decoder.input_channels, config.decoder.model_channels
    shapes = _linear("projection", narrow, width, 1)
    for layer in range(config.decoder.num_layers):
        name = f"descriptor_attention.{layer}"
        for kind in ("self", "cross"):
            shapes |= {f"{name}.{kind}_attn.in_proj_weight": (3 * width, width)}
            shapes |= {f"{name}.{kind}_attn.in_proj_bias": (3 * width,)}
            shapes |= _linear(f"{name}.{kind}_attn.out_proj", width, width, 0)
        shapes |= _linear(f"{name}.mlp.0", width, width, 0) | _linear(f"{name}.mlp.2", width, width, 0)
        for number in (1, 2, 3):
            shapes |= _norm(f"{name}.norm{number}", width)
    for name, num in (("similarity_head", width), ("coarse_pairing_head", narrow), ("loop_head.mlp", width)):
        shapes |= _linear(f"{name}.0", num, num, 1) | _linear(f"{name}.2", num, num, 1)
    shapes |= _linear("loop_head.projection.0", 2 * width, 2 * width, 0)
    shapes |= _linear("loop_head.projection.2", 2 * width, 1, 0)
    for number, (num_in, num_out) in enumerate(((2 * width, width), (width, width // 2), (width // 2, width // 4))):
        shapes |= _linear(f"offset_head.mlp.{2 * number}", num_in, num_out, 1)
    shapes |= _linear("offset_head.downsample", 2 * width, width // 4, 1)
    return shapes | _linear("offset_head.head", width // 4, 3, 1)
