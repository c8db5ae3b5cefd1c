"""Verification of motion hypotheses by the scans themselves: surfaces that meet, and free space that stays free.

A short point-to-plane alignment first brings a hypothesis to where the surfaces say that it should be. A right one then
puts most points onto planes of the other scan, and hardly any into its free space. In corridors wrong ones do so, too:
there, motions along the axis and half-turns are tried, and the elements that face the axis choose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dpmjax.checks import require_fields
from dpmjax.geometry import rigid
from dpmjax.scans.free_space import RangeImage, RangeImageConfig, range_image, view_points
from dpmjax.scans.plane_information import WeakDirection, weakest_direction
from dpmjax.scans.surface_alignment import (
    AlignmentConfig,
    AlignmentLevel,
    align_surfaces,
    align_surfaces_from,
    nearest_planes,
    pair_with_planes,
)
from dpmjax.scans.surfaces import Surface, SurfaceConfig, scan_surface
from dpmjax.scans.view_correlation import T_level_lidar, ViewCorrelationConfig, correlate_views
from dpmjax.scans.weak_directions import WallAxis, facing_surface, sliding_motions, wall_axis, weak_share
from dpmjax.types import Verification

HYPOTHESES_AT_ONCE = 4
SPARSE_SHARE = 0.5
"""A target with a smaller share of the source's number of points has been thinned (`saved_maps`). Too few of its points
are near those of the source, so its own points are compared with the planes of the source."""

LEVEL_COSINE = 0.8
"""Surfaces whose normals are nearer to the vertical are level."""

DISTINCT_M, DISTINCT_RAD = 2.0, np.radians(5.0)
"""Motions that differ by less end in the same place."""

OF_THE_SEARCH = ("gap", "num_tried", "num_slid", "facing_gap")
"""Fields of `Verification` that rest on all motions that were tried."""

COARSE = AlignmentConfig(levels=(AlignmentLevel(3.0, 600, 5),))
FINE = AlignmentConfig(levels=(AlignmentLevel(1.0, 1500, 5),))
SLIDING = AlignmentConfig(levels=(*COARSE.levels, *FINE.levels))
REFINEMENT = AlignmentConfig(levels=(AlignmentLevel(1.0, 4000, 8), AlignmentLevel(0.4, 8000, 10)))


@dataclass(frozen=True)
class EvidenceWeights:
    """Logistic model of P(right within 2 m and 5 degrees) of one motion, by shares of the points of both scans.

    Fitted by `python -m experiments.dpm_evidence` on simulated scenes, dense and sparse, out of doors and inside.
    Walls are all surfaces that are not level.

    Attributes:
        bias: the constant.
        walls_met: points of walls that meet a plane where the other scan sees.
        walls_visible: points of walls where the other scan sees.
        walls_contradicted: points of walls in the free space of the other scan.
        level_met: points of level surfaces that meet a plane where the other scan sees.
        level_visible: points of level surfaces where the other scan sees.
        level_contradicted: points of level surfaces in the free space of the other scan.
    """

    bias: float = -6.6
    walls_met: float = 14.4
    walls_visible: float = 9.2
    walls_contradicted: float = -65.0
    level_met: float = -0.7
    level_visible: float = 7.6
    level_contradicted: float = 5.0


@dataclass(frozen=True)
class SlidingConfig:
    """Search along a weak axis.

    Attributes:
        max_weak_share: an axis is weak if its share of the information of the walls is smaller; 0.25 or more in streets
            and rooms, 0.07 to 0.21 in corridors. 0 switches the search off.
        step_m: distance of the motions that are tried.
        alignment: of each.
        num_samples: number of elements of each scan that face the axis and are compared.
        contradicted: an element that faces the axis and lies in free space counts against a motion as so many that
            meet count for it.
        visible: the same of an element that the other scan sees.
    """

    max_weak_share: float = 0.22
    step_m: float = 0.7
    alignment: AlignmentConfig = SLIDING
    num_samples: int = 4000
    contradicted: float = 3.0
    visible: float = 0.2

    def __post_init__(self) -> None:
        require_fields(self, "max_weak_share", "contradicted", "visible", low=0)
        require_fields(self, "step_m", low=1e-9)
        require_fields(self, "num_samples", low=1)


@dataclass(frozen=True)
class VerificationConfig:
    """Settings of the verification and of the final alignment.

    Attributes:
        surface: points and normals of a scan.
        image: free space of a scan.
        views: search of further motions by the scans alone, where the first hypotheses are not clearly right.
        coarse: alignment of each hypothesis.
        fine: alignment of the best `num_fine` of them.
        refinement: alignment of the chosen one, for `register(..., refine=True)`; it starts where `fine` ended.
        num_fine: number of hypotheses that are aligned finely.
        num_samples: number of points of each scan that are compared.
        plane_radius_m: a point meets a plane if a point of it is within this distance, ...
        plane_distance_m: ... the plane itself is within this, ...
        min_cosine: ... and the cosine between both normals is larger.
        evidence: what the points of both scans say about a motion.
        clear_score: no further hypothesis is tried after one with higher log odds.
        sliding: further motions where the walls hold one direction only, and their comparison.
    """

    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    image: RangeImageConfig = field(default_factory=RangeImageConfig)
    views: ViewCorrelationConfig = field(default_factory=ViewCorrelationConfig)
    coarse: AlignmentConfig = COARSE
    fine: AlignmentConfig = FINE
    refinement: AlignmentConfig = REFINEMENT
    num_fine: int = 3
    num_samples: int = 1000
    plane_radius_m: float = 1.0
    plane_distance_m: float = 0.15
    min_cosine: float = 0.7
    evidence: EvidenceWeights = field(default_factory=EvidenceWeights)
    clear_score: float = 1.0
    sliding: SlidingConfig = field(default_factory=SlidingConfig)

    def __post_init__(self) -> None:
        require_fields(self, "num_fine", "num_samples", low=1)
        require_fields(self, "plane_radius_m", "plane_distance_m", low=1e-9)
        require_fields(self, "min_cosine", low=0)


class MeasuredScan(NamedTuple):
    """What verification compares: the surface of a scan and its free space.

    Attributes:
        surface: points, normals and a tree, in the frame of the lidar.
        image: ranges by direction.
    """

    surface: Surface
    image: RangeImage


class VerifiedMotion(NamedTuple):
    """A hypothesis after verification.

    Attributes:
        row: the hypothesis of the descriptors that it comes from, or agrees with; None where only the views of the
            scans have suggested it.
        T_target_source: its motion after the alignment of the surfaces.
        verification: how well the scans agree under that motion.
    """

    row: int | None
    T_target_source: Float[np.ndarray, "4 4"]
    verification: Verification


def measure_scan(points: Float[np.ndarray, "n 3"], config: VerificationConfig) -> MeasuredScan:
    """Prepares a scan for verification.

    Args:
        points: metres, in the frame of the lidar; points that are not finite are dropped.
        config: resolution.

    Returns:
        Surface and free space.
    """
    surface = scan_surface(points, config.surface)
    return MeasuredScan(surface, range_image(surface.points, config.image))


def verify_motion(
    source: MeasuredScan, target: MeasuredScan, T_target_source: Float[np.ndarray, "4 4"], config: VerificationConfig
) -> Verification:
    """Compares two scans under a motion.

    Args:
        source: a scan.
        target: the other.
        T_target_source: the motion.
        config: tolerances.

    Returns:
        Shares of points that are visible, that meet planes and that lie in free space, and what they say together.
    """
    return verify_motions(source, target, np.asarray(T_target_source)[None], config)[0]


def verify_motions(
    source: MeasuredScan, target: MeasuredScan, T_target_source: Float[np.ndarray, "s 4 4"], config: VerificationConfig
) -> list[Verification]:
    """Compares two scans under several motions.

    Args:
        source: a scan.
        target: the other.
        T_target_source: the motions.
        config: tolerances.

    Returns:
        What `verify_motion` returns for each motion.
    """
    sides = _both_sides(source, target, T_target_source, config)
    is_thin = len(target.surface.points) < SPARSE_SHARE * len(source.surface.points)
    matched = _share(sides[1 if is_thin else 0].meets)
    bias, *weights = astuple(config.evidence)
    num_visible = sum(side.is_visible.sum(axis=1) for side in sides)
    num_contradicted = sum(side.is_contradicted.sum(axis=1) for side in sides)
    visible = num_visible / max(sum(side.is_visible.shape[1] for side in sides), 1)
    contradicted = num_contradicted / np.maximum(num_visible, 1)
    scores = _evidence(sides) @ np.array(weights) + bias
    columns = (column.tolist() for column in (visible, matched, contradicted, scores))
    return [Verification(*shares) for shares in zip(*columns, strict=True)]


class _Compared(NamedTuple):
    """Samples of a scan under several motions, in the other scan."""

    meets: Bool[np.ndarray, "s n"]
    is_visible: Bool[np.ndarray, "s n"]
    is_contradicted: Bool[np.ndarray, "s n"]
    is_level: Bool[np.ndarray, " n"]


def _compared(
    scan: MeasuredScan, other: MeasuredScan, T_other_scan: Float[np.ndarray, "s 4 4"], config: VerificationConfig
) -> _Compared:
    level = AlignmentLevel(config.plane_radius_m, config.num_samples, 1)
    planes = nearest_planes(scan.surface, other.surface, T_other_scan, level)
    meets = planes.is_paired & (np.abs(planes.residuals) < config.plane_distance_m)
    meets &= planes.cosines > config.min_cosine
    view = view_points(other.image, planes.points.reshape(-1, 3), config.image)
    is_level = np.abs(scan.surface.normals[scan.surface.samples[: config.num_samples], 2]) > LEVEL_COSINE
    return _Compared(meets, view.is_visible.reshape(meets.shape), view.is_contradicted.reshape(meets.shape), is_level)


def evidence_shares(
    source: MeasuredScan, target: MeasuredScan, T_target_source: Float[np.ndarray, "s 4 4"], config: VerificationConfig
) -> Float[np.ndarray, "s 6"]:
    """Computes what `EvidenceWeights` weighs.

    Only what the other scan sees counts. So a motion that puts two scans onto each other gains nothing by it: level
    ground meets level ground anywhere, but walls do not.

    Args:
        source: a scan.
        target: the other.
        T_target_source: motions.
        config: tolerances.

    Returns:
        Shares in the order of `EvidenceWeights`, means of both scans.
    """
    return _evidence(_both_sides(source, target, T_target_source, config))


def _both_sides(
    source: MeasuredScan, target: MeasuredScan, T_target_source: Float[np.ndarray, "s 4 4"], config: VerificationConfig
) -> tuple[_Compared, _Compared]:
    return (
        _compared(source, target, T_target_source, config),
        _compared(target, source, rigid.inverse(T_target_source), config),
    )


def _evidence(sides: Sequence[_Compared]) -> Float[np.ndarray, "s 6"]:
    shares = []
    for is_level in (False, True):
        of_kind = [side.is_visible & (side.is_level == is_level) for side in sides]
        shares += [
            [_share(seen & side.meets) for seen, side in zip(of_kind, sides, strict=True)],
            [_share(seen) for seen in of_kind],
            [_share(seen & side.is_contradicted) for seen, side in zip(of_kind, sides, strict=True)],
        ]
    return np.mean(shares, axis=1).T


def _share(points: Bool[np.ndarray, "s n"]) -> Float[np.ndarray, " s"]:
    return points.sum(axis=1) / max(points.shape[1], 1)


def choose_motion(
    source: MeasuredScan, target: MeasuredScan, T_target_source: Float[np.ndarray, "h 4 4"], config: VerificationConfig
) -> VerifiedMotion:
    """Chooses the hypothesis under which two scans agree best.

    Where the walls of both hold one direction only, motions along the other are tried too, both ways round, and the
    motion is taken under which most elements that face this direction meet.

    Args:
        source: a scan.
        target: the other.
        T_target_source: at least one hypothesis, the most likely first.
        config: alignments and tolerances.

    Returns:
        The best hypothesis, aligned.
    """

    def aligned(alignment: AlignmentConfig, candidates: Sequence[_Candidate | VerifiedMotion]) -> list[VerifiedMotion]:
        starts = np.stack([candidate.T_target_source for candidate in candidates])
        found = align_surfaces_from(source.surface, target.surface, starts, alignment)
        T = np.stack([alignment.T_target_source for alignment in found])
        verified = verify_motions(source, target, T, config)
        return [VerifiedMotion(one.row, *rest) for one, *rest in zip(candidates, T, verified, strict=True)]

    tried: list[VerifiedMotion] = []
    for some in _candidates(source, target, np.asarray(T_target_source, float), config):
        tried += aligned(config.coarse, some)
        tried.sort(key=lambda motion: -motion.verification.score)
        if tried[0].verification.score > config.clear_score:
            break
    finalists, remaining = aligned(config.fine, tried[: config.num_fine]), tried[config.num_fine :]
    axes = wall_axis(source.surface), wall_axis(target.surface)
    slid = np.zeros((0, 4, 4))
    if is_weak := weak_share(*axes) < config.sliding.max_weak_share:
        slid = sliding_motions(*axes, config.sliding.step_m)
        finalists += aligned(config.sliding.alignment, [_Candidate(None, T) for T in slid])
    motions = [*finalists, *remaining]
    T = np.stack([motion.T_target_source for motion in motions])
    scores = np.array([motion.verification.score for motion in motions])
    facing = _facing_elements(source, target, axes, T, config) if is_weak else np.zeros(len(motions))
    best = int(np.argmax((facing if is_weak else scores)[: len(finalists)]))
    chosen, is_other = motions[best], _is_apart(T, T[best])
    if chosen.row is None:
        agreeing = np.flatnonzero(~_is_apart(np.asarray(T_target_source, float), T[best]))
        chosen = chosen._replace(row=int(agreeing[0]) if len(agreeing) else None)
    gap, facing_gap = (values[best] - values[is_other].max(initial=0.0) for values in (scores, facing))
    found = chosen.verification._replace(gap=gap, num_tried=len(tried), num_slid=len(slid), facing_gap=facing_gap)
    return chosen._replace(verification=found)


def _facing_elements(
    source: MeasuredScan,
    target: MeasuredScan,
    axes: tuple[WallAxis, WallAxis],
    T_target_source: Float[np.ndarray, "s 4 4"],
    config: VerificationConfig,
) -> Float[np.ndarray, " s"]:
    """Counts elements that face the weak axis and meet; those in free space and unmet visible ones count against it."""
    sliding, settings = config.sliding, replace(config, num_samples=config.sliding.num_samples)
    first, second = (
        scan._replace(surface=facing_surface(scan.surface, axis.axis))
        for scan, axis in zip((source, target), axes, strict=True)
    )
    sides = (
        _compared(first, target, T_target_source, settings),
        _compared(second, source, rigid.inverse(T_target_source), settings),
    )
    counts = [
        side.meets.sum(axis=1)
        - sliding.contradicted * side.is_contradicted.sum(axis=1)
        - sliding.visible * side.is_visible.sum(axis=1)
        for side in sides
    ]
    return np.mean(counts, axis=0)


class _Candidate(NamedTuple):
    row: int | None
    T_target_source: Float[np.ndarray, "4 4"]


def _candidates(
    source: MeasuredScan, target: MeasuredScan, T_target_source: Float[np.ndarray, "h 4 4"], config: VerificationConfig
) -> Iterator[list[_Candidate]]:
    """Yields hypotheses, some at a time, from the second time on in turn with motions from the views of the scans."""
    hypotheses = _batched([_Candidate(row, T) for row, T in enumerate(T_target_source)])
    yield hypotheses[0]
    searched = _batched([_Candidate(None, T) for T in _searched(source, target, config)])
    for number in range(max(len(searched), len(hypotheses) - 1)):
        yield from (*searched[number : number + 1], *hypotheses[number + 1 : number + 2])


def _searched(source: MeasuredScan, target: MeasuredScan, config: VerificationConfig) -> Float[np.ndarray, "s 4 4"]:
    if config.views.num_motions == 0:
        return np.zeros((0, 4, 4))
    return correlate_views(source.surface, target.surface, config.views)


def _batched(candidates: list[_Candidate]) -> list[list[_Candidate]]:
    starts = range(0, len(candidates), HYPOTHESES_AT_ONCE)
    return [candidates[start : start + HYPOTHESES_AT_ONCE] for start in starts]


def refine_motion(
    source: MeasuredScan, target: MeasuredScan, motion: VerifiedMotion, config: VerificationConfig
) -> VerifiedMotion:
    """Aligns the surfaces of two scans point to plane, as finely as the scans allow.

    Args:
        source: a scan.
        target: the other.
        motion: from `choose_motion`.
        config: alignment and tolerances.

    Returns:
        The refined motion and its verification.
    """
    start = motion.T_target_source
    T = align_surfaces(source.surface, target.surface, start, config.refinement).T_target_source
    found = verify_motion(source, target, T, config)
    kept = {name: getattr(motion.verification, name) for name in OF_THE_SEARCH}
    return VerifiedMotion(motion.row, T, found._replace(**kept))


def weak_direction_of(
    source: MeasuredScan, target: MeasuredScan, T_target_source: Float[np.ndarray, "4 4"], config: VerificationConfig
) -> WeakDirection:
    """Finds the horizontal direction in which a motion is known least, by all elements of the source that meet planes.

    Args:
        source: a scan.
        target: the other.
        T_target_source: the motion.
        config: tolerances.

    Returns:
        The direction in the target frame, and the standard deviation of the translation along it.
    """
    # The first samples are of all directions alike, which would hide that few elements face the weak one.
    level = AlignmentLevel(config.plane_radius_m, max(1, len(source.surface.samples)), 1)
    pairs = pair_with_planes(source.surface, target.surface, T_target_source, level)
    up = T_level_lidar(target.surface)[2, :3]
    return weakest_direction(pairs, T_target_source, up, max_residual_m=config.plane_distance_m)


def _is_apart(T: Float[np.ndarray, "s 4 4"], T_other: Float[np.ndarray, "4 4"]) -> Bool[np.ndarray, " s"]:
    """Whether motions differ from another: near-equal ones do not compete."""
    difference = rigid.inverse(T_other) @ T
    cosine = (np.trace(difference[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    return (np.linalg.norm(difference[:, :3, 3], axis=1) > DISTINCT_M) | (cosine < np.cos(DISTINCT_RAD))
