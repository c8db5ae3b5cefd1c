"""Correction of the weak steps between the parts of a sequence, by submaps and by loops that agree.

A step is weak if the scans on both sides share few beams. All later scans may then be metres off. So the two submaps on
either side are searched against each other, and then submaps of different parts. A single pair may be wrong. But wrong
pairs propose different poses, and correct pairs propose the same pose (consensus, as in pairwise consistent sets of
loops). Each pair is a vote.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dpmjax.geometry import se2
from dpmjax.scan.planar.compare import pair_scores, weak_steps
from dpmjax.scan.planar.motion_prior import MotionPrior
from dpmjax.scan.planar.propose import CorrelativeConfig, Hypotheses, search_pairs
from dpmjax.scan.planar.record import Floats, Indices, PlanarScans, planar_scans, spread_evenly
from dpmjax.scan.planar.wall_directions import WallDirections

# Length of the submaps on either side of a weak step along the trajectory, typical ranges, so that both may see the end
# of a corridor. Largest turn and shift of such a step, and number of cells of the images and of candidates.
_SIDE_LENGTH, _MAX_TURN, _MAX_SHIFT, _NUM_CELLS, _NUM_CANDIDATES = 2.0, 2.2, 1.6, 256, 24
# Weight of the motion prior beside the agreement of two submaps, and beside the votes of loops.
_PRIOR_WEIGHT, _LOOP_PRIOR_WEIGHT = 0.1, 0.3
# The largest distance of pairs of submaps is the sum of a constant, a share of the path length between them, and a
# length for each weak step between them. Least path length between two submaps on either side of one weak step. Lengths
# are in typical ranges. Number of likely turns that are searched.
_NEAR, _DRIFT, _WEAK_STEP, _LEAST_WAY, _NUM_TURNS = 1.0, 0.1, 1.0, 1.5, 6
# Least score of a vote; and scale within which votes agree (typical ranges, radians).
_LEAST_VOTE, _AGREEMENT = 0.3, (0.15, 0.12)
# Weight of the score of a weak step itself, and least gain in votes of another pose.
_OWN_WEIGHT, _LEAST_GAIN = 4.0, 0.4
# Smaller corrections are left to the loop closure: typical ranges, radians.
_LEAST_MOVE = (0.25, 0.25)
_NUM_ROUNDS = 2
# Number of beams of a submap, and largest number of its scans, spread evenly along the trajectory.
_NUM_BEAMS, _NUM_MEMBERS = 360, 12


class _Sequence(NamedTuple):
    """A sequence of scans, of which `rows` are registered at `poses` (n, 3)."""

    scans: PlanarScans
    poses: Floats
    rows: Indices
    prior: MotionPrior


class _Submaps(NamedTuple):
    """Submaps along a sequence: rows of the centres, their parts, and the path length up to them."""

    scans: PlanarScans
    centres: Indices
    parts: Indices
    ways: Floats


def join_parts(
    scans: PlanarScans, poses: Floats, rows: Indices, prior: MotionPrior, config: CorrelativeConfig
) -> Floats:
    """Corrects each weak step to the relative pose that most scans support.

    Args:
        scans: n scans in time order.
        poses: (n, 3) T_world_scan.
        rows: (k,) the registered scans.
        prior: motion prior of the registered scans.
        config: settings of the search of pairs of submaps.

    Returns:
        (n, 3) poses; unchanged if no step is weak.
    """
    sequence = _Sequence(scans, poses.copy(), rows, prior)
    steps = np.flatnonzero(weak_steps(scans, poses, rows))
    if not len(steps):
        return poses
    _search_across(sequence, steps, config)
    part = np.append(0, np.cumsum(np.isin(np.arange(len(rows) - 1), steps)))
    submaps = _make_submaps(sequence, part)
    votes = _find_votes(sequence, submaps, config)
    for _ in range(_NUM_ROUNDS):
        for step in steps:
            _follow_votes(sequence, submaps, votes, int(step))
    return sequence.poses


def _search_across(sequence: _Sequence, steps: Indices, config: CorrelativeConfig) -> None:
    """Corrects each weak step by a search of the submap after it against the submap before it."""
    poses, rows, unit = sequence.poses, sequence.rows, sequence.scans.typical_range
    ends = np.concatenate([[-1], steps, [len(rows) - 1]])
    sides = []
    for number, step in enumerate(steps):
        before, after = rows[ends[number] + 1 : step + 1], rows[step + 1 : ends[number + 2] + 1]
        sides += [side[se2.driven_lengths(poses[side]) <= _SIDE_LENGTH * unit] for side in (before[::-1], after)]
    centres = np.array([side[0] for side in sides])
    submaps, target = _merge_scans(sequence, centres, sides), 2 * np.arange(len(steps))
    config = config._replace(num_cells=_NUM_CELLS, max_shift=_MAX_SHIFT, num_candidates=_NUM_CANDIDATES)
    turns = np.abs(se2.wrap_angle(2 * np.pi * np.arange(config.num_turns) / config.num_turns)) < _MAX_TURN
    found = search_pairs(submaps, target + 1, target, config, turns=np.broadcast_to(turns, (len(target), len(turns))))
    for number, step in enumerate(steps):
        before, after = rows[step], rows[step + 1]
        gap, here = int(after - before), se2.relative(poses[before], poses[after])
        candidates = found.poses[found.target == 2 * number]
        ways = np.concatenate([[here, sequence.prior.expected(gap)], candidates])
        pairs = np.full(len(ways), 2 * number + 1), np.full(len(ways), 2 * number)
        score = pair_scores(submaps, *pairs, ways)
        score -= _PRIOR_WEIGHT * sequence.prior.surprise(ways, np.full(len(ways), gap))
        _move_behind(sequence, int(step), ways[score.argmax()])


def _move_behind(sequence: _Sequence, step: int, way: Floats) -> None:
    """Moves all scans after a step so that the relative pose of the step becomes `way`."""
    poses, rows = sequence.poses, sequence.rows
    motion = se2.compose(se2.compose(poses[rows[step]], way), se2.inverse(poses[rows[step + 1]]))
    poses[rows[step + 1] :] = se2.compose(motion, poses[rows[step + 1] :])


def _make_submaps(sequence: _Sequence, part: Indices) -> _Submaps:
    """Makes submaps about a typical range apart, none across a weak step."""
    poses, rows, unit = sequence.poses, sequence.rows, sequence.scans.typical_range
    way = se2.driven_lengths(poses[rows])
    # Submaps lie a typical range apart, or farther if they were more than this.
    spacing = max(unit, way[-1] / 80)
    middles, members = [], []
    for number in range(part[-1] + 1):
        own = np.flatnonzero(part == number)
        count = max(1, int(np.ceil((way[own[-1]] - way[own[0]]) / spacing)))
        for place in way[own[0]] + (np.arange(count) + 0.5) / count * (way[own[-1]] - way[own[0]]):
            middles.append(own[np.abs(way[own] - place).argmin()])
            members.append(rows[own[np.abs(way[own] - way[middles[-1]]) < unit]])
    middle = np.array(middles)
    submaps = _merge_scans(sequence, rows[middle], members)
    return _Submaps(submaps, rows[middle], part[middle], way[middle])


def _merge_scans(sequence: _Sequence, centres: Indices, members: list[Indices]) -> PlanarScans:
    """Makes a scan with a full field of view of each submap.

    A scan of a limited field of view shares few beams with the scan before where the robot turns or passes a door.
    Merged scans on either side share more. Of each submap, the nearest hit at each bearing of the centre is kept.

    Args:
        sequence: its poses are correct within a submap.
        centres: (s,) rows of the scans whose frames are those of the submaps.
        members: rows of the scans of each submap, s arrays.

    Returns:
        s scans in no order, with the noise and the typical range of the scans.
    """
    scans, poses = sequence.scans, sequence.poses
    points, mask = np.zeros((len(centres), _NUM_BEAMS, 2), np.float32), np.zeros((len(centres), _NUM_BEAMS), bool)
    hits, valid = np.asarray(scans.views.points, np.float64), scans.mask
    for row, (centre, rows) in enumerate(zip(centres, members, strict=True)):
        used = rows[spread_evenly(len(rows), _NUM_MEMBERS)]
        seen = se2.transform_points(se2.relative(poses[centre], poses[used]), hits[used])[valid[used]]
        bearing = np.arctan2(seen[:, 1], seen[:, 0]) % (2 * np.pi)
        beam = np.minimum((bearing * _NUM_BEAMS / (2 * np.pi)).astype(np.int64), _NUM_BEAMS - 1)
        order = np.lexsort((np.hypot(seen[:, 0], seen[:, 1]), beam))
        beams, first = np.unique(beam[order], return_index=True)
        points[row, beams], mask[row, beams] = seen[order[first]], True
    made = planar_scans(points, mask, is_ordered=False)
    return replace(made, noise=scans.noise, typical_range=scans.typical_range)


def _find_votes(sequence: _Sequence, submaps: _Submaps, config: CorrelativeConfig) -> Hypotheses:
    """Finds relative poses of submaps of different parts that may overlap: the votes."""
    unit, poses = sequence.scans.typical_range, sequence.poses[submaps.centres]
    later, earlier = np.tril_indices(len(poses), k=-1)
    way, crossed = submaps.ways[later] - submaps.ways[earlier], submaps.parts[later] - submaps.parts[earlier]
    reach = _NEAR * unit + _DRIFT * way + _WEAK_STEP * unit * crossed
    keep = np.hypot(*(poses[later, :2] - poses[earlier, :2]).T) < reach
    keep &= (crossed > 0) & ((way > _LEAST_WAY * unit) | (crossed > 1))
    later, earlier = later[keep], earlier[keep]
    if not len(later):
        return Hypotheses(later, earlier, np.zeros((0, 3)), np.zeros(0))
    turns = WallDirections(submaps.scans).likely_turns(later, earlier, config.num_turns, _NUM_TURNS)
    votes = search_pairs(submaps.scans, later, earlier, config._replace(num_candidates=4), turns=turns)
    votes = votes._replace(scores=pair_scores(submaps.scans, votes.source, votes.target, votes.poses))
    return votes.take(votes.scores > _LEAST_VOTE)


def _follow_votes(sequence: _Sequence, submaps: _Submaps, votes: Hypotheses, step: int) -> None:
    """Corrects a weak step to the relative pose that most loops across it agree on."""
    poses, unit, prior = sequence.poses, sequence.scans.typical_range, sequence.prior
    before, after = sequence.rows[step], sequence.rows[step + 1]
    here, gap = se2.relative(poses[before], poses[after]), int(after - before)
    votes = votes._replace(source=submaps.centres[votes.source], target=submaps.centres[votes.target])
    votes = votes.take((votes.source >= after) & (votes.target <= before))
    motion = se2.compose(votes.world_poses(poses), se2.inverse(poses[votes.source]))
    ways = se2.relative(poses[before], se2.compose(motion, poses[after]))
    is_near = np.hypot(ways[:, 0], ways[:, 1]) < _WEAK_STEP * unit
    ways = np.concatenate([here[None], ways[is_near]])
    weight = np.append(0.0, votes.scores[is_near])
    off = se2.relative(ways[:, None], ways[None])
    distance = np.hypot(off[..., 0], off[..., 1]) / (_AGREEMENT[0] * unit)
    total = np.exp(-0.5 * (distance**2 + (off[..., 2] / _AGREEMENT[1]) ** 2)) @ weight
    total -= _LOOP_PRIOR_WEIGHT * prior.surprise(ways, np.full(len(ways), gap))
    own = pair_scores(sequence.scans, np.array([after]), np.array([before]), here[None])
    total[0] += _OWN_WEIGHT * max(0.0, float(own[0]))
    best = int(total.argmax())
    is_far = not se2.is_within(off[0, best], _LEAST_MOVE[0] * unit, _LEAST_MOVE[1])
    if is_far and total[best] > total[0] + _LEAST_GAIN:
        _move_behind(sequence, step, ways[best])
