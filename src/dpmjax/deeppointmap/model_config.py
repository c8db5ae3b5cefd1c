"""The configuration of a model, and its three presets."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from dpmjax.checks import require_one_of, require_positive, require_value
from dpmjax.deeppointmap.confidence import Calibration, LogisticModel
from dpmjax.deeppointmap.matching import MatchConfig
from dpmjax.geometry.consensus import ConsensusConfig
from dpmjax.geometry.pyramid import PyramidConfig, PyramidStage
from dpmjax.nets.decoder import DecoderConfig
from dpmjax.nets.point_encoder import EncoderConfig
from dpmjax.scan.lidar.compare import VerificationConfig
from dpmjax.scan.lidar.preprocess import PreprocessConfig

Preset = Literal["tiny", "small", "paper"]

# Stages of training (DeepPointMap section 3.3): descriptors and registration, then the overlap head.
Stage = Literal["registration", "overlap"]


@dataclass(frozen=True)
class ModelConfig:
    """Configuration of a model (defaults: DeepPointMap's published configuration).

    Attributes:
        pyramid: sampled points and neighbourhoods.
        encoder: widths of the encoder.
        decoder: widths of the decoder.
        scale_m: metres in one unit of the pyramid's normalised coordinates.
        preprocess: filters of raw scans, in training and inference alike.
        matching: choice of descriptor pairs and inliers.
        verification: verification of hypotheses by the scans, and the final alignment.
        calibration: calibration of the confidence; None where it was not fitted.
        overlap: model of the overlap probability; None where it was not fitted: the decoder's head predicts it.
        trained: stages of training that the parameters went through; those of others are as they began.
    """

    pyramid: PyramidConfig = field(default_factory=PyramidConfig)
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    scale_m: float = 60.0
    preprocess: PreprocessConfig = field(default_factory=PreprocessConfig)
    matching: MatchConfig = field(default_factory=MatchConfig)
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    calibration: Calibration | None = None
    overlap: LogisticModel | None = None
    trained: tuple[Stage, ...] = ()

    def __post_init__(self) -> None:
        require_positive("scale_m", self.scale_m)
        for stage in self.trained:
            require_one_of("trained", stage, get_args(Stage))
        inputs, outputs = self.decoder.input_channels, self.encoder.output_channels
        require_value(inputs == outputs, "decoder.input_channels", f"the encoder's output_channels {outputs}", inputs)

    @property
    def num_descriptors(self) -> int:
        """Number of descriptors of a scan."""
        return self.pyramid.stages[-1 - self.pyramid.num_interpolations].num_points


def model_preset(name: str) -> ModelConfig:
    """Returns the configuration of a preset.

    Args:
        name: "tiny" for trials on a CPU, "small" for real time, or "paper".

    Returns:
        The configuration.

    An unknown name raises a `ValueError`.
    """
    require_one_of("name", name, PRESETS)
    return PRESETS[name]


def _pyramid(
    num_points: tuple[int, ...], num_neighbours: tuple[int, ...], last_radii: tuple[float, ...]
) -> PyramidConfig:
    radii = ((0.05, 0.1), (0.1, 0.2), (0.2, 0.4), (0.4, 0.8), last_radii)
    return PyramidConfig(tuple(map(PyramidStage, num_points, radii, num_neighbours)))


# Without the offset head motions are as exact or better: docs/notebook/training_notes.md, "The offset head".
PRESETS: dict[str, ModelConfig] = {
    "tiny": ModelConfig(
        pyramid=_pyramid((1024, 512, 256, 64, 16), (16, 16, 16, 16, 8), (0.8,)),
        encoder=EncoderConfig(stem_channels=8, expansion=2, output_channels=64, frame="local"),
        decoder=DecoderConfig(
            input_channels=64, model_channels=64, num_heads=2, is_crossed=False, predicts_offsets=False
        ),
        preprocess=PreprocessConfig(capacity=4096),
        matching=MatchConfig(pair_ratio=2.0, consensus=ConsensusConfig()),
    ),
    "small": ModelConfig(
        pyramid=_pyramid((1536, 512, 256, 64, 16), (16, 16, 16, 16, 16), (0.8, 1.6)),
        encoder=EncoderConfig(stem_channels=16, expansion=2, output_channels=128, frame="local"),
        decoder=DecoderConfig(input_channels=128, model_channels=128, num_heads=4, predicts_offsets=False),
        matching=MatchConfig(pair_ratio=2.0, consensus=ConsensusConfig()),
    ),
    "paper": ModelConfig(),
}
