"""Methods of SLAM for ablations: maps of fewer surface elements, and descriptors without surface elements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dpmjax import Model
from dpmjax.scans import surface_at
from dpmjax.slam import (
    Alignment,
    Geometry,
    LocalMap,
    Match,
    Matcher,
    SlamConfig,
    SlamMethods,
    Submap,
    ThinnedScan,
    make_methods,
)


def with_network(methods: SlamMethods) -> SlamMethods:
    """Returns methods whose decoder is the source of every first guess."""
    odometry = replace(methods.config.odometry, proposer="network")
    return methods._replace(config=replace(methods.config, odometry=odometry))


def with_fewer_elements(model: Model, num_elements: int) -> SlamMethods:
    """Returns methods whose scans and keyframes have at most `num_elements` surface elements.

    Fewer elements of the same surface are farther apart, by the root of the ratio: radii of odometry grow with it.
    """
    factor = max(math.sqrt(model.config.pyramid.stages[0].num_points / num_elements), 1.0)
    whole = make_methods(model, _with_wider_radii(SlamConfig(), factor))
    matcher = _FewerOfKeyframes(whole.matcher, num_elements)
    return whole._replace(matcher=matcher, geometry=_FewerOfScans(whole.geometry, num_elements))


def _with_wider_radii(config: SlamConfig, factor: float) -> SlamConfig:
    def wider(alignment: Any) -> Any:
        levels = (replace(level, radius_m=factor * level.radius_m) for level in alignment.levels)
        return replace(alignment, levels=tuple(levels))

    odometry = config.odometry
    radius_m = factor * odometry.plane_radius_m
    odometry = replace(odometry, narrow=wider(odometry.narrow), wide=wider(odometry.wide), plane_radius_m=radius_m)
    return replace(config, odometry=odometry)


def without_elements(methods: SlamMethods) -> SlamMethods:
    """Returns methods without surface elements: each pose and each loop stays as the decoder proposes it."""
    loops = methods.config.loops
    information = np.diag(np.repeat([loops.sigma_m**-2.0, loops.sigma_rad**-2.0], 3))
    geometry = _Unmoved(methods.geometry, information)
    return with_network(methods._replace(matcher=_DecoderAlone(methods.matcher), geometry=geometry))


class _Wrapped:
    """A matcher or a geometry of which some functions are replaced."""

    def __init__(self, wrapped: Any) -> None:
        self._wrapped = wrapped

    def __getattr__(self, name: str) -> Any:
        return getattr(self._wrapped, name)


class _FewerOfKeyframes(_Wrapped):
    """A matcher whose keyframes keep the first elements, in the order of farthest points, and their features."""

    def __init__(self, matcher: Matcher, num_elements: int) -> None:
        super().__init__(matcher)
        self._num = num_elements

    def encode(self, scan: ThinnedScan) -> Any:
        whole = self._wrapped.encode(scan)
        unit_m, *arrays = whole.elements
        elements = type(whole.elements)(unit_m, *(array[: self._num] for array in arrays))
        described = {name: getattr(whole, name)[: self._num] for name in ("features", "feature_steps", "directions")}
        return whole._replace(elements=elements, **described)


class _FewerOfScans(_Wrapped):
    """A geometry whose scans have their first elements only."""

    def __init__(self, geometry: Geometry, num_elements: int) -> None:
        super().__init__(geometry)
        self._num = num_elements

    def thin(self, points: np.ndarray) -> ThinnedScan | None:
        whole = self._wrapped.thin(points)
        if whole is None:
            return None
        points = whole.measured.surface.points
        few = surface_at(points, np.arange(min(self._num, len(points))))
        return whole._replace(measured=whole.measured._replace(surface=few))


class _Unmoved(_Wrapped):
    """A geometry that returns the first of the given poses and accepts it."""

    def __init__(self, geometry: Geometry, information: np.ndarray) -> None:
        super().__init__(geometry)
        self._information = information

    def align(self, local_map: LocalMap, scan: ThinnedScan, T_map_scan: np.ndarray) -> Alignment:
        return Alignment(T_map_scan, 1.0, 0.0, 1.0, self._information)

    def search(self, local_map: LocalMap, scan: ThinnedScan, T_map_scan: np.ndarray) -> Alignment:
        return self.align(local_map, scan, T_map_scan[0])


class _DecoderAlone(_Wrapped):
    """A matcher that registers the central scans of submaps by their descriptors, and verifies nothing."""

    def register(self, pairs: Sequence[tuple[Submap, Submap]]) -> list[Match]:
        proposals = [self._wrapped.propose(source.scans[0], target.scans[0], 1) for source, target in pairs]
        return [Match(proposal.T_target_source[0], proposal.probability, np.nan) for proposal in proposals]
