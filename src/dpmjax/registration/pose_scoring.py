"""How well a place of a scan goes with the places of others: what each has to say of it, and what chance alone says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.registration.pair_search import Candidates, Floats, Indices
from dpmjax.registration.range_profiles import Margins, Profiles, judge_pairs


@dataclass(frozen=True)
class AssembleConfig:
    """Settings. Lengths are in length scales of the scans.

    Attributes:
        crossed_weight: matched beams that make up for a crossed one.
        next_weight: how much more the matched beams of neighbours in time count, where there is an order.
        radius: scans farther apart than this do not judge each other ...
        num_judges: ... and of the others so many nearest ones do.
        agreement: a pair agrees with a map within this: translation, radians.
        min_score: beams by which a pair must hold to count as an edge.
        num_seeds: maps grown from so many different pairs; the best one is kept.
        num_revisions: rounds in which scans and blocks may change their place.
        num_cuts: weakest joints at which a block is cut off in a round.
        num_block_places: places that are tried for a block.
        sigma: accuracy of a pair with all its beams: translation, radians.
    """

    crossed_weight: float = 4.0
    next_weight: float = 4.0
    radius: float = 8.0
    num_judges: int = 32
    agreement: tuple[float, float] = (0.4, 0.1)
    min_score: float = 40.0
    num_seeds: int = 6
    num_revisions: int = 3
    num_cuts: int = 6
    num_block_places: int = 48
    sigma: tuple[float, float] = (0.03, 0.01)


class Offers(NamedTuple):
    """Every candidate in both directions: where `scan` would be if `anchor` stood at the origin."""

    scan: Indices
    anchor: Indices
    poses: Floats
    scores: Floats


def make_offers(candidates: Candidates) -> Offers:
    """Offers of all candidates that hold by any beam."""
    count = candidates.scores.shape[1]
    source, target = np.repeat(candidates.source, count), np.repeat(candidates.target, count)
    poses, scores = candidates.poses.reshape(-1, 3), candidates.scores.reshape(-1)
    keep = np.isfinite(scores) & (scores > 0.0)
    source, target, poses, scores = source[keep], target[keep], poses[keep], scores[keep]
    return Offers(
        np.concatenate([source, target]),
        np.concatenate([target, source]),
        np.concatenate([poses, se2.inverse(poses)]),
        np.concatenate([scores, scores]),
    )


class Leash(NamedTuple):
    """Where scans can be at all.

    Attributes:
        middle: (n, 2).
        length: (n,) farthest from there.
    """

    middle: Floats
    length: Floats


# Said of places that cannot be: less than any scans could say.
_IMPOSSIBLE = -1e6


class MapJudge(NamedTuple):
    """Scores places of scans against placed ones.

    Attributes:
        profiles: n scans.
        config: settings.
        scale: `length_scale` of the scans.
        margins: how exactly hits are compared.
        chance: beams that two scans of different places match by chance; they do not count.
        noisy_share: share of beams that seem to cross surfaces where all is right.
        is_ordered: neighbours in the array are neighbours in time.
        leash: where scans can be; None: anywhere.
    """

    profiles: Profiles
    config: AssembleConfig
    scale: float
    margins: Margins
    chance: float
    noisy_share: float
    is_ordered: bool
    leash: Leash | None = None

    def against(self, scan: Indices, places: Floats, placed: Indices, poses: Floats) -> Floats:
        """(m,) what all of `placed` together say of each `scan` at its place."""
        row, _, value = self.opinions(scan, places, placed, poses)
        said = add_up(row, value, len(scan))
        if self.leash is not None:
            off = places[:, :2] - self.leash.middle[scan]
            said += np.where(np.hypot(off[:, 0], off[:, 1]) > self.leash.length[scan], _IMPOSSIBLE, 0.0)
        return said

    def opinions(
        self, scan: Indices, places: Floats, placed: Indices, poses: Floats
    ) -> tuple[Indices, Indices, Floats]:
        """What single ones of `placed` say of single ones of `scan` (m,) at `places`: row, column, value."""
        apart = places[:, None, :2] - poses[placed][None, :, :2]
        apart = np.hypot(apart[..., 0], apart[..., 1])
        apart[scan[:, None] == placed[None]] = np.inf
        limit = np.full(len(scan), self.config.radius * self.scale)
        if len(placed) > self.config.num_judges:
            limit = np.minimum(limit, np.partition(apart, self.config.num_judges, axis=1)[:, self.config.num_judges])
        row, column = (x.astype(np.int64) for x in np.nonzero(apart < limit[:, None]))
        other = placed[column]
        value = self.of_pairs(scan[row], other, se2.relative(poses[other], places[row]))
        return row, column, value

    def of_pairs(self, source: Indices, target: Indices, poses: Floats) -> Floats:
        """(p,) what the scans of pairs say of each other at `poses`, T_target_source: matched less weighted crossed."""
        verdict = judge_pairs(self.profiles, source, target, poses, margins=self.margins, stride=4)
        # What two scans of different places reach by chance says nothing; else rooms would be stacked on rooms.
        is_next = self.is_ordered & (np.abs(source - target) == 1)
        matched = np.maximum(verdict.matched - np.where(is_next, 0.5, 1.0) * self.chance, 0.0)
        matched *= np.where(is_next, self.config.next_weight, 1.0)
        crossed = np.maximum(verdict.crossed - self.noisy_share * verdict.seen, 0.0)
        return np.asarray(matched - self.config.crossed_weight * crossed, np.float64)


def add_up(row: Indices, value: Floats, count: int) -> Floats:
    """All that is said of each of `count` rows: objections in full, and of what speaks for it the k-th best by 1 / k.

    A place needs a few scans that know it well. Were all counted alike, rooms that look alike would be stacked: the
    more scans overlap, the more beams match.
    """
    order = np.lexsort((-value, row))
    row, value = row[order], value[order]
    rank = np.arange(len(row)) - np.searchsorted(row, row)
    return np.bincount(row, np.where(value > 0.0, value / (1.0 + rank), value), minlength=count).astype(np.float64)


def is_firmly_more(said: Floats | np.float64, support: Floats | np.float64) -> NDArray[np.bool_]:
    """More than a little: what is only a little better is the same place, told by another pair."""
    return np.asarray(said > support + 0.02 * np.abs(support))


def chance_level(candidates: Candidates) -> float:
    """Beams by which a wrong pose of a pair holds, the median: second candidates are mostly wrong."""
    second = candidates.scores[:, 1]
    second = second[np.isfinite(second)]
    return max(0.0, float(np.median(second))) if len(second) else 0.0


def noisy_share(profiles: Profiles, candidates: Candidates, margins: Margins) -> float:
    """Share of beams that seem to cross a surface in pairs that are right: what noise alone does."""
    best = np.argsort(-candidates.scores[:, 0])[: profiles.mask.shape[0]]
    verdict = judge_pairs(
        profiles, candidates.source[best], candidates.target[best], candidates.poses[best, 0], margins=margins
    )
    share = verdict.crossed / np.maximum(verdict.seen, 1.0)
    return 3.0 * float(np.percentile(share, 90)) if len(share) else 0.0
