"""Registration of scans and maps without a first guess: hypotheses from descriptors, verified by the scans.

Two scans are registered the same from either side. Without a model, the scans alone suggest motions.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dpmjax.checks import require_pairs, require_type, runs_on_host
from dpmjax.deeppointmap.confidence import (
    MatchEvidence,
    gather_evidence,
    with_confidence,
)
from dpmjax.deeppointmap.encoding import (
    NUM_THREADS,
    ScanOrCloud,
    descriptors_of,
    encode,
    prepare_scans,
)
from dpmjax.deeppointmap.matching import MatchConfig, match_hypotheses
from dpmjax.deeppointmap.model import Model, correlate, descriptor_similarity, predict_offsets
from dpmjax.geometry import rigid
from dpmjax.geometry.bearing import directions_of
from dpmjax.kept_programs import kept_jit
from dpmjax.reading import read_path
from dpmjax.scan.lidar.align import LEVELS, align_on_host
from dpmjax.scan.lidar.choose import choose_motion, refine_motion, verify_elements
from dpmjax.scan.lidar.compare import CORRIDOR_CONFIDENCE, VerificationConfig
from dpmjax.scan.lidar.record import Scan, measure_scan, measured_elements, valid_points
from dpmjax.scan.lidar.sizes import matched_share, relative_size
from dpmjax.scan.lidar.slide import WeakDirection, corridor_axis, weakest_direction
from dpmjax.types import DescriptorCloud, Pose, Poses, RawScan, Registration, Verification

# Probability from which one way is enough: of 517 such motions of real pairs two were wrong.
SURE_PROBABILITY = 0.9

# Scans with a smaller median range are registered enlarged, too: of fragments of rooms (2.5 m) the network places none
# at their own size, those of a hall (7 m) all. Factor; and factor for the comparison, whose tolerances are a street's.
ROOM_M, ROOM_SCALE, FINE_SCALE = 5.0, 2.0, 3.0

# Number of surface elements of a scan that is registered with a cloud.
NUM_ELEMENTS = 1024

# Fewer descriptors fit each other by chance: any two sets of three points have a motion.
MIN_DESCRIPTORS = 20

# Largest confidence of a motion between scans of another size: 4 % of a street are half a metre.
OTHER_SIZE_CONFIDENCE = np.float32(0.8)

# Fields of `Registration` that are 0 for a motion that no pairs of descriptors support.
OF_THE_INLIERS = ("confidence", "mean_score", "support", "num_inliers", "is_inlier")

# Two scans that are ready for a registration.
ReadyPair = tuple[DescriptorCloud | Scan, DescriptorCloud | Scan]


@runs_on_host("call correlate and weighted_svd there")
def register(
    model: Model,
    source: ScanOrCloud,
    target: ScanOrCloud,
    *,
    refine: bool | None = None,
) -> Registration:
    """Registers two scans or maps without a first guess (DeepPointMap section 3.2).

    For two scans, the scans themselves verify the best distinct motions of their descriptors: points must meet surfaces
    and must not lie in free space. If none of these motions is clearly right, motions under which the scans look alike
    from above are tried too. In corridors, motions along the axis and half-turns are added. The motion under which the
    scans agree best is taken. Descriptor clouds have no points: the best motion of the descriptors is taken, and
    refined by their surface elements.

    With a calibrated model, exchanged scans give the inverse motion with the same probability. The library chooses
    which scan is the source. If the probability is below 0.9, it exchanges the scans and registers them again, and
    takes the more probable motion. Raw scans of small rooms are then registered at twice their size, too, and are
    never sure.

    Args:
        model: encoder and decoder.
        source: a raw scan (n, 3) in metres or its file, a scan from `prepare_scan`, or a descriptor cloud.
        target: the same; a scan can be registered with a map.
        refine: True ends with a fine point-to-plane alignment, of two scans or else of the surface elements of both
            clouds, if they have some. False returns the motion of the short alignment that verified it for two
            scans, else that of the descriptors. None is True with a calibrated model; published weights give the
            published motion.

    Returns:
        `T_target_source`, `confidence`, `rmse` and the pairs. The confidence of a calibrated model
        (`model.config.calibration`) is the probability that the motion is right within 2 m and 5 degrees. Without
        calibration it is the mean score of the pairs, which is no probability. Refined clouds of single scans with 512
        elements or more have the agreement of their elements as evidence, too. The ends of corridors may look alike in
        all elements, so the confidence of clouds is at most 0.88 there. A motion that only the views from above
        suggested has no inliers, and without calibration the confidence 0. Failure is data. The motion is the identity
        and the confidence 0 if there is neither a pair nor a view, or if either side has fewer than 20 descriptors.
        With fewer than three distinct pairs, `rmse` is infinite.

    Raises:
        ValueError: if the model is none, the points are no real numbers (n, 3), or features have another width than the
            model.
    """
    found = _register_either_way(model, [(source, target)], refine=refine)[0]
    is_raw = not any(isinstance(scan, DescriptorCloud | Scan) for scan in (source, target))
    if not is_raw or model.config.calibration is None or found.confidence >= SURE_PROBABILITY:
        return found
    return _register_as_room(model, source, target, found, refine=refine)


def _register_as_room(
    model: Model, source: ScanOrCloud, target: ScanOrCloud, found: Registration, *, refine: bool | None
) -> Registration:
    """Registers scans of small rooms enlarged, too: the motion is kept under which the surfaces meet more closely."""
    # The network has learned streets and halls, and the confidence is calibrated on these.
    points = [valid_points(cast(RawScan, read_path(scan, "io.read_lidar_file"))) for scan in (source, target)]
    if not all(len(some) and np.median(np.linalg.norm(some, axis=1)) < ROOM_M for some in points):
        return found
    one, two = (measure_scan(FINE_SCALE * some).surface for some in points)
    # Surfaces of a corridor meet after any shift along it.
    if any(corridor_axis(surface) is not None for surface in (one, two)):
        return found
    other = _register_either_way(model, [(ROOM_SCALE * points[0], ROOM_SCALE * points[1])], refine=refine)[0]
    T_other = other.T_target_source.at[:3, 3].divide(ROOM_SCALE)

    def agreement(T_target_source: Array) -> float:
        T = np.array(T_target_source, np.float64)
        T[:3, 3] *= FINE_SCALE
        return min(matched_share(one, two, T), matched_share(two, one, rigid.inverse(T)))

    if agreement(T_other) <= agreement(found.T_target_source):
        return found
    confidence, rmse = jnp.minimum(other.confidence, CORRIDOR_CONFIDENCE), other.rmse / ROOM_SCALE
    sigma_m = None if other.weak_sigma_m is None else other.weak_sigma_m / ROOM_SCALE
    return replace(other, T_target_source=T_other, rmse=rmse, weak_sigma_m=sigma_m, confidence=confidence)


@runs_on_host("call correlate and weighted_svd there")
def register_pairs(
    model: Model,
    sources: Sequence[ScanOrCloud],
    targets: Sequence[ScanOrCloud],
    *,
    refine: bool | None = None,
) -> Registration:
    """Registers many pairs as `register` does; a scan that is in several pairs is prepared once.

    Args:
        model: encoder and decoder.
        sources: raw scans, prepared scans or descriptor clouds; clouds must have one capacity.
        targets: the same, one for each source.
        refine: see `register`.

    Returns:
        All fields with a leading axis, in the order of the pairs.

    Raises:
        ValueError: if the lengths differ or are 0, if some pairs are scans and others have a descriptor cloud, or where
            `register` raises one for a pair.
    """
    require_pairs(sources, targets)
    pairs = list(zip(sources, targets, strict=True))
    if len({_are_scans(pair) for pair in pairs}) > 1:
        raise ValueError("sources, targets: expected scans in all pairs, or a descriptor cloud in each, got both")
    found = _register_either_way(model, pairs, refine=refine)
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *jax.device_get(found))


def _register_either_way(
    model: Model, pairs: Sequence[tuple[ScanOrCloud, ScanOrCloud]], *, refine: bool | None
) -> list[Registration]:
    """Registers each pair one way, and unsure pairs both ways. Without calibration, the given way is the only one."""
    require_type("model", model, Model, "load_model")
    ready = _prepared(model, pairs, refine=_refines(model, refine))
    if model.config.calibration is None:
        return register_each(model, ready, refine=refine)
    is_turned = [_order(source) > _order(target) for source, target in ready]
    one_way = [pair[::-1] if turned else pair for pair, turned in zip(ready, is_turned, strict=True)]
    found = register_each(model, one_way, refine=refine)
    unsure = [row for row, one in enumerate(found) if one.confidence < SURE_PROBABILITY]
    others = register_each(model, [one_way[row][::-1] for row in unsure], refine=refine)
    for row, other in zip(unsure, others, strict=True):
        if other.confidence > found[row].confidence:
            found[row] = inverse_registration(other)
    return [inverse_registration(one) if turned else one for one, turned in zip(found, is_turned, strict=True)]


def _prepared(model: Model, pairs: Sequence[tuple[ScanOrCloud, ScanOrCloud]], *, refine: bool) -> list[ReadyPair]:
    """Prepares each raw scan once; beside clouds a scan needs its descriptors alone."""
    raw = {id(scan): scan for pair in pairs for scan in pair if not isinstance(scan, DescriptorCloud | Scan)}
    made: list[DescriptorCloud] | list[Scan]
    if all(map(_are_scans, pairs)):
        made = prepare_scans(model, raw.values())
    else:
        num_elements = min(NUM_ELEMENTS, model.config.pyramid.stages[0].num_points) if refine else None
        made = [encode(model, scan, num_elements=num_elements) for scan in raw.values()]
    ready = dict(zip(raw, made, strict=True))
    return [cast(ReadyPair, tuple(ready.get(id(scan), scan) for scan in pair)) for pair in pairs]


def _are_scans(pair: tuple[ScanOrCloud, ScanOrCloud]) -> bool:
    """Returns True where both sides are scans, so that their surfaces can verify a motion."""
    return not any(isinstance(scan, DescriptorCloud) for scan in pair)


def _refines(model: Model, refine: bool | None) -> bool:
    return model.config.calibration is not None if refine is None else refine


def _order(scan: Scan | DescriptorCloud) -> tuple[int, float]:
    """Returns an order of scans that does not depend on the side of the pair."""
    points = scan.surface.points if isinstance(scan, Scan) else np.where(scan.mask[:, None], scan.positions, 0)
    return len(points), float(np.sum(points))


def inverse_registration(found: Registration) -> Registration:
    """Exchanges source and target of a registration.

    Args:
        found: one registration.

    Returns:
        The motion from the target to the source, with the same confidence and evidence.
    """
    T = jnp.asarray(rigid.inverse(np.asarray(found.T_target_source)))
    swapped = replace(
        found, T_target_source=T, source_indices=found.target_indices, target_indices=found.source_indices
    )
    if found.weak_direction is not None and found.relative_size is not None:
        direction, size = T[:3, :3] @ found.weak_direction, 1 / found.relative_size
        swapped = replace(swapped, weak_direction=direction, relative_size=size)
    return swapped


def register_each(model: Model, pairs: Sequence[ReadyPair], *, refine: bool | None = None) -> list[Registration]:
    """Registers pairs from source to target alone; threads verify one pair while JAX matches the next.

    Args:
        model: encoder and decoder.
        pairs: prepared scans or descriptor clouds.
        refine: see `register`.

    Returns:
        One registration for each pair.

    Raises:
        ValueError: see `register`.
    """
    refine, verification = _refines(model, refine), model.config.verification
    with ThreadPoolExecutor(NUM_THREADS) as pool:
        started = []
        for source, target in pairs:
            clouds = descriptors_of(source), descriptors_of(target)
            hypotheses = match_clouds(model, *clouds, config=model.config.matching)
            if min(int(np.sum(cloud.described.mask)) for cloud in clouds) < MIN_DESCRIPTORS:
                motion = pool.submit(_unregistered, source, target)
            elif isinstance(source, Scan) and isinstance(target, Scan):
                motion = pool.submit(_verified, source, target, hypotheses, verification, refine=refine)
            elif refine and all(cloud.normals is not None for cloud in clouds):
                motion = pool.submit(_refined, *clouds, hypotheses, model)
            else:
                motion = pool.submit(_RegisteredMotion, 0, np.asarray(hypotheses.T_target_source[0]))
            started.append((hypotheses, motion))
        return [_as_registration(model, hypotheses, motion.result()) for hypotheses, motion in started]


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
    motion = _refined(source, target, hypotheses, model)
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


def _unregistered(*scans: DescriptorCloud | Scan) -> _RegisteredMotion:
    """Returns the identity, with all fields that a registration of two scans has."""
    if any(isinstance(scan, DescriptorCloud) for scan in scans):
        return _RegisteredMotion(None, np.eye(4))
    return _RegisteredMotion(
        None, np.eye(4), None, Verification(0.0, 0.0, 0.0, 0.0), WeakDirection(np.zeros(3), np.inf)
    )


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
    source: DescriptorCloud, target: DescriptorCloud, hypotheses: Registration, model: Model
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
    return _RegisteredMotion(0, T_target_source, elements=agreement, num_elements=num_elements)


def _as_registration(model: Model, hypotheses: Registration, motion: _RegisteredMotion) -> Registration:
    """Joins the hypothesis that was chosen, its motion and its verification, and adds the confidence."""
    row = motion.row
    evidence = gather_evidence(hypotheses, row, motion.evidence, motion.elements, motion.num_elements)
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
