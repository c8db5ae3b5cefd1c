"""One map from scored relative poses of pairs, grown scan by scan; every new pose is scored against all placed scans.

A wrong pair scores well for its two scans; it rarely does against all others. So the best pair starts a map, every free
scan has the pose hypotheses of its pairs, and the one with the best score against all placed scans is taken next. Then
each scan may move once all the others stand, and a robust graph over all pairs that agree averages their small errors.

Where places look alike, a map can go wrong by a single connection. Everything behind it is right in itself and wrong
together, and no scan alone gains by moving. So the map is cut at its weakest connections, and the smaller block moves
to the best of the poses that any pair across the cut supports.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges
from dpmjax.pose_graph.planar import optimize_planar_graph
from dpmjax.registration.pair_search import Candidates
from dpmjax.registration.planar_scans import Floats, Indices
from dpmjax.registration.pose_scoring import (
    AssemblyConfig,
    Hypotheses,
    PoseScorer,
    add_up,
    chance_level,
    is_firmly_more,
    lower_pairs,
    noisy_share,
)
from dpmjax.registration.range_profiles import RangeProfiles


def assemble(
    profiles: RangeProfiles, candidates: Candidates, config: AssemblyConfig | None = None, *, is_ordered: bool = False
) -> Floats:
    """Poses of all scans from candidates of their pairs, without a first guess.

    Args:
        profiles: n scans.
        candidates: of pairs that connect all scans.
        config: settings.
        is_ordered: neighbours in the array are neighbours in time, so likely to overlap.

    Returns:
        (n, 3) T_world_scan; the first pose is zero.
    """
    config = config or AssemblyConfig()
    scorer = PoseScorer(profiles, config, chance_level(candidates), noisy_share(profiles, candidates), is_ordered)
    hypotheses, everyone = Hypotheses.of(candidates), np.arange(len(profiles))
    best, highest = np.zeros((len(profiles), 3)), -np.inf
    for seed in _choose_seeds(hypotheses, config.num_seeds):
        poses = _settle(_grow(hypotheses, scorer, seed), hypotheses, scorer)
        total = float(scorer.score(everyone, poses, everyone, poses).sum())
        if total > highest:
            best, highest = poses, total
    poses, num_moved = move_blocks(best, hypotheses, scorer)
    poses = _settle(poses, hypotheses, scorer) if num_moved else poses
    edges = agreeing_edges(poses, candidates, config, profiles.typical_range)
    if len(edges.source):
        poses, _ = optimize_planar_graph(poses, edges)
    return np.asarray(se2.relative(poses[0], poses))


def place_in_map(poses: Floats, placed: Indices, hypotheses: Hypotheses, scorer: PoseScorer) -> Floats:
    """Poses of the scans that are not yet placed: of their hypotheses the one with the best score against placed scans.

    Then all scans may change their poses as in `assemble`.

    Args:
        poses: (n, 3); right for those of `placed`.
        placed: rows.
        hypotheses: of pairs; each scan that is not placed needs one with a placed scan.
        scorer: of the map.

    Returns:
        (n, 3) poses. Scans without any hypothesis stay where `poses` has them.
    """
    is_placed = np.zeros(len(poses), bool)
    is_placed[placed] = True
    fresh = hypotheses.take(np.flatnonzero(is_placed[hypotheses.anchor] & ~is_placed[hypotheses.scan]))
    candidates = fresh.world_poses(poses)
    # Hypotheses of one scan compete with each other alone: no need to subtract what chance would give.
    score = scorer._replace(chance=0.0, is_ordered=False).score(fresh.scan, candidates, placed, poses)
    order = np.argsort(score, kind="stable")
    poses = poses.copy()
    # The best one of each scan is written last.
    poses[fresh.scan[order]] = candidates[order]
    return _settle(poses, hypotheses, scorer)


def agreeing_edges(poses: Floats, candidates: Candidates, config: AssemblyConfig, typical_range: float) -> Edges:
    """Edges of the pairs with a candidate that agrees with the map; of each pair the nearest one."""
    here = se2.relative(poses[candidates.target], poses[candidates.source])
    off = se2.relative(here[:, None], candidates.poses)
    distance = np.hypot(off[..., 0], off[..., 1]) / (config.agreement[0] * typical_range)
    turn = np.abs(se2.wrap_angle(off[..., 2])) / config.agreement[1]
    mismatch = np.where(candidates.scores > config.min_score, np.maximum(distance, turn), np.inf)
    best = mismatch.argmin(axis=1)
    row = np.arange(len(best))
    keep = mismatch[row, best] < 1.0
    sigma = np.array([config.sigma[0] * typical_range, config.sigma[0] * typical_range, config.sigma[1]])
    share = candidates.scores[row, best][keep] / 500.0
    information = share[:, None, None] * np.diag(1.0 / sigma**2)
    return Edges(candidates.source[keep], candidates.target[keep], candidates.poses[row, best][keep], information)


def _choose_seeds(hypotheses: Hypotheses, count: int) -> list[int]:
    """The best pairs, no scan in two of them."""
    chosen: list[int] = []
    used: set[int] = set()
    for row in np.argsort(-hypotheses.scores, kind="stable"):
        pair = {int(hypotheses.scan[row]), int(hypotheses.anchor[row])}
        if len(chosen) < count and not pair & used:
            chosen.append(int(row))
            used |= pair
    return chosen


def _grow(hypotheses: Hypotheses, scorer: PoseScorer, seed: int) -> Floats:
    """Poses of all scans, grown from the anchor of one hypothesis."""
    num_scans = len(scorer.profiles)
    poses, is_placed = np.zeros((num_scans, 3)), np.zeros(num_scans, bool)
    scan, newest = int(hypotheses.scan[seed]), int(hypotheses.anchor[seed])
    is_placed[newest] = True
    # Open hypotheses: the scan, its pose in the world, and its score against each placed scan.
    open_scan, open_pose, scores = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, num_scans))
    while not is_placed.all():
        fresh = hypotheses.take(np.flatnonzero((hypotheses.anchor == newest) & ~is_placed[hypotheses.scan]))
        placed, added = np.flatnonzero(is_placed), fresh.world_poses(poses)
        row, _, value = scorer.pairwise_scores(open_scan, open_pose, np.array([newest]), poses)
        scores[row, newest] = value
        row, column, value = scorer.pairwise_scores(fresh.scan, added, placed, poses)
        added_scores = np.zeros((len(added), num_scans))
        added_scores[row, placed[column]] = value
        open_scan, open_pose = np.concatenate([open_scan, fresh.scan]), np.concatenate([open_pose, added])
        scores = np.concatenate([scores, added_scores])
        if len(open_scan):
            row, column = (x.astype(np.int64) for x in np.nonzero(scores))
            total = add_up(row, scores[row, column], len(scores))
            best = int(total.argmax()) if is_placed.sum() > 1 else int(np.flatnonzero(open_scan == scan)[0])
            newest, pose = int(open_scan[best]), open_pose[best]
        else:
            newest, pose = int(np.flatnonzero(~is_placed)[0]), np.zeros(3)
        poses[newest], is_placed[newest] = pose, True
        keep = open_scan != newest
        open_scan, open_pose, scores = open_scan[keep], open_pose[keep], scores[keep]
    return poses


def _settle(poses: Floats, hypotheses: Hypotheses, scorer: PoseScorer) -> Floats:
    """Rounds in which scans move, until none does."""
    for _ in range(scorer.config.num_revisions):
        poses, num_moved = _revise(poses, hypotheses, scorer)
        if not num_moved:
            break
    return poses


def _revise(poses: Floats, hypotheses: Hypotheses, scorer: PoseScorer) -> tuple[Floats, int]:
    """Moves each scan, the worst supported first, to its hypothesis with the best score; and counts the moves."""
    poses, everyone, num_moved = poses.copy(), np.arange(len(poses)), 0
    support = scorer.score(everyone, poses, everyone, poses)
    score = scorer.score(hypotheses.scan, hypotheses.world_poses(poses), everyone, poses)
    # A scan without a better hypothesis now is not compared again.
    is_better = np.isin(everyone, hypotheses.scan[is_firmly_more(score, support[hypotheses.scan])])
    for scan in (scan for scan in np.argsort(support) if is_better[scan]):
        own = hypotheses.take(np.flatnonzero(hypotheses.scan == scan))
        candidates = np.concatenate([poses[scan][None], own.world_poses(poses)])
        score = scorer.score(np.full(len(candidates), scan), candidates, everyone, poses)
        best = int(score.argmax())
        if is_firmly_more(score[best], score[0]):
            off = se2.relative(poses[scan], candidates[best])
            far = scorer.config.agreement[0] * scorer.profiles.typical_range
            num_moved += bool(np.hypot(off[0], off[1]) > far)
            poses[scan] = candidates[best]
    return poses, num_moved


def move_blocks(poses: Floats, hypotheses: Hypotheses, scorer: PoseScorer) -> tuple[Floats, int]:
    """Cuts the map at its weakest connections, one after the other, and moves blocks that score better elsewhere.

    Args:
        poses: (n, 3) a map of all scans.
        hypotheses: of all pairs.
        scorer: of the map.

    Returns:
        (n, 3) poses, and how many blocks have moved.
    """
    num_moved = 0
    for cut in range(scorer.config.num_cuts):
        values = scorer.score_map(poses)
        blocks = weakest_cuts(values, scorer.config.num_cuts)
        if cut >= len(blocks):
            break
        motion = _better_motion(poses, blocks[cut], hypotheses, scorer, values)
        if motion is not None:
            poses = poses.copy()
            poses[blocks[cut]] = se2.compose(motion, poses[blocks[cut]])
            num_moved += 1
    return poses, num_moved


def weakest_cuts(values: Floats, count: int) -> list[NDArray[np.bool_]]:
    """The smaller sides (n,) of the cuts at the weakest connections of the best tree of pairs, the weakest first."""
    cost = np.tril(values.max() + 1.0 - np.maximum(values, 0.0), k=-1)
    tree = scipy.sparse.csgraph.minimum_spanning_tree(scipy.sparse.csr_matrix(cost)).tocoo()
    blocks = []
    for edge in np.argsort(-tree.data)[:count]:
        keep = np.arange(len(tree.data)) != edge
        rest = scipy.sparse.coo_matrix((tree.data[keep], (tree.row[keep], tree.col[keep])), shape=tree.shape)
        _, label = scipy.sparse.csgraph.connected_components(rest, directed=False)
        side = label == label[tree.row[edge]]
        blocks.append(side if 2 * side.sum() <= len(values) else ~side)
    return blocks


def _better_motion(
    poses: Floats, block: NDArray[np.bool_], hypotheses: Hypotheses, scorer: PoseScorer, values: Floats
) -> Floats | None:
    """The motion (3,) of the block in the world with the best score, of those by pairs across the cut; None: none."""
    across = np.flatnonzero(block[hypotheses.scan] & ~block[hypotheses.anchor])
    across = across[np.argsort(-hypotheses.scores[across], kind="stable")[: scorer.config.num_block_poses]]
    best = hypotheses.take(across)
    motions = se2.compose(best.world_poses(poses), se2.inverse(poses[best.scan]))
    motions = np.concatenate([np.zeros((1, 3)), motions])
    inside, outside = np.flatnonzero(block), np.flatnonzero(~block)
    moved = se2.compose(motions[:, None], poses[inside][None])
    apart = moved[:, :, None, :2] - poses[outside][None, None, :, :2]
    which, i, j = np.nonzero(np.hypot(apart[..., 0], apart[..., 1]) < scorer.radius)
    value = scorer.score_pairs(inside[i], outside[j], se2.relative(poses[outside[j]], moved[which, i]))
    # Pairs on one side of the cut are the same for all motions.
    one, other = lower_pairs(len(poses))
    is_kept = block[one] == block[other]
    one, other = one[is_kept], other[is_kept]
    motion = np.concatenate([np.repeat(np.arange(len(motions)), len(one)), which])
    first = np.concatenate([np.tile(one, len(motions)), inside[i]])
    second = np.concatenate([np.tile(other, len(motions)), outside[j]])
    value = np.concatenate([np.tile(values[one, other], len(motions)), value])
    row = np.concatenate([motion, motion]) * len(poses) + np.concatenate([first, second])
    total = add_up(row, np.concatenate([value, value]), len(motions) * len(poses))
    total = total.reshape(len(motions), -1).sum(axis=1)
    highest = int(total.argmax())
    return motions[highest] if is_firmly_more(total[highest], total[0]) else None
