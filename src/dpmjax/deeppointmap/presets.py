"""Models of three sizes: one to try things on a CPU, one for real time, and the paper's."""

from __future__ import annotations

from typing import Literal

from dpmjax.deeppointmap.matching import MatchConfig
from dpmjax.deeppointmap.model import ModelConfig
from dpmjax.geometry.consensus import ConsensusConfig
from dpmjax.geometry.pyramid import PyramidConfig, PyramidStage
from dpmjax.nets.decoder import DecoderConfig
from dpmjax.nets.point_encoder import EncoderConfig
from dpmjax.scans.preprocess import PreprocessConfig

Preset = Literal["tiny", "small", "paper"]

PRESETS: dict[Preset, ModelConfig] = {
    "tiny": ModelConfig(
        pyramid=PyramidConfig(
            stages=(
                PyramidStage(1024, (0.05, 0.1), 16),
                PyramidStage(512, (0.1, 0.2), 16),
                PyramidStage(256, (0.2, 0.4), 16),
                PyramidStage(64, (0.4, 0.8), 16),
                PyramidStage(16, (0.8,), 8),
            )
        ),
        encoder=EncoderConfig(stem_channels=8, expansion=2, output_channels=64, frame="bearing"),
        decoder=DecoderConfig(input_channels=64, model_channels=64, num_heads=2),
        preprocess=PreprocessConfig(capacity=4096),
        matching=MatchConfig(consensus=ConsensusConfig()),
    ),
    "small": ModelConfig(
        pyramid=PyramidConfig(
            stages=(
                PyramidStage(2048, (0.05, 0.1), 24),
                PyramidStage(768, (0.1, 0.2), 24),
                PyramidStage(256, (0.2, 0.4), 24),
                PyramidStage(64, (0.4, 0.8), 24),
                PyramidStage(16, (0.8, 1.6), 16),
            )
        ),
        encoder=EncoderConfig(stem_channels=16, expansion=2, output_channels=128, frame="bearing"),
        decoder=DecoderConfig(input_channels=128, model_channels=128),
        matching=MatchConfig(consensus=ConsensusConfig()),
    ),
    "paper": ModelConfig(),
}
"""By name; `paper` is the published configuration."""


def model_preset(name: str) -> ModelConfig:
    """The configuration of a preset.

    Raises:
        ValueError: no preset has this name.
    """
    for preset, config in PRESETS.items():
        if preset == name:
            return config
    raise ValueError(f"name: expected one of {', '.join(PRESETS)}, got {name!r}")
