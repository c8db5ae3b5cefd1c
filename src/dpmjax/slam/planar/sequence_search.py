"""Poses of a sequence of scans by beam search, with several hypotheses for each scan.

If two scans share few beams, several poses of their step fit. An exhaustive search of the pair finds these hypotheses
(`propose.py`). It prefers poses with much overlap. So alignments from arcs of the usual motion are further
hypotheses. The score of a hypothesis is matched less contradicting beams against all of the last placed scans. (The
fitness of an ICP ignores contradicting beams.) The best sequences of poses are kept from scan to scan. A scan that fits
none of the last placed scans (a swapped line of the log, a covered lens) is not registered, and the sequence continues
with the next scan.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import join_rows
from dpmjax.scan.apart import apart
from dpmjax.scan.planar.align import FINE, PairMatches, match_pairs
from dpmjax.scan.planar.compare import (
    LEAST_VISIBLE,
    WEAK_SCORE,
    contradicted_share,
    find_evidence,
    pair_scores,
    weak_steps,
)
from dpmjax.scan.planar.motion_prior import MotionPrior
from dpmjax.scan.planar.propose import CorrelativeConfig, Hypotheses, refine_candidates, search_pairs
from dpmjax.scan.planar.record import Booleans, Floats, Indices, PlanarScans
from dpmjax.slam.planar.recordings import distinct_rows, interpolate
from dpmjax.slam.planar.sequence_joining import join_parts

# Turns of a step that are searched, radians for each scan that it spans.
_MAX_TURN = 1.7
# A step is clear where its score, fitness and the weakest eigenvalue (share of the beams) are above these, and the
# share of visible beams that contradict is below the last one.
_CLEAR_SCORE, _CLEAR_FITNESS, _CLEAR_EIGENVALUE, _CLEAR_CONTRADICTION = 0.45, 0.5, 0.02, 0.05
# Weak steps are also searched between scans before and after them, up to the first number of scans apart; steps with a
# score below the second number, up to the third number apart.
_WEAK_SPAN, _BAD_SCORE, _BAD_SPAN = 3, 0.12, 5
# Where neither step of a scan has a better score, the scans before and after it are searched against each other.
_SURE_SCORE = 0.5
# Hypotheses of a scan within these tolerances are equal, typical ranges and radians.
_SAME = (0.02, 0.02)
# Two sequences are equal if this number of their last scans agrees within these tolerances, typical ranges and radians.
_NUM_SAME, _SAME_SHAPE = 4, (0.05, 0.05)
# Score of a scan that is left out; and of one at the pose of the scan before it, after too many were left out.
_LEFT_OUT, _GUESSED = 0.05, -1.0
# Number of sequences that are kept from scan to scan, and of the last placed scans that a scan is compared with.
_NUM_SEQUENCES, _NUM_COMPARED = 6, 8
# Search of steps that are not clear.
_SEARCH = CorrelativeConfig(max_shift=0.9, block=8, num_peaks=6, num_candidates=8, num_levels=3)
# Weight of the motion prior.
_PRIOR_WEIGHT = 0.1


def search_sequence(scans: PlanarScans, steps: PairMatches) -> Floats:
    """Finds the poses of scans in time order.

    Args:
        scans: n scans.
        steps: the n - 1 steps T_scan_next that an ICP has found.

    Returns:
        (n, 3) T_world_scan, the first one zero; interpolated for scans that fit none of the scans around them.
    """
    rows = distinct_rows(scans)
    some = scans.take(rows)
    # The scans between two of these rows are the first of the two.
    matched = PairMatches(*(x[rows[1:] - 1] for x in steps))
    hypotheses = _find_hypotheses(some, matched)
    is_clear = (hypotheses.source == hypotheses.target + 1) & (hypotheses.scores > _CLEAR_SCORE)
    prior = MotionPrior.of(hypotheses.poses[is_clear], scans.typical_range)
    poses, is_registered = _Beam(some, hypotheses, prior).run()
    kept = np.flatnonzero(is_registered)
    kept = kept[~_is_alone(weak_steps(some, poses, kept))]
    poses = join_parts(some, poses, kept, prior, _SEARCH)
    return interpolate(len(scans), rows[kept], poses[kept])


def _is_alone(is_weak: Booleans) -> Booleans:
    """Returns True (k,) for one or two scans between two weak steps."""
    part = np.append(0, np.cumsum(is_weak))
    # Largest number of scans between two weak steps for which these scans are left out.
    return np.asarray(np.bincount(part)[part] <= min(2, len(part) // 4))


def _find_hypotheses(scans: PlanarScans, steps: PairMatches) -> Hypotheses:
    """Returns the steps, and candidates of a search for steps that are not clear."""
    num_scans = len(scans)
    later = np.arange(1, num_scans)
    scores = pair_scores(scans, later, later - 1, steps.poses)
    best = scores.copy()
    num_beams = scans.num_on_line[1:]
    is_clear = (best > _CLEAR_SCORE) & (steps.fitness > _CLEAR_FITNESS)
    is_clear &= contradicted_share(scans, later, later - 1, steps.poses) < _CLEAR_CONTRADICTION
    is_clear &= steps.weakest_eigenvalue() > _CLEAR_EIGENVALUE * num_beams
    found = [Hypotheses(later, later - 1, steps.poses, scores)]
    usual = MotionPrior.of(steps.poses[is_clear], scans.typical_range)
    found.append(align_arcs(scans, later[~is_clear & (scores < _CLEAR_SCORE)], usual))
    open_steps, searched = later[~is_clear], set[tuple[int, int]]()
    for span, limit in ((1, np.inf), (_WEAK_SPAN, WEAK_SCORE), (_BAD_SPAN, _BAD_SCORE)):
        open_steps = open_steps[best[open_steps - 1] < limit]
        pairs = {(a, a - k) for i in open_steps.tolist() for k in range(1, span + 1) for a in range(i, i + k)}
        if span == 1:
            # A scan that no clear step reaches may be one to leave out.
            pairs |= {
                (i + 1, i - 1) for i in later[:-1][(scores[:-1] < _SURE_SCORE) & (scores[1:] < _SURE_SCORE)].tolist()
            }
        new = np.array(sorted(p for p in pairs - searched if p[1] >= 0 and p[0] < num_scans), np.int64).reshape(-1, 2)
        searched |= pairs
        if not len(new):
            break
        found.append(_search(scans, new))
        # A step is as good as the best hypothesis across it.
        for source, target, score in zip(found[-1].source, found[-1].target, found[-1].scores, strict=True):
            across = slice(target, source)
            best[across] = np.maximum(best[across], score)
    joined = join_rows(*found)
    return joined.take(np.lexsort((-joined.scores, joined.source)))


def _search(scans: PlanarScans, pairs: Indices) -> Hypotheses:
    """Finds candidates of pairs (p, 2), each aligned by ICP where the score does not fall."""
    source, target = pairs.T.copy()
    turn = se2.wrap_angle(2 * np.pi * np.arange(_SEARCH.num_turns) / _SEARCH.num_turns)
    turns = np.abs(turn) < _MAX_TURN * (source - target)[:, None] ** 0.5
    source, target, poses, _ = search_pairs(scans, source, target, _SEARCH, turns=turns)
    aligned = match_pairs(scans.take(source), scans.take(target), poses[:, None], FINE).poses
    before, after = (pair_scores(scans, source, target, x) for x in (poses, aligned))
    is_better = after > before - 0.02
    poses = np.where(is_better[:, None], aligned, poses)
    return Hypotheses(source, target, poses, np.where(is_better, after, before))


def align_arcs(scans: PlanarScans, later: Indices, usual: MotionPrior) -> Hypotheses:
    """Aligns steps from the arcs of the usual motion.

    Args:
        scans: n scans in time order.
        later: (k,) rows of the scans at the ends of the steps.
        usual: motion prior.

    Returns:
        Distinct hypotheses of each step with the best scores under the motion prior.
    """
    arcs = usual.arcs()
    source, guesses = np.repeat(later, len(arcs)), np.tile(arcs, (len(later), 1))
    poses = match_pairs(scans.take(source), scans.take(source - 1), guesses[:, None], FINE).poses
    poses[:, 2] = se2.wrap_angle(poses[:, 2])
    scores = pair_scores(scans, source, source - 1, poses)
    values = scores - _PRIOR_WEIGHT * usual.surprise(poses, np.ones(len(source), np.int64))
    limits, kept = (_SAME_SHAPE[0] * scans.typical_range, _SAME_SHAPE[1]), [np.zeros(0, np.int64)]
    for first in range(0, len(source), len(arcs)):
        own = poses[first : first + len(arcs)]
        are_near = [se2.is_within(own - one, *limits) for one in own]
        # Number of hypotheses of a step that are kept of the alignments from arcs.
        kept.append(first + apart(values[first : first + len(arcs)], are_near.__getitem__, 3))
    found = Hypotheses(source, source - 1, poses, scores).take(np.concatenate(kept))
    # The fitness of an alignment ignores contradicting beams, so its pose may lie beside the best score. The best score
    # of two scans alone may lie beside the right pose, too: the last placed scans choose.
    shifted = refine_candidates(scans, found, _SEARCH).poses
    after = pair_scores(scans, found.source, found.target, shifted)
    is_better = after > found.scores
    return join_rows(found, found._replace(poses=shifted, scores=after).take(is_better))


class _Sequences(NamedTuple):
    """The s best sequences of poses of the first m scans, the best first.

    Attributes:
        poses: (s, m, 3) T_world_scan.
        is_placed: (s, m) True for registered scans.
        scores: (s,) totals.
    """

    poses: Floats
    is_placed: Booleans
    scores: Floats


def _with_second_start(now: _Sequences) -> _Sequences:
    """Adds a sequence that begins at the second scan."""
    poses, is_placed = np.zeros_like(now.poses[:1]), np.zeros_like(now.is_placed[:1])
    is_placed[:, -1] = True
    scores = np.append(now.scores, _LEFT_OUT)
    return _Sequences(np.concatenate([now.poses, poses]), np.concatenate([now.is_placed, is_placed]), scores)


class _Beam:
    """The beam search over the hypotheses of a sequence."""

    def __init__(self, scans: PlanarScans, hypotheses: Hypotheses, prior: MotionPrior) -> None:
        self.scans, self.hypotheses, self.prior = scans, hypotheses, prior
        self.unit = scans.typical_range
        self.starts = np.searchsorted(hypotheses.source, np.arange(len(scans) + 1))

    def run(self) -> tuple[Floats, Booleans]:
        """Runs the search over all scans and returns the best sequence: poses (n, 3), and True for registered scans."""
        now = _Sequences(np.zeros((1, 1, 3)), np.ones((1, 1), bool), np.zeros(1))
        for scan in range(1, len(self.scans)):
            now = self.advance(now, scan)
            if scan == 1:
                # The first scan may fit no other scan.
                now = _with_second_start(now)
        return now.poses[0], now.is_placed[0]

    def advance(self, now: _Sequences, scan: int) -> _Sequences:
        """Returns the best sequences with one more scan."""
        longer = self.extend(now, scan)
        chosen = apart(longer.scores, lambda best: self.are_same(longer, best), _NUM_SEQUENCES)
        scores = longer.scores[chosen]
        return _Sequences(longer.poses[chosen], longer.is_placed[chosen], scores - scores[0])

    def extend(self, now: _Sequences, scan: int) -> _Sequences:
        """Returns all continuations by a scan: one for each hypothesis, and one without the scan."""
        own = slice(self.starts[scan], self.starts[scan + 1])
        target = self.hypotheses.target[own]
        parent, which = np.nonzero(now.is_placed[:, target])
        pose = np.asarray(se2.compose(now.poses[parent, target[which]], self.hypotheses.poses[own][which]))
        keep = self.distinct(parent, pose)
        parent, pose = parent[keep], pose[keep]
        lost = ~now.is_placed[:, -_BAD_SPAN:].any(axis=1)
        score = np.append(self.score(now, scan, parent, pose), np.where(lost, _GUESSED, _LEFT_OUT))
        is_placed, pose = np.append(np.ones(len(keep), bool), lost), np.concatenate([pose, now.poses[:, -1]])
        parent = np.append(parent, np.arange(len(now.scores)))
        return _Sequences(
            np.concatenate([now.poses[parent], pose[:, None]], axis=1),
            np.concatenate([now.is_placed[parent], is_placed[:, None]], axis=1),
            now.scores[parent] + score,
        )

    def distinct(self, parent: Indices, pose: Floats) -> Indices:
        """Returns rows of the hypotheses that differ from all earlier ones of the same sequence."""
        near = se2.is_within(pose[:, None] - pose, _SAME[0] * self.unit, _SAME[1]) & (parent[:, None] == parent)
        return apart(-np.arange(len(parent), dtype=np.float64), near.__getitem__, len(parent))

    def score(self, now: _Sequences, scan: int, parent: Indices, pose: Floats) -> Floats:
        """Computes the agreement (m,) of a scan with the last placed scans, less the weighted motion prior."""
        first = max(0, scan - _NUM_COMPARED - _BAD_SPAN)
        is_placed, placed = now.is_placed[:, first:], now.poses[parent, first:]
        rank = np.cumsum(is_placed[:, ::-1], axis=1)[:, ::-1]
        is_used = (is_placed & (rank <= _NUM_COMPARED))[parent]
        relative = np.asarray(se2.relative(placed, np.broadcast_to(pose[:, None], placed.shape)))
        row, column = np.nonzero(is_used)
        pairs = np.full(len(row), scan), first + column
        evidence, visible = find_evidence(self.scans, *pairs, relative[row, column])
        # The newest scan has the largest weight, so that overlap with older scans does not favour short motions.
        weight = 1.0 / rank[parent][row, column]
        total, seen = (np.bincount(row, weight * x, len(parent)) for x in (evidence, visible))
        agreement = total / (seen + LEAST_VISIBLE)
        newest = is_used.shape[1] - 1 - is_used[:, ::-1].argmax(axis=1)
        step, gap = relative[np.arange(len(parent)), newest], scan - first - newest
        return np.asarray(agreement - _PRIOR_WEIGHT * self.prior.surprise(step, gap), np.float64)

    def are_same(self, sequences: _Sequences, row: int) -> Booleans:
        """Returns True for each sequence whose last scans agree with those of the sequence in `row`."""
        placed = sequences.is_placed[:, -_NUM_SAME:]
        poses = sequences.poses[:, -_NUM_SAME:][:, placed[row]]
        inside = np.asarray(se2.relative(poses[:, -1:], poses))
        is_near = se2.is_within(inside - inside[row], _SAME_SHAPE[0] * self.unit, _SAME_SHAPE[1])
        return np.asarray((placed == placed[row]).all(axis=1) & is_near.all(axis=1))
