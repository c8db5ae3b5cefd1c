"""Recordings: choice of the scans that are registered, and poses of all scans.

A robot's log has thousands of scans, most of them a few centimetres from the previous one. Only scans that differ by a
least distance or turn are registered. Each remaining scan follows the odometry between the registered scans before and
after it. It is then aligned with the nearer of these two.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dpmjax.geometry import se2
from dpmjax.scan.planar.align import COARSE, FINE, PairPrior, match_pairs
from dpmjax.scan.planar.compare import WEAK_SCORE, contradicted_share, pair_scores
from dpmjax.scan.planar.record import (
    Booleans,
    Floats,
    Indices,
    Pairs,
    PlanarScans,
    planar_scans,
    spread_evenly,
)
from dpmjax.scan.planar.slide import slide_steps
from dpmjax.types import ScanSet

# Standard deviation of odometry from one chosen scan to the next: translation in typical ranges, radians.
_ODOMETRY_SIGMA = (0.005, 0.01)
# The same for a scan that does not fit, because in fast turns odometry and scan have different times. Initial turns of
# such a scan, radians.
_LOOSE_SIGMA, _TURNS = (0.01, 0.1), (-0.15, -0.1, -0.05, 0.0, 0.05, 0.1, 0.15)
# Least fitness, and largest share of beams that contradict the chosen scan, of an aligned scan; else odometry is kept.
_MIN_FITNESS, _MAX_CONTRADICTED = 0.5, 0.05
# A robot stands still where it moves by less than this share of the least distance of registered scans.
_STANDING = 0.02
# Odometry that repeats its pose for this many steps may have failed; low rates repeat it for fewer. Number of scans of
# such a run that are compared.
_LEAST_SILENT, _MAX_COMPARED = 3, 8
# A beam has changed by more than these standard deviations of the noise, and this share of the typical range; the
# robot has stood where a smaller share of the beams has changed, in most scans.
_NOISE, _LEAST_CHANGE, _CHANGED_SHARE, _MOST = 6.0, 0.02, 0.015, 0.6


class Recording(NamedTuple):
    """All scans of a recording, and those that are registered.

    Attributes:
        scans: all n scans.
        chosen: rows of the k registered scans, in order.
        motion: (n, 3) poses whose steps are the motion between registered scans. None if all scans except repeated ones
            are registered.
        originals: (n,) row of the scan that each scan repeats beam by beam, or its own row. A scan without an echo
            counts as a repetition, and gets a pose between its neighbours.
    """

    scans: ScanSet
    chosen: Indices
    motion: Floats | None
    originals: Indices

    def between(self, poses: Floats) -> Floats:
        """Returns poses of all scans from those of the registered scans and the motion between them."""
        rows, copies = np.unique(self.originals, return_inverse=True)
        if self.motion is not None:
            poses = fill_between(np.searchsorted(rows, self.chosen), poses, self.motion[rows])
        return self._with_blind(poses[copies])

    def aligned(self, poses: Floats) -> tuple[Floats, Indices]:
        """Aligns each scan with the nearest registered one.

        Returns:
            Poses of all scans, and the rows of three successive scans or more that fit no neighbour in time: single
            ones may be covered.
        """
        poses = self.between(poses)
        if self.motion is None:
            return poses, np.zeros(0, np.int64)
        rows, copies = np.unique(self.originals, return_inverse=True)
        scans, chosen = planar_scans(take_scans(self.scans, rows)), np.searchsorted(rows, self.chosen)
        found = align_between(scans, chosen, poses[rows])
        # So many successive scans that fit no neighbour are lost; fewer are covered, or passed by people.
        is_lost = in_runs(_best_scores(scans, found) < WEAK_SCORE, 3)
        for gap in np.unique(np.searchsorted(chosen, np.flatnonzero(is_lost))):
            # Odometry is wrong there: wheels slip, and some of them count forward alone.
            part = np.arange(chosen[max(gap - 1, 0)], chosen[gap] + 1)
            some, ends, turns = scans.take(part), np.array([0, len(part) - 1]), np.outer(_TURNS, [0.0, 0.0, 1.0])
            guesses = np.broadcast_to(turns, (len(part) - 1, *turns.shape))
            motion = se2.chain(match_pairs(some.take(slice(1, None)), some.take(slice(-1)), guesses, COARSE).poses)
            placed = align_between(some, ends, fill_between(ends, found[part[ends]], motion))
            if _best_scores(some, placed).sum() > _best_scores(some, found[part]).sum():
                found[part] = placed
        is_lost = in_runs(_best_scores(scans, found) < WEAK_SCORE, 3)
        return self._with_blind(found[copies]), rows[is_lost]

    def _with_blind(self, poses: Floats) -> Floats:
        """Puts scans without any echo between their neighbours."""
        seen = np.flatnonzero(np.asarray(self.scans.mask).any(axis=1))
        return poses if len(seen) == len(poses) else interpolate(len(poses), seen, poses[seen])


def _best_scores(scans: PlanarScans, poses: Floats) -> Floats:
    """Computes, for each of n scans at poses (n, 3), the better one of its scores with the scans before and after."""
    later = np.arange(1, len(poses))
    scores = pair_scores(scans, later, later - 1, se2.relative(poses[:-1], poses[1:]))
    return np.maximum(np.append(scores, -np.inf), np.append(-np.inf, scores))


def in_runs(is_member: Booleans, length: int) -> Booleans:
    """Returns True for members of a run of at least this many members."""
    is_long = np.zeros(len(is_member), bool)
    for first, last in find_runs(is_member, length):
        is_long[first:last] = True
    return is_long


def find_runs(is_member: Booleans, length: int) -> Indices:
    """Finds the runs of at least this many members: rows (k, 2) of the first member and of the one after the last."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], is_member, [False]]))).reshape(-1, 2)
    return ends[ends[:, 1] - ends[:, 0] >= length]


