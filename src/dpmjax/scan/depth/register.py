"""Registration of two depth images without a first guess, and the probability that the motion is right."""

from __future__ import annotations

import jax
import numpy as np
from numpy.typing import ArrayLike

from dpmjax.checks import runs_on_host
from dpmjax.geometry.sampling import typical_range
from dpmjax.scan.depth.align import DepthCamera, DepthImages, depth_view, linearise_images
from dpmjax.scan.depth.propose import SEARCH
from dpmjax.scan.depth.record import as_depth_scans
from dpmjax.scan.depth.track import initialize_depth
from dpmjax.scan.pair_evidence import PairEvidence, PairModel, ScanRegistration

# Samples of 100 points of the source whose residuals give the information.
_NUM_SAMPLES = 12
# Fitted to 200 pairs of simulated apartments.
DEPTH = PairModel(weights=(8.30, 12.20, -5.89, -0.839), bias=-7.41)


@runs_on_host("call deepmapping.solve there")
def register_images(source: ArrayLike, target: ArrayLike) -> ScanRegistration:
    """Registers two depth images of one camera, up to 0.7 m and 75 degrees apart.

    Args:
        source: (h, w, 3) points in the frame of the camera (x right, y down, z forward), metres; pixels that are not
            finite or all zero are invalid.
        target: the same, of the same size.

    Returns:
        The motion, its lead over the best other motion, and the probability that it is right within a tenth of a metre
        and 3 degrees.

    Raises:
        ValueError: wrong or different shapes, an image without a valid pixel, or points behind the camera.
    """
    images = [np.asarray(image, np.float32) for image in (target, source)]
    if images[0].ndim != 3 or images[0].shape != images[1].shape:
        raise ValueError(
            f"source, target: expected two images (h, w, 3) of one size, got {images[1].shape} and {images[0].shape}"
        )
    scans = as_depth_scans(np.stack(images))
    placed = initialize_depth(scans, "full", key=jax.random.key(0))
    T = placed.T_world_camera
    camera = DepthCamera(scans.pinhole, float(typical_range(scans.points, scans.mask)), "full")
    rng = np.random.default_rng(0)
    pair = DepthImages([depth_view(scans, row, camera, rng) for row in range(2)], camera, _NUM_SAMPLES)
    ends = np.array([[1, 0]])
    system = linearise_images(pair, T, ends, SEARCH["full"].final_tolerance)
    # Without any pair the deviations are a typical range and a radian.
    information = system.information[0] + np.diag([camera.unit**-2.0] * 3 + [1.0] * 3)
    covariance = np.linalg.inv(information)[:3, :3]
    variances, axes = np.linalg.eigh(covariance)
    sigma = float(variances[-1] ** 0.5)
    evidence = PairEvidence(float(placed.explained.mean()), placed.lead, float(system.visible[0]), sigma / camera.unit)
    return ScanRegistration(
        T_target_source=T[1],
        confidence=DEPTH.probability(evidence),
        evidence=evidence,
        weak_direction=T[1][:3, :3] @ axes[:, -1],
        weak_sigma=sigma,
        information=information,
    )
