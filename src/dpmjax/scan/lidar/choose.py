"""Choice among motion hypotheses: each is aligned by the surfaces of both scans, and compared by them.

A clearly right motion competes with motions to other places under which the scans look alike from above.
In corridors wrong motions agree with the scans, too. There, motions along the axis and half-turns are tried, and the
surface elements that face the axis decide.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import count, repeat
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import are_near
from dpmjax.scan.lidar.align import AlignmentLevel, align_on_host
from dpmjax.scan.lidar.compare import VerificationConfig, compare_scans, verify_motions
from dpmjax.scan.lidar.propose import ViewCorrelationConfig, correlate_views
from dpmjax.scan.lidar.record import Scan
from dpmjax.scan.lidar.slide import WallAxis, facing_samples, sliding_motions, wall_axis, weak_share
from dpmjax.types import Pose, Poses, Verification

# Alignment of each hypothesis.
COARSE = (AlignmentLevel(3.0, 600, 5),)

# Alignment of the best `NUM_FINE` hypotheses.
FINE = (AlignmentLevel(1.0, 1500, 5),)

# Alignment of the chosen hypothesis by `refine_motion`; it starts where `FINE` ended.
REFINEMENT = (AlignmentLevel(1.0, 4000, 8), AlignmentLevel(0.4, 8000, 10))

NUM_FINE = 3

# No further hypothesis is tried after one with higher log odds.
CLEAR_SCORE = 1.0

# Spacing of the motions that are tried along a weak axis.
SLIDING_STEP_M = 0.7

# Number of these motions that are aligned finely.
NUM_SLID_FINE = 32

# Surface elements of descriptor clouds are metres apart.
ELEMENT_RADIUS_M = 2.0

# Alignment of elements, and number of sliding motions that are aligned by it.
OF_ELEMENTS = (AlignmentLevel(3.0, 1024, 5, kernel_m=0.5), AlignmentLevel(2.0, 1024, 4, kernel_m=0.2))
NUM_SLID_ELEMENTS = 16

# Number of elements of each scan that face the axis and are compared.
NUM_FACING = 4000

# Largest number of elements that count at one position along the axis, so that an end wall is one observation; the two
# ends of a corridor may look alike.
MAX_FACING = 10.0

# Penalty of an element that faces the axis and lies in free space; an element that meets a plane adds 1.
FACING_CONTRADICTED = 3.0

# Penalty of a visible element that faces the axis.
FACING_VISIBLE = 0.2

HYPOTHESES_AT_ONCE = 4

# Rows of motions that no descriptors support.
UNSUPPORTED = repeat(None)

# Motions that differ by less end in the same place.
DISTINCT_M, DISTINCT_RAD = 2.0, math.radians(5.0)

# Fields of `Verification` that rest on all motions that were tried.
OF_THE_SEARCH = ("gap", "num_tried", "num_slid", "facing_gap", "distinct_gap", "lookalike_gap")


class VerifiedMotion(NamedTuple):
    """A hypothesis after verification.

    Attributes:
        row: row of the hypothesis of the descriptors that it comes from, or agrees with; None for a motion of the
            correlated views alone.
        T_target_source: its motion after the alignment of the surfaces.
        verification: agreement of the scans under that motion.
    """

    row: int | None
    T_target_source: Pose
    verification: Verification


def choose_motion(source: Scan, target: Scan, T_target_source: Poses, config: VerificationConfig) -> VerifiedMotion:
    """Chooses the hypothesis under which two scans agree best.

    The walls of a corridor constrain one horizontal direction only. There, motions along its axis are tried too, with
    and without a half-turn, and the elements that face the axis decide. Elsewhere a clearly right hypothesis ends the
    search, and competes with motions to other places that look alike; the best of all is chosen.

    Args:
        source: a scan.
        target: the second scan.
        T_target_source: at least one hypothesis, the most likely first.
        config: alignments and tolerances.

    Returns:
        The best motion, aligned.
    """
    pair, hypotheses = _Pair(source, target, config), np.asarray(T_target_source, float)
    tried, lookalikes = list[VerifiedMotion](), list[VerifiedMotion]()
    for rows, T in pair.candidates(hypotheses):
        tried = _best_first([*tried, *pair.aligned(rows, T, COARSE)])
        if tried[0].verification.score > CLEAR_SCORE:
            lookalikes = pair.lookalikes(tried[0].T_target_source)
            break
    finalists, remaining = pair.refined(tried[:NUM_FINE]), tried[NUM_FINE:]
    lookalikes = pair.refined(lookalikes[:NUM_FINE])
    axes = wall_axis(source.surface), wall_axis(target.surface)
    is_weak = weak_share(*axes) < config.max_weak_share
    starts = sliding_motions(*axes, SLIDING_STEP_M) if is_weak else hypotheses[:0]
    if is_weak:
        slid = align_on_host(source.surface, target.surface, starts, COARSE).T_target_source
        order = np.argsort(-pair.facing_elements(axes, slid)[0], kind="stable")
        finalists += pair.aligned(UNSUPPORTED, slid[order[:NUM_SLID_FINE]], FINE)
    motions = [*lookalikes, *finalists, *remaining]
    T = np.stack([motion.T_target_source for motion in motions])
    scores = np.array([motion.verification.score for motion in motions])
    facing, met_share = pair.facing_elements(axes, T) if is_weak else np.zeros((2, len(motions)))
    best = int(np.argmax((facing if is_weak else scores)[: len(lookalikes) + len(finalists)]))
    chosen, is_other = motions[best], _is_apart(T, T[best])
    if chosen.row is None:
        agreeing = np.flatnonzero(~_is_apart(hypotheses, T[best]))
        chosen = chosen._replace(row=int(agreeing[0]) if len(agreeing) else None)
    # In corridors shifts along the axis look alike, and the elements that face the axis decide.
    is_compared = len(lookalikes) > 0 and not is_weak
    lookalike_gap = float(scores[best] - scores[is_other].max(initial=-np.inf)) if is_compared else np.inf
    is_other[: len(lookalikes)] = False
    gap, facing_gap = (float(values[best] - values[is_other].max(initial=0.0)) for values in (scores, facing))
    distinct_gap = float(facing_gap * max(facing_gap, 0.0) / max(facing[best], 1.0) * met_share[best])
    found = chosen.verification._replace(facing_gap=facing_gap, distinct_gap=distinct_gap, lookalike_gap=lookalike_gap)
    return chosen._replace(verification=found._replace(gap=gap, num_tried=len(tried), num_slid=len(starts)))


def _best_first(motions: list[VerifiedMotion]) -> list[VerifiedMotion]:
    return sorted(motions, key=lambda motion: -motion.verification.score)


class _Pair(NamedTuple):
    # The two scans whose motion is chosen.
    source: Scan
    target: Scan
    config: VerificationConfig

    def candidates(self, T_target_source: Poses) -> Iterator[tuple[Iterable[int | None], Poses]]:
        """Yields hypotheses in batches; from the second on, they alternate with motions of the correlated views."""
        yield count(), T_target_source[:HYPOTHESES_AT_ONCE]
        searched = T_target_source[:0]
        if self.config.views.num_motions > 0:
            searched = correlate_views(self.source.surface, self.target.surface, self.config.views)
        for start in range(0, max(len(searched), len(T_target_source) - HYPOTHESES_AT_ONCE), HYPOTHESES_AT_ONCE):
            end = start + HYPOTHESES_AT_ONCE
            yield UNSUPPORTED, searched[start:end]
            yield count(end), T_target_source[end : end + HYPOTHESES_AT_ONCE]

    def lookalikes(self, T_target_source: Pose) -> list[VerifiedMotion]:
        """Returns aligned motions to other places under which the views look alike, too, the best first."""
        if self.config.num_lookalikes == 0:
            return []
        views = ViewCorrelationConfig(self.config.num_lookalikes)
        found = correlate_views(self.source.surface, self.target.surface, views, beside=T_target_source)
        similar = self.aligned(UNSUPPORTED, found, COARSE)
        return _best_first([one for one in similar if _is_apart(one.T_target_source[None], T_target_source)[0]])

    def refined(self, motions: Sequence[VerifiedMotion]) -> list[VerifiedMotion]:
        """Aligns motions finely, and verifies them again."""
        rows, T = [motion.row for motion in motions], [motion.T_target_source for motion in motions]
        return self.aligned(rows, np.reshape(T, (-1, 4, 4)), FINE)

    def aligned(
        self, rows: Iterable[int | None], T_target_source: Poses, levels: tuple[AlignmentLevel, ...]
    ) -> list[VerifiedMotion]:
        """Aligns the surfaces of both scans from each motion, and verifies the results."""
        if len(T_target_source) == 0:
            return []
        T = align_on_host(self.source.surface, self.target.surface, T_target_source, levels).T_target_source
        verified = verify_motions(self.source, self.target, T, self.config)
        return list(map(VerifiedMotion, rows, T, verified))

    def facing_elements(self, axes: Sequence[WallAxis], T_target_source: Poses) -> Float[np.ndarray, "2 s"]:
        """Counts elements that face the weak axis and meet; those in free space and unmet visible ones are deducted.

        Returns:
            The counts; and the shares of visible ones that meet, each of the scan with the smaller share.
        """
        settings, counts, shares = replace(self.config, num_samples=NUM_FACING), [], []
        scans, motions = (self.source, self.target), (T_target_source, rigid.inverse(T_target_source))
        for scan, other, axis, T_other_scan in zip(scans, scans[::-1], axes, motions, strict=True):
            surface, weights = facing_samples(scan.surface, axis.axis, MAX_FACING)
            side = compare_scans(scan._replace(surface=surface), other, T_other_scan, settings)
            values = side.meets - FACING_CONTRADICTED * side.is_contradicted - FACING_VISIBLE * side.is_visible
            weights = weights[:NUM_FACING]
            counts.append(values @ weights)
            shares.append((side.meets & side.is_visible) @ weights / np.maximum(side.is_visible @ weights, 1.0))
        return np.stack([np.mean(counts, axis=0), np.min(shares, axis=0)])


def refine_motion(source: Scan, target: Scan, motion: VerifiedMotion, config: VerificationConfig) -> VerifiedMotion:
    """Aligns the surfaces of two scans point to plane, as finely as the scans allow.

    Args:
        source: a scan.
        target: the second scan.
        motion: motion from `choose_motion`.
        config: alignment and tolerances.

    Returns:
        The refined motion and its verification.
    """
    T = align_on_host(source.surface, target.surface, motion.T_target_source[None], REFINEMENT).T_target_source
    found = verify_motions(source, target, T, config)[0]
    kept = {name: getattr(motion.verification, name) for name in OF_THE_SEARCH}
    return VerifiedMotion(motion.row, T[0], found._replace(**kept))


def verify_elements(source: Scan, target: Scan, T_target_source: Pose, config: VerificationConfig) -> Verification:
    """Compares the surface elements of two scans under a motion that is kept.

    In corridors motions along the axis are tried as by `choose_motion`. Elements are too few to choose among these, but
    not to tell that another motion agrees as well.

    Args:
        source: elements of a scan (`surface_of_elements`) and their range image.
        target: the same of the second scan.
        T_target_source: the motion, aligned.
        config: limit of a weak axis; number of elements that are compared.

    Returns:
        The agreement. `facing_gap` is negative where a motion along the axis agrees better.
    """
    pair, T = _Pair(source, target, replace(config, plane_radius_m=ELEMENT_RADIUS_M)), T_target_source[None]
    found = verify_motions(source, target, T, pair.config)[0]
    axes = wall_axis(source.surface), wall_axis(target.surface)
    if weak_share(*axes) >= config.max_weak_share:
        return found
    starts = sliding_motions(*axes, SLIDING_STEP_M)
    num_slid = len(starts)
    order = np.argsort(-pair.facing_elements(axes, starts)[0], kind="stable")
    starts = starts[order[:NUM_SLID_ELEMENTS]]
    slid = align_on_host(source.surface, target.surface, starts, OF_ELEMENTS).T_target_source
    own, *facing = pair.facing_elements(axes, np.concatenate([T, slid]))[0]
    best = np.array(facing)[_is_apart(slid, T_target_source)].max(initial=0.0)
    return found._replace(num_slid=num_slid, facing_gap=float(own - best))


def _is_apart(T: Poses, T_other: Pose) -> Bool[np.ndarray, " s"]:
    """Returns True for motions to another place than that of `T_other`; only these compete with it."""
    return np.array([not are_near(T_other, one, DISTINCT_M, DISTINCT_RAD) for one in T])
