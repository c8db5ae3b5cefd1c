"""One map from scored relative poses of pairs: grown scan by scan, each new place judged by all scans that are there.

A wrong pair looks good to its two scans; it rarely does to all others. So the best pair starts a map, every free scan
offers the places that its pairs propose, and the place on which all placed scans together agree best is taken next.
Then each scan may change its mind once all the others stand, and a robust graph over all pairs that agree averages
their small errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dpmjax.geometry import planar_poses
from dpmjax.registration.correlative import Candidates, Floats, Indices
from dpmjax.registration.planar_graph import Edges, GraphConfig, optimize_planar_graph
from dpmjax.registration.profiles import Margins, Profiles, judge_pairs


@dataclass(frozen=True)
class AssembleConfig:
    """Settings. Lengths are in length scales of the scans.

    Attributes:
        crossed_weight: matched beams that make up for a crossed one.
        next_weight: how much more the matched beams of neighbours in time count, where there is an order.
        radius: scans farther apart than this do not judge each other.
        agreement: a pair agrees with a map within this: translation, radians.
        min_score: beams by which a pair must hold to count as an edge.
        num_seeds: maps grown from so many different pairs; the best one is kept.
        num_revisions: rounds in which scans may change their place.
        sigma: accuracy of a pair with all its beams: translation, radians.
    """

    crossed_weight: float = 4.0
    next_weight: float = 4.0
    radius: float = 8.0
    agreement: tuple[float, float] = (0.4, 0.1)
    min_score: float = 40.0
    num_seeds: int = 6
    num_revisions: int = 3
    sigma: tuple[float, float] = (0.03, 0.01)


class Assembly(NamedTuple):
    """A map of all scans.

    Attributes:
        poses: (n, 3) T_world_scan.
        support: (n,) matched less weighted crossed beams of each scan against all the others.
        edges: pairs that agree with it.
        total: sum of the support over all pairs.
    """

    poses: Floats
    support: Floats
    edges: Edges
    total: float


class _Offers(NamedTuple):
    """Every candidate in both directions: where `scan` would be if `anchor` stood at the origin."""

    scan: Indices
    anchor: Indices
    poses: Floats
    scores: Floats


def _offers(candidates: Candidates) -> _Offers:
    count = candidates.scores.shape[1]
    source, target = np.repeat(candidates.source, count), np.repeat(candidates.target, count)
    poses, scores = candidates.poses.reshape(-1, 3), candidates.scores.reshape(-1)
    keep = np.isfinite(scores) & (scores > 0.0)
    source, target, poses, scores = source[keep], target[keep], poses[keep], scores[keep]
    return _Offers(
        np.concatenate([source, target]),
        np.concatenate([target, source]),
        np.concatenate([poses, planar_poses.inverse(poses)]),
        np.concatenate([scores, scores]),
    )


class _Judge(NamedTuple):
    """Scores places of scans against placed ones."""

    profiles: Profiles
    config: AssembleConfig
    scale: float
    margins: Margins
    chance: float
    noisy_share: float
    is_ordered: bool

    def against(self, scan: Indices, places: Floats, placed: Indices, poses: Floats) -> Floats:
        """(m,) sum over `placed` of matched less weighted crossed beams of `scan` at `places`."""
        apart = places[:, None, :2] - poses[placed][None, :, :2]
        row, column = np.nonzero(np.hypot(apart[..., 0], apart[..., 1]) < self.config.radius * self.scale)
        other = placed[column]
        keep = other != scan[row]
        row, other = row[keep], other[keep]
        relative = planar_poses.relative(poses[other], places[row])
        verdict = judge_pairs(self.profiles, scan[row], other, relative, margins=self.margins, stride=4)
        # What two scans of different places reach by chance says nothing; else rooms would be stacked on rooms.
        is_next = self.is_ordered & (np.abs(scan[row] - other) == 1)
        matched = np.maximum(verdict.matched - np.where(is_next, 0.5, 1.0) * self.chance, 0.0)
        matched *= np.where(is_next, self.config.next_weight, 1.0)
        crossed = np.maximum(verdict.crossed - self.noisy_share * verdict.seen, 0.0)
        value = matched - self.config.crossed_weight * crossed
        return np.asarray(np.bincount(row, value, minlength=len(scan)), np.float64)


def _grow(offers: _Offers, judge: _Judge, num_scans: int, seed: int) -> tuple[Floats, float]:
    """Poses of all scans, grown from the anchor of one offer; the sum of what each scan had for it."""
    poses, is_placed = np.zeros((num_scans, 3)), np.zeros(num_scans, bool)
    scan, anchor = int(offers.scan[seed]), int(offers.anchor[seed])
    is_placed[anchor] = True
    # Open offers: which scan, where in the world, and what the placed scans say so far.
    whose, where, said = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0)
    newest, total = anchor, 0.0
    while not is_placed.all():
        fresh = np.flatnonzero((offers.anchor == newest) & ~is_placed[offers.scan])
        placed = np.flatnonzero(is_placed)
        places = planar_poses.compose(poses[newest], offers.poses[fresh])
        said = said + judge.against(whose, where, np.array([newest]), poses)
        new_said = judge.against(offers.scan[fresh], places, placed, poses)
        whose, where = np.concatenate([whose, offers.scan[fresh]]), np.concatenate([where, places])
        said = np.concatenate([said, new_said])
        if len(whose):
            best = int(said.argmax()) if is_placed.sum() > 1 else int(np.flatnonzero(whose == scan)[0])
            newest, place = int(whose[best]), where[best]
            total += said[best]
        else:
            newest, place = int(np.flatnonzero(~is_placed)[0]), np.zeros(3)
        poses[newest], is_placed[newest] = place, True
        keep = whose != newest
        whose, where, said = whose[keep], where[keep], said[keep]
    return poses, total


def _revise(poses: Floats, offers: _Offers, judge: _Judge) -> tuple[Floats, int]:
    """Each scan, the worst supported first, moves to where all others want it most; and how many have moved."""
    poses, everyone, moved = poses.copy(), np.arange(len(poses)), 0
    support = judge.against(everyone, poses, everyone, poses)
    for scan in np.argsort(support):
        mine = np.flatnonzero(offers.scan == scan)
        if not len(mine):
            continue
        places = planar_poses.compose(poses[offers.anchor[mine]], offers.poses[mine])
        places = np.concatenate([poses[scan][None], places])
        said = judge.against(np.full(len(places), scan), places, everyone[everyone != scan], poses)
        best = int(said.argmax())
        # A little better is the same place, only said by another pair.
        if said[best] > said[0] + 0.02 * abs(said[0]):
            off = planar_poses.relative(poses[scan], places[best])
            moved += bool(np.hypot(off[0], off[1]) > judge.config.agreement[0] * judge.scale)
            poses[scan] = places[best]
    return poses, moved


def agreeing_edges(poses: Floats, candidates: Candidates, config: AssembleConfig, scale: float) -> Edges:
    """Pairs whose candidate says what the map says; of each pair the nearest one."""
    here = planar_poses.relative(poses[candidates.target], poses[candidates.source])
    off = planar_poses.relative(here[:, None], candidates.poses)
    distance = np.hypot(off[..., 0], off[..., 1]) / (config.agreement[0] * scale)
    turn = np.abs(planar_poses.wrap(off[..., 2])) / config.agreement[1]
    mismatch = np.where(candidates.scores > config.min_score, np.maximum(distance, turn), np.inf)
    best = mismatch.argmin(axis=1)
    row = np.arange(len(best))
    keep = mismatch[row, best] < 1.0
    sigma = np.array([config.sigma[0] * scale, config.sigma[0] * scale, config.sigma[1]])
    share = candidates.scores[row, best][keep] / 500.0
    information = share[:, None, None] * np.diag(1.0 / sigma**2)
    return Edges(candidates.source[keep], candidates.target[keep], candidates.poses[row, best][keep], information)


def assemble(
    profiles: Profiles,
    candidates: Candidates,
    config: AssembleConfig | None = None,
    *,
    scale: float,
    margins: Margins,
    is_ordered: bool = False,
) -> Assembly:
    """Poses of all scans from candidates of their pairs; no order, no first guess.

    Args:
        profiles: n scans.
        candidates: of pairs that connect all scans.
        config: settings.
        scale: `length_scale` of the scans.
        margins: how exactly hits are compared.
        is_ordered: neighbours in the array are neighbours in time, so likely to overlap.

    Returns:
        Assembly; the first pose is zero.
    """
    config = config or AssembleConfig()
    num_scans = profiles.mask.shape[0]
    chance, share = chance_level(candidates), noisy_share(profiles, candidates, margins)
    judge, offers = _Judge(profiles, config, scale, margins, chance, share, is_ordered), _offers(candidates)
    everyone = np.arange(num_scans)
    best: Assembly | None = None
    seeds = _choose_seeds(offers, config.num_seeds)
    for seed in seeds:
        poses, _ = _grow(offers, judge, num_scans, seed)
        for _ in range(config.num_revisions):
            poses, moved = _revise(poses, offers, judge)
            if not moved:
                break
        edges = agreeing_edges(poses, candidates, config, scale)
        if len(edges.source):
            poses, _ = optimize_planar_graph(poses, edges, GraphConfig())
        support = judge.against(everyone, poses, everyone, poses)
        if best is None or support.sum() > best.total:
            poses = planar_poses.relative(poses[0], poses)
            best = Assembly(poses, support, edges, float(support.sum()))
    if best is None:
        return Assembly(
            np.zeros((num_scans, 3)),
            np.zeros(num_scans),
            agreeing_edges(np.zeros((num_scans, 3)), candidates, config, scale),
            0.0,
        )
    return best


def place_in_map(
    profiles: Profiles,
    poses: Floats,
    placed: Indices,
    candidates: Candidates,
    config: AssembleConfig,
    *,
    scale: float,
    margins: Margins,
) -> Floats:
    """Poses of the scans that are not yet placed: of what their pairs offer, where the placed scans match best.

    Args:
        profiles: n scans.
        poses: (n, 3); right for those of `placed`.
        placed: rows.
        candidates: of pairs of a placed scan and another.
        config: settings.
        scale: `length_scale` of the scans.
        margins: how exactly hits are compared.

    Returns:
        (n, 3) poses. Scans without any offer stand where `poses` has them.
    """
    share = noisy_share(profiles, candidates, margins)
    # Places of one scan compete with each other alone: no need to subtract what chance would give.
    judge, offers = _Judge(profiles, config, scale, margins, 0.0, share, False), _offers(candidates)
    is_placed = np.zeros(len(poses), bool)
    is_placed[placed] = True
    rows = np.flatnonzero(is_placed[offers.anchor] & ~is_placed[offers.scan])
    places = planar_poses.compose(poses[offers.anchor[rows]], offers.poses[rows])
    said = judge.against(offers.scan[rows], places, placed, poses)
    order = np.argsort(said, kind="stable")
    poses = poses.copy()
    # The best one of each scan is written last.
    poses[offers.scan[rows[order]]] = places[order]
    return poses


def chance_level(candidates: Candidates) -> float:
    """Beams that a wrong pose of a pair reaches at most, nine times in ten: second candidates are mostly wrong."""
    second = candidates.scores[:, 1]
    second = second[np.isfinite(second)]
    return float(np.percentile(second, 90)) if len(second) else 0.0


def noisy_share(profiles: Profiles, candidates: Candidates, margins: Margins) -> float:
    """Share of beams that seem to cross a surface in pairs that are right: what noise alone does."""
    best = np.argsort(-candidates.scores[:, 0])[: profiles.mask.shape[0]]
    verdict = judge_pairs(
        profiles, candidates.source[best], candidates.target[best], candidates.poses[best, 0], margins=margins
    )
    share = verdict.crossed / np.maximum(verdict.seen, 1.0)
    return 3.0 * float(np.percentile(share, 90)) if len(share) else 0.0


def _choose_seeds(offers: _Offers, count: int) -> list[int]:
    """The best pairs, no scan in two of them."""
    chosen: list[int] = []
    used: set[int] = set()
    for row in np.argsort(-offers.scores, kind="stable"):
        pair = {int(offers.scan[row]), int(offers.anchor[row])}
        if len(chosen) < count and not pair & used:
            chosen.append(int(row))
            used |= pair
    return chosen