def find_silent_steps(scans: ScanSet, odometry: Floats) -> Booleans:
    """Finds steps without any odometry, although the scans do not show that the robot stood.

    Encoders that fail repeat their last pose, as those of a standing robot do. A robot has stood where its scans are
    equal within their noise, or fit without a motion and at no other place, as in a room that people walk through.

    Args:
        scans: n scans in the order of time.
        odometry: (n, 3) raw poses.

    Returns:
        (n - 1,) True for the steps of a run in which the robot may have moved.
    """
    seen = np.flatnonzero(np.asarray(scans.mask).any(axis=1))
    stands = np.abs(np.diff(odometry, axis=0)).max(axis=1) < 1e-9
    is_silent = np.zeros(len(stands), np.bool_)
    for first, last in find_runs(stands, _LEAST_SILENT):
        rows = seen[(seen >= first) & (seen <= last)]
        if len(rows) > 1:
            rows = rows[spread_evenly(len(rows), _MAX_COMPARED)]
            is_silent[first:last] = not _has_stood(planar_scans(take_scans(scans, rows)))
    return is_silent


def _has_stood(scans: PlanarScans) -> bool:
    """Returns True if most scans fit the one before without a motion, and do not fit as well at another place."""
    ranges = np.linalg.norm(scans.points, axis=-1)
    off = np.abs(np.diff(ranges, axis=0)) > max(_NOISE * scans.noise, _LEAST_CHANGE * scans.typical_range)
    both = scans.mask[1:] & scans.mask[:-1]
    changed = (off & both).sum(axis=1) / np.maximum(both.sum(axis=1), 1)
    if np.quantile(changed, _MOST) < _CHANGED_SHARE:
        return True
    slides = slide_steps(scans, np.zeros((len(scans) - 1, 3)))
    return bool(((slides.scores > WEAK_SCORE) & ~slides.is_torn & ~slides.is_open).mean() >= _MOST)


def take_scans(scans: ScanSet, rows: Indices) -> ScanSet:
    """Returns the scans of these rows."""
    # On the host: each number of rows would be a program of its own.
    return ScanSet(jnp.asarray(np.asarray(scans.points)[rows]), jnp.asarray(np.asarray(scans.mask)[rows]))


