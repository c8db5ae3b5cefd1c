"""Assembly of one map from scored relative poses of pairs, scan by scan, each scored against all placed scans.

A wrong relative pose may have a high score for its two scans, but rarely against all other scans. So the best pair
starts a map, and each remaining scan has the pose hypotheses of its pairs. The hypothesis with the best score against
all placed scans is added next. Once all scans are placed, each may move to a better hypothesis. A robust pose graph
over all pairs that agree then averages their small errors.

A single wrong connection between similar places misplaces a consistent block of scans. Then no single scan has a better
score at another pose. So the map is cut at its weakest connections. Pairs across the cut propose poses for the smaller
block, and the block moves to the best of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges, PoseGraph, label_parts
from dpmjax.pose_graph.optimize import ROBUST, optimize_pose_graph
from dpmjax.scan.planar.compare import compare_pairs
from dpmjax.scan.planar.propose import Hypotheses, chance_level, noisy_share
from dpmjax.scan.planar.record import Booleans, Floats, Indices, PlanarScans

# A pair agrees with a map within this: translation in typical ranges, radians.
_AGREEMENT = (0.06, 0.1)
# Least score of an edge as a share of the beams; and the accuracy of a pair with all its beams matched: typical ranges,
# radians.
_MIN_SHARE, _SIGMA = 0.08, (0.0045, 0.01)
# Number of matched beams that outweigh a contradicting one.
_CONTRADICTION_WEIGHT = 4.0
# Largest distance of scans that score each other, in typical ranges, and largest number of nearest scans that do.
_RADIUS, _NUM_SCORERS = 1.2, 32
# Poses times placed scans that are compared at a time: 8 MB a table.
_BLOCK = 1 << 20
# Weakest connections at which a block is cut off, and poses that are tried for a block.
_NUM_CUTS, _NUM_BLOCK_POSES = 6, 48


class PoseScorer(NamedTuple):
    """Scores poses of scans against placed scans.

    Attributes:
        scans: n scans.
        chance: number of beams that two scans of different places match by chance. Scores subtract it.
        noisy_share: share of visible beams that range noise makes contradictory. Scores subtract it.
        is_ordered: True if neighbours in the array are neighbours in time.
    """

    scans: PlanarScans
    chance: float
    noisy_share: float
    is_ordered: bool

    @property
    def radius(self) -> float:
        """Distance within which scans score each other, unit of the points."""
        return _RADIUS * self.scans.typical_range

    def score(self, scan: Indices, candidates: Floats, placed: Indices, poses: Floats) -> Floats:
        """Scores (m,) each `scan` at its candidate pose (m, 3) against all of `placed`, which are at `poses`."""
        total, height = np.zeros(len(scan)), max(1, _BLOCK // max(len(placed), 1))
        for start in range(0, len(scan), height):
            part = slice(start, start + height)
            total[part] = add_up(self.pairwise_scores(scan[part], candidates[part], placed, poses))
        return total

    def pairwise_scores(self, scan: Indices, candidates: Floats, placed: Indices, poses: Floats) -> Floats:
        """Scores (m, k) each `scan` against each of `placed`; 0 for scans too far apart."""
        apart = candidates[:, None, :2] - poses[placed][None, :, :2]
        apart = np.hypot(apart[..., 0], apart[..., 1])
        apart[scan[:, None] == placed[None]] = np.inf
        limit = np.full(len(scan), self.radius)
        if len(placed) > _NUM_SCORERS:
            limit = np.minimum(limit, np.partition(apart, _NUM_SCORERS, axis=1)[:, _NUM_SCORERS])
        row, column = np.nonzero(apart < limit[:, None])
        other, scores = placed[column], np.zeros(apart.shape)
        scores[row, column] = self.score_pairs(scan[row], other, se2.relative(poses[other], candidates[row]))
        return scores

    def score_pairs(self, source: Indices, target: Indices, poses: Floats) -> Floats:
        """Computes matched beams above chance less weighted contradicting beams (p,) of pairs at T_target_source."""
        views = compare_pairs(self.scans, source, target, poses, stride=4)
        # Without this, chance matches would favour poses with more overlap, such as one room on top of another.
        is_next = self.is_ordered & (np.abs(source - target) == 1)
        matched = np.maximum(views.matched - np.where(is_next, 0.5, 1.0) * self.chance, 0.0)
        # Weight of the matched beams of neighbours in time, where there is an order.
        matched *= np.where(is_next, 4.0, 1.0)
        contradicted = np.maximum(views.contradicted - self.noisy_share * views.visible, 0.0)
        return np.asarray(matched - _CONTRADICTION_WEIGHT * contradicted, np.float64)

    def score_map(self, poses: Floats) -> Floats:
        """Computes the pairwise scores (n, n) of a map, below the diagonal; 0 for scans too far apart."""
        source, target = np.tril_indices(len(poses), k=-1)
        relative = se2.relative(poses[target], poses[source])
        near = np.hypot(relative[:, 0], relative[:, 1]) < self.radius
        values = np.zeros((len(poses), len(poses)))
        values[source[near], target[near]] = self.score_pairs(source[near], target[near], relative[near])
        return values


def add_up(scores: Floats) -> Floats:
    """Sums pairwise scores. Negative scores have weight 1, the k-th best positive score has weight 1 / k.

    A pose needs a few scans that match it well. Equal weights would favour overlap and put rooms that look alike on
    top of each other.

    Args:
        scores: (..., k).

    Returns:
        (...) totals.
    """
    ordered = -np.sort(-scores, axis=-1)
    return np.where(ordered > 0.0, ordered / np.arange(1, scores.shape[-1] + 1), ordered).sum(axis=-1)


def is_firmly_more(score: Floats | np.float64, reference: Floats | np.float64) -> Booleans:
    """Returns True where a score exceeds a reference by more than 2 % of the reference's magnitude."""
    return np.asarray(score > reference + 0.02 * np.abs(reference))


