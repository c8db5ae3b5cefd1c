"""Methods of SLAM whose map keeps fewer surface elements of a scan, for ablations; the scan itself keeps all."""

from __future__ import annotations

import jax
import numpy as np

from dpmjax.deeppointmap.compact_scans import CompactScan
from dpmjax.slam import Geometry, Matcher, SlamMethods, ThinnedScan


class _FewerOfKeyframes:
    """A matcher whose keyframes keep the first elements, in the order of farthest points, and their features."""

    def __init__(self, matcher: Matcher, num_elements: int) -> None:
        self._matcher, self._num = matcher, num_elements

    def __getattr__(self, name: str) -> object:
        return getattr(self._matcher, name)

    def encode(self, scan: ThinnedScan) -> CompactScan:
        whole = self._matcher.encode(scan)
        unit_m, *arrays = whole.elements
        elements = type(whole.elements)(unit_m, *(array[: self._num] for array in arrays))
        features, steps, directions = (
            array[: self._num] for array in (whole.features, whole.feature_steps, whole.directions)
        )
        return CompactScan(elements, features, steps, directions, whole.image)


class _FewerOfScans:
    """A geometry whose scans leave their first elements in the local map."""

    def __init__(self, geometry: Geometry, num_elements: int) -> None:
        self._geometry, self._num = geometry, num_elements

    def __getattr__(self, name: str) -> object:
        return getattr(self._geometry, name)

    def thin(self, points: np.ndarray) -> ThinnedScan | None:
        whole = self._geometry.thin(points)
        if whole is None:
            return None
        return whole._replace(elements=jax.tree.map(lambda array: array[: self._num], whole.elements))


def with_fewer_elements(methods: SlamMethods, num_elements: int) -> SlamMethods:
    """Returns methods whose map keeps at most `num_elements` surface elements of each scan."""
    matcher = _FewerOfKeyframes(methods.matcher, num_elements)
    return methods._replace(matcher=matcher, geometry=_FewerOfScans(methods.geometry, num_elements))
