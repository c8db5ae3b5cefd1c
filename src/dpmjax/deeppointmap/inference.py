"""Inference: encode a raw scan to descriptors, register two scans or maps, predict their overlap.

`evaluate_registration` and `overlap_accuracy` measure a model on held-out pairs of scans.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from dpmjax.deeppointmap.confidence import gather_evidence, with_confidence
from dpmjax.deeppointmap.matching import MatchConfig, match_hypotheses
from dpmjax.deeppointmap.model import (
    Model,
    ModelConfig,
    correlate,
    encode_pyramid,
    overlap_probability,
    predict_offsets,
    similarity_features,
)
from dpmjax.deeppointmap.verification import (
    MeasuredScan,
    VerifiedMotion,
    choose_motion,
    measure_scan,
    refine_motion,
)
from dpmjax.geometry import se2
from dpmjax.geometry.pyramid_host import build_pyramid_on_host
from dpmjax.metrics.poses import RegistrationRecall, registration_recall
from dpmjax.scans.preprocess import preprocess_scan_on_host
from dpmjax.sequences import LidarSequence
from dpmjax.types import AnyArray, DescriptorCloud, PointCloud, PointPyramid, Registration, Verification

PAIR_STREAM = 3103
NEAR_M = (2.0, 10.0)
"""Least and largest distance between the scans of an evaluation pair."""

FAR_M = 40.0
"""Scans farther apart than this do not overlap."""


def encode(model: Model, points: PointCloud | Float[AnyArray, "n 3"]) -> DescriptorCloud:
    """Encodes a raw scan to descriptors, preprocessing included (DeepPointMap section 3.1).

    A `ValueError` says if the points are no real numbers (n, 3). A warning says if hardly any point is in range: the
    points are then probably not in metres.

    Args:
        model: its configuration includes the preprocessing.
        points: (n, 3), metres, in the frame of the lidar; points that are not finite are dropped.

    Returns:
        `model.config.num_descriptors` descriptors, metres, same frame. The mask of an empty scan is all False.
    """
    return encode_pyramid(model, pyramid_of_scan(points, model.config))


def pyramid_of_scan(points: PointCloud | Float[AnyArray, "n 3"], config: ModelConfig) -> PointPyramid:
    """Computes the first half of `encode` on the host: preprocessing, normalisation and the point pyramid.

    Args:
        points: (n, 3), metres, in the frame of the lidar; points that are not finite are dropped.
        config: preprocessing, pyramid, and scale of its coordinates.

    Returns:
        The pyramid, in normalised coordinates.

    Raises:
        ValueError: if the points are no real numbers (n, 3).
    """
    array, mask = (points.points, points.mask) if isinstance(points, PointCloud) else (points, None)
    array = np.asarray(array)
    if array.ndim != 2 or array.shape[1] != 3:
        hint = "; pass points[:, :3] without the reflectance" if array.shape[1:] == (4,) else ""
        raise ValueError(f"points: expected shape (n, 3), got {array.shape}{hint}")
    if not (np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)):
        raise ValueError(f"points: expected real numbers, got dtype {array.dtype}")
    cloud = preprocess_scan_on_host(array, None if mask is None else np.asarray(mask), config.preprocess)
    return pyramid_of_cloud(cloud, config)


def pyramid_of_cloud(cloud: PointCloud, config: ModelConfig, *, num_threads: int = 2) -> PointPyramid:
    """Converts metres to normalised coordinates and builds the pyramid on the host.

    Args:
        cloud: a preprocessed scan, metres, in the frame of the lidar.
        config: pyramid, and scale of its coordinates.
        num_threads: threads of the neighbour search.

    Returns:
        The pyramid, in normalised coordinates.
    """
    scaled = np.asarray(cloud.points) / np.float32(config.scale_m)
    return build_pyramid_on_host(scaled, np.asarray(cloud.mask), config.pyramid, num_threads=num_threads)


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

    A `ValueError` says if the points are no real numbers (n, 3), if features have another width than the model, or if
    `refine` is asked for without two scans.

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
    """
    if refine and (isinstance(source, DescriptorCloud) or isinstance(target, DescriptorCloud)):
        raise ValueError("refine: expected two scans, raw or from prepare_scan, got descriptors without points")
    matching = config or model.config.matching
    if isinstance(source, DescriptorCloud) or isinstance(target, DescriptorCloud):
        hypotheses = match_clouds(model, _as_cloud(model, source), _as_cloud(model, target), config=matching)
        return _with_confidence(model, hypotheses, 0, None)
    prepared = [scan if isinstance(scan, PreparedScan) else prepare_scan(model, scan) for scan in (source, target)]
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