def assemble(scans: PlanarScans, candidates: Hypotheses, *, is_ordered: bool) -> Floats:
    """Assembles one map of all scans from candidates of their pairs, without initial poses.

    Args:
        scans: n scans.
        candidates: candidates of pairs that connect all scans.
        is_ordered: True if neighbours in the array are neighbours in time, and so probably overlap.

    Returns:
        (n, 3) T_world_scan; the first pose is zero.
    """
    scorer = PoseScorer(scans, chance_level(candidates), noisy_share(scans, candidates), is_ordered)
    hypotheses, everyone = candidates.take(candidates.scores > 0.0).in_both_directions(), np.arange(len(scans))
    maps = [settle(_grow(hypotheses, scorer, seed), hypotheses, scorer) for seed in _choose_seeds(hypotheses)]
    scores = [scorer.score(everyone, poses, everyone, poses).sum() for poses in maps]
    poses = maps[int(np.argmax(scores))] if maps else np.zeros((len(scans), 3))
    poses, num_moved = move_blocks(poses, hypotheses, scorer)
    poses = settle(poses, hypotheses, scorer) if num_moved else poses
    edges = agreeing_edges(poses, candidates, scans)
    poses = optimize_pose_graph(PoseGraph.create(poses, edges), ROBUST).graph.poses
    return np.asarray(se2.relative(poses[0], poses))


