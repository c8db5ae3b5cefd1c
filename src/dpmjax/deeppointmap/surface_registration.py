"""Registration of two lidar scans without a model: by their views from above and their surfaces."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy.special import expit

from dpmjax.checks import runs_on_host
from dpmjax.deeppointmap.confidence import CORRIDOR_CONFIDENCE, MAX_SCORE, lookalike_share
from dpmjax.deeppointmap.encoding import valid_points
from dpmjax.deeppointmap.motion_choice import choose_motion, refine_motion
from dpmjax.deeppointmap.prepared_scans import RawScan
from dpmjax.deeppointmap.verification import VerificationConfig
from dpmjax.reading import read_path
from dpmjax.scans.lidar import measure_scan
from dpmjax.scans.pair_registration import PairEvidence, ScanRegistration
from dpmjax.scans.pairs import nearest_planes
from dpmjax.scans.weak_directions import plane_information, weakest_direction


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
    confidence = float(expit(min(agreement.score, MAX_SCORE)) * lookalike_share(agreement.lookalike_gap))
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
