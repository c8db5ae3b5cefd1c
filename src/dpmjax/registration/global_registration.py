"""Global registration: poses of all scans without a first guess, without ICP, and if need be without an order.

A few dozen scans that differ most, the keyframes, are searched against each other exhaustively and assembled into one
map. The other scans are then searched against some of them and placed in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy.sparse.csgraph
import scipy.spatial
from jaxtyping import Float
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import PoseGraph, join_edges
from dpmjax.pose_graph.optimize import ROBUST, optimize_pose_graph
from dpmjax.registration.map_assembly import PoseScorer, PositionPrior, assemble, settle
from dpmjax.registration.pair_search import (
    AGREEMENT,
    Candidates,
    CorrelativeConfig,
    Hypotheses,
    agreeing_edges,
    chance_level,
    join_candidates,
    noisy_share,
    search_pairs,
)
from dpmjax.registration.planar_scans import Floats, Indices, PlanarScans
from dpmjax.registration.range_profiles import RangeProfiles, compare_pairs, make_profiles
from dpmjax.registration.wall_directions import WallDirections

# Every scan that is no keyframe is searched against the keyframes with the so many most similar views, and without an
# order against so many scans with the most similar views ...
_NUM_ANCHORS, _NUM_NEAREST_VIEWS = 2, 3
# ... around so many likely headings; and keyframes against each other around so many.
_NUM_LIKELY_TURNS, _NUM_KEYFRAME_TURNS = 3, 6
# Where there is an order, its heading is within this of a linear one between the keyframes around it, radians.
_MAX_BEND = 0.7
# A scan whose best neighbour matches less than this share of the usual beams is unregistered; scans are of one cluster
# if they match more than this share.
_MIN_SUPPORT, _MIN_LINK = 0.6, 0.3


@dataclass(frozen=True)
class GlobalConfig:
    """Settings of the global registration. Lengths are in typical ranges of the scans.

    Attributes:
        max_keyframes: so many scans are searched all against all.
        max_unregistered: so many unregistered scans are searched against all keyframes, and those that remain against
            as many of the other scans; a cluster of up to half as many, which matches no other, is unregistered too.
        search: of pairs.
    """

    max_keyframes: int = 32
    max_unregistered: int = 12
    search: CorrelativeConfig = field(default_factory=CorrelativeConfig)


class GlobalRegistration(NamedTuple):
    """Result of `register_globally`.

    Attributes:
        poses: (n, 3) T_world_scan, the first one zero.
        keyframes: rows of the scans that were searched all against all.
    """

    poses: Floats
    keyframes: Indices


class _Task(NamedTuple):
    """The scans to be registered, the same for all stages."""

    profiles: RangeProfiles
    walls: WallDirections
    keyframes: Indices
    is_ordered: bool
    config: GlobalConfig

    @property
    def others(self) -> Indices:
        """Rows of the scans that are no keyframes."""
        return np.setdiff1d(np.arange(len(self.profiles)), self.keyframes)

    def search(self, source: Indices, target: Indices, turns: NDArray[np.bool_] | None = None) -> Candidates:
        """Candidates of pairs."""
        return search_pairs(self.profiles, source, target, self.config.search, turns=turns)

    def likely_turns(self, source: Indices, target: Indices, num_peaks: int) -> NDArray[np.bool_]:
        """Headings of T_target_source that the walls of both scans suggest."""
        return self.walls.likely_turns(source, target, self.config.search.num_turns, num_peaks)


def register_globally(scans: PlanarScans, config: GlobalConfig | None = None) -> GlobalRegistration:
    """Poses of all scans from no guess.

    Args:
        scans: n scans. Where they are ordered, neighbours in the array are taken as neighbours in time; else no order
            is used, and shuffled scans give the same map.
        config: settings.

    Returns:
        GlobalRegistration.
    """
    config, profiles = config or GlobalConfig(), make_profiles(scans)
    walls, unit = WallDirections(scans), scans.typical_range
    if scans.is_ordered:
        keyframes = evenly_in_time(len(scans), config.max_keyframes)
    else:
        everyone = np.arange(len(scans))
        keyframes = most_typical(walls.best_similarity(everyone, everyone), config.max_keyframes)
    task = _Task(profiles, walls, keyframes, scans.is_ordered, config)
    first, second = np.tril_indices(len(keyframes), k=-1)
    pairs = keyframes[first], keyframes[second]
    found = task.search(*pairs, task.likely_turns(*pairs, _NUM_KEYFRAME_TURNS))
    inside = found._replace(source=first, target=second)
    poses = np.zeros((len(scans), 3))
    poses[keyframes] = assemble(profiles.take(keyframes), inside, is_ordered=scans.is_ordered)
    if len(keyframes) < len(scans):
        key_edges = agreeing_edges(poses, found, unit)
        poses, more = place_others(task, poses, found, _search_others(task, poses))
        edges = join_edges(key_edges, agreeing_edges(poses, more, unit))
        poses = optimize_pose_graph(PoseGraph.create(poses, edges), ROBUST).graph.poses
    return GlobalRegistration(se2.relative(poses[0], poses), keyframes)


def evenly_in_time(num_scans: int, count: int) -> Indices:
    """At most `count` scans, the first and the last among them."""
    return np.unique(np.round(np.linspace(0, num_scans - 1, min(num_scans, count))).astype(np.int64))


def most_typical(similarity: Float[np.ndarray, "n n"], count: int) -> Indices:
    """Scans that together are most similar to all others."""
    count = min(len(similarity), count)
    chosen: list[int] = []
    # Similarity of each scan to the most similar chosen one; each choice adds as much to that as it can.
    covered = np.full(len(similarity), -1.0)
    for _ in range(count):
        gain = np.maximum(similarity - covered[:, None], 0.0).sum(axis=0)
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
        covered = np.maximum(covered, similarity[:, chosen[-1]])
    return np.sort(np.array(chosen, np.int64))


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
    return settle(poses, hypotheses, scorer)


def _search_others(task: _Task, poses: Floats) -> Candidates:
    """Candidates of the scans that are no keyframes, against some keyframes each."""
    source, target, turns = _similar_pairs(task)
    if task.is_ordered:
        near = _neighbour_pairs(task, poses[task.keyframes, 2])
        source, target, turns = (np.concatenate(x) for x in zip((source, target, turns), near, strict=True))
    return task.search(source, target, turns)


def _similar_pairs(task: _Task) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """Pairs of similar views, of each other scan with keyframes and with any scans; and the turns to try for each."""
    others = task.others
    order = np.argsort(-task.walls.best_similarity(others, task.keyframes), axis=1)[:, :_NUM_ANCHORS]
    pairs = task.keyframes[order]
    if not task.is_ordered:  # Neighbours in time are better partners than any similar view.
        best = task.walls.best_similarity(others, np.arange(len(task.profiles)))
        best[np.arange(len(others)), others] = -np.inf
        pairs = np.concatenate([pairs, np.argsort(-best, axis=1)[:, :_NUM_NEAREST_VIEWS]], axis=1)
    # Each pair once, with one scan that is turned for all its partners.
    ends = np.stack([pairs.reshape(-1), np.repeat(others, pairs.shape[1])], axis=-1)
    _, first = np.unique(np.sort(ends, axis=1), axis=0, return_index=True)
    source, target = ends[np.sort(first)].T
    return source, target, task.likely_turns(source, target, _NUM_LIKELY_TURNS)


def _neighbour_pairs(task: _Task, headings: Floats) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """The same of the keyframes before and after each other scan, whose heading lies about between theirs."""
    keyframes, others, num_turns = task.keyframes, task.others, task.config.search.num_turns
    after = np.clip(np.searchsorted(keyframes, others), 1, len(keyframes) - 1)
    between = np.interp(others, keyframes, np.unwrap(headings))
    source, target = np.concatenate([keyframes[after - 1], keyframes[after]]), np.concatenate([others, others])
    expected = np.concatenate([headings[after - 1], headings[after]]) - np.concatenate([between, between])
    turn = 2 * np.pi * np.arange(num_turns) / num_turns
    return source, target, np.abs(se2.wrap_angle(turn - expected[:, None])) < _MAX_BEND


def place_others(task: _Task, poses: Floats, found: Candidates, more: Candidates) -> tuple[Floats, Candidates]:
    """Places all scans, from the poses of the keyframes.

    Args:
        task: the scans.
        poses: (n, 3); right for the keyframes.
        found: candidates of the keyframes.
        more: candidates of the other scans.

    Returns:
        (n, 3) poses, and `more` with the candidates of scans that had to be searched again.
    """
    prior = _prior_between(poses, task) if task.is_ordered else None

    def place(poses: Floats, more: Candidates) -> Floats:
        candidates = join_candidates(found, more)
        share = noisy_share(task.profiles, candidates)
        scorer = PoseScorer(task.profiles, chance_level(found), share, task.is_ordered, prior)
        return place_in_map(poses, task.keyframes, Hypotheses.of(candidates), scorer)

    poses = place(poses, more)
    # A scan that sees no keyframe, and a keyframe that sees no other one, have their neighbours among the others.
    for partners in (task.keyframes, task.others):
        lost = find_unregistered(task.profiles, poses, task.config)
        if not len(lost):
            break
        # Similarity has misled these, so all turns are tried, with the partners of the most similar views.
        similarity = np.where(lost[:, None] == partners, -np.inf, task.walls.best_similarity(lost, partners))
        order = np.argsort(-similarity, axis=1, kind="stable")[:, : len(task.keyframes)]
        source, target = partners[order].reshape(-1), np.repeat(lost, order.shape[1])
        is_pair = source != target
        more = join_candidates(more, task.search(source[is_pair], target[is_pair]))
        poses = place(poses, more)
    return poses, more


def _prior_between(poses: Floats, task: _Task) -> PositionPrior:
    """Scans are between the keyframes before and after them, within the way from one to the other."""
    keyframes, scans = task.keyframes, np.arange(len(poses))
    centre = np.stack([np.interp(scans, keyframes, poses[keyframes, axis]) for axis in (0, 1)], axis=-1)
    step = np.hypot(*np.diff(poses[keyframes, :2], axis=0).T)
    gap = step[np.clip(np.searchsorted(keyframes, scans) - 1, 0, len(step) - 1)]
    slack = AGREEMENT[0] * task.profiles.scans.typical_range
    return PositionPrior(centre, np.where(np.isin(scans, keyframes), slack, gap + slack))


def find_unregistered(profiles: RangeProfiles, poses: Floats, config: GlobalConfig) -> Indices:
    """Unregistered scans, the worst first: they match far fewer beams than usual with any scan outside their cluster.

    A small cluster of scans that match each other and no other scan is unregistered too: its scans must not support
    each other.

    Args:
        profiles: n scans.
        poses: (n, 3) T_world_scan.
        config: settings.

    Returns:
        Rows of the unregistered scans.
    """
    num_scans = len(poses)
    num_near = min(7, num_scans)
    near = scipy.spatial.cKDTree(poses[:, :2]).query(poses[:, :2], k=num_near)[1]
    scan, other = np.repeat(np.arange(num_scans), num_near), near.reshape(-1).astype(np.int64)
    views = compare_pairs(profiles, scan, other, se2.relative(poses[other], poses[scan]))
    matched = np.where(scan == other, 0.0, views.matched)
    usual = float(np.median(matched.reshape(near.shape).max(axis=1)))
    is_linked = np.zeros((num_scans, num_scans), bool)
    is_linked[scan, other] = matched > _MIN_LINK * usual
    cluster = scipy.sparse.csgraph.connected_components(is_linked, directed=False)[1]
    is_small = np.bincount(cluster)[cluster] <= config.max_unregistered // 2
    matched = np.where(is_small[scan] & (cluster[scan] == cluster[other]), 0.0, matched)
    support = matched.reshape(near.shape).max(axis=1)
    worst = np.argsort(support)[: config.max_unregistered]
    return worst[support[worst] < _MIN_SUPPORT * usual].astype(np.int64)


def nearest_tour(poses: Floats) -> Indices:
    """Orders scans so that neighbours are near each other: from each pose to the nearest one not yet visited.

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