def agreeing_edges(poses: Floats, candidates: Hypotheses, scans: PlanarScans) -> Edges:
    """Returns an edge for each pair with a candidate that agrees with the map: its nearest candidate."""
    typical_range, num_beams = scans.typical_range, scans.mask.sum(1)
    shares = candidates.scores / np.maximum(num_beams[candidates.source] + num_beams[candidates.target], 1.0)
    here = se2.relative(poses[candidates.target], poses[candidates.source])
    off = se2.relative(here, candidates.poses)
    distance = np.hypot(off[:, 0], off[:, 1]) / (_AGREEMENT[0] * typical_range)
    turn = np.abs(se2.wrap_angle(off[:, 2])) / _AGREEMENT[1]
    mismatch = np.where(shares > _MIN_SHARE, np.maximum(distance, turn), np.inf)
    order = np.lexsort((mismatch, candidates.pair))
    best = order[np.unique(candidates.pair[order], return_index=True)[1]]
    best = best[mismatch[best] < 1.0]
    sigma = np.array(_SIGMA)[[0, 0, 1]] * [typical_range, typical_range, 1.0]
    information = shares[best][:, None, None] * np.diag(1.0 / sigma**2)
    return Edges(candidates.source[best], candidates.target[best], candidates.poses[best], information)


def _choose_seeds(hypotheses: Hypotheses) -> list[int]:
    """Selects the rows of the best disjoint pairs."""
    chosen: list[int] = []
    used: set[int] = set()
    for row in np.argsort(-hypotheses.scores, kind="stable"):
        pair = {int(hypotheses.source[row]), int(hypotheses.target[row])}
        # Number of maps, each grown from a different pair; the best one is kept.
        if len(chosen) < 6 and not pair & used:
            chosen.append(int(row))
            used |= pair
    return chosen


def _grow(hypotheses: Hypotheses, scorer: PoseScorer, seed: int) -> Floats:
    """Places all scans one by one, from the anchor of one hypothesis."""
    scan, anchor, num_scans = hypotheses.source, hypotheses.target, len(scorer.scans)
    poses, is_placed = np.zeros((num_scans, 3)), np.zeros(num_scans, bool)
    # World pose of each usable hypothesis, and its score against each placed scan.
    worlds, scores = np.zeros((len(scan), 3)), np.zeros((len(scan), num_scans))
    newest, pose = int(anchor[seed]), np.zeros(3)
    while True:
        poses[newest], is_placed[newest] = pose, True
        if is_placed.all():
            return poses
        is_open, is_fresh = is_placed[anchor] & ~is_placed[scan], anchor == newest
        worlds[is_fresh] = hypotheses.take(np.flatnonzero(is_fresh)).world_poses(poses)
        for chosen, placed in ((~is_fresh, np.array([newest])), (is_fresh, np.flatnonzero(is_placed))):
            rows = np.flatnonzero(is_open & chosen)
            scores[rows[:, None], placed] = scorer.pairwise_scores(scan[rows], worlds[rows], placed, poses)
        rows = np.flatnonzero(is_open)
        if len(rows):
            best = rows[add_up(scores[rows]).argmax()] if is_placed.sum() > 1 else seed
            newest, pose = int(scan[best]), worlds[best]
        else:
            newest, pose = int(np.flatnonzero(~is_placed)[0]), np.zeros(3)


def settle(poses: Floats, hypotheses: Hypotheses, scorer: PoseScorer) -> Floats:
    """Moves scans to better pose hypotheses until no scan moves or the limit of rounds is reached."""
    # Rounds in which scans may change their pose.
    for _ in range(3):
        poses, num_moved = _revise(poses, hypotheses, scorer)
        if not num_moved:
            break
    return poses


def _revise(poses: Floats, hypotheses: Hypotheses, scorer: PoseScorer) -> tuple[Floats, int]:
    """Moves each scan, the lowest score first, to its hypothesis with the best score, and counts the moves."""
    poses, everyone, num_moved = poses.copy(), np.arange(len(poses)), 0
    support = scorer.score(everyone, poses, everyone, poses)
    score = scorer.score(hypotheses.source, hypotheses.world_poses(poses), everyone, poses)
    # A scan without a better hypothesis now is not compared again.
    is_better = np.isin(everyone, hypotheses.source[is_firmly_more(score, support[hypotheses.source])])
    for scan in (scan for scan in np.argsort(support) if is_better[scan]):
        own = hypotheses.take(np.flatnonzero(hypotheses.source == scan))
        candidates = np.concatenate([poses[scan][None], own.world_poses(poses)])
        score = scorer.score(np.full(len(candidates), scan), candidates, everyone, poses)
        best = int(score.argmax())
        if is_firmly_more(score[best], score[0]):
            far = _AGREEMENT[0] * scorer.scans.typical_range
            num_moved += bool(np.hypot(*(candidates[best] - poses[scan])[:2]) > far)
            poses[scan] = candidates[best]
    return poses, num_moved