class EvaluationPairs(NamedTuple):
    """Pairs of scans that are ready for all models of one configuration.

    Attributes:
        pyramids: pyramids of all scans, in normalised coordinates.
        T_world_scan: (n, 4, 4) true poses, metres.
        pairs: (p, 2) source and target of each pair.
        scale_m: metres in one unit of the pyramids.
    """

    pyramids: list[PointPyramid]
    T_world_scan: Float[np.ndarray, "n 4 4"]
    pairs: Int[np.ndarray, "p 2"]
    scale_m: float

    def scan_points(self, row: int) -> Float[np.ndarray, "n 3"]:
        """Returns the preprocessed points of a scan.

        Args:
            row: number of the scan.

        Returns:
            Points in the frame of the scan, metres.
        """
        level = self.pyramids[row].levels[0]
        return np.asarray(level.positions)[np.asarray(level.mask)] * np.float32(self.scale_m)


class Evaluation(NamedTuple):
    """Results of a model on evaluation pairs.

    Attributes:
        recall: errors, and the share of correct registrations.
        matches: registrations in the order of the pairs.
        clouds: descriptors of all scans.
        T_true: (p, 4, 4) true motions, target from source, metres.
    """

    recall: RegistrationRecall
    matches: list[Registration]
    clouds: list[DescriptorCloud]
    T_true: Float[np.ndarray, "p 4 4"]


def draw_evaluation_pairs(
    drive: LidarSequence, num_pairs: int, config: ModelConfig, *, seed: int = 0
) -> EvaluationPairs:
    """Draws random pairs of one drive; each scan is rotated by a random yaw. The two are 2 to 10 m apart.

    Args:
        drive: scans with true poses.
        num_pairs: number of pairs; fewer where the drive has fewer.
        config: preprocessing and pyramid.
        seed: seed of the draws.

    Returns:
        The pairs.

    Raises:
        ValueError: if the drive has no poses, or no such pairs.
    """
    rng = np.random.default_rng([PAIR_STREAM, seed])
    poses = drive.T_world_lidar
    if poses is None:
        raise ValueError("drive: expected a true pose for each scan, got none")
    distances = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    sources, targets = np.nonzero((distances >= NEAR_M[0]) & (distances <= NEAR_M[1]))
    if len(sources) == 0:
        raise ValueError(f"drive: expected scans {NEAR_M[0]} to {NEAR_M[1]} m apart, got none")
    chosen = rng.choice(len(sources), min(num_pairs, len(sources)), replace=False)
    rows = np.stack([sources[chosen], targets[chosen]], axis=1)
    pyramids, rotated = [], []
    for row, yaw in zip(rows.ravel(), rng.uniform(-np.pi, np.pi, rows.size), strict=True):
        T = np.eye(4)
        T[:2, :2] = se2.rotation(np.asarray(yaw))
        points = (drive.read_scan(int(row)) @ T[:3, :3].T).astype(np.float32)
        pyramids.append(pyramid_of_scan(points, config))
        rotated.append(poses[row] @ np.linalg.inv(T))
    return EvaluationPairs(pyramids, np.stack(rotated), np.arange(rows.size).reshape(-1, 2), config.scale_m)


def evaluate_registration(model: Model, pairs: EvaluationPairs) -> Evaluation:
    """Registers all pairs.

    Args:
        model: a model of the configuration that the pairs were drawn for.
        pairs: from `draw_evaluation_pairs`.

    Returns:
        Errors, registrations and descriptors.
    """
    clouds = [encode_pyramid(model, pyramid) for pyramid in pairs.pyramids]
    matches = [register(model, clouds[a], clouds[b]) for a, b in pairs.pairs]
    poses, (sources, targets) = pairs.T_world_scan, pairs.pairs.T
    T_true = np.linalg.inv(poses[targets]) @ poses[sources]
    T_found = np.stack([np.asarray(match.T_target_source) for match in matches])
    return Evaluation(registration_recall(T_found, T_true), matches, clouds, T_true)


def overlap_accuracy(model: Model, evaluation: Evaluation, pairs: EvaluationPairs) -> float:
    """Measures the overlap prediction on the pairs, and on as many pairs that are over 40 m apart.

    Args:
        model: the model of the evaluation.
        evaluation: from `evaluate_registration`.
        pairs: the pairs of the evaluation.

    Returns:
        Share of correct predictions.
    """
    positions, clouds = pairs.T_world_scan[:, :3, 3], evaluation.clouds
    is_right = []
    for a, b in pairs.pairs:
        is_right.append(float(overlap(model, clouds[a], clouds[b])) > 0.5)
        far = np.flatnonzero(np.linalg.norm(positions - positions[a], axis=1) > FAR_M)
        if len(far) > 0:
            other = int(far[(7 * int(a)) % len(far)])
            is_right.append(float(overlap(model, clouds[a], clouds[other])) <= 0.5)
    return float(np.mean(is_right))


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