def find_originals(scans: ScanSet) -> Indices:
    """Finds scans that repeat the previous scan beam by beam, and scans without any echo.

    Args:
        scans: n scans in the order of time.

    Returns:
        (n,) row of the first scan of each run of repetitions. A scan without an echo never has its own row.
    """
    points, mask = np.asarray(scans.points), np.asarray(scans.mask)
    repeats = np.append(False, (points[1:] == points[:-1]).all((1, 2)) & (mask[1:] == mask[:-1]).all(1))
    is_seen = mask.any(axis=1)
    first = int(is_seen.argmax())
    return np.maximum(np.maximum.accumulate(np.where(repeats | ~is_seen, 0, np.arange(len(points)))), first)


def choose_scans(
    scans: ScanSet, motion: Floats | None, min_distance: float, min_turn: float, is_silent: Booleans | None = None
) -> Recording:
    """Selects the scans to register by distance and turn.

    If that keeps at least half of the distinct scans, all scans of the moving robot are selected.

    Args:
        scans: n scans in the order of time.
        motion: (n, 3) odometry of any kind; None: all scans are registered.
        min_distance: as `choose_by_motion`.
        min_turn: as `choose_by_motion`.
        is_silent: (n - 1,) steps that `motion` does not measure; their scans are registered.

    Returns:
        Recording. A scan that repeats the previous scan is not registered, and gets the pose of that scan.

    Raises:
        ValueError: all scans are equal.
    """
    originals = find_originals(scans)
    rows = np.unique(originals)
    if len(rows) < 2:
        raise ValueError(f"scans: expected two different ones, got {len(originals)} that are equal beam by beam")
    if motion is None:
        return Recording(scans, rows, None, originals)
    chosen = choose_by_motion(motion[rows], min_distance, min_turn)
    if 2 * len(chosen) >= len(rows):
        # A robot that stands still measures noise alone.
        chosen = choose_by_motion(motion[rows], _STANDING * min_distance, _STANDING * min_turn)
    if is_silent is not None:
        ends = np.append(is_silent, False) | np.append(False, is_silent)
        chosen = np.union1d(chosen, np.flatnonzero(ends[rows]))
    return Recording(scans, rows[chosen], None if len(chosen) == len(rows) else motion, originals)


def choose_by_motion(odometry: Float[np.ndarray, "n 3"], min_distance: float, min_turn: float) -> Indices:
    """Chooses scans that lie apart; a standing robot adds none.

    Args:
        odometry: poses x, y, heading of all scans, in the order of time.
        min_distance: a scan is chosen at this distance or more from the last chosen one.
        min_turn: a scan is also chosen at this turn or more against the last chosen one; radians.

    Returns:
        Rows of the chosen scans in order; the first and the last scan are among them.
    """
    chosen = [0]
    for row in range(1, len(odometry)):
        x, y, heading = odometry[row] - odometry[chosen[-1]]
        if np.hypot(x, y) >= min_distance or abs(se2.wrap_angle(heading)) >= min_turn:
            chosen.append(row)
    if chosen[-1] != len(odometry) - 1:
        chosen.append(len(odometry) - 1)
    return np.array(chosen, np.int64)


def fill_between(chosen: Indices, poses: Float[np.ndarray, "k 3"], odometry: Float[np.ndarray, "n 3"]) -> Floats:
    """Computes poses of all scans from the poses of the chosen scans and the corrected odometry between them.

    The error of odometry at the next chosen scan is distributed over the scans before it, in proportion to distance and
    turns.

    Args:
        chosen: rows of k scans in order, the first and the last scan among them.
        poses: T_world_scan of the chosen scans, x, y, heading.
        odometry: odometry of all n scans.

    Returns:
        (n, 3) T_world_scan; those at `chosen` are `poses`.
    """
    before = np.clip(np.searchsorted(chosen, np.arange(len(odometry)), side="right") - 1, 0, max(len(chosen) - 2, 0))
    after = np.minimum(before + 1, len(chosen) - 1)
    start, end = chosen[before], chosen[after]
    # In the frame of the chosen scan before: the next chosen scan by odometry, and the error of odometry there.
    T_before_after = se2.relative(odometry[start], odometry[end])
    error = se2.relative(T_before_after, se2.relative(poses[before], poses[after]))
    part = se2.share_of(error, _share_of_way(odometry, start, end))
    correction = se2.compose(se2.compose(T_before_after, part), se2.inverse(T_before_after))
    T_before_scan = se2.compose(correction, se2.relative(odometry[start], odometry))
    filled = np.asarray(se2.compose(poses[before], T_before_scan), np.float64)
    filled[chosen] = poses
    return filled


