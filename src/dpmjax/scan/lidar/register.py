"""Registration of two lidar scans without a first guess and without a model."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy.special import expit

from dpmjax.checks import runs_on_host
from dpmjax.reading import read_path
from dpmjax.scan.lidar.choose import choose_motion, refine_motion
from dpmjax.scan.lidar.compare import CORRIDOR_CONFIDENCE, MAX_SCORE, VerificationConfig
from dpmjax.scan.lidar.pairs import nearest_planes
from dpmjax.scan.lidar.record import measure_scan, valid_points
from dpmjax.scan.lidar.slide import plane_information, weakest_direction
from dpmjax.scan.pair_evidence import PairEvidence, ScanRegistration
from dpmjax.types import RawScan


@runs_on_host("call icp there")
def register_surfaces(source: RawScan, target: RawScan) -> ScanRegistration:
    """Registers two lidar scans without a first guess and without a model, as `register` does without descriptors.

    Args:
        source: (n, 3) points in metres, in the frame of the lidar, z up, or their file; points that are not finite are
            dropped.
        target: the same.

    Returns:
        The motion, and the probability that it is right within 2 m and 5 degrees, by the agreement of the scans.

    Raises:
        ValueError: the points are no real numbers (n, 3).
    """
    config = VerificationConfig()
    given = (cast(RawScan, read_path(scan, "io.read_lidar_file")) for scan in (source, target))
    ends = tuple(measure_scan(valid_points(points), config.surface) for points in given)
    chosen = choose_motion(ends[0], ends[1], np.eye(4)[None], config)
    T = refine_motion(ends[0], ends[1], chosen, config).T_target_source
    agreement, surfaces = chosen.verification, (ends[0].surface, ends[1].surface)
    direction, sigma = weakest_direction(*surfaces, T, config.plane_radius_m)
    pairs = nearest_planes(*surfaces, T[None], config.plane_radius_m, config.num_samples).take(0)
    confidence = float(expit(min(agreement.score, MAX_SCORE)) * expit(agreement.lookalike_gap))
    return ScanRegistration(
        T_target_source=T,
        confidence=min(confidence, CORRIDOR_CONFIDENCE) if agreement.num_slid else confidence,
        evidence=PairEvidence(
            score=agreement.score,
            lead=float(min(agreement.gap, agreement.lookalike_gap)),
            visible=agreement.visible_share,
            sigma=float(sigma),
        ),
        weak_direction=np.asarray(direction),
        weak_sigma=float(sigma),
        information=plane_information(pairs.take(pairs.is_paired), T),
    )
