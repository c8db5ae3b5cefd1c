"""Registration of scans and maps one way: hypotheses from descriptors, verified by the scans."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dpmjax.checks import require_type
from dpmjax.deeppointmap.confidence import MatchEvidence, gather_evidence, with_confidence
from dpmjax.deeppointmap.matching import MatchConfig, match_hypotheses
from dpmjax.deeppointmap.model import Model, correlate, descriptor_similarity, predict_offsets
from dpmjax.deeppointmap.motion_choice import choose_motion, refine_motion, verify_elements
from dpmjax.deeppointmap.prepared_scans import (
    ScanOrCloud,
    descriptors_of,
    is_verified_pair,
    prepare_each,
)
from dpmjax.deeppointmap.verification import NUM_THREADS, VerificationConfig
from dpmjax.geometry.bearing import directions_of
from dpmjax.kept_programs import kept_jit
from dpmjax.scans.align import LEVELS, align_on_host
from dpmjax.scans.lidar import Scan, measured_elements
from dpmjax.scans.sizes import relative_size
from dpmjax.scans.weak_directions import WeakDirection, weakest_direction
from dpmjax.types import DescriptorCloud, Pose, Poses, Registration, Verification

# Number of surface elements of a scan that is refined against a cloud.
NUM_ELEMENTS = 1024

# Fewer descriptors fit each other by chance: any two sets of three points have a motion.
MIN_DESCRIPTORS = 20

# Largest confidence of a motion between scans of another size: 4 % of a street are half a metre.
OTHER_SIZE_CONFIDENCE = np.float32(0.8)

# Agreement of two scans of which one has too few descriptors.
NOT_COMPARED = Verification(0.0, 0.0, 0.0, 0.0)

# Fields of `Registration` that are 0 for a motion that no pairs of descriptors support.
OF_THE_INLIERS = ("confidence", "mean_score", "support", "num_inliers", "is_inlier")


def register_each(
    model: Model,
    pairs: Sequence[tuple[ScanOrCloud, ScanOrCloud]],
    *,
    config: MatchConfig | None = None,
    refine: bool | None = None,
    scale: float = 1.0,
) -> list[Registration]:
    """Registers pairs from source to target alone; threads verify one pair while JAX matches the next.

    Args:
        model: encoder and decoder.
        pairs: source and target of each; a scan that is in several pairs is prepared once.
        config: see `register`.
        refine: see `register`.
        scale: see `register`; all raw scans share one.

    Returns:
        One registration for each pair.

    Raises:
        ValueError: see `register`.
    """
    require_type("model", model, Model, "load_model")
    num_elements = num_elements_of(model, refine=refine)
    refine = num_elements is not None
    prepared = prepare_each(model, pairs, scale, num_elements=num_elements)
    matching, verification = config or model.config.matching, model.config.verification
    with ThreadPoolExecutor(NUM_THREADS) as pool:
        started = []
        for pair in pairs:
            source, target = (prepared[id(scan), is_verified_pair(pair)] for scan in pair)
            clouds = descriptors_of(source), descriptors_of(target)
            in_cloud_units = match_clouds(model, *clouds, config=matching)
            pair_scale = _shared_scale(source, target, scale)
            hypotheses = _in_metres(in_cloud_units, pair_scale)
            if min(int(np.sum(cloud.described.mask)) for cloud in clouds) < MIN_DESCRIPTORS:
                motion = pool.submit(_unregistered, source, target)
            elif isinstance(source, Scan) and isinstance(target, Scan):
                motion = pool.submit(_verified, source, target, hypotheses, verification, refine=refine)
            elif refine and all(cloud.normals is not None for cloud in clouds):
                motion = pool.submit(_refined, *clouds, in_cloud_units, pair_scale, model)
            else:
                motion = pool.submit(_RegisteredMotion, 0, np.asarray(hypotheses.T_target_source[0]))
            started.append((hypotheses, motion))
        return [_as_registration(model, hypotheses, motion.result()) for hypotheses, motion in started]


def num_elements_of(model: Model, *, refine: bool | None) -> int | None:
    """Returns the number of surface elements of a scan that is registered with a cloud.

    Args:
        model: encoder and calibration.
        refine: see `register`.

    Returns:
        The number; None without refinement.
    """
    refine = model.config.calibration is not None if refine is None else refine
    return min(NUM_ELEMENTS, model.config.pyramid.stages[0].num_points) if refine else None


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


def register_clouds(model: Model, source: DescriptorCloud, target: DescriptorCloud) -> tuple[Pose, MatchEvidence]:
    """Registers two clouds of surface elements as `register` does, and keeps the features of the confidence.

    Args:
        model: encoder and decoder.
        source: descriptors of a scan with surface elements.
        target: the same of the second scan.

    Returns:
        T_target_source, and the features from which `register` computes the confidence.
    """
    hypotheses = match_clouds(model, source, target, config=model.config.matching)
    motion = _refined(source, target, hypotheses, 1.0, model)
    return motion.T_target_source, gather_evidence(hypotheses, motion.row, None, motion.elements, motion.num_elements)


def distinct_motions(hypotheses: Registration) -> Poses:
    """Returns the motions of the hypotheses that any pair supports; at least one.

    Args:
        hypotheses: hypotheses from `match_clouds`.

    Returns:
        T_target_source in float64, best first.
    """
    num_motions = max(1, int((hypotheses.support > 0).sum()))
    return np.asarray(hypotheses.T_target_source[:num_motions], np.float64)


class _RegisteredMotion(NamedTuple):
    """Chosen and refined motion of one pair, in metres; the confidence rests on the evidence before the refinement."""

    row: int | None
    T_target_source: Pose
    evidence: Verification | None = None
    verification: Verification | None = None
    weak: WeakDirection | None = None
    size: float = 1.0
    elements: Verification | None = None
    num_elements: int = 0


def _shared_scale(source: DescriptorCloud | Scan, target: DescriptorCloud | Scan, scale: float) -> float:
    """Returns the scale that both sides of a pair have; raises a `ValueError` if they differ."""
    scales = [scan.scale if isinstance(scan, Scan) else scale for scan in (source, target)]
    if scales[0] != scales[1]:
        raise ValueError(f"target: expected scale {scales[0]:g} as the source, got {scales[1]:g}")
    return scales[0]


def _in_metres(hypotheses: Registration, scale: float) -> Registration:
    """Scales the hypotheses from the units of the descriptors to metres."""
    T = np.array(hypotheses.T_target_source)
    T[:, :3, 3] /= scale
    return replace(hypotheses, T_target_source=jnp.asarray(T), rmse=hypotheses.rmse / np.float32(scale))


def _unregistered(*scans: DescriptorCloud | Scan) -> _RegisteredMotion:
    """Returns the identity, with all fields that a registration of two scans has."""
    if any(isinstance(scan, DescriptorCloud) for scan in scans):
        return _RegisteredMotion(None, np.eye(4))
    return _RegisteredMotion(None, np.eye(4), None, NOT_COMPARED, WeakDirection(np.zeros(3), np.inf))


def _verified(
    source: Scan, target: Scan, hypotheses: Registration, config: VerificationConfig, *, refine: bool
) -> _RegisteredMotion:
    """Chooses the motion of two scans by their surfaces and free space, and refines it on request."""
    chosen = choose_motion(source, target, distinct_motions(hypotheses), config)
    final = refine_motion(source, target, chosen, config) if refine else chosen
    T = final.T_target_source
    weak = weakest_direction(source.surface, target.surface, T, config.plane_radius_m)
    size = relative_size(source.surface, target.surface, T)
    return _RegisteredMotion(chosen.row, T, chosen.verification, final.verification, weak, size)


def _refined(
    source: DescriptorCloud, target: DescriptorCloud, hypotheses: Registration, scale: float, model: Model
) -> _RegisteredMotion:
    """Refines the best motion of two descriptor clouds by their surface elements, and compares these under it."""
    # The elements alone cannot choose among hypotheses: in a corridor, or after a half-turn, wrong ones meet the same
    # number of planes.
    T_target_source, agreement = np.array(hypotheses.T_target_source[0], np.float64), None
    num_elements = min(int(np.sum(cloud.mask)) for cloud in (source, target))
    if hypotheses.num_inliers[0] > 0 and np.isfinite(T_target_source).all():
        scans = measured_elements(source.elements), measured_elements(target.elements)
        surfaces = scans[0].surface, scans[1].surface
        T_target_source = align_on_host(*surfaces, T_target_source[None], LEVELS).T_target_source[0]
        # A map of several scans was not seen from one place: it has no free space of its own.
        if max(len(cloud.features) for cloud in (source, target)) <= model.config.num_descriptors:
            agreement = verify_elements(*scans, T_target_source, model.config.verification)
    T_target_source[:3, 3] /= scale
    return _RegisteredMotion(0, T_target_source, elements=agreement, num_elements=num_elements)


def _as_registration(model: Model, hypotheses: Registration, motion: _RegisteredMotion) -> Registration:
    """Joins the hypothesis that was chosen, its motion and its verification, and adds the confidence."""
    row, evidence = (
        motion.row,
        gather_evidence(hypotheses, motion.row, motion.evidence, motion.elements, motion.num_elements),
    )
    match = jax.tree.map(lambda leaf: jnp.asarray(leaf[row or 0]), hypotheses)
    if row is None:
        none = {name: jnp.zeros_like(getattr(match, name)) for name in OF_THE_INLIERS}
        match = replace(match, rmse=jnp.full_like(match.rmse, jnp.inf), **none)
    T = jnp.asarray(motion.T_target_source, match.T_target_source.dtype)
    match = replace(match, T_target_source=T, verification=motion.verification)
    if motion.weak is not None:
        direction, sigma_m, size = (jnp.asarray(value, T.dtype) for value in (*motion.weak, motion.size))
        match = replace(match, weak_direction=direction, weak_sigma_m=sigma_m, relative_size=size)
    match = with_confidence(match, evidence, model.config.calibration)
    # A motion cannot be right if the scans are of another size.
    is_limited = motion.size != 1 and model.config.calibration is not None
    return replace(match, confidence=jnp.minimum(match.confidence, OTHER_SIZE_CONFIDENCE)) if is_limited else match


@kept_jit("config")
def trace_match(model: Model, source: DescriptorCloud, target: DescriptorCloud, *, config: MatchConfig) -> Registration:
    """Matches two clouds as `match_clouds` does, inside a compiled program.

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
