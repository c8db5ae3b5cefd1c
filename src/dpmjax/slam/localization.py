"""Re-localisation: single scans are found in a map without a first guess, or are said not to be in it.

The keyframes that look most alike are registered one by one. Registrations that put the scan at the same place support
each other: two wrong ones hardly ever do. Then the neighbours of that place are registered too.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.checks import require_fields
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.prepared_scans import CompactScan
from dpmjax.slam.interfaces import Match, SlamMethods
from dpmjax.slam.keyframes import (
    KeyframeMap,
    Pose,
    Submap,
    are_near,
    distances_to,
    orthonormal,
    submap_around,
    with_origin,
)
from dpmjax.slam.loop_consistency import scans_agree
from dpmjax.slam.retrieval import most_similar
from dpmjax.slam.system import make_methods
from dpmjax.types import AnyArray

MAX_RIVAL_SHARE = 0.5
"""Largest sum of probabilities of a second place, as a share of that of the best one."""

SAME_PLACE_RAD = 0.06
"""Largest turn between registrations that agree."""

SAME_PLACE_M = 1.5
"""Largest distance between registrations that agree."""

NUM_AT_ONCE = 2
"""Number of registrations at a time; the next ones follow only where the place is not clear."""

LocalizationStatus = Literal["found", "not in this map", "empty"]


@dataclass(frozen=True)
class LocalizationConfig:
    """Number of registrations, and limits from which on a place is accepted.

    Attributes:
        num_similar: number of keyframes by retrieval whose overlap is estimated.
        num_registered: largest number of them that are registered, in order of their overlap.
        num_neighbours: number of further keyframes near the best place that are registered.
        num_submap: number of keyframes whose descriptors are merged for a registration.
        min_probability: a registration supports a place from this P(correct) on, if the scans agree.
        min_support: number of registrations that must end at the same place; the scans of at least one must agree. One
            registration suffices where no other keyframe is near.
        min_best: smallest P(correct) of the best registration of a place. Streets look alike: several may agree on a
            wrong place.
    """

    num_similar: int = 16
    num_registered: int = 8
    num_neighbours: int = 2
    num_submap: int = 1
    min_probability: float = 0.2
    min_support: int = 2
    min_best: float = 0.9

    def __post_init__(self) -> None:
        require_fields(self, "num_similar", "num_registered", "num_submap", "min_support", low=1)
        require_fields(self, "num_neighbours", low=0)
        require_fields(self, "min_probability", "min_best", low=0, high=1)


class KeyframeMatch(NamedTuple):
    """One registration of the scan.

    Attributes:
        keyframe: row of the keyframe.
        T_world_scan: where it puts the scan.
        match: the registration.
        do_scans_agree: whether enough points meet planes, by the limits of loop closure; streets look alike.
    """

    keyframe: int
    T_world_scan: Pose
    match: Match
    do_scans_agree: bool


class Localization(NamedTuple):
    """Place of a scan in a map, or that it is not in the map.

    Attributes:
        status: "found", "not in this map", or "empty": the scan has too few points.
        T_world_scan: pose in the frame of the map; None where it was not found.
        probability: P(correct) of the place; 0 where it was not found.
        keyframe: row of the keyframe that it was found by; None where it was not found.
        reason: the numbers that decided.
        evidence: all registrations.
    """

    status: LocalizationStatus
    T_world_scan: Pose | None
    probability: float
    keyframe: int | None
    reason: str
    evidence: tuple[KeyframeMatch, ...] = ()

    @property
    def is_in_map(self) -> bool:
        """True where the scan was found."""
        return self.status == "found"


class _Place(NamedTuple):
    # Registrations that agree, the most probable first.
    members: tuple[KeyframeMatch, ...]

    @property
    def total(self) -> float:
        return sum(member.match.probability for member in self.members)


def localize(
    model: Model | SlamMethods,
    slam_map: KeyframeMap,
    scan: Float[AnyArray, "n 3"],
    config: LocalizationConfig | None = None,
) -> Localization:
    """Finds a scan in a map without a first guess.

    Args:
        model: the model that made the map; or methods of your own.
        slam_map: from `load_map` or of a run.
        scan: points in metres, in the frame of the lidar; points that are not finite are dropped.
        config: number of registrations and limits of acceptance; None takes the defaults.

    Returns:
        The pose in the frame of the map, or that the scan is not in it.

    Raises:
        ValueError: if the shape is not (n, 3), the map is empty, or it was made with other weights.
    """
    (found,) = localize_each(model, slam_map, [scan], config)
    return found


def localize_each(
    model: Model | SlamMethods,
    slam_map: KeyframeMap,
    scans: Iterable[Float[AnyArray, "_n 3"]],
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
    if slam_map.origin is None:
        raise ValueError("slam_map: expected keyframes, got an empty map")
    methods = model if isinstance(model, SlamMethods) else make_methods(model, slam_map.origin.config)
    with_origin(slam_map, methods.origin)
    for scan in scans:
        yield _localized(methods, slam_map, np.asarray(scan), config or LocalizationConfig())


def _localized(
    methods: SlamMethods, slam_map: KeyframeMap, scan: np.ndarray, config: LocalizationConfig
) -> Localization:
    if scan.ndim != 2 or scan.shape[1] != 3:
        raise ValueError(f"scan: expected shape (n, 3), got {scan.shape}")
    points = scan[np.isfinite(scan).all(axis=1)]
    thinned = methods.geometry.thin(points)
    if thinned is None:
        return Localization("empty", None, 0.0, None, "too few points")
    compact, extent_m = methods.matcher.encode(thinned), thinned.extent_m
    rows = _candidates(slam_map, compact, methods, config)
    tried: list[KeyframeMatch] = []
    for start in range(0, len(rows), NUM_AT_ONCE):
        done = {one.keyframe for one in tried}
        left = [row for row in rows[start : start + NUM_AT_ONCE] if row not in done]
        tried += _registered(slam_map, left, compact, methods, config)
        place = max(_places(tried, config), key=lambda place: place.total, default=None)
        if place is not None and not _is_supported(place, config, config.min_support):
            near = _neighbours(slam_map, place.members[0], tried, extent_m, config)
            tried += _registered(slam_map, near, compact, methods, config)
        found = _decided(slam_map, tried, extent_m, config)
        if found.status == "found":
            return found
    return found


def _candidates(
    slam_map: KeyframeMap, compact: CompactScan, methods: SlamMethods, config: LocalizationConfig
) -> list[int]:
    """Returns the keyframes to register, the most probable overlap first."""
    vector = methods.matcher.vector(compact)
    vector = vector / max(float(np.linalg.norm(vector)), 1e-12)
    rows, _ = most_similar(slam_map.vectors, vector, config.num_similar)
    overlaps = methods.matcher.overlaps(compact, [slam_map.keyframes[row].compact for row in rows])
    order = np.argsort(-overlaps, kind="stable")[: config.num_registered]
    return [int(rows[number]) for number in order]


def _registered(
    slam_map: KeyframeMap, rows: list[int], compact: CompactScan, methods: SlamMethods, config: LocalizationConfig
) -> list[KeyframeMatch]:
    source = Submap((compact,), np.eye(4)[None])
    targets = [submap_around(slam_map, row, config.num_submap) for row in rows]
    matches = methods.matcher.register([(source, target) for target in targets]) if rows else []
    return [
        KeyframeMatch(
            row, orthonormal(slam_map.T_world_keyframe[row] @ match.T_target_source), match, scans_agree(match)
        )
        for row, match in zip(rows, matches, strict=True)
    ]


def _places(tried: list[KeyframeMatch], config: LocalizationConfig) -> list[_Place]:
    """Groups registrations around the most probable ones whose scans agree."""
    # Fewer points meet planes of a keyframe farther off: that it puts the scan at the same place is enough.
    left = sorted(tried, key=lambda one: -one.match.probability)
    left = [one for one in left if one.match.probability >= config.min_probability]
    places = []
    while first := next((one for one in left if one.do_scans_agree), None):
        others = [one for one in left if one is not first and _agree(first, one)]
        places.append(_Place((first, *others)))
        left = [one for one in left if not any(one is member for member in places[-1].members)]
    return places


def _agree(one: KeyframeMatch, other: KeyframeMatch) -> bool:
    return are_near(one.T_world_scan, other.T_world_scan, SAME_PLACE_M, SAME_PLACE_RAD)


def _is_supported(place: _Place, config: LocalizationConfig, min_support: int) -> bool:
    return len(place.members) >= min_support and place.members[0].match.probability >= config.min_best


def _neighbours(
    slam_map: KeyframeMap, best: KeyframeMatch, tried: list[KeyframeMatch], extent_m: float, config: LocalizationConfig
) -> list[int]:
    """Returns keyframes near the place that were not tried yet, nearest first."""
    apart_m = distances_to(slam_map, best.T_world_scan[:3, 3])
    done = {one.keyframe for one in tried}
    near = [int(row) for row in np.argsort(apart_m, kind="stable") if apart_m[row] <= extent_m]
    return [row for row in near if row not in done][: config.num_neighbours]


def _decided(
    slam_map: KeyframeMap, tried: list[KeyframeMatch], extent_m: float, config: LocalizationConfig
) -> Localization:
    places = sorted(_places(tried, config), key=lambda place: -place.total)
    evidence = tuple(tried)
    if not places:
        highest = max((one.match.probability for one in tried), default=0.0)
        return Localization("not in this map", None, 0.0, None, f"best P {highest:.2f} of {len(tried)}", evidence)
    best, rival = places[0], places[1].total if len(places) > 1 else 0.0
    first = best.members[0]
    numbers = f"{len(best.members)} of {len(tried)} agree, P {first.match.probability:.2f}, sum {best.total:.2f}"
    numbers += f", next place {rival:.2f}"
    is_alone = int((distances_to(slam_map, first.T_world_scan[:3, 3]) <= extent_m).sum()) <= 1
    is_supported = _is_supported(best, config, 1 if is_alone else config.min_support)
    if not is_supported or rival > MAX_RIVAL_SHARE * best.total:
        return Localization("not in this map", None, 0.0, None, numbers, evidence)
    probability = first.match.probability
    return Localization("found", first.T_world_scan, probability, first.keyframe, numbers, evidence)
