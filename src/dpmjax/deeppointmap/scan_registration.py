"""Registration of scans and maps: hypotheses from descriptors, verified by the scans; and whether two overlap."""

from __future__ import annotations

import functools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from dpmjax.deeppointmap.confidence import gather_evidence, with_confidence
from dpmjax.deeppointmap.encoding import encode
from dpmjax.deeppointmap.matching import MatchConfig, match_hypotheses
from dpmjax.deeppointmap.model import Model, correlate, overlap_probability, predict_offsets, similarity_features
from dpmjax.deeppointmap.verification import (
    MeasuredScan,
    VerifiedMotion,
    choose_motion,
    measure_scan,
    refine_motion,
)
from dpmjax.types import AnyArray, DescriptorCloud, PointCloud, Registration, Verification


class PreparedScan(NamedTuple):
    """A scan that is ready for any number of registrations.

    Attributes:
        descriptors: of the scan, or of a map in its frame.
        measured: surface and free space of the scan.
    """

    descriptors: DescriptorCloud
    measured: MeasuredScan


ScanOrCloud = DescriptorCloud | PreparedScan | PointCloud | Float[AnyArray, "_n 3"]
"""A raw scan in metres, in the frame of its lidar; or the same prepared; or descriptors of a scan or of a map."""


def prepare_scan(model: Model, points: PointCloud | Float[AnyArray, "n 3"]) -> PreparedScan:
    """Encodes a raw scan and prepares the verification by its points, so that `register` need not do it again.

    A `ValueError` says if the points are no real numbers (n, 3).

    Args:
        model: encoder and configuration.
        points: (n, 3), metres, in the frame of the lidar; points that are not finite are dropped.

    Returns:
        Descriptors, surface and free space.
    """
    cloud = encode(model, points)
    array = np.asarray(points.points)[np.asarray(points.mask)] if isinstance(points, PointCloud) else np.asarray(points)
    return PreparedScan(cloud, measure_scan(array, model.config.verification))


def register(
    model: Model,
    source: ScanOrCloud,
    target: ScanOrCloud,
    *,
    config: MatchConfig | None = None,
    refine: bool = False,
) -> Registration:
    """Registers two scans or maps without a first guess (DeepPointMap section 3.2).

    Where both are scans, the best distinct motions of the descriptors are verified by the scans themselves: points
    must meet surfaces and leave free space free. The motion under which the scans agree best is taken.

    Args:
        model: encoder and decoder.
        source: a raw scan (n, 3) in metres, a scan from `prepare_scan`, or a descriptor cloud.
        target: the same; one may be a scan and the other a map.
        config: choice of pairs and inliers; None takes that of the model.
        refine: whether to end with a fine point-to-plane alignment of the scans. Without it, the motion of two scans is
            that of the short alignment that verified it, and any other that of the descriptors.

    Returns:
        `T_target_source`, `confidence`, `rmse_m` and the pairs. The confidence is the probability that the motion is
        right within 2 m and 5 degrees if the model is calibrated (`model.config.calibration`), else the mean score of
        the pairs, which is no probability. Failure is data: without any pair the motion is the identity and the
        confidence 0; with fewer than three distinct pairs `rmse_m` is infinite.

    Raises:
        ValueError: if the points are no real numbers (n, 3), if features have another width than the model, or if
            `refine` is asked for without two scans.
    """
    if refine and (isinstance(source, DescriptorCloud) or isinstance(target, DescriptorCloud)):
        raise ValueError("refine: expected two scans, raw or from prepare_scan, got descriptors without points")
    matching = config or model.config.matching
    if isinstance(source, DescriptorCloud) or isinstance(target, DescriptorCloud):
        hypotheses = match_clouds(model, _as_cloud(model, source), _as_cloud(model, target), config=matching)
        return _with_confidence(model, hypotheses, 0, None)
    with ThreadPoolExecutor(2) as pool:
        prepared = list(pool.map(functools.partial(_as_prepared, model), (source, target)))
    hypotheses, motion = verify_hypotheses(model, prepared[0], prepared[1], config=matching)
    match = _with_confidence(model, hypotheses, motion.row, motion.verification)
    if refine:
        motion = refine_motion(prepared[0].measured, prepared[1].measured, motion, model.config.verification)
    T = jnp.asarray(motion.T_target_source, match.T_target_source.dtype)
    return replace(match, T_target_source=T, verification=motion.verification)


