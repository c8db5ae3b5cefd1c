"""Settings of our SLAM by name: the default, the paper's method, and parts left out (DeepPointMap, Table 2)."""

from __future__ import annotations

from dataclasses import replace

from dpmjax import Model, slam

WHOLE, NETWORK, PAPER = "whole", "network proposes every pose", "paper"
PAPER_WIDE, WIDE_M = "paper, errors up to 2.5 m", 2.5
NEAREST, NO_OFFSETS = "features of the nearest keyframe alone", ", without the offset head"
SETTINGS = (
    WHOLE,
    NEAREST,
    PAPER,
    *(f"{proposer}{offsets}" for proposer in (NETWORK, PAPER_WIDE) for offsets in ("", NO_OFFSETS)),
)


def make_setting(model: Model, setting: str) -> slam.SlamMethods:
    """Returns the methods of one of `SETTINGS`.

    "paper" is section 4 by its own method, with the published limits; "paper, errors up to 2.5 m" has the limit of the
    error that suits the shipped weights.
    """
    if setting.endswith(NO_OFFSETS):
        decoder = replace(model.config.decoder, predicts_offsets=False)
        model = replace(model, config=replace(model.config, decoder=decoder))
    config, setting = slam.SlamConfig(), setting.removesuffix(NO_OFFSETS)
    if setting == NETWORK:
        config = replace(config, odometry=replace(config.odometry, proposer="network"))
    if setting == NEAREST:
        config = replace(config, front_end=replace(config.front_end, num_submap=1))
    if setting in (PAPER, PAPER_WIDE):
        limits = slam.DescriptorConfig() if setting == PAPER else slam.DescriptorConfig(max_rmse_m=WIDE_M)
        config = replace(slam.slam_preset("paper"), descriptors=limits)
    return slam.make_methods(model, config)
