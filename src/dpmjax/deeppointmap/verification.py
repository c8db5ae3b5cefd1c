"""Verification of motion hypotheses by the scans themselves: surfaces that meet, and free space that stays free.

A short point-to-plane alignment first brings a hypothesis to where the surfaces say that it should be. A right one then
puts most points onto planes of the other scan, and hardly any into its free space.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.checks import require_fields
from dpmjax.geometry import rigid
from dpmjax.scans.free_space import RangeImage, RangeImageConfig, range_image, view_points
from dpmjax.scans.surface_alignment import AlignmentConfig, AlignmentLevel, align_surfaces, pair_with_planes
from dpmjax.scans.surfaces import Surface, SurfaceConfig, scan_surface
from dpmjax.types import Verification

HYPOTHESES_AT_ONCE = 4

DISTINCT_M, DISTINCT_RAD = 2.0, np.radians(5.0)
"""Motions that differ by less end in the same place."""


COARSE = AlignmentConfig(levels=(AlignmentLevel(3.0, 600, 5),))
FINE = AlignmentConfig(levels=(AlignmentLevel(1.0, 1500, 5),))
REFINEMENT = AlignmentConfig(levels=(AlignmentLevel(1.0, 4000, 8), AlignmentLevel(0.4, 8000, 10)))


@dataclass(frozen=True)
class VerificationConfig:
    """Settings of the verification and of the final alignment.

    Attributes:
        surface: points and normals of a scan.
        image: free space of a scan.
        coarse: alignment of each hypothesis.
        fine: alignment of the best `num_fine` of them.
        refinement: alignment of the chosen one, for `register(..., refine=True)`; it starts where `fine` ended.
        num_fine: number of hypotheses that are aligned finely.
        num_samples: number of points of each scan that are compared.
        plane_radius_m: a point meets a plane if a point of it is within this distance, ...
        plane_distance_m: ... the plane itself is within this, ...
        min_cosine: ... and the cosine between both normals is larger.
        contradiction_weight: how much a contradicted point counts against one that meets a plane.
        clear_score: no further hypothesis is tried after one with a higher score.
    """

    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    image: RangeImageConfig = field(default_factory=RangeImageConfig)
    coarse: AlignmentConfig = COARSE
    fine: AlignmentConfig = FINE
    refinement: AlignmentConfig = REFINEMENT
    num_fine: int = 3
    num_samples: int = 1000
    plane_radius_m: float = 1.0
    plane_distance_m: float = 0.15
    min_cosine: float = 0.7
    contradiction_weight: float = 2.0
    clear_score: float = 0.5

    def __post_init__(self) -> None:
        require_fields(self, "num_fine", "num_samples", low=1)
        require_fields(self, "plane_radius_m", "plane_distance_m", low=1e-9)
        require_fields(self, "min_cosine", "contradiction_weight", "clear_score", low=0)


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
        row: which hypothesis.
        T_target_source: its motion after the alignment of the surfaces.
        verification: how well the scans agree under that motion.
    """

    row: int
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
        Shares of points that are visible, that meet planes and that lie in free space.
    """
    num_samples = config.num_samples
    level = AlignmentLevel(config.plane_radius_m, num_samples, 1)
    pairs = pair_with_planes(source.surface, target.surface, T_target_source, level)
    meets = (np.abs(pairs.residuals) < config.plane_distance_m) & (pairs.cosines > config.min_cosine)
    views = []
    sides = ((source, target, T_target_source), (target, source, rigid.inverse(T_target_source)))
    for scan, other, T_other_scan in sides:
        points = scan.surface.points[scan.surface.samples[:num_samples]]
        moved = points @ T_other_scan[:3, :3].T + T_other_scan[:3, 3]
        views.append(view_points(other.image, moved, config.image))
    num_visible = sum(int(view.is_visible.sum()) for view in views)
    num_points = sum(len(view.is_visible) for view in views)
    matched = int(meets.sum()) / max(len(views[0].is_visible), 1)
    contradicted = sum(int(view.is_contradicted.sum()) for view in views) / max(num_visible, 1)
    score = matched - config.contradiction_weight * contradicted
    return Verification(num_visible / max(num_points, 1), matched, contradicted, score)


def choose_motion(
    source: MeasuredScan, target: MeasuredScan, T_target_source: Float[np.ndarray, "h 4 4"], config: VerificationConfig
) -> VerifiedMotion:
    """Chooses the hypothesis under which two scans agree best.

    Args:
        source: a scan.
        target: the other.
        T_target_source: at least one hypothesis, the most likely first.
        config: alignments and tolerances.

    Returns:
        The best hypothesis, aligned.
    """

    def aligned(alignment: AlignmentConfig, row: int, start: Float[np.ndarray, "4 4"]) -> VerifiedMotion:
        T = align_surfaces(source.surface, target.surface, start, alignment, num_threads=1).T_target_source
        return VerifiedMotion(row, T, verify_motion(source, target, T, config))

    tried: list[VerifiedMotion] = []
    with ThreadPoolExecutor(2) as pool:
        for first in range(0, len(T_target_source), HYPOTHESES_AT_ONCE):
            rows = range(first, min(first + HYPOTHESES_AT_ONCE, len(T_target_source)))
            tried += pool.map(lambda row: aligned(config.coarse, row, np.asarray(T_target_source[row], float)), rows)
            tried.sort(key=lambda motion: -motion.verification.score)
            if tried[0].verification.score > config.clear_score:
                break
        best = tried[: config.num_fine]
        fine = list(pool.map(lambda motion: aligned(config.fine, motion.row, motion.T_target_source), best))
    chosen = max(fine, key=lambda motion: motion.verification.score)
    others = [other for other in (*fine, *tried[config.num_fine :]) if _is_apart(other, chosen)]
    second = max((other.verification.score for other in others), default=0.0)
    gap = chosen.verification.score - max(second, 0.0)
    return chosen._replace(verification=chosen.verification._replace(gap=gap, num_tried=len(tried)))


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
    kept = motion.verification
    return VerifiedMotion(motion.row, T, found._replace(gap=kept.gap, num_tried=kept.num_tried))


def _is_apart(motion: VerifiedMotion, other: VerifiedMotion) -> bool:
    """Whether two motions differ: near-equal ones do not compete."""
    difference = rigid.inverse(motion.T_target_source) @ other.T_target_source
    cosine = (np.trace(difference[:3, :3]) - 1) / 2
    return bool(np.linalg.norm(difference[:3, 3]) > DISTINCT_M or cosine < np.cos(DISTINCT_RAD))
