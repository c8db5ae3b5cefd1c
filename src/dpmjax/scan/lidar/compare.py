"""Verification of motion hypotheses by the scans themselves: surfaces that meet, and free space that stays free.

`choose.py` first aligns a hypothesis. A right one then puts most points of each scan onto planes
of the opposite scan, and hardly any into its free space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dpmjax.checks import require_fields
from dpmjax.geometry import rigid
from dpmjax.scan.lidar.pairs import Pairs, nearest_planes
from dpmjax.scan.lidar.propose import ViewCorrelationConfig
from dpmjax.scan.lidar.record import Scan
from dpmjax.scan.lidar.surfaces import Surface, SurfaceConfig, view_points
from dpmjax.types import Poses, Verification

# A target with a smaller share of the source's number of points has been thinned (`saved_maps`). Too few of its points
# are near those of the source, so its own points are compared with the planes of the source.
SPARSE_SHARE = 0.5

# Where walls constrain one direction only, wrong motions reach higher log odds, too.
MAX_SCORE = 3.0

# The two ends of a corridor may look alike in all elements of a cloud, so that no evidence is sure. The share has the
# best likelihood on places left out of the fit (by a script, on the pairs of `experiments.dpm_calibrate`).
CORRIDOR_CONFIDENCE = 0.88

# Surfaces whose normals are nearer to the vertical are level.
LEVEL_COSINE = 0.8


@dataclass(frozen=True)
class EvidenceWeights:
    """Logistic model of P(right within 2 m and 5 degrees) of one motion, by shares of the points of both scans.

    Fitted by `python -m experiments.dpm_calibrate --evidence` on simulated scenes, dense and sparse, also indoors.
    Points of each scan are compared with the opposite scan, and are visible where that scan has measurements. Walls are
    all surfaces that are not level.

    Attributes:
        bias: constant term.
        walls_met: weight of the share of points of walls that are visible and meet a plane.
        walls_visible: weight of the share of points of walls that are visible.
        walls_contradicted: weight of the share of points of walls that are visible and lie in free space.
        level_met: weight of the share of points of level surfaces that are visible and meet a plane.
        level_visible: weight of the share of points of level surfaces that are visible.
        level_contradicted: weight of the share of points of level surfaces that are visible and lie in free space.
    """

    bias: float = -6.6
    walls_met: float = 14.4
    walls_visible: float = 9.2
    walls_contradicted: float = -65.0
    level_met: float = -0.7
    level_visible: float = 7.6
    level_contradicted: float = 5.0


EVIDENCE = EvidenceWeights()


@dataclass(frozen=True)
class VerificationConfig:
    """Settings of the verification.

    Attributes:
        surface: points and normals of a scan.
        views: search of further motions by the scans alone, where the first hypotheses are not clearly right.
        num_samples: number of points of each scan that are compared.
        plane_radius_m: largest distance of a point from the nearest point of a plane that it meets.
        max_weak_share: motions along an axis are tried if its share of the information of the walls is smaller. The
            share is 0.25 or more in streets and rooms, 0.07 to 0.21 in corridors. 0 switches the search off.
        num_lookalikes: largest number of motions to other places that compete with a clearly right one. Under them the
            scans look alike from above, too, as in bare rooms and in rows of equal houses. 0 switches this off.
    """

    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    views: ViewCorrelationConfig = field(default_factory=ViewCorrelationConfig)
    num_samples: int = 1000
    plane_radius_m: float = 1.0
    max_weak_share: float = 0.22
    num_lookalikes: int = 12

    def __post_init__(self) -> None:
        require_fields(self, "num_samples", low=1)
        require_fields(self, "plane_radius_m", low=1e-9)
        require_fields(self, "max_weak_share", "num_lookalikes", low=0)


def verify_motions(
    source: Scan, target: Scan, T_target_source: Poses, config: VerificationConfig
) -> list[Verification]:
    """Compares two scans under several motions.

    Args:
        source: a scan.
        target: the second scan.
        T_target_source: the motions.
        config: tolerances.

    Returns:
        For each motion, shares of points that are visible, that meet planes and that lie in free space, and the log
        odds that the motion is right.
    """
    sides = _both_sides(source, target, T_target_source, config)
    is_thin = len(target.surface.points) < SPARSE_SHARE * len(source.surface.points)
    matched = _share(sides[1 if is_thin else 0].meets)
    bias, *weights = astuple(EVIDENCE)
    num_visible = sum(side.is_visible.sum(axis=1) for side in sides)
    num_contradicted = sum(side.is_contradicted.sum(axis=1) for side in sides)
    visible = num_visible / max(sum(side.is_visible.shape[1] for side in sides), 1)
    contradicted = num_contradicted / np.maximum(num_visible, 1)
    scores = _evidence(sides) @ np.array(weights) + bias
    columns = (column.tolist() for column in (visible, matched, contradicted, scores))
    return [Verification(*shares) for shares in zip(*columns, strict=True)]


class ComparedScan(NamedTuple):
    """Samples of a scan under several motions, compared with a second scan.

    Attributes:
        meets: (s, n) True for a sample that meets a plane of the second scan.
        is_visible: (s, n) True for a sample where the second scan has measurements.
        is_contradicted: (s, n) True for a sample in the free space of the second scan.
        is_level: (n,) True for a sample of a level surface.
    """

    meets: Bool[np.ndarray, "s n"]
    is_visible: Bool[np.ndarray, "s n"]
    is_contradicted: Bool[np.ndarray, "s n"]
    is_level: Bool[np.ndarray, " n"]


def compare_scans(scan: Scan, other: Scan, T_other_scan: Poses, config: VerificationConfig) -> ComparedScan:
    """Compares the samples of one scan with a second scan.

    Args:
        scan: the scan whose samples are compared.
        other: the second scan.
        T_other_scan: motions.
        config: number of samples and tolerances.

    Returns:
        The samples under each motion.
    """
    planes = nearest_planes(scan.surface, other.surface, T_other_scan, config.plane_radius_m, config.num_samples)
    is_level = np.abs(scan.surface.normals[scan.surface.samples[: config.num_samples], 2]) > LEVEL_COSINE
    return ComparedScan(planes.meets, *view_points(other.image, planes.points), is_level)


def evidence_shares(
    source: Scan, target: Scan, T_target_source: Poses, config: VerificationConfig
) -> Float[np.ndarray, "s 6"]:
    """Computes the shares that `EvidenceWeights` weighs.

    Only visible points count. So a motion that merely puts two scans onto each other gains nothing: level ground meets
    level ground anywhere, but walls do not.

    Args:
        source: a scan.
        target: the second scan.
        T_target_source: motions.
        config: tolerances.

    Returns:
        Shares in the order of `EvidenceWeights`, means of both scans.
    """
    return _evidence(_both_sides(source, target, T_target_source, config))


def matched_shares(surface: Surface, planes: Pairs) -> Float[np.ndarray, " s"]:
    """Computes the mean share of elements that meet planes, over the main directions of their normals.

    Ground meets ground under any motion: without the mean it would outweigh the walls.

    Args:
        surface: surface of a scan.
        planes: planes nearest to its first samples, under several motions.

    Returns:
        A share for each motion.
    """
    meets = planes.meets
    is_along = np.eye(3)[np.argmax(np.abs(surface.normals[surface.samples[: meets.shape[1]]]), axis=1)]
    counts = is_along.sum(axis=0)
    # A direction of few elements counts less, because its share is uncertain.
    weights = np.minimum(counts, counts.max() / 3) + 1e-9
    return np.asarray(meets @ is_along / np.maximum(counts, 1) @ (weights / weights.sum()))


def contradicted_shares(surface: Surface, scan: Scan, T_surface_scan: Poses) -> Float[np.ndarray, " s"]:
    """Computes the share of the visible elements of a surface that lie in the free space of a scan.

    Args:
        surface: the surface, as of a local map.
        scan: the scan.
        T_surface_scan: motions of the scan.

    Returns:
        A share for each motion.
    """
    # Number of elements that are compared.
    points = surface.points.take(surface.samples[:4000], axis=0).astype(np.float32)
    T_scan_surface = rigid.inverse(T_surface_scan).astype(np.float32)
    moved = np.matmul(T_scan_surface[:, :3, :3], points.T) + T_scan_surface[:, :3, 3:]
    is_visible, is_contradicted = view_points(scan.image, moved.swapaxes(1, 2))
    return np.asarray(is_contradicted.sum(axis=1) / np.maximum(is_visible.sum(axis=1), 1))


def _both_sides(
    source: Scan, target: Scan, T_target_source: Poses, config: VerificationConfig
) -> tuple[ComparedScan, ComparedScan]:
    forward = compare_scans(source, target, T_target_source, config)
    return forward, compare_scans(target, source, rigid.inverse(T_target_source), config)


def _evidence(sides: Sequence[ComparedScan]) -> Float[np.ndarray, "s 6"]:
    of_sides = []
    for side in sides:
        kinds = [side.is_visible & (side.is_level == is_level) for is_level in (False, True)]
        counted = side.meets, side.is_visible, side.is_contradicted
        of_sides.append([_share(seen & some) for seen in kinds for some in counted])
    return np.mean(of_sides, axis=0).T


def _share(points: Bool[np.ndarray, "s n"]) -> Float[np.ndarray, " s"]:
    return points.sum(axis=1) / max(points.shape[1], 1)
