"""Registration of scans and maps: hypotheses from descriptors, verified by the scans; and whether two overlap."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dpmjax.deeppointmap.confidence import gather_evidence, with_confidence
from dpmjax.deeppointmap.encoding import encode, pyramid_of_scan, scene_scale
from dpmjax.deeppointmap.matching import MatchConfig, match_hypotheses
from dpmjax.deeppointmap.model import (
    Model,
    correlate,
    descriptor_similarity,
    encode_pyramid,
    predict_offsets,
)
from dpmjax.deeppointmap.motion_choice import choose_motion, refine_motion, weak_direction_of
from dpmjax.deeppointmap.overlap_prediction import overlap_probability
from dpmjax.deeppointmap.verification import MeasuredScan, VerificationConfig, measure_scan
from dpmjax.geometry.bearing import directions_of
from dpmjax.scans.element_alignment import align_elements_on_host
from dpmjax.scans.weak_directions import WeakDirection
from dpmjax.types import AnyArray, DescriptorCloud, PointCloud, Registration, Verification

NUM_THREADS = 2

NUM_ELEMENTS = 1024
"""Number of surface elements of a scan that is refined against a cloud."""


class PreparedScan(NamedTuple):
    """A scan that is ready for any number of registrations.

    Attributes:
        descriptors: of the scan; positions in metres times `scale`.
        measured: surface and free space of the scan, metres.
        scale: factor by which the points were enlarged for the encoder.
    """

    descriptors: DescriptorCloud
    measured: MeasuredScan
    scale: float = 1.0


RawScan = PointCloud | Float[AnyArray, "_n 3"]
"""Points in metres, in the frame of the lidar."""

ScanOrCloud = DescriptorCloud | PreparedScan | RawScan
"""A raw scan; or the same prepared; or descriptors of a scan or of a map."""

Scale = float | Literal["auto"]
"""Factor by which scans are enlarged for the encoder; "auto" chooses it by `scene_scale`."""


def prepare_scan(model: Model, points: RawScan, *, scale: float = 1.0) -> PreparedScan:
    """Encodes a raw scan and prepares the verification by its points, so that `register` need not do it again.

    A `ValueError` says if the points are no real numbers (n, 3), or if the scale is not positive.

    Args:
        model: encoder and configuration.
        points: (n, 3), metres, in the frame of the lidar; points that are not finite are dropped.
        scale: see `encode`.

    Returns:
        Descriptors, surface and free space.
    """
    return prepare_scans(model, [points], scale=scale)[0]


def prepare_scans(model: Model, scans: Sequence[RawScan], *, scale: float = 1.0) -> list[PreparedScan]:
    """Prepares scans in their order; threads measure their surfaces while JAX encodes.

    A `ValueError` says if the points of a scan are no real numbers (n, 3).

    Args:
        model: encoder and configuration.
        scans: points in metres, each in the frame of its lidar.
        scale: see `encode`.

    Returns:
        The prepared scans.
    """
    # Threads run NumPy only: compiled programs wait for threads of JAX, and may wait for each other.
    with ThreadPoolExecutor(NUM_THREADS) as pool:
        clouds, measured = [], []
        for points in scans:
            pyramid = pyramid_of_scan(points, model.config, scale=scale)
            measured.append(pool.submit(_measured, points, model.config.verification))
            clouds.append(encode_pyramid(model, pyramid))
        return [PreparedScan(cloud, future.result(), scale) for cloud, future in zip(clouds, measured, strict=True)]


def register(
    model: Model,
    source: ScanOrCloud,
    target: ScanOrCloud,
    *,
    config: MatchConfig | None = None,
    refine: bool | None = None,
    scale: Scale = 1.0,
) -> Registration:
    """Registers two scans or maps without a first guess (DeepPointMap section 3.2).

    For two scans, the scans themselves verify the best distinct motions of their descriptors: points must meet surfaces
    and must not lie in free space. If none of these motions is clearly right, motions under which the scans look alike
    from above are tried too. In corridors, motions along the axis and half-turns are added. The motion under which the
    scans agree best is taken. Descriptor clouds have no points: the best motion of the descriptors is taken, and
    refined by their surface elements.

    Args:
        model: encoder and decoder.
        source: a raw scan (n, 3) in metres, a scan from `prepare_scan`, or a descriptor cloud.
        target: the same; a scan can be registered with a map.
        config: choice of pairs and inliers; None takes that of the model.
        refine: whether to end with a fine point-to-plane alignment: of two scans, or else of the surface elements of
            both clouds, if they have some. Without it, the motion of two scans is that of the short alignment that
            verified it, and any other that of the descriptors. None refines with a calibrated model: published
            weights give the published motion.
        scale: factor by which raw scans are enlarged for the encoder, or by which descriptors were; "auto" chooses 1,
            2 or 4 from the extent of both scans. Prepared scans know theirs. The result is in metres.

    Returns:
        `T_target_source`, `confidence`, `rmse` and the pairs. The confidence of a calibrated model
        (`model.config.calibration`) is the probability that the motion is right within 2 m and 5 degrees. Without
        calibration it is the mean score of the pairs, which is no probability. A motion that only the views from above
        suggested has no inliers, and without calibration the confidence 0. Failure is data: without any pair and
        without a view the motion is the identity and the confidence 0; with fewer than three distinct pairs `rmse` is
        infinite.

    Raises:
        ValueError: if the points are no real numbers (n, 3), if features have another width than the model, if both
            have another scale, or if "auto" meets descriptors.
    """
    return register_each(model, [(source, target)], config=config, refine=refine, scale=scale)[0]


def register_each(
    model: Model,
    pairs: Sequence[tuple[ScanOrCloud, ScanOrCloud]],
    *,
    config: MatchConfig | None = None,
    refine: bool | None = None,
    scale: Scale = 1.0,
) -> list[Registration]:
    """Registers pairs as `register` does; threads verify one pair while JAX matches the next.

    Args:
        model: encoder and decoder.
        pairs: source and target of each; a scan that is in several pairs is prepared once.
        config: see `register`.
        refine: see `register`.
        scale: see `register`; all raw scans share one.

    Returns:
        One registration for each pair.

    Raises:
        ValueError: as `register` says.
    """
    refine = model.config.calibration is not None if refine is None else refine
    scale = _scale_of(pairs, scale, model)
    prepared = _prepared(model, pairs, scale, num_elements=_num_elements(model) if refine else None)
    matching, verification = config or model.config.matching, model.config.verification
    with ThreadPoolExecutor(NUM_THREADS) as pool:
        started = []
        for pair in pairs:
            source, target = (prepared[id(scan)] for scan in pair)
            clouds = _descriptors(source), _descriptors(target)
            in_cloud_units = match_clouds(model, *clouds, config=matching)
            pair_scale = _shared_scale(source, target, scale)
            hypotheses = _in_metres(in_cloud_units, pair_scale)
            motions: Future[_Motions] | None = None
            if isinstance(source, PreparedScan) and isinstance(target, PreparedScan):
                scans = source.measured, target.measured
                motions = pool.submit(_verified, *scans, hypotheses, verification, refine=refine)
            elif refine and all(cloud.normals is not None for cloud in clouds):
                motions = pool.submit(_refined, *clouds, in_cloud_units, pair_scale)
            started.append((hypotheses, motions))
        return [
            _finished(model, hypotheses, None if motions is None else motions.result())
            for hypotheses, motions in started
        ]


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
    return jax.device_get(trace_match(model, source.described, target.described, config=config))


def overlap(model: Model, source: ScanOrCloud, target: ScanOrCloud) -> Float[Array, ""]:
    """Predicts the probability that two scans or maps overlap: that their origins are less than 20 m apart.

    A calibrated model (`model.config.overlap`, from `python -m experiments.dpm_calibrate`) rests it on the match of the
    descriptors. It is fitted on simulated towns and buildings. Half of the pairs overlapped, a quarter was 20 to 40 m
    apart, and a quarter was farther apart or of different places. Where overlap is rarer, the probability is too high.
    A model without it answers with the decoder's head (DeepPointMap section 3.2), which is right for published weights
    only.

    A `ValueError` says if the points are no real numbers (n, 3), or if features have another width than the model.

    Args:
        model: encoder and decoder.
        source: a raw scan (n, 3) in metres, a scan from `prepare_scan`, or a descriptor cloud.
        target: the same; the order matters a little.

    Returns:
        The probability; 0 where a scan is empty or a feature is not finite.
    """
    return overlap_probability(model, _as_cloud(model, source).described, _as_cloud(model, target).described)


def distinct_motions(hypotheses: Registration) -> Float[np.ndarray, "h 4 4"]:
    """Returns the motions of the hypotheses that any pair supports; at least one.

    Args:
        hypotheses: from `match_clouds`.

    Returns:
        T_target_source in float64, best first.
    """
    num_motions = max(1, int((hypotheses.support > 0).sum()))
    return np.asarray(hypotheses.T_target_source[:num_motions], np.float64)


class _Motions(NamedTuple):
    # The chosen hypothesis and its final motion, metres. The confidence rests on the evidence before the refinement.
    row: int | None
    T_target_source: Float[np.ndarray, "4 4"]
    evidence: Verification | None = None
    verification: Verification | None = None
    weak: WeakDirection | None = None


def _num_elements(model: Model) -> int:
    return min(NUM_ELEMENTS, model.config.pyramid.stages[0].num_points)


def _measured(points: RawScan, config: VerificationConfig) -> MeasuredScan:
    array = np.asarray(points.points)[np.asarray(points.mask)] if isinstance(points, PointCloud) else np.asarray(points)
    return measure_scan(array, config)


def _scale_of(pairs: Sequence[tuple[ScanOrCloud, ScanOrCloud]], scale: Scale, model: Model) -> float:
    if scale != "auto":
        return scale
    scans = [scan for pair in pairs for scan in pair if not isinstance(scan, PreparedScan)]
    if any(isinstance(scan, DescriptorCloud) for scan in scans):
        raise ValueError('scale: "auto" needs scans, got descriptors; give the factor that they were encoded with')
    return scene_scale([scan for scan in scans if not isinstance(scan, DescriptorCloud)], model.config)


def _shared_scale(
    source: DescriptorCloud | PreparedScan, target: DescriptorCloud | PreparedScan, scale: float
) -> float:
    scales = [scan.scale if isinstance(scan, PreparedScan) else scale for scan in (source, target)]
    if scales[0] != scales[1]:
        raise ValueError(f"target: expected scale {scales[0]:g} as the source, got {scales[1]:g}")
    return scales[0]


def _in_metres(hypotheses: Registration, scale: float) -> Registration:
    if scale == 1:
        return hypotheses
    T = np.array(hypotheses.T_target_source)
    T[:, :3, 3] /= scale
    return replace(hypotheses, T_target_source=jnp.asarray(T), rmse=hypotheses.rmse / np.float32(scale))


def _prepared(
    model: Model, pairs: Sequence[tuple[ScanOrCloud, ScanOrCloud]], scale: float, *, num_elements: int | None
) -> dict[int, DescriptorCloud | PreparedScan]:
    # By identity; each scan once. Surfaces are measured only where both sides of a pair are scans.
    raw: dict[int, RawScan] = {}
    ready: dict[int, DescriptorCloud | PreparedScan] = {}
    for pair in pairs:
        is_verified = not any(isinstance(scan, DescriptorCloud) for scan in pair)
        for scan in pair:
            if isinstance(scan, DescriptorCloud | PreparedScan):
                ready[id(scan)] = scan
            elif is_verified:
                raw[id(scan)] = scan
            elif id(scan) not in ready:
                ready[id(scan)] = encode(model, scan, scale=scale, num_elements=num_elements)
    return {**ready, **dict(zip(raw, prepare_scans(model, list(raw.values()), scale=scale), strict=True))}


def _verified(
    source: MeasuredScan, target: MeasuredScan, hypotheses: Registration, config: VerificationConfig, *, refine: bool
) -> _Motions:
    chosen = choose_motion(source, target, distinct_motions(hypotheses), config)
    final = refine_motion(source, target, chosen, config) if refine else chosen
    T = final.T_target_source
    weak = weak_direction_of(source, target, T, config)
    return _Motions(chosen.row, T, chosen.verification, final.verification, weak)


def _refined(source: DescriptorCloud, target: DescriptorCloud, hypotheses: Registration, scale: float) -> _Motions:
    # The elements alone cannot choose among hypotheses: in a corridor, or after a half-turn, wrong ones meet the same
    # number of planes.
    T_target_source = np.array(hypotheses.T_target_source[0], np.float64)
    if hypotheses.num_inliers[0] > 0 and np.isfinite(T_target_source).all():
        aligned = align_elements_on_host(source.elements, target.elements, T_target_source)
        T_target_source = np.array(aligned.T_target_source)
    T_target_source[:3, 3] /= scale
    return _Motions(0, T_target_source)


def _finished(model: Model, hypotheses: Registration, motions: _Motions | None) -> Registration:
    row = 0 if motions is None else motions.row
    evidence = gather_evidence(hypotheses, row, None if motions is None else motions.evidence)
    match = jax.tree.map(lambda leaf: jnp.asarray(leaf[0 if row is None else row]), hypotheses)
    if row is None:
        match = _without_inliers(match)
    if motions is not None:
        T = jnp.asarray(motions.T_target_source, match.T_target_source.dtype)
        match = replace(match, T_target_source=T, verification=motions.verification)
    if motions is not None and motions.weak is not None:
        direction, sigma_m = (jnp.asarray(value, match.T_target_source.dtype) for value in motions.weak)
        match = replace(match, weak_direction=direction, weak_sigma_m=sigma_m)
    return with_confidence(match, evidence, model.config.calibration)


def _without_inliers(match: Registration) -> Registration:
    zero = jnp.zeros_like(match.support)
    return replace(
        match,
        confidence=zero,
        mean_score=zero,
        rmse=zero + jnp.inf,
        support=zero,
        num_inliers=jnp.zeros_like(match.num_inliers),
        is_inlier=jnp.zeros_like(match.is_inlier),
    )


def _descriptors(scan: DescriptorCloud | PreparedScan) -> DescriptorCloud:
    return scan.descriptors if isinstance(scan, PreparedScan) else scan


def _as_cloud(model: Model, scan: ScanOrCloud) -> DescriptorCloud:
    return _descriptors(scan) if isinstance(scan, DescriptorCloud | PreparedScan) else encode(model, scan)


@functools.partial(jax.jit, static_argnames="config")
def trace_match(model: Model, source: DescriptorCloud, target: DescriptorCloud, *, config: MatchConfig) -> Registration:
    """Does the work of `match_clouds`; for use in compiled programs.

    Args:
        model: encoder and decoder.
        source: uncorrelated descriptors.
        target: the same.
        config: choice of pairs, inliers and hypotheses.

    Returns:
        All hypotheses, with a leading axis.
    """
    source, target = correlate(model, source, target)
    similarity = descriptor_similarity(model, source, target)

    def offsets(source_rows: Array, target_rows: Array) -> tuple[Array, Array]:
        a, b = source.features[source_rows], target.features[target_rows]
        of_source, of_target = directions_of(source)[source_rows], directions_of(target)[target_rows]
        return predict_offsets(model, a, b, of_source), predict_offsets(model, b, a, of_target)

    return match_hypotheses(source, target, similarity, offsets, config=config)
