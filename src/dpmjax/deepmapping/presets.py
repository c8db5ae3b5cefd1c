"""Presets of DeepMapping: phases and networks of planar scans, of depth images and of lidar clouds."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from dpmjax.checks import require_one_of
from dpmjax.deepmapping.config import (
    LOCALIZE,
    REFINE,
    ChamferComparison,
    DeepMappingConfig,
    Motion,
    PhaseConfig,
    PlaneComparison,
    ProjectiveComparison,
)
from dpmjax.nets.mapping import LocalizationNetConfig, OccupancyConfig

# M-Net of the fast presets in space.
_SPATIAL_GRID = OccupancyConfig(kind="grid", resolutions=(8, 16, 32, 64))

# Phase of the paper: 3000 epochs of two batches for 256 scans, all beams, 19 free samples, gamma 0.1, windows of 4.
JOINT = PhaseConfig(
    name="L-Net and M-Net",
    poses="network",
    num_steps=6000,
    occupancy_weight=0.1,
    learning_rate=1e-3,
    scans_per_step=128,
    beams_per_step=1 << 30,
    num_free=19,
    is_sampled_as_published=True,
)

# Cold start of depth images.
LOCALIZE_DEPTH = replace(
    LOCALIZE, num_steps=400, learning_rate=1e-3, beams_per_step=400, num_offsets=2, max_offset=3, scans_per_window=None
)

# Free poses of depth images; the decreasing limit of the Chamfer distance removes its bias at low overlap.
UNROLL_DEPTH = replace(
    LOCALIZE_DEPTH,
    name="free poses, Chamfer",
    poses="free",
    num_steps=300,
    learning_rate=1e-2,
    final_learning_rate=0.02,
    comparison=ChamferComparison(limit=(0.5, 0.05)),
)

# Free poses and a map that sharpens from coarse to fine. The Chamfer distance is biased by the spacing of the pixels
# and by points that only one image has observed; the comparison by projection is not.
REFINE_DEPTH = replace(
    REFINE,
    name="free poses and map",
    num_steps=150,
    occupancy_weight=0.1,
    learning_rate=2e-3,
    beams_per_step=200,
    num_offsets=3,
    max_offset=1 << 30,
    surface_distance=(0.05, 0.01),
    comparison=ProjectiveComparison(tolerance=(0.05, 0.005)),
)

# Phase of the paper for depth images: all pixels, 35 free samples on each ray, gamma 0.9, comparison of neighbours.
JOINT_DEPTH = replace(
    JOINT, num_steps=3000, occupancy_weight=0.9, scans_per_step=256, num_offsets=1, max_offset=1, num_free=35
)

# Cold start of clouds.
LOCALIZE_CLOUDS = replace(
    LOCALIZE, num_steps=300, learning_rate=1e-3, beams_per_step=256, num_offsets=2, max_offset=3, scans_per_window=None
)

# Free poses of clouds, as `UNROLL_DEPTH`.
UNROLL_CLOUDS = replace(UNROLL_DEPTH, num_steps=200, beams_per_step=256, scans_per_step=64)

# Free poses, planes and a map that sharpens from coarse to fine. The Chamfer distance aligns the sparse rings of two
# scans; the distance to the plane between the rings does not.
REFINE_CLOUDS = replace(
    REFINE,
    name="free poses, planes and map",
    num_steps=300,
    occupancy_weight=0.1,
    learning_rate=2e-3,
    final_learning_rate=0.01,
    scans_per_step=64,
    beams_per_step=128,
    num_offsets=3,
    max_offset=8,
    surface_distance=(0.05, 0.01),
    comparison=PlaneComparison(width=(0.04, 0.002)),
)

# Losses and sampling of the paper, for clouds.
JOINT_CLOUDS = replace(JOINT, num_steps=3000, scans_per_step=64, beams_per_step=2048)


_FAST: dict[str, DeepMappingConfig] = {
    "planar": DeepMappingConfig(),
    "depth": DeepMappingConfig(
        cold_phases=(LOCALIZE_DEPTH, UNROLL_DEPTH, REFINE_DEPTH),
        warm_phases=(REFINE_DEPTH,),
        localization=LocalizationNetConfig(features=(32, 64, 128), strides=(2, 2, 1), hidden=(128, 64)),
        occupancy=_SPATIAL_GRID,
        steps_per_call=50,
        map_margin=1.2,
    ),
    "clouds": DeepMappingConfig(
        cold_phases=(LOCALIZE_CLOUDS, UNROLL_CLOUDS, REFINE_CLOUDS),
        warm_phases=(REFINE_CLOUDS,),
        localization=LocalizationNetConfig(kind="point", features=(32, 64, 128), hidden=(128, 64)),
        occupancy=_SPATIAL_GRID,
        map_margin=1.05,
        motion="full",
    ),
}
# Phase and L-Net of the paper for each sensor.
_PAPER = {
    "planar": (JOINT, LocalizationNetConfig()),
    "depth": (JOINT_DEPTH, LocalizationNetConfig(features=(64, 128, 256, 1024), strides=(1,) * 4)),
    "clouds": (JOINT_CLOUDS, LocalizationNetConfig(kind="point")),
}


def preset(
    name: Literal["fast", "paper"],
    sensor: Literal["planar", "depth", "clouds"] = "planar",
    *,
    motion: Motion = "planar",
    is_organised: bool = True,
) -> DeepMappingConfig:
    """Returns the settings of a preset.

    Args:
        name: "fast" (seconds to a minute on two cores) or "paper" (its networks, losses and sampling).
        sensor: "planar" scans, "depth" images or lidar "clouds".
        motion: degrees of freedom of a depth camera.
        is_organised: False for planar scans whose beams have no order; L-Net is a PointNet then.

    Returns:
        The settings.

    Raises:
        ValueError: the name or the sensor is unknown.
    """
    require_one_of("preset", name, ("fast", "paper"))
    require_one_of("sensor", sensor, _FAST)
    config = _FAST[sensor]
    if sensor == "depth":
        config = replace(config, motion=motion)
    if name == "paper":
        phase, net = _PAPER[sensor]
        config = replace(config, cold_phases=(phase,), warm_phases=(phase,), steps_per_call=1)
        config = replace(config, localization=net, occupancy=OccupancyConfig())
    elif sensor == "depth" and motion == "full":
        # Real depth images in SE(3) do not agree to half a percent of the depth, and initial poses are less accurate.
        refine = replace(REFINE_DEPTH, comparison=ProjectiveComparison(tolerance=(0.1, 0.02)))
        config = replace(config, cold_phases=(*config.cold_phases[:-1], refine), warm_phases=(refine,))
    if not is_organised:
        config = replace(config, localization=replace(config.localization, kind="point"))
    return config