def verify_hypotheses(
    model: Model, source: PreparedScan, target: PreparedScan, *, config: MatchConfig
) -> tuple[Registration, VerifiedMotion]:
    """Matches the descriptors of two scans and chooses the motion under which the scans agree best.

    Args:
        model: encoder and decoder.
        source: a scan.
        target: the other.
        config: choice of pairs, inliers and hypotheses.

    Returns:
        All hypotheses, with a leading axis and on the host; and the chosen one, aligned.
    """
    hypotheses = match_clouds(model, source.descriptors, target.descriptors, config=config)
    num_motions = max(1, int((hypotheses.support > 0).sum()))
    motions = np.asarray(hypotheses.T_target_source[:num_motions], np.float64)
    return hypotheses, choose_motion(source.measured, target.measured, motions, model.config.verification)


def match_clouds(
    model: Model, source: DescriptorCloud, target: DescriptorCloud, *, config: MatchConfig
) -> Registration:
    """Correlates two descriptor clouds and estimates the best distinct motions between them.

    Args:
        model: encoder and decoder.
        source: uncorrelated descriptors.
        target: the same.
        config: choice of pairs, inliers and hypotheses.

    Returns:
        All hypotheses, with a leading axis, as arrays of NumPy on the host.
    """
    return jax.device_get(_match_clouds(model, source, target, config=config))


def overlap(model: Model, source: ScanOrCloud, target: ScanOrCloud) -> Float[Array, ""]:
    """Predicts the probability that two scans or maps overlap: less than 20 m apart (DeepPointMap section 3.2).

    A `ValueError` says if the points are no real numbers (n, 3), or if features have another width than the model.

    Args:
        model: encoder and decoder.
        source: a raw scan (n, 3) in metres, or a descriptor cloud.
        target: the same; the order matters a little.

    Returns:
        The probability; 0 where a scan is empty or a feature is not finite.
    """
    return overlap_probability(model, _as_cloud(model, source), _as_cloud(model, target))


def _as_prepared(model: Model, scan: PreparedScan | PointCloud | Float[AnyArray, "_n 3"]) -> PreparedScan:
    return scan if isinstance(scan, PreparedScan) else prepare_scan(model, scan)


def _as_cloud(model: Model, scan: ScanOrCloud) -> DescriptorCloud:
    if isinstance(scan, PreparedScan):
        return scan.descriptors
    return scan if isinstance(scan, DescriptorCloud) else encode(model, scan)


def _with_confidence(
    model: Model, hypotheses: Registration, row: int, verification: Verification | None
) -> Registration:
    match = jax.tree.map(lambda leaf: jnp.asarray(leaf[row]), hypotheses)
    match = replace(match, verification=verification)
    return with_confidence(match, gather_evidence(hypotheses, row, verification), model.config.calibration)


@functools.partial(jax.jit, static_argnames="config")
def _match_clouds(
    model: Model, source: DescriptorCloud, target: DescriptorCloud, *, config: MatchConfig
) -> Registration:
    source, target = correlate(model, source, target)
    directions = [_unit(similarity_features(model, cloud)) for cloud in (source, target)]
    similarity = jnp.matmul(directions[0], directions[1].T, precision=lax.Precision.HIGHEST)

    def offsets(source_rows: Array, target_rows: Array) -> tuple[Array, Array]:
        a, b = source.features[source_rows], target.features[target_rows]
        return predict_offsets(model, a, b), predict_offsets(model, b, a)

    return match_hypotheses(source, target, similarity, offsets, config=config)


def _unit(features: Float[Array, "m c"]) -> Float[Array, "m c"]:
    squared = jnp.sum(features.astype(jnp.float32) ** 2, axis=1, keepdims=True)
    return features / jnp.sqrt(jnp.where(squared > 0, squared, 1))
