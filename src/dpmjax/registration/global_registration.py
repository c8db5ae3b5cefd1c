"""Poses of all scans from nothing but the scans: no first guess, no iterated closest points, and if need be no order.

A few dozen scans that differ most are searched against each other exhaustively and assembled into one map; the others
then look for their places in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import scipy.spatial
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import join_edges
from dpmjax.pose_graph.planar import optimize_planar_graph
from dpmjax.registration.line_fitting import LineScans
from dpmjax.registration.map_assembly import agreeing_edges, assemble, place_in_map
from dpmjax.registration.pair_search import (
    Candidates,
    CorrelativeConfig,
    Floats,
    Indices,
    join_candidates,
    search_pairs,
)
from dpmjax.registration.pairs import length_scale
from dpmjax.registration.pose_scoring import AssembleConfig, Leash, chance_level
from dpmjax.registration.range_profiles import Margins, Profiles, judge_pairs, make_profiles

# Directions that profiles are compared at for likeness.
_LIKENESS_BEARINGS = 128


@dataclass(frozen=True)
class GlobalConfig:
    """Settings. Lengths are in length scales of the scans.

    Attributes:
        max_keyframes: so many scans are searched all against all.
        num_anchors: every other scan is searched against so many keyframes that look like it.
        num_twins: and, without an order, against so many of all scans that look like it most.
        num_likely_turns: headings that are tried for these, by likeness, and their neighbours.
        max_bend: a scan's heading is within this of what the keyframes before and after it say, radians; only where
            there is an order.
        min_company: a scan whose best neighbour matches less than this share of what is usual is lost.
        min_hold: scans hold together by more than this share of what is usual; a few that hold to none else are lost.
        max_stragglers: so many lost scans are searched against all keyframes, and those that are lost still against
            as many of the other scans; half as many make an island.
        match: how near a hit must come to count as matched; never below half the range noise.
        cross: how far in front of a surface a hit contradicts it; never below five times the range noise.
        search: of pairs.
        assembly: of the map.
    """

    max_keyframes: int = 32
    num_anchors: int = 2
    num_twins: int = 3
    num_likely_turns: int = 3
    max_bend: float = 0.7
    min_company: float = 0.6
    min_hold: float = 0.3
    max_stragglers: int = 12
    match: float = 0.04
    cross: float = 0.12
    search: CorrelativeConfig = field(default_factory=CorrelativeConfig)
    assembly: AssembleConfig = field(default_factory=AssembleConfig)


class GlobalStart(NamedTuple):
    """Result of `global_start`.

    Attributes:
        poses: (n, 3) T_world_scan, the first one zero.
        keyframes: rows of the scans that were searched all against all.
        num_edges: pairs that agree with the map.
    """

    poses: Floats
    keyframes: Indices
    num_edges: int


def view_margins(lines: LineScans, config: GlobalConfig | None = None) -> Margins:
    """How exactly hits of these scans can be compared."""
    config = config or GlobalConfig()
    scale, noise = length_scale(lines), float(lines.noise[0])
    return Margins(max(config.match * scale, 0.5 * noise), max(config.cross * scale, 5.0 * noise))


def likeness(profiles: Profiles, scale: float) -> tuple[Floats, Floats]:
    """How alike the views of all pairs are when turned rightly, (n, n), and for each turn, (n, n, 128).

    Turn k of pair (i, j) is the heading 2 pi k / 128 of T_i_j.
    """
    stride = profiles.surface.shape[1] // _LIKENESS_BEARINGS
    reach = np.asarray(profiles.surface, np.float64).reshape(-1, _LIKENESS_BEARINGS, stride).mean(-1)
    # Near surfaces move most between two views of one place, so far ones are worth less.
    seen = np.asarray(profiles.is_seen).reshape(-1, _LIKENESS_BEARINGS, stride).any(-1)
    view = np.where(seen, np.log1p(reach / scale), 0.0)
    view = view - view.mean(axis=1, keepdims=True)
    view /= np.maximum(np.linalg.norm(view, axis=1, keepdims=True), 1e-9)
    spectrum = np.fft.rfft(view, axis=1)
    turned = np.fft.irfft(spectrum[:, None] * np.conj(spectrum[None]), n=_LIKENESS_BEARINGS, axis=-1)
    return turned.max(-1), turned


def choose_keyframes(alike: Floats, config: GlobalConfig, *, is_ordered: bool) -> Indices:
    """Scans that cover the place: evenly in time where there is an order, else those that others look like."""
    num_scans = len(alike)
    count = min(num_scans, config.max_keyframes)
    if is_ordered or count == num_scans:
        return np.unique(np.round(np.linspace(0, num_scans - 1, count)).astype(np.int64))
    chosen: list[int] = []
    # How well each scan is stood for by the chosen ones; each choice adds as much to that as it can.
    covered = np.full(num_scans, -1.0)
    for _ in range(count):
        gain = np.maximum(alike - covered[:, None], 0.0).sum(axis=0)
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
        covered = np.maximum(covered, alike[:, chosen[-1]])
    return np.sort(np.array(chosen, np.int64))


def _anchor_pairs(
    alike: Floats, turned: Floats, keyframes: Indices, config: GlobalConfig, *, num_twins: int
) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """Pairs that look alike, of each other scan with keyframes and with any scans; and which turns to try for each."""
    others = np.setdiff1d(np.arange(len(alike)), keyframes)
    order = np.argsort(-alike[np.ix_(others, keyframes)], axis=1)[:, : config.num_anchors]
    unlike_itself = alike - 2.0 * np.eye(len(alike))
    twins = np.argsort(-unlike_itself[others], axis=1)[:, :num_twins]
    pairs = np.concatenate([keyframes[order], twins], axis=1)
    # Each pair once, with one scan that is turned for all its partners.
    ends = np.stack([pairs.reshape(-1), np.repeat(others, pairs.shape[1])], axis=-1)
    _, first = np.unique(np.sort(ends, axis=1), axis=0, return_index=True)
    source, target = ends[np.sort(first)].T
    # T_target_source of a keyframe in the frame of the other scan.
    curve = turned[target, source]
    num_turns, count = config.search.num_turns, curve.shape[-1]
    turns = np.zeros((len(source), num_turns), bool)
    row = np.arange(len(source))
    for _ in range(config.num_likely_turns):
        best = curve.argmax(axis=1)
        middle = np.round(best * num_turns / count).astype(int)
        for offset in (-2, -1, 0, 1, 2):
            turns[row, (middle + offset) % num_turns] = True
        for offset in range(-6, 7):
            curve[row, (best + offset) % count] = -np.inf
    return source, target, turns


def _neighbour_pairs(
    num_scans: int, keyframes: Indices, headings: Floats, config: GlobalConfig
) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """The same of the keyframes before and after each other scan, which has about a heading between theirs."""
    others = np.setdiff1d(np.arange(num_scans), keyframes)
    after = np.clip(np.searchsorted(keyframes, others), 1, len(keyframes) - 1)
    between = np.interp(others, keyframes, np.unwrap(headings))
    source, target = np.concatenate([keyframes[after - 1], keyframes[after]]), np.concatenate([others, others])
    expected = np.concatenate([headings[after - 1], headings[after]]) - np.concatenate([between, between])
    turn = 2 * np.pi * np.arange(config.search.num_turns) / config.search.num_turns
    return source, target, np.abs(se2.wrap_angle(turn - expected[:, None])) < config.max_bend


def _search_others(
    profiles: Profiles, alike: Floats, turned: Floats, keyframes: Indices, poses: Floats, config: GlobalConfig,
    *, scale: float, margins: Margins, is_ordered: bool,
) -> Candidates:  # fmt: skip
    """Candidates of the scans that are no keyframes, against some keyframes each."""
    # Neighbours in time are better twins than any that look alike.
    num_twins = 0 if is_ordered else config.num_twins
    source, target, turns = _anchor_pairs(alike, turned, keyframes, config, num_twins=num_twins)
    if is_ordered:
        near = _neighbour_pairs(len(alike), keyframes, poses[keyframes, 2], config)
        source, target, turns = (np.concatenate(x) for x in zip((source, target, turns), near, strict=True))
    return search_pairs(profiles, source, target, config.search, scale=scale, margins=margins, turns=turns)


def _find_stragglers(profiles: Profiles, poses: Floats, margins: Margins, config: GlobalConfig) -> Indices:
    """Scans that share far fewer beams than is usual with any neighbour outside of their own island, the worst first.

    An island is a few scans that hold together and to nothing else: lost together, they would vouch for each other.
    """
    num_scans = len(poses)
    near = scipy.spatial.cKDTree(poses[:, :2]).query(poses[:, :2], k=min(7, num_scans))[1]
    scan, other = np.repeat(np.arange(num_scans), near.shape[1]), near.reshape(-1).astype(np.int64)
    verdict = judge_pairs(profiles, scan, other, se2.relative(poses[other], poses[scan]), margins=margins)
    matched = np.where(scan == other, 0.0, verdict.matched)
    usual = float(np.median(matched.reshape(near.shape).max(axis=1)))
    holds = matched > config.min_hold * usual
    graph = scipy.sparse.csr_matrix((matched[holds], (scan[holds], other[holds])), shape=(num_scans, num_scans))
    island = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    is_small = np.bincount(island)[island] <= config.max_stragglers // 2
    matched = np.where(is_small[scan] & (island[scan] == island[other]), 0.0, matched)
    company = matched.reshape(near.shape).max(axis=1)
    worst = np.argsort(company)[: config.max_stragglers]
    return worst[company[worst] < config.min_company * usual].astype(np.int64)


def _leash_between(poses: Floats, keyframes: Indices, config: GlobalConfig, scale: float) -> Leash:
    """Scans are between the keyframes before and after them, give or take the way from one to the other."""
    scans = np.arange(len(poses))
    middle = np.stack([np.interp(scans, keyframes, poses[keyframes, axis]) for axis in (0, 1)], axis=-1)
    step = np.hypot(*np.diff(poses[keyframes, :2], axis=0).T)
    gap = step[np.clip(np.searchsorted(keyframes, scans) - 1, 0, len(step) - 1)]
    slack = config.assembly.agreement[0] * scale
    return Leash(middle, np.where(np.isin(scans, keyframes), slack, gap + slack))


def _place_others(
    profiles: Profiles, alike: Floats, keyframes: Indices, poses: Floats, found: Candidates, more: Candidates,
    config: GlobalConfig, *, scale: float, margins: Margins, is_ordered: bool,
) -> tuple[Floats, Candidates]:  # fmt: skip
    """Poses of all scans from those of the keyframes, and the pairs that told them: `more` and those of stragglers."""
    leash = _leash_between(poses, keyframes, config, scale) if is_ordered else None

    def place(poses: Floats, more: Candidates) -> Floats:
        return place_in_map(
            profiles, poses, keyframes, join_candidates(found, more), config.assembly, scale=scale, margins=margins,
            chance=chance_level(found), is_ordered=is_ordered, leash=leash,
        )  # fmt: skip

    poses = place(poses, more)
    # A scan that sees no keyframe, and a keyframe that sees no other one, have their neighbours among the others.
    for partners in (keyframes, np.setdiff1d(np.arange(len(poses)), keyframes)):
        lost = _find_stragglers(profiles, poses, margins, config)
        if not len(lost):
            break
        # Likeness has misled these, so all turns are tried.
        source, target = _straggler_pairs(alike, lost, partners, len(keyframes))
        again = search_pairs(profiles, source, target, config.search, scale=scale, margins=margins)
        more = join_candidates(more, again)
        poses = place(poses, more)
    return poses, more


def _straggler_pairs(alike: Floats, lost: Indices, partners: Indices, count: int) -> tuple[Indices, Indices]:
    """Pairs of each lost scan with those `count` of the partners that look like it most."""
    views = np.where(lost[:, None] == partners, -np.inf, alike[np.ix_(lost, partners)])
    order = np.argsort(-views, axis=1, kind="stable")[:, :count]
    source, target = partners[order].reshape(-1), np.repeat(lost, order.shape[1])
    return source[source != target], target[source != target]


def global_start(
    lines: LineScans, valid: NDArray[np.bool_], config: GlobalConfig | None = None, *, is_ordered: bool = True
) -> GlobalStart:
    """Poses of all scans from no guess.

    Args:
        lines: n scans with lines.
        valid: (n, b) beams that measured something.
        config: settings.
        is_ordered: neighbours in the array are neighbours in time; else no order is used, and shuffled scans give
            the same map.

    Returns:
        GlobalStart.
    """
    config = config or GlobalConfig()
    scale, margins = length_scale(lines), view_margins(lines, config)
    profiles = make_profiles(lines, np.asarray(valid))
    num_scans = len(np.asarray(valid))
    alike, turned = likeness(profiles, scale)
    keyframes = choose_keyframes(alike, config, is_ordered=is_ordered)
    first, second = (x.astype(np.int64) for x in np.nonzero(np.tri(len(keyframes), k=-1, dtype=bool)))
    found = search_pairs(profiles, keyframes[first], keyframes[second], config.search, scale=scale, margins=margins)
    inside = Candidates(first, second, found.poses, found.scores)
    key_profiles = _rows(profiles, keyframes)
    assembly = assemble(key_profiles, inside, config.assembly, scale=scale, margins=margins, is_ordered=is_ordered)
    poses = np.zeros((num_scans, 3))
    poses[keyframes] = assembly.poses
    edges = agreeing_edges(poses, found, config.assembly, scale)
    if len(keyframes) < num_scans:
        more = _search_others(
            profiles, alike, turned, keyframes, poses, config, scale=scale, margins=margins, is_ordered=is_ordered
        )
        poses, more = _place_others(
            profiles, alike, keyframes, poses, found, more, config,
            scale=scale, margins=margins, is_ordered=is_ordered,
        )  # fmt: skip
        edges = join_edges(edges, agreeing_edges(poses, more, config.assembly, scale))
        if len(edges.source):
            poses, _ = optimize_planar_graph(poses, edges)
    return GlobalStart(se2.relative(poses[0], poses), keyframes, len(edges.source))


def _rows(profiles: Profiles, rows: Indices) -> Profiles:
    return jax.tree.map(lambda x: x[rows], profiles)
