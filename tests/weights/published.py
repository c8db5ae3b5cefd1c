"""State dictionaries of the published layout, made up at any size: names and shapes as the checkpoints have them."""

from __future__ import annotations

import numpy as np

from dpmjax.deeppointmap import ModelConfig

Tensors = dict[str, np.ndarray]


def published_tensors(config: ModelConfig, seed: int = 0) -> dict[str, Tensors]:
    """{"encoder": tensors by name, "decoder": tensors by name}, random."""
    rng = np.random.default_rng(seed)
    shapes = {"encoder": _encoder_shapes(config), "decoder": _decoder_shapes(config)}
    return {
        part: {name: rng.normal(size=shape).astype(np.float32) for name, shape in named.items()}
        for part, named in shapes.items()
    }


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
    shapes |= _linear("loop_head.projection.0", 2 * width, 2 * width, 0) | _linear(
        "loop_head.projection.2", 2 * width, 1, 0
    )
    for number, (num_in, num_out) in enumerate(((2 * width, width), (width, width // 2), (width // 2, width // 4))):
        shapes |= _linear(f"offset_head.mlp.{2 * number}", num_in, num_out, 1)
    shapes |= _linear("offset_head.downsample", 2 * width, width // 4, 1)
    return shapes | _linear("offset_head.head", width // 4, 3, 1)
