"""One map from scored relative poses of pairs: grown scan by scan, each new place judged by all scans that are there.

A wrong pair looks good to its two scans; it rarely does to all others. So the best pair starts a map, every free scan
offers the places that its pairs propose, and the place on which all placed scans together agree best is taken next.
Then each scan may change its mind once all the others stand, whole blocks may move, and a robust graph over all pairs
that agree averages their small errors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges
from dpmjax.pose_graph.planar import GraphConfig, optimize_planar_graph
from dpmjax.registration.block_moves import move_blocks
from dpmjax.registration.pair_search import Candidates, Floats, Indices
from dpmjax.registration.pose_scoring import (
    AssembleConfig,
    Leash,
    MapJudge,
    Offers,
    add_up,
    chance_level,
    is_firmly_more,
    make_offers,
    noisy_share,
)
from dpmjax.registration.range_profiles import Margins, Profiles


class Assembly(NamedTuple):
    """A map of all scans.

    Attributes:
        poses: (n, 3) T_world_scan.
        edges: pairs that agree with it.
    """

    poses: Floats
    edges: Edges


def _grow(offers: Offers, judge: MapJudge, num_scans: int, seed: int) -> Floats:
    """Poses of all scans, grown from the anchor of one offer."""
    poses, is_placed = np.zeros((num_scans, 3)), np.zeros(num_scans, bool)
    scan, anchor = int(offers.scan[seed]), int(offers.anchor[seed])
    is_placed[anchor] = True
    # Open offers: which scan, where in the world, and what each placed scan says.
    whose, where, said = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, num_scans))
    newest = anchor
    while not is_placed.all():
        fresh = np.flatnonzero((offers.anchor == newest) & ~is_placed[offers.scan])
        placed = np.flatnonzero(is_placed)
        places = se2.compose(poses[newest], offers.poses[fresh])
        _fill(said, judge.opinions(whose, where, np.array([newest]), poses), np.array([newest]))
        new_said = np.zeros((len(fresh), num_scans))
        _fill(new_said, judge.opinions(offers.scan[fresh], places, placed, poses), placed)
        whose, where = np.concatenate([whose, offers.scan[fresh]]), np.concatenate([where, places])
        said = np.concatenate([said, new_said])
        if len(whose):
            row, column = (x.astype(np.int64) for x in np.nonzero(said))
            support = add_up(row, said[row, column], len(said))
            best = int(support.argmax()) if is_placed.sum() > 1 else int(np.flatnonzero(whose == scan)[0])
            newest, place = int(whose[best]), where[best]
        else:
            newest, place = int(np.flatnonzero(~is_placed)[0]), np.zeros(3)
        poses[newest], is_placed[newest] = place, True
        keep = whose != newest
        whose, where, said = whose[keep], where[keep], said[keep]
    return poses


def _fill(said: Floats, opinions: tuple[Indices, Indices, Floats], placed: Indices) -> None:
    row, column, value = opinions
    said[row, placed[column]] = value


def _revise(poses: Floats, offers: Offers, judge: MapJudge) -> tuple[Floats, int]:
    """Each scan, the worst supported first, moves to where all others want it most; and how many have moved."""
    poses, everyone, moved = poses.copy(), np.arange(len(poses)), 0
    support = judge.against(everyone, poses, everyone, poses)
    places = se2.compose(poses[offers.anchor], offers.poses)
    said = judge.against(offers.scan, places, everyone, poses)
    # Where nobody wants it elsewhere now, a scan is not asked again.
    is_better = is_firmly_more(said, support[offers.scan])
    for scan in (scan for scan in np.argsort(support) if scan in set(offers.scan[is_better].tolist())):
        mine = np.flatnonzero(offers.scan == scan)
        places = se2.compose(poses[offers.anchor[mine]], offers.poses[mine])
        places = np.concatenate([poses[scan][None], places])
        said = judge.against(np.full(len(places), scan), places, everyone, poses)
        best = int(said.argmax())
        if is_firmly_more(said[best], said[0]):
            off = se2.relative(poses[scan], places[best])
            moved += bool(np.hypot(off[0], off[1]) > judge.config.agreement[0] * judge.scale)
            poses[scan] = places[best]
    return poses, moved


def _settle(poses: Floats, offers: Offers, judge: MapJudge) -> Floats:
    """Rounds in which scans move, until none does."""
    for _ in range(judge.config.num_revisions):
        poses, moved = _revise(poses, offers, judge)
        if not moved:
            break
    return poses


def agreeing_edges(poses: Floats, candidates: Candidates, config: AssembleConfig, scale: float) -> Edges:
    """Pairs whose candidate says what the map says; of each pair the nearest one."""
    here = se2.relative(poses[candidates.target], poses[candidates.source])
    off = se2.relative(here[:, None], candidates.poses)
    distance = np.hypot(off[..., 0], off[..., 1]) / (config.agreement[0] * scale)
    turn = np.abs(se2.wrap_angle(off[..., 2])) / config.agreement[1]
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
    judge, offers = MapJudge(profiles, config, scale, margins, chance, share, is_ordered), make_offers(candidates)
    everyone = np.arange(num_scans)
    best, most = np.zeros((num_scans, 3)), -np.inf
    for seed in _choose_seeds(offers, config.num_seeds):
        poses = _settle(_grow(offers, judge, num_scans, seed), offers, judge)
        total = float(judge.against(everyone, poses, everyone, poses).sum())
        if total > most:
            best, most = poses, total
    poses, num_moved = move_blocks(best, offers, judge)
    poses = _settle(poses, offers, judge) if num_moved else poses
    edges = agreeing_edges(poses, candidates, config, scale)
    if len(edges.source):
        poses, _ = optimize_planar_graph(poses, edges, GraphConfig())
    return Assembly(se2.relative(poses[0], poses), edges)


def place_in_map(
    profiles: Profiles,
    poses: Floats,
    placed: Indices,
    candidates: Candidates,
    config: AssembleConfig,
    *,
    scale: float,
    margins: Margins,
    chance: float,
    is_ordered: bool = False,
    leash: Leash | None = None,
) -> Floats:
    """Poses of the scans that are not yet placed: of what their pairs offer, where the placed scans match best.

    Then all scans may change their places as in `assemble`.

    Args:
        profiles: n scans.
        poses: (n, 3); right for those of `placed`.
        placed: rows.
        candidates: of pairs, each scan that is not placed with a placed one in one of them at least.
        config: settings.
        scale: `length_scale` of the scans.
        margins: how exactly hits are compared.
        chance: `chance_level` of the pairs of placed scans.
        is_ordered: neighbours in the array are neighbours in time.
        leash: where scans can be; None: anywhere.

    Returns:
        (n, 3) poses. Scans without any offer stand where `poses` has them.
    """
    share = noisy_share(profiles, candidates, margins)
    # Places of one scan compete with each other alone: no need to subtract what chance would give.
    judge, offers = MapJudge(profiles, config, scale, margins, 0.0, share, False, leash), make_offers(candidates)
    is_placed = np.zeros(len(poses), bool)
    is_placed[placed] = True
    rows = np.flatnonzero(is_placed[offers.anchor] & ~is_placed[offers.scan])
    places = se2.compose(poses[offers.anchor[rows]], offers.poses[rows])
    said = judge.against(offers.scan[rows], places, placed, poses)
    order = np.argsort(said, kind="stable")
    poses = poses.copy()
    # The best one of each scan is written last.
    poses[offers.scan[rows[order]]] = places[order]
    judge = judge._replace(chance=chance, is_ordered=is_ordered)
    return _settle(poses, offers, judge)


def _choose_seeds(offers: Offers, count: int) -> list[int]:
    """The best pairs, no scan in two of them."""
    chosen: list[int] = []
    used: set[int] = set()
    for row in np.argsort(-offers.scores, kind="stable"):
        pair = {int(offers.scan[row]), int(offers.anchor[row])}
        if len(chosen) < count and not pair & used:
            chosen.append(int(row))
            used |= pair
    return chosen
