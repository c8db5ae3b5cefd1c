"""Global registration: poses of all scans without a first guess, also without an order.

Scans in time order are registered as a sequence (`sequence_search.py`). If there is no order, or if steps are weak or
noisy, a few dozen keyframes are chosen. All pairs of keyframes are searched exhaustively, and the keyframes are
assembled into one map. Keyframes are spread evenly in time. Without an order, the scans most similar to all scans are
keyframes. The remaining scans are then searched against similar keyframes and placed in the map.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.spatial
from jaxtyping import Float

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import PoseGraph, join_rows, label_parts
from dpmjax.pose_graph.optimize import ROBUST, optimize_pose_graph
from dpmjax.scan.planar.compare import compare_pairs, weak_steps
from dpmjax.scan.planar.propose import (
    CorrelativeConfig,
    Hypotheses,
    chance_level,
    noisy_share,
    search_pairs,
)
from dpmjax.scan.planar.record import Booleans, Floats, Indices, PlanarScans, spread_evenly
from dpmjax.scan.planar.wall_directions import WallDirections
from dpmjax.slam.planar.map_assembly import PoseScorer, agreeing_edges, assemble, settle
from dpmjax.slam.planar.track import incremental_icp

# Numbers of search partners of a scan that is no keyframe: keyframes with the most similar views, and, without an
# order, scans with the most similar views. With an order the keyframes before and after it replace the latter.
_NUM_ANCHORS, _NUM_NEAREST_VIEWS = 2, 3
# Numbers of likely headings around which these pairs, and pairs of keyframes, are searched.
_NUM_LIKELY_TURNS, _NUM_KEYFRAME_TURNS = 3, 6
# A sequence is registered like a set where more than this share of its steps is weak, or where the range noise is more
# than this in typical ranges: a chain of steps drifts then.
_MAX_WEAK, _MAX_NOISE = 0.25, 0.0225
# A scan whose best neighbour matches less than this share of the usual beams is unregistered; scans are of one cluster
# if they match more than this share.
_MIN_SUPPORT, _MIN_LINK = 0.6, 0.3
# Largest number of unregistered scans that are searched against all keyframes. Those still unregistered are then
# searched against an equal number of further scans. A cluster of up to half of this number of scans, which matches no
# scan outside it, is unregistered too.
_MAX_UNREGISTERED = 12
# Largest number of keyframes, of which all pairs are searched; and the search of pairs.
_MAX_KEYFRAMES, _SEARCH = 32, CorrelativeConfig()


class _Task(NamedTuple):
    """The scans to be registered, the same for all stages."""

    scans: PlanarScans
    walls: WallDirections
    keyframes: Indices

    @property
    def others(self) -> Indices:
        """Rows of the scans that are no keyframes."""
        return np.setdiff1d(np.arange(len(self.scans)), self.keyframes)

    def search(self, source: Indices, target: Indices, turns: Booleans | None = None) -> Hypotheses:
        """Returns candidates of pairs."""
        return search_pairs(self.scans, source, target, _SEARCH, turns=turns)

    def likely_turns(self, source: Indices, target: Indices, num_peaks: int) -> Booleans:
        """Returns the headings of T_target_source at which the wall directions of both scans agree."""
        return self.walls.likely_turns(source, target, _SEARCH.num_turns, num_peaks)


def register_globally(scans: PlanarScans) -> Floats:
    """Registers all scans without initial poses.

    Args:
        scans: n scans. If they are ordered, neighbours in the array are neighbours in time. Otherwise no order is used,
            and up to 1,024 shuffled scans give the same map.

    Returns:
        (n, 3) T_world_scan, the first one zero.
    """
    everyone = np.arange(len(scans))
    if scans.is_ordered and scans.noise <= _MAX_NOISE * scans.typical_range:
        poses = incremental_icp(scans).poses
        # Few scans are searched all against all as soon as one step is weak.
        allowed = _MAX_WEAK if len(scans) > _MAX_KEYFRAMES else 0.0
        if weak_steps(scans, poses, everyone).sum() <= allowed * len(scans):
            return poses
    walls = WallDirections(scans)
    if scans.is_ordered:
        keyframes = spread_evenly(len(scans), _MAX_KEYFRAMES)
    else:
        # Without an order, keyframes are chosen among this number of evenly spread scans.
        eligible = spread_evenly(len(scans), 1024)
        keyframes = eligible[most_typical(walls.best_similarity(everyone, eligible), _MAX_KEYFRAMES)]
    task = _Task(scans, walls, keyframes)
    first, second = np.tril_indices(len(keyframes), k=-1)
    pairs = keyframes[first], keyframes[second]
    found = task.search(*pairs, task.likely_turns(*pairs, _NUM_KEYFRAME_TURNS))
    inside = found._replace(
        source=np.searchsorted(keyframes, found.source), target=np.searchsorted(keyframes, found.target)
    )
    poses = np.zeros((len(scans), 3))
    poses[keyframes] = assemble(scans.take(keyframes), inside, is_ordered=scans.is_ordered)
    if len(keyframes) < len(scans):
        key_edges = agreeing_edges(poses, found, scans)
        poses, more = place_others(task, poses, found, task.search(*_similar_pairs(task)))
        edges = join_rows(key_edges, agreeing_edges(poses, more, scans))
        poses = optimize_pose_graph(PoseGraph.create(poses, edges), ROBUST).graph.poses
    return np.asarray(se2.relative(poses[0], poses))


def most_typical(similarity: Float[np.ndarray, "n m"], count: int) -> Indices:
    """Selects columns greedily to maximise the sum of the similarity of each scan to its most similar column.

    Args:
        similarity: of n scans to m candidates.
        count: largest number of selected columns.

    Returns:
        Selected columns in increasing order.
    """
    count = min(similarity.shape[1], count)
    chosen: list[int] = []
    # Similarity of each scan to its most similar chosen scan; each choice adds most to the sum of these.
    covered = np.full(len(similarity), -1.0, similarity.dtype)
    for _ in range(count):
        gain = np.maximum(similarity - covered[:, None], 0.0).sum(axis=0)
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
        covered = np.maximum(covered, similarity[:, chosen[-1]])
    return np.sort(np.array(chosen, np.int64))


def _similar_pairs(task: _Task) -> tuple[Indices, Indices, Booleans]:
    """Pairs each other scan with similar keyframes and with near scans, and chooses the turns to try for each pair."""
    others, keyframes = task.others, task.keyframes
    if task.scans.is_ordered:
        after = np.clip(np.searchsorted(keyframes, others), 1, len(keyframes) - 1)
        near = np.stack([keyframes[after - 1], keyframes[after]], axis=1)
    else:  # Scans with the most similar views are likely to be near.
        near = task.walls.most_similar(others, np.arange(len(task.scans)), _NUM_NEAREST_VIEWS)
    pairs = np.concatenate([task.walls.most_similar(others, keyframes, _NUM_ANCHORS), near], axis=1)
    # Each pair once, with one scan that is turned for all its partners.
    ends = np.stack([pairs.reshape(-1), np.repeat(others, pairs.shape[1])], axis=-1)
    _, first = np.unique(np.sort(ends, axis=1), axis=0, return_index=True)
    source, target = ends[np.sort(first)].T
    return source, target, task.likely_turns(source, target, _NUM_LIKELY_TURNS)


def place_others(task: _Task, poses: Floats, found: Hypotheses, more: Hypotheses) -> tuple[Floats, Hypotheses]:
    """Places all scans, given the poses of the keyframes.

    Args:
        task: the scans.
        poses: (n, 3) T_world_scan; those of the keyframes are correct.
        found: candidates of the keyframes.
        more: candidates of the scans that are no keyframes.

    Returns:
        (n, 3) poses, and `more` with the candidates of scans that had to be searched again.
    """
    poses = _place(task, poses, found, more)
    # A scan that overlaps with no keyframe has its neighbours among the remaining scans; so has a keyframe that
    # overlaps with no other keyframe.
    for partners in (task.keyframes, task.others):
        lost = find_unregistered(task.scans, poses)
        if not len(lost):
            break
        # The likely turns of these scans were wrong, so all turns are tried, with the most similar partners.
        similar = task.walls.most_similar(lost, partners, len(task.keyframes))
        source, target = similar.reshape(-1), np.repeat(lost, similar.shape[1])
        more = join_rows(more, task.search(source, target))
        poses = _place(task, poses, found, more)
    return poses, more


def _place(task: _Task, poses: Floats, found: Hypotheses, more: Hypotheses) -> Floats:
    """Places each other scan at its hypothesis with the best score against the keyframes, and revises all poses."""
    candidates = join_rows(found, more)
    scorer = PoseScorer(task.scans, chance_level(found), noisy_share(task.scans, candidates), task.scans.is_ordered)
    hypotheses, keyframes = candidates.take(candidates.scores > 0.0).in_both_directions(), task.keyframes
    is_fresh = np.isin(hypotheses.target, keyframes) & ~np.isin(hypotheses.source, keyframes)
    fresh = hypotheses.take(np.flatnonzero(is_fresh))
    worlds = fresh.world_poses(poses)
    # Only hypotheses of one scan are compared with each other, so the chance level is not subtracted.
    score = scorer._replace(chance=0.0, is_ordered=False).score(fresh.source, worlds, keyframes, poses)
    order = np.argsort(score, kind="stable")
    poses = poses.copy()
    # The best one of each scan is written last; scans without any hypothesis keep their poses.
    poses[fresh.source[order]] = worlds[order]
    return settle(poses, hypotheses, scorer)


def find_unregistered(scans: PlanarScans, poses: Floats) -> Indices:
    """Finds unregistered scans, which match far fewer beams than usual with any scan outside their cluster.

    A small cluster of scans that match only each other is unregistered, too, because its scans must not support each
    other.

    Args:
        scans: n scans.
        poses: (n, 3) T_world_scan.

    Returns:
        Rows of the unregistered scans, the worst first.
    """
    num_scans = len(poses)
    num_near = min(7, num_scans)
    near = scipy.spatial.cKDTree(poses[:, :2]).query(poses[:, :2], k=num_near)[1]
    scan, other = np.repeat(np.arange(num_scans), num_near), near.reshape(-1).astype(np.int64)
    views = compare_pairs(scans, scan, other, se2.relative(poses[other], poses[scan]))
    matched = np.where(scan == other, 0.0, views.matched)
    usual = float(np.median(matched.reshape(near.shape).max(axis=1)))
    is_linked = matched > _MIN_LINK * usual
    cluster = label_parts(num_scans, scan[is_linked], other[is_linked])
    is_small = np.bincount(cluster)[cluster] <= _MAX_UNREGISTERED // 2
    matched = np.where(is_small[scan] & (cluster[scan] == cluster[other]), 0.0, matched)
    support = matched.reshape(near.shape).max(axis=1)
    worst = np.argsort(support)[:_MAX_UNREGISTERED]
    return worst[support[worst] < _MIN_SUPPORT * usual].astype(np.int64)


def nearest_tour(poses: Floats) -> Indices:
    """Orders scans so that neighbours are near each other. The nearest unvisited pose comes next.

    Args:
        poses: (n, 3) x, y, heading.

    Returns:
        (n,) rows, the first one 0.
    """
    tour, apart = [0], np.linalg.norm(poses[:, None, :2] - poses[:, :2], axis=-1)
    for _ in poses[1:]:
        apart[:, tour[-1]] = np.inf
        tour.append(int(apart[tour[-1]].argmin()))
    return np.array(tour, np.int64)