def move_blocks(poses: Floats, hypotheses: Hypotheses, scorer: PoseScorer) -> tuple[Floats, int]:
    """Cuts the map at its weakest connections in turn, and moves blocks that have a better score at a new pose.

    Args:
        poses: (n, 3) a map of all scans.
        hypotheses: of all pairs.
        scorer: of the map.

    Returns:
        (n, 3) poses, and the number of blocks that have moved.
    """
    num_moved = 0
    for cut in range(_NUM_CUTS):
        values = scorer.score_map(poses)
        blocks = weakest_cuts(values, _NUM_CUTS)
        if cut >= len(blocks):
            break
        motion = _better_motion(poses, blocks[cut], hypotheses, scorer, values)
        if motion is not None:
            poses = poses.copy()
            poses[blocks[cut]] = se2.compose(motion, poses[blocks[cut]])
            num_moved += 1
    return poses, num_moved


def weakest_cuts(values: Floats, count: int) -> list[Booleans]:
    """Cuts the maximum spanning tree at each of its weakest edges, and returns the smaller component of each cut.

    Args:
        values: (n, n) pairwise scores of a map, below the diagonal.
        count: largest number of cuts.

    Returns:
        A mask (n,) of the smaller component for each cut, the weakest edge first.
    """
    cost = np.tril(values.max() + 1.0 - np.maximum(values, 0.0), k=-1)
    tree = scipy.sparse.csgraph.minimum_spanning_tree(scipy.sparse.csr_matrix(cost)).tocoo()
    blocks = []
    for edge in np.argsort(-tree.data)[:count]:
        keep = np.arange(len(tree.data)) != edge
        label = label_parts(len(values), tree.row[keep], tree.col[keep])
        side = label == label[tree.row[edge]]
        blocks.append(side if 2 * side.sum() <= len(values) else ~side)
    return blocks


def _better_motion(
    poses: Floats, block: Booleans, hypotheses: Hypotheses, scorer: PoseScorer, values: Floats
) -> Floats | None:
    """Finds the best motion (3,) of the block in the world, proposed by a pair across the cut; None: none is better."""
    across = np.flatnonzero(block[hypotheses.source] & ~block[hypotheses.target])
    across = across[np.argsort(-hypotheses.scores[across], kind="stable")[:_NUM_BLOCK_POSES]]
    best = hypotheses.take(across)
    motions = se2.compose(best.world_poses(poses), se2.inverse(poses[best.source]))
    motions = np.concatenate([np.zeros((1, 3)), motions])
    inside, outside = np.flatnonzero(block), np.flatnonzero(~block)
    moved = se2.compose(motions[:, None], poses[inside][None])
    apart = moved[:, :, None, :2] - poses[outside][None, None, :, :2]
    which, i, j = np.nonzero(np.hypot(apart[..., 0], apart[..., 1]) < scorer.radius)
    value = scorer.score_pairs(inside[i], outside[j], se2.relative(poses[outside[j]], moved[which, i]))
    # Pairs on one side of the cut are the same for all motions.
    scores = np.repeat(np.where(block[:, None] == block, values, 0.0)[None], len(motions), axis=0)
    scores[which, inside[i], outside[j]] = value
    # Each pair counts for both scans.
    total = add_up(scores + np.swapaxes(scores, 1, 2)).sum(axis=-1)
    highest = int(total.argmax())
    return motions[highest] if is_firmly_more(total[highest], total[0]) else None