def interpolate(num_scans: int, rows: Indices, poses: Floats) -> Floats:
    """Interpolates poses of all scans from the poses (k, 3) of `rows` (k,); both ends of the sequence are constant."""
    at_start, at_end = rows[:1] * 0, rows[-1:] * 0 + num_scans - 1
    chosen, first = np.unique(np.concatenate([rows, at_start, at_end]), return_index=True)
    known = np.concatenate([poses, poses[:1], poses[-1:]])[first]
    return fill_between(chosen, known, np.zeros((num_scans, 3)))


def align_between(scans: PlanarScans, chosen: Indices, poses: Float[np.ndarray, "n 3"]) -> Floats:
    """Aligns each scan with the chosen scan before or after it, point to line; the nearer one first.

    Args:
        scans: n scans in the order of time.
        chosen: rows of k scans in order, the first and the last scan among them.
        poses: T_world_scan of all scans, as `fill_between` computes them.

    Returns:
        (n, 3) T_world_scan; unchanged at `chosen` and for scans that do not fit.
    """
    aligned = poses.copy()
    others = np.setdiff1d(np.arange(len(poses)), chosen)
    after = np.searchsorted(chosen, others)
    ends = np.stack([chosen[after - 1], chosen[after]])
    apart = np.abs(se2.relative(poses[ends], poses[others]))
    order = (apart @ [1.0, 1.0, scans.typical_range]).argsort(axis=0)
    nearest, farther = np.take_along_axis(ends, order, axis=0)
    is_left = np.ones(len(others), bool)
    for target, turns, sigma in (
        (nearest, (0.0,), _ODOMETRY_SIGMA),
        (nearest, _TURNS, _LOOSE_SIGMA),
        (farther, _TURNS, _LOOSE_SIGMA),
    ):
        rows = np.flatnonzero(is_left)
        found, fits = _align_with(scans, poses, (others[rows], target[rows]), turns, sigma)
        aligned[others[rows[fits]]] = found[fits]
        is_left[rows[fits]] = False
    return aligned


def _align_with(
    scans: PlanarScans, poses: Floats, pairs: Pairs, turns: tuple[float, ...], sigma: tuple[float, float]
) -> tuple[Floats, Booleans]:
    """Aligns sources with their targets from turns of the expected poses; returns poses, and True where they fit."""
    source, target = pairs
    expected = np.asarray(se2.relative(poses[target], poses[source]))
    spread = np.array(sigma)[[0, 0, 1]] * [scans.typical_range, scans.typical_range, 1.0]
    prior = PairPrior(expected, np.broadcast_to((3.0 * scans.noise / spread) ** 2, expected.shape))
    guesses = expected[:, None] + np.outer(turns, [0.0, 0.0, 1.0])
    found = match_pairs(scans.take(source), scans.take(target), guesses, FINE, prior)
    both, rows = scans.take(np.concatenate([source, target])), np.arange(len(source))
    contradicted = contradicted_share(both, rows, len(source) + rows, found.poses)
    fits = (found.fitness > _MIN_FITNESS) & (contradicted < _MAX_CONTRADICTED)
    return np.asarray(se2.compose(poses[target], found.poses)), fits


def _share_of_way(odometry: Floats, start: Indices, end: Indices) -> Floats:
    """Computes the share of the path from `start` to `end` up to each scan; a radian equals one unit of length."""
    steps = se2.relative(odometry[:-1], odometry[1:])
    lengths = np.hypot(steps[:, 0], steps[:, 1]) + np.abs(se2.wrap_angle(steps[:, 2])) + 1e-9
    way = np.append(0.0, np.cumsum(lengths))
    return np.asarray((way - way[start]) / np.maximum(way[end] - way[start], 1e-9), np.float64)


def distinct_rows(scans: PlanarScans) -> Indices:
    """Returns rows of the scans that differ from the previous scan; all rows for scans without noise."""
    is_new = (np.diff(scans.points, axis=0) != 0).any(axis=(1, 2))
    # Range noise, in typical ranges, above which no two scans are equal.
    is_new = is_new | (scans.noise < 1.5e-4 * scans.typical_range)
    return np.flatnonzero(np.append(True, is_new))
