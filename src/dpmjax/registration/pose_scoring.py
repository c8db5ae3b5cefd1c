"""The pose scorer: how well a pose of a scan goes with the poses of others, by pairwise scores above chance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.registration.pair_search import Candidates
from dpmjax.registration.planar_scans import Floats, Indices
from dpmjax.registration.range_profiles import RangeProfiles, compare_pairs

# Score of an impossible pose, below any real score.
_IMPOSSIBLE = -1e6


@dataclass(frozen=True)
class AssemblyConfig:
    """Settings of the map assembly. Lengths are in typical ranges of the scans.

    Attributes:
        contradiction_weight: matched beams that make up for a contradicting one.
        next_weight: how much more the matched beams of neighbours in time count, where there is an order.
        radius: scans farther apart than this do not score each other ...
        num_scorers: ... and of the others so many nearest ones do.
        agreement: a pair agrees with a map within this: translation, radians.
        min_score: beams that a pair must hold by to be an edge.
        num_seeds: maps grown from so many different pairs; the best one is kept.
        num_revisions: rounds in which scans and blocks may change their pose.
        num_cuts: weakest connections at which a block is cut off.
        num_block_poses: poses that are tried for a block.
        sigma: accuracy of a pair with all its beams: translation, radians.
    """

    contradiction_weight: float = 4.0
    next_weight: float = 4.0
    radius: float = 1.2
    num_scorers: int = 32
    agreement: tuple[float, float] = (0.06, 0.1)
    min_score: float = 40.0
    num_seeds: int = 6
    num_revisions: int = 3
    num_cuts: int = 6
    num_block_poses: int = 48
    sigma: tuple[float, float] = (0.0045, 0.01)


class Hypotheses(NamedTuple):
    """Pose hypotheses: every candidate in both directions, the pose of `scan` in the frame of `anchor`."""

    scan: Indices
    anchor: Indices
    poses: Floats
    scores: Floats

    @classmethod
    def of(cls, candidates: Candidates) -> Hypotheses:
        """Hypotheses of all candidates with a positive score."""
        count = candidates.scores.shape[1]
        source, target = np.repeat(candidates.source, count), np.repeat(candidates.target, count)
        poses, scores = candidates.poses.reshape(-1, 3), candidates.scores.reshape(-1)
        keep = np.isfinite(scores) & (scores > 0.0)
        source, target, poses, scores = source[keep], target[keep], poses[keep], scores[keep]
        both = (source, target), (target, source), (poses, se2.inverse(poses)), (scores, scores)
        return cls(*(np.concatenate(x) for x in both))

    def take(self, rows: NDArray[np.integer]) -> Hypotheses:
        """The hypotheses of these rows."""
        return Hypotheses(*(x[rows] for x in self))

    def world_poses(self, poses: Floats) -> Floats:
        """(h, 3) pose of each scan in the world, by that of its anchor."""
        return np.asarray(se2.compose(poses[self.anchor], self.poses))


class PositionPrior(NamedTuple):
    """Discs outside of which scans cannot be.

    Attributes:
        centre: (n, 2).
        radius: (n,).
    """

    centre: Floats
    radius: Floats


class PoseScorer(NamedTuple):
    """Scores poses of scans against those of placed ones.

    Attributes:
        profiles: n scans.
        config: settings.
        chance: beams that two scans of different places match by chance; they do not count.
        noisy_share: share of visible beams that seem to contradict where all is right; they do not count.
        is_ordered: neighbours in the array are neighbours in time.
        prior: where scans can be; None: anywhere.
    """

    profiles: RangeProfiles
    config: AssemblyConfig
    chance: float
    noisy_share: float
    is_ordered: bool
    prior: PositionPrior | None = None

    @property
    def radius(self) -> float:
        """Distance within which scans score each other, unit of the points."""
        return self.config.radius * self.profiles.typical_range

    def score(self, scan: Indices, candidates: Floats, placed: Indices, poses: Floats) -> Floats:
        """(m,) score of each `scan` at its candidate pose (m, 3) against all of `placed`, which are at `poses`."""
        row, _, value = self.pairwise_scores(scan, candidates, placed, poses)
        total = add_up(row, value, len(scan))
        if self.prior is not None:
            off = candidates[:, :2] - self.prior.centre[scan]
            total += np.where(np.hypot(off[:, 0], off[:, 1]) > self.prior.radius[scan], _IMPOSSIBLE, 0.0)
        return total

    def pairwise_scores(
        self, scan: Indices, candidates: Floats, placed: Indices, poses: Floats
    ) -> tuple[Indices, Indices, Floats]:
        """Scores of single ones of `scan` against single ones of `placed`: row, column, score."""
        apart = candidates[:, None, :2] - poses[placed][None, :, :2]
        apart = np.hypot(apart[..., 0], apart[..., 1])
        apart[scan[:, None] == placed[None]] = np.inf
        limit = np.full(len(scan), self.radius)
        if len(placed) > self.config.num_scorers:
            limit = np.minimum(limit, np.partition(apart, self.config.num_scorers, axis=1)[:, self.config.num_scorers])
        row, column = (x.astype(np.int64) for x in np.nonzero(apart < limit[:, None]))
        other = placed[column]
        return row, column, self.score_pairs(scan[row], other, se2.relative(poses[other], candidates[row]))

    def score_pairs(self, source: Indices, target: Indices, poses: Floats) -> Floats:
        """(p,) matched less weighted contradicting beams of pairs at `poses`, T_target_source, above chance."""
        views = compare_pairs(self.profiles, source, target, poses, stride=4)
        # Matches by chance do not count; else rooms would be stacked on rooms.
        is_next = self.is_ordered & (np.abs(source - target) == 1)
        matched = np.maximum(views.matched - np.where(is_next, 0.5, 1.0) * self.chance, 0.0)
        matched *= np.where(is_next, self.config.next_weight, 1.0)
        contradicted = np.maximum(views.contradicted - self.noisy_share * views.visible, 0.0)
        return np.asarray(matched - self.config.contradiction_weight * contradicted, np.float64)

    def score_map(self, poses: Floats) -> Floats:
        """(n, n) pairwise scores of a map, below the diagonal; 0 for scans too far apart."""
        source, target = lower_pairs(len(poses))
        relative = se2.relative(poses[target], poses[source])
        near = np.hypot(relative[:, 0], relative[:, 1]) < self.radius
        values = np.zeros((len(poses), len(poses)))
        values[source[near], target[near]] = self.score_pairs(source[near], target[near], relative[near])
        return values


def lower_pairs(count: int) -> tuple[Indices, Indices]:
    """All pairs of different rows, the later one first."""
    first, second = np.nonzero(np.tri(count, k=-1, dtype=bool))
    return first.astype(np.int64), second.astype(np.int64)


def add_up(row: Indices, value: Floats, count: int) -> Floats:
    """Total score of each of `count` rows: negative scores in full, and the k-th best positive one by 1 / k.

    A pose needs a few scans that match it well. Were all counted alike, rooms that look alike would be stacked: the
    more scans overlap, the more beams match.
    """
    order = np.lexsort((-value, row))
    row, value = row[order], value[order]
    rank = np.arange(len(row)) - np.searchsorted(row, row)
    return np.bincount(row, np.where(value > 0.0, value / (1.0 + rank), value), minlength=count).astype(np.float64)


def is_firmly_more(score: Floats | np.float64, reference: Floats | np.float64) -> NDArray[np.bool_]:
    """Whether a score is more than 2 % above a reference: below that it is the same pose by another pair."""
    return np.asarray(score > reference + 0.02 * np.abs(reference))


def chance_level(candidates: Candidates) -> float:
    """Score of a wrong pose of a pair, the median: second candidates are mostly wrong."""
    second = candidates.scores[:, 1]
    second = second[np.isfinite(second)]
    return max(0.0, float(np.median(second))) if len(second) else 0.0


def noisy_share(profiles: RangeProfiles, candidates: Candidates) -> float:
    """Share of visible beams that seem to contradict in pairs that are right: what noise alone does."""
    best = np.argsort(-candidates.scores[:, 0])[: len(profiles)]
    views = compare_pairs(profiles, candidates.source[best], candidates.target[best], candidates.poses[best, 0])
    share = views.contradicted / np.maximum(views.visible, 1.0)
    return 3.0 * float(np.percentile(share, 90)) if len(share) else 0.0
