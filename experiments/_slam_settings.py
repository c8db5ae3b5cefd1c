"""Settings of our SLAM by name: the default, the paper's method, and parts left out (DeepPointMap, Table 2)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from dpmjax import Model, scans, slam

NUM_ELEMENTS = (64, 128, 256, 512, 1024)
WHOLE, NETWORK, PAPER = "whole", "network proposes every pose", "paper"
PAPER_WIDE, WIDE_M = "paper, errors up to 2.5 m", 2.5
NEAREST, NO_OFFSETS = "features of the nearest keyframe alone", ", without the offset head"
SETTINGS = (
    WHOLE,
    NEAREST,
    *(f"{num} elements" for num in NUM_ELEMENTS),
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
    if setting.endswith("elements"):
        return with_fewer_elements(model, int(setting.split()[0]))
    if setting == NETWORK:
        config = replace(config, odometry=replace(config.odometry, proposer="network"))
    if setting == NEAREST:
        config = replace(config, front_end=replace(config.front_end, num_submap=1))
    if setting in (PAPER, PAPER_WIDE):
        limits = slam.DescriptorConfig() if setting == PAPER else slam.DescriptorConfig(max_rmse_m=WIDE_M)
        config = replace(slam.slam_preset("paper"), descriptors=limits)
    return slam.make_methods(model, config)


def with_fewer_elements(model: Model, num_elements: int) -> slam.SlamMethods:
    """Returns methods whose scans and keyframes have at most `num_elements` surface elements.

    Fewer elements of the same surface are farther apart, by the root of the ratio: radii of odometry grow with it.
    """
    factor = max(math.sqrt(model.config.pyramid.stages[0].num_points / num_elements), 1.0)
    whole = slam.make_methods(model)

    def encode(scan: scans.Scan) -> Any:
        """Returns a keyframe with its first elements, in the order of farthest points, and their features."""
        compact = whole.matcher.encode(scan)
        unit_m, *arrays = compact.elements
        elements = type(compact.elements)(unit_m, *(array[:num_elements] for array in arrays))
        described = {
            name: getattr(compact, name)[:num_elements] for name in ("features", "feature_steps", "directions")
        }
        return compact._replace(elements=elements, **described)

    def thin(points: np.ndarray) -> scans.Scan | None:
        """Returns a scan with its first elements only."""
        scan = whole.geometry.thin(points)
        if scan is None:
            return None
        surface = scan.surface
        # Normals are those of all points, as in a keyframe.
        first = {name: getattr(surface, name)[:num_elements] for name in ("points", "normals", "flatness")}
        samples, tree = surface.samples[surface.samples < num_elements], type(surface.tree)(first["points"])
        few = surface._replace(**first, samples=samples, tree=tree)
        return scan._replace(surface=few)

    matcher = _Replaced(whole.matcher, encode=encode)
    geometry = _Replaced(slam.SurfaceGeometry(model.config, spacing=factor), thin=thin)
    return whole._replace(matcher=matcher, geometry=geometry)


class _Replaced:
    """A matcher or a geometry of which some functions are replaced."""

    def __init__(self, wrapped: Any, **functions: Callable[..., Any]) -> None:
        self._wrapped = wrapped
        vars(self).update(functions)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._wrapped, name)
