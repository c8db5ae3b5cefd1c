"""Size of one scan over that of another, by planes that meet: other units or a wrong calibration change it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax.geometry.planes import geman_mcclure
from dpmjax.scan.lidar.pairs import Pairs, nearest_planes
from dpmjax.scan.lidar.surfaces import Surface
from dpmjax.types import Pose

# Largest distances of the pairs and widths of the kernel, one of each step: 4 % of 30 m is more than a metre.
RADII_M = (3.0, 3.0, 3.0, 2.0, 2.0, 2.0, 1.5, 1.5, 1.5, 1.5)
KERNELS_M = (0.5, 0.5, 0.4, 0.3, 0.3, 0.2, 0.2, 0.1, 0.1, 0.1)
NUM_ELEMENTS = 2000

# Scales from which the alignment starts, because it does not reach those farther off than about 2 %. No other size is
# tried where more than this share of the elements meets planes already.
START_SCALES, ENOUGH = tuple(np.arange(0.88, 1.125, 0.02)), 0.7

# A size counts if it differs from 1 by more than MIN_DIFFERENCE, and if the elements that meet planes increase by more
# than MIN_GAIN. 28 right pairs of seven drives gain up to 0.004; copies enlarged by 1 to 10 % gain 0.02 to 0.5. The
# motion of a lidar during its turn bends a scan: 30 such right pairs gain up to 0.08, at sizes that differ by 0.009.
MIN_DIFFERENCE, MIN_GAIN = 0.01, 0.015
# From this gain on, half of the difference counts: copies enlarged by 1.0 and 1.1 % gain 0.15 and 0.10.
CLEAR_GAIN = 0.09


def relative_size(source: Surface, target: Surface, T_target_source: Pose) -> float:
    """Estimates the size of a scan over that of another, by an alignment with scale (point to plane).

    Args:
        source: surface of a scan.
        target: surface of the second scan.
        T_target_source: the motion.

    Returns:
        The factor by which the source is larger; exactly 1 where no other size explains more.
    """
    if not len(source.samples) or not len(target.points):
        return 1.0
    before = _pair_both(source, target, T_target_source, 1.0).meets.mean()
    if before > ENOUGH:
        return 1.0
    found = [_align_with_scale(source, target, T_target_source, scale) for scale in START_SCALES]
    share, scale = max((_pair_both(source, target, _scaled(T, scale), 1.0).meets.mean(), scale) for T, scale in found)
    least = MIN_DIFFERENCE / 2 if share > before + CLEAR_GAIN else MIN_DIFFERENCE
    return 1 / scale if abs(1 - scale) > least and share > before + MIN_GAIN else 1.0


def _align_with_scale(source: Surface, target: Surface, T_target_source: Pose, scale: float) -> tuple[Pose, float]:
    """Aligns the planes of both scans, so that neither comes first; returns the motion and the scale."""
    T = np.array(T_target_source, np.float64)
    for radius_m, kernel_m in zip(RADII_M, KERNELS_M, strict=True):
        pairs = _pair_both(source, target, _scaled(T, scale), radius_m)
        pairs = pairs.take(pairs.is_paired)
        if len(pairs.points) < 20:
            break
        centred = pairs.points - T[:3, 3]
        jacobian = np.column_stack([pairs.normals, np.cross(centred, pairs.normals), (centred * pairs.normals).sum(1)])
        weights = geman_mcclure(pairs.residuals, kernel_m) * pairs.flatness * np.maximum(pairs.cosines - 0.3, 0)
        information = (jacobian * weights[:, None]).T @ jacobian + 1e-6 * np.eye(7)
        step = -np.linalg.solve(information, (jacobian * weights[:, None]).T @ pairs.residuals)
        scale *= 1 + float(np.clip(step[6], -0.1, 0.1))
        T[:3, 3] += step[:3]
        T[:3, :3] = Rotation.from_rotvec(step[3:6]).as_matrix() @ T[:3, :3]
    return T, scale


def _pair_both(source: Surface, target: Surface, T_target_source: Pose, radius_m: float) -> Pairs:
    """Pairs elements of each scan with planes of the other under a similarity, all in the frame of the target."""
    T, T_inverse = np.asarray(T_target_source, np.float64), np.linalg.inv(T_target_source)
    pairs = nearest_planes(source, target, T[None], radius_m, NUM_ELEMENTS // 2).take(0)
    back = nearest_planes(target, source, T_inverse[None], radius_m, NUM_ELEMENTS // 2).take(0)
    turn, scale = T[:3, :3].T, np.cbrt(np.linalg.det(T[:3, :3]))
    points, normals = back.points @ turn + T[:3, 3], back.normals @ turn / scale
    back = back._replace(points=points, normals=normals, residuals=-scale * back.residuals)
    return Pairs(*map(np.concatenate, zip(pairs, back, strict=True)))


def _scaled(T_target_source: Pose, scale: float) -> Pose:
    """Returns the similarity that scales points before it moves them."""
    scaled = T_target_source.copy()
    scaled[:3, :3] *= scale
    return scaled


def matched_share(source: Surface, target: Surface, T_target_source: Pose) -> float:
    """Computes the share of elements of a scan that meet planes of another.

    Args:
        source: surface of a scan.
        target: surface of the second scan.
        T_target_source: rigid motion or similarity.

    Returns:
        The share, 0 to 1.
    """
    return float(nearest_planes(source, target, T_target_source[None], 1.0, NUM_ELEMENTS).meets.mean())
