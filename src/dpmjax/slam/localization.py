"""Re-localisation: finds single scans in a map without a first guess, or reports that they are not in it.

The scan is registered with the most similar keyframes one by one. Registrations that put the scan at the same place
support each other, because two wrong ones rarely agree. Then the keyframes near that place are registered, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dpmjax.checks import require_fields, runs_on_host
from dpmjax.deeppointmap.compact_scans import CompactScan
from dpmjax.deeppointmap.model import Model
from dpmjax.geometry.se3 import are_near, orthonormal
from dpmjax.reading import read_path
from dpmjax.slam.interfaces import Match, SlamMethods
from dpmjax.slam.keyframe_map import KeyframeMap, Submap, measured_parts, submap_around, with_origin
from dpmjax.slam.loop_closure import most_similar
from dpmjax.slam.model_methods import methods_for
from dpmjax.slam.system import corrected_points
from dpmjax.types import AnyArray, Pose, with_short_repr

# Largest turn between registrations that agree.
SAME_PLACE_RAD = 0.06

# Largest distance between registrations that agree.
SAME_PLACE_M = 1.5

# Numbers of keyframes by retrieval whose overlap is estimated, and of those that are registered: more find more scans,
# slower. Number of registrations that must end at the same place; one suffices if no other keyframe is near.
NUM_SIMILAR, NUM_REGISTERED, MIN_SUPPORT = 16, 8, 2

# Number of registrations at a time; further ones follow only while the place is not clear.
NUM_AT_ONCE = 2

# Number of further keyframes near the best place that are registered.
NUM_NEIGHBOURS = 2

# Scans agree up to this share of points in free space.
MAX_CONTRADICTED_SHARE = 0.1

# Scans agree from this share of points that meet planes on.
MIN_MATCHED_SHARE = 0.35

LocalizationStatus = Literal["found", "not in this map", "empty"]


@dataclass(frozen=True)
class LocalizationConfig:
    """Limit of acceptance.

    Attributes:
        min_best: smallest P(correct) of the best registration of a place. Streets look alike, so several registrations
            may agree on a wrong place. A high limit rejects such places.
    """

    min_best: float = 0.98

    def __post_init__(self) -> None:
        require_fields(self, "min_best", low=0, high=1)


class KeyframeMatch(NamedTuple):
    """One registration of the scan.

    Attributes:
        keyframe: row of the keyframe.
        T_world_scan: pose of the scan by this registration.
        match: the registration.
        do_scans_agree: True if enough points meet planes, and few lie in free space.
    """

    keyframe: int
    T_world_scan: Pose
    match: Match
    do_scans_agree: bool


@with_short_repr
class Localization(NamedTuple):
    """Result of `localize`.

    Attributes:
        status: "found", "not in this map", or "empty": the scan has too few points.
        T_world_scan: pose in the frame of the map, see `part`; None if the scan was not found.
        probability: P(correct) of the place; 0 if the scan was not found.
        keyframe: row of the keyframe of the most probable registration; None if the scan was not found.
        reason: the numbers that decided.
        evidence: all registrations.
        part: number of the part of the map that holds the pose (`measured_parts`). Only part 0 has the frame of the
            map. The relative pose of a part that no loop joins to it is a guess.
    """

    status: LocalizationStatus
    T_world_scan: Pose | None
    probability: float
    keyframe: int | None
    reason: str
    evidence: tuple[KeyframeMatch, ...] = ()
    part: int = 0

    @property
    def is_in_map(self) -> bool:
        """True where the scan was found."""
        return self.status == "found"


@runs_on_host("call encode_pyramid, correlate and icp there")
def localize(
    model: Model | SlamMethods,
    slam_map: KeyframeMap | str | Path,
    scan: Float[AnyArray, "n 3"] | str | Path,
    config: LocalizationConfig | None = None,
) -> Localization:
    """Finds a scan in a map without a first guess.

    Args:
        model: the model that made the map; or methods of your own.
        slam_map: map from `load_map` or of a run, or its file.
        scan: points in metres, in the frame of the lidar, or their file; points that are not finite are dropped.
        config: number of registrations and limits of acceptance; None takes the defaults.

    Returns:
        The result; its pose is None if the scan is not in the map.

    Raises:
        ValueError: if the shape is not (n, 3), the map is empty, or it was made with other weights.
    """
    (found,) = localize_each(model, read_path(slam_map, "saved_maps.load_map"), [scan], config)
    return found


def localize_each(
    model: Model | SlamMethods,
    slam_map: KeyframeMap,
    scans: Iterable[Float[AnyArray, "_n 3"] | str | Path],
    config: LocalizationConfig | None = None,
) -> Iterator[Localization]:
    """Finds scans in a map, each by itself.

    Args:
        model: see `localize`.
        slam_map: see `localize`.
        scans: points of each; any iterable.
        config: see `localize`.

    Yields:
        One result a scan.

    Raises:
        ValueError: see `localize`.
    """
    methods = methods_for(model, slam_map)
    if slam_map.origin is None:
        raise ValueError("slam_map: expected keyframes, got an empty map")
    search = _Search(methods, slam_map, config or LocalizationConfig(), measured_parts(slam_map))
    with_origin(slam_map, search.methods.origin)
    yield from map(search.localized, scans)


# Registrations that agree, the most probable first.
Place = tuple[KeyframeMatch, ...]


class _Search(NamedTuple):
    # The map, the settings of the search in it, and the part of each keyframe.
    methods: SlamMethods
    slam_map: KeyframeMap
    config: LocalizationConfig
    parts: Int[np.ndarray, " k"]

    def localized(self, scan: Float[AnyArray, "_n 3"] | str | Path) -> Localization:
        """Registers the scan with keyframes until the place is clear, or no keyframe remains."""
        thinned = self.methods.geometry.thin(corrected_points(scan, None))
        if thinned is None:
            return Localization("empty", None, 0.0, None, "too few points")
        compact, extent_m = self.methods.matcher.encode(thinned), thinned.extent_m
        rows, tried = self._candidates(compact), list[KeyframeMatch]()
        for start in range(0, len(rows), NUM_AT_ONCE):
            tried += self._registered(rows[start : start + NUM_AT_ONCE], compact, tried)
            places = self._places(tried)
            if places and not self._is_supported(places[0], MIN_SUPPORT):
                apart_m = self._distances(places[0][0].T_world_scan, places[0][0].keyframe)
                done = [one.keyframe for one in tried]
                nearest = [row for row in np.argsort(apart_m, kind="stable").tolist() if apart_m[row] <= extent_m]
                near = [row for row in nearest if row not in done][:NUM_NEIGHBOURS]
                tried += self._registered(near, compact, tried)
            found = self._decided(tried, extent_m)
            if found.status == "found":
                break
        return found

    def _candidates(self, compact: CompactScan) -> list[int]:
        """Returns the keyframes to register, the most probable overlap first."""
        matcher = self.methods.matcher
        vector = matcher.vector(compact)
        vector = vector / max(float(np.linalg.norm(vector)), 1e-12)
        rows, _ = most_similar(self.slam_map.vectors, vector, NUM_SIMILAR)
        overlaps = matcher.overlaps(compact, [self.slam_map.keyframes[row].compact for row in rows])
        return rows[np.argsort(-overlaps, kind="stable")[:NUM_REGISTERED]].tolist()

    def _registered(self, rows: list[int], compact: CompactScan, tried: list[KeyframeMatch]) -> list[KeyframeMatch]:
        """Registers the scan with the keyframes that were not tried before."""
        rows = [row for row in rows if row not in [one.keyframe for one in tried]]
        source, targets = Submap((compact,), np.eye(4)[None]), [submap_around(self.slam_map, row, 1) for row in rows]
        matches = self.methods.matcher.register([(source, target) for target in targets]) if rows else []
        T_world = self.slam_map.T_world_keyframe
        return [
            KeyframeMatch(row, orthonormal(T_world[row] @ match.T_target_source), match, _do_scans_agree(match))
            for row, match in zip(rows, matches, strict=True)
        ]

    def _places(self, tried: list[KeyframeMatch]) -> list[Place]:
        """Groups registrations around the most probable ones whose scans agree; the most probable place first."""
        # Few points meet planes of a distant keyframe, so its registration only needs to end at the same place.
        left = sorted(tried, key=lambda one: -one.match.probability)
        # A registration supports a place from this P(correct) on, if the scans agree.
        left = [one for one in left if one.match.probability >= 0.2]
        places = []
        while first := next((one for one in left if one.do_scans_agree), None):
            others = [one for one in left if one is not first and self._agree(first, one)]
            places.append((first, *others))
            left = [one for one in left if not any(one is member for member in places[-1])]
        return sorted(places, key=lambda place: -_total(place))

    def _agree(self, one: KeyframeMatch, other: KeyframeMatch) -> bool:
        is_one_frame = self.parts[one.keyframe] == self.parts[other.keyframe]
        return bool(is_one_frame) and are_near(one.T_world_scan, other.T_world_scan, SAME_PLACE_M, SAME_PLACE_RAD)

    def _distances(self, T_world: Pose, keyframe: int) -> Float[np.ndarray, " k"]:
        """Returns the distances of all keyframes to a pose in the part of a keyframe; infinite in other parts."""
        return np.where(self.parts == self.parts[keyframe], self.slam_map.distances_to(T_world[:3, 3]), np.inf)

    def _is_supported(self, place: Place, min_support: int) -> bool:
        return len(place) >= min_support and place[0].match.probability >= self.config.min_best

    def _decided(self, tried: list[KeyframeMatch], extent_m: float) -> Localization:
        places, evidence = self._places(tried), tuple(tried)
        if not places:
            highest = max((one.match.probability for one in tried), default=0.0)
            return Localization("not in this map", None, 0.0, None, f"best P {highest:.2f} of {len(tried)}", evidence)
        best, total, rival = places[0], _total(places[0]), _total(places[1]) if len(places) > 1 else 0.0
        first, probability = best[0], best[0].match.probability
        numbers = f"{len(best)} of {len(tried)} agree, P {probability:.2f}, sum {total:.2f}, next place {rival:.2f}"
        # Measured from the keyframe: a wrong pose beside the map would have no keyframe near it, either.
        around_m = self._distances(self.slam_map.T_world_keyframe[first.keyframe], first.keyframe)
        is_alone = int((around_m <= extent_m).sum()) <= 1
        is_supported = self._is_supported(best, 1 if is_alone else MIN_SUPPORT)
        # Largest sum of probabilities of a second place, as a share of the sum of the best place.
        if not is_supported or rival > 0.5 * total:
            return Localization("not in this map", None, 0.0, None, numbers, evidence)
        part = int(self.parts[first.keyframe])
        return Localization("found", first.T_world_scan, probability, first.keyframe, numbers, evidence, part)


def _do_scans_agree(match: Match) -> bool:
    shares = match.verification
    return shares is None or (
        shares.matched_share >= MIN_MATCHED_SHARE and shares.contradicted_share <= MAX_CONTRADICTED_SHARE
    )


def _total(place: Place) -> float:
    return sum(member.match.probability for member in place)
