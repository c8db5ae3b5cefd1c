"""The parts of SLAM: matcher, geometry and settings."""

from __future__ import annotations

from typing import NamedTuple

from dpmjax.slam.alignment import Geometry
from dpmjax.slam.config import MapOrigin, SlamConfig
from dpmjax.slam.matcher import Matcher


class SlamMethods(NamedTuple):
    """The parts of SLAM that are arguments.

    Attributes:
        matcher: recognises places and registers scans without a first guess.
        geometry: aligns a scan with recent ones.
        config: settings of all stages.
        weights: name of the weights, noted in the map; may be empty.
    """

    matcher: Matcher
    geometry: Geometry
    config: SlamConfig
    weights: str = ""

    @property
    def origin(self) -> MapOrigin:
        """The origin that maps of these methods note."""
        return MapOrigin(self.matcher.fingerprint, self.config, self.weights)
