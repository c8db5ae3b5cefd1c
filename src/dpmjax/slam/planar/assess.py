"""Quality of a registration without ground truth: scores of trajectories, choice of the best, and trust in it.

A map is good if few nats encode all its beams (`map_code_length`) and if near scans agree (`view_misfit`). A trajectory
is good if its steps are those of the odometry, within its noise.

A map is wrong where a weak connection holds it together, where beams pass through the hits of other scans, or where a
relative pose is unconstrained along a corridor. Trust rests on three quantities. The first is the score of the weakest
connection of the best tree of pairs. The second is the share of contradicting beams of the pairs outside the tree,
beyond that of the pairs in it. The third is the standard deviation of each scan's position relative to the largest part
of the map without unconstrained connections.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import scipy.spatial
import scipy.special
from jaxtyping import Bool

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import label_parts
from dpmjax.scan.planar.compare import compare_pairs, pair_scores
from dpmjax.scan.planar.motion_prior import StepPrior
from dpmjax.scan.planar.propose import Hypotheses
from dpmjax.scan.planar.record import Floats, Indices, Pairs, PlanarScans
from dpmjax.scan.planar.slide import Slides, slid_steps, slide_parts, slide_steps

# Maps whose code lengths differ by less than this share are compared by their misfits, because the position of the
# walls in the cells changes the code length by some percent.
_SAME_MAP = 0.1
# Weight of the mean nats of a step relative to nats of a beam and to misfit; and standard deviations of a step without
# cost.
_STEP_WEIGHT, _ALLOWED = 0.2, 3.0
# Largest number of beams, and number of free samples on each beam.
_MAX_BEAMS = 40_000
_SAMPLES_A_BEAM = 32
_GRID_TURNS = (0.2, 0.5, 0.9, 1.3)
# Side of a cell in typical ranges: some thicknesses of a wall. `view_misfit` measures finer agreement.
_CELL = 0.015
# Least tolerance of the misfit, in typical ranges; a larger range noise replaces it.
_LEAST_TOLERANCE = 0.001
# Number of nearest scans, by position and once more by position and heading, that each scan is compared with.
_NUM_NEAREST = 12
# Typical ranges that a radian of heading equals in the second of these searches.
_HEADING_WEIGHT = 0.5
# Range noise in typical ranges above which correct and wrong maps have equal scores, so no map is trusted.
_MAX_NOISE = 0.0225

# Limits of `assess_trajectory`, calibrated on right and wrong maps of simulated worlds and of thinned logs
# (docs/notebook/deepmapping_notes.md).
# Score of its best pair above which a scan belongs to the map.
_LEAST_SCORE = 0.1
# Least share of the scans that the connected map must hold.
_LEAST_REGISTERED = 0.9
# Least score of the weakest connection between two parts of a trusted map.
_MIN_CONNECTION = 0.1
# Least number of scans of a part, and least share of the connected scans; the larger of the two decides.
_PART_SCANS, _PART_SHARE = 3, 0.02
# In maps of no more connected scans than this, a single scan is a part.
_FEW_SCANS = 60
# The largest contradiction (`Assessment`) of a trusted map is the floor plus the factor times the contradicted share of
# the connections that hold the map, because sensor and people contradict there too; it is never above the maximum.
_CONTRADICTION_FLOOR = 0.02
_CONTRADICTION_FACTOR = 1.6
_MAX_CONTRADICTION = 0.055
# Most consecutive scans that fit no other scan in a trusted map. Lines of another moment and covered lenses are single
# scans; more of them in sequence are a part of the way that is not registered, and what follows may be displaced.
_MAX_ALONE = 2
# Largest standard deviation of a scan's position relative to the map, typical ranges. Of 39 right maps of made passages
# with odometry, 30 are trusted with 0.02 and 38 with this; a wrong one, of 18 without sound odometry, with 0.06.
_MAX_DEVIATION = 0.04
# Least information of a turn, for each beam, in typical ranges: between bare round walls it is 0.0003 to 0.0054, with a
# range noise of up to 2 cm in 5 m; in seven logs and five simulated worlds 0.008 or more. Least information of a shift.
_LEAST_TURN, _LEAST_SHIFT = 0.006, 1e-4


class Score(NamedTuple):
    """Errors of a trajectory in three measures; lower is better.

    Attributes:
        code_length: nats of the map for each beam (`map_code_length`), a measure of global consistency.
        misfit: share of beams off the surfaces of near scans (`view_misfit`), a measure of sharpness.
        surprise: mean nats of a step beyond the tolerance of its prior; 0 without a prior.
    """

    code_length: float
    misfit: float
    surprise: float = 0.0


def choose_trajectory(
    scans: PlanarScans, candidates: Mapping[str, Floats], *, prior: StepPrior | None = None
) -> tuple[str, dict[str, Score]]:
    """Chooses the trajectory of least misfit among those with nearly the shortest code length.

    With range noise above `_MAX_NOISE`, misfits do not separate correct maps from wrong ones, and the trajectory with
    the shortest code length is chosen.

    Args:
        scans: n scans.
        candidates: (n, 3) poses by name; at least one.
        prior: prior of their steps; None without a prior.

    Returns:
        The name of the best, and the scores of all.
    """
    scores = {
        name: Score(map_code_length(scans, poses), view_misfit(scans, poses), _surprise(poses, prior))
        for name, poses in candidates.items()
    }
    lengths = {name: score.code_length + _STEP_WEIGHT * score.surprise for name, score in scores.items()}
    same_map = 0.0 if scans.noise > _MAX_NOISE * scans.typical_range else _SAME_MAP
    as_short = [name for name, length in lengths.items() if length <= (1.0 + same_map) * min(lengths.values())]
    return min(as_short, key=lambda name: scores[name].misfit + _STEP_WEIGHT * scores[name].surprise), scores


def _surprise(poses: Floats, prior: StepPrior | None) -> float:
    """Computes the mean cost of the steps beyond that of three standard deviations."""
    if prior is None:
        return 0.0
    steps = np.asarray(se2.relative(poses[:-1], poses[1:]))
    allowed = prior.costs(
        prior.steps + _ALLOWED * np.where(np.isfinite(prior.deviations), prior.deviations, 0.0) * [1.0, 0.0, 0.0]
    )
    return float(np.maximum(prior.costs(steps) - allowed, 0.0).mean())


def map_code_length(scans: PlanarScans, poses: Floats) -> float:
    """Computes the code length of the map of all scans at these poses, in nats for each beam; lower is better.

    The world is divided into cells. Each beam labels the cells that it passes free and the cell where it ends occupied.
    A Krichevsky-Trofimov code encodes the labels of each cell. It is short where all beams agree, and long for cells
    with both labels or with one beam. A doubled wall is coded at two positions and contradicts beams that pass through
    it. The code length equals the occupancy loss of DeepMapping with the best possible M-Net. Only beams on a line are
    coded, where there are some. The mean over turned grids reduces the influence of the position of the walls in the
    cells.

    Args:
        scans: n scans.
        poses: (n, 3) x, y, heading.

    Returns:
        Code length divided by the number of beams; comparable among poses of one set of scans.
    """
    points, mask = scans.points, scans.is_on_line
    if not mask.any():
        mask = scans.mask
    world = se2.transform_points(poses, points)
    sensors = np.broadcast_to(poses[:, None, :2], world.shape)
    stride = max(1, int(np.ceil(mask.sum() / _MAX_BEAMS)))
    hits, sensors, cell = world[mask][::stride], sensors[mask][::stride], _CELL * scans.typical_range
    turns = [se2.rotation(np.float64(angle)) for angle in _GRID_TURNS]
    return float(np.mean([_code_length(hits @ turn, sensors @ turn, cell) for turn in turns]))


def _code_length(hits: Floats, sensors: Floats, cell: float) -> float:
    """Computes the code length in one grid, from hits and their sensor positions (m, 2) in the frame of the grid."""
    ranges = np.linalg.norm(hits - sensors, axis=-1)
    # Passages stop two cells short of the hit, where a slanted wall may still be touched.
    share = (np.arange(_SAMPLES_A_BEAM) + 0.5) / _SAMPLES_A_BEAM
    passed = share * np.maximum(1.0 - 2.0 * cell / np.maximum(ranges, 1e-9), 0.0)[:, None]
    free = (sensors[:, None] + passed[..., None] * (hits - sensors)[:, None]).reshape(-1, 2)
    # All samples lie between the sensors and the hits.
    low = np.minimum(hits.min(axis=0), sensors.min(axis=0))
    columns = int((max(hits[:, 1].max(), sensors[:, 1].max()) - low[1]) / cell) + 2

    def count(points: Floats) -> tuple[Indices, Indices]:
        index = np.floor((points - low) / cell).astype(np.int64)
        return np.unique(index[:, 0] * columns + index[:, 1], return_counts=True)

    hit_cells, num_hits = count(hits)
    free_cells, num_free = count(free)
    row = np.minimum(np.searchsorted(free_cells, hit_cells), len(free_cells) - 1)
    passages = np.where(free_cells[row] == hit_cells, num_free[row], 0)
    # Only cells with hits are coded: the amount of free space depends on the room, not on the poses.
    nats = np.log(np.pi) - scipy.special.betaln(num_hits + 0.5, passages + 0.5)
    return float(nats.sum() / len(hits))


def view_misfit(scans: PlanarScans, poses: Floats) -> float:
    """Computes the disagreement of near scans at these poses; lower is better.

    Each scan predicts the ranges of near scans by linear interpolation between its own beams, which needs no straight
    walls. Beams that are occluded in the predicting scan are left out.

    Args:
        scans: n scans.
        poses: (n, 3) x, y, heading.

    Returns:
        The share of visible beams, 0 to 1, that do not end on the predicting scan's surface within the range noise.
        Near misses count as fractions. The share is 1 where no scan sees a surface that another scan has seen.
    """
    tolerance = max(scans.noise, _LEAST_TOLERANCE * scans.typical_range)
    source, target = near_pairs(poses, scans.typical_range)
    tolerances, relative = scans.tolerances._replace(match=tolerance), se2.relative(poses[target], poses[source])
    views = compare_pairs(scans.fine, source, target, relative, tolerances=tolerances)
    return 1.0 - float(np.sum(views.matched) / max(float(np.sum(views.visible)), 1.0))


def near_pairs(poses: Floats, typical_range: float) -> Pairs:
    """Returns pairs (source, target) of each scan and its nearest scans, each pair once."""
    heading = _HEADING_WEIGHT * typical_range * np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    count, row = min(_NUM_NEAREST + 1, len(poses)), np.arange(len(poses))
    pairs = []
    for place in (poses[:, :2], np.concatenate([poses[:, :2], heading], axis=1)):
        nearest = scipy.spatial.cKDTree(place).query(place, k=count)[1]
        pairs.append(np.stack([np.repeat(row, count), nearest.reshape(-1)], axis=-1))
    found = np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)
    target, source = found[found[:, 0] < found[:, 1]].astype(np.int64).T
    return source, target


class Assessment(NamedTuple):
    """Trust in a registration, computed without ground truth.

    Attributes:
        weakest_connection: score, at most 1, of the weakest connection that holds two parts of the map together.
        contradiction: share of contradicting beams in the pairs outside the tree of best pairs, less that of the pairs
            in it. A beam contradicts where it ends in the free space of another scan.
        is_trusted: True where both values are within the limits of correct maps, no scan is unconstrained, the scans
            are not mirrored, and the range noise is below its limit.
        uncertain_scans: rows of the scans that fit no other scan, or whose position along a corridor or heading between
            round walls is unconstrained.
        fault: sentence on axes or units that contradict the odometry; None without a fault.
    """

    weakest_connection: float
    contradiction: float
    is_trusted: bool
    uncertain_scans: tuple[int, ...] = ()
    fault: str | None = None


def assess_trajectory(
    scans: PlanarScans, poses: Floats, *, prior: StepPrior | None = None, fault: str | None = None
) -> Assessment:
    """Assesses the registration of scans by the scans alone.

    The best pairs of scans make a tree that holds the map together. It must have no weak connection between two parts.
    Pairs outside the tree must contradict hardly more than the pairs in it. A few scans that fit no other scan are left
    out, up to two in sequence. The position of each remaining scan relative to the map must be constrained. Without a
    prior, its heading must be constrained, too, because round walls leave it open.

    Args:
        scans: n scans, two at least.
        poses: (n, 3) x, y, heading.
        prior: of the steps of ordered scans; None: the scans alone.
        fault: fault of the odometry, or of the scans against it. A map with a fault is not trusted.

    Returns:
        Assessment.
    """
    source, target = near_pairs(poses, scans.typical_range)
    relative = np.asarray(se2.relative(poses[target], poses[source]))
    pairs = Hypotheses(source, target, relative, pair_scores(scans, source, target, relative))
    views = compare_pairs(scans, source, target, relative)
    best = np.full(len(poses), -np.inf)
    np.maximum.at(best, np.concatenate([source, target]), np.tile(pairs.scores, 2))
    is_used = (best[source] > _LEAST_SCORE) & (best[target] > _LEAST_SCORE)
    pairs = pairs.take(is_used)
    contradicted, visible = (np.asarray(x)[is_used] for x in (views.contradicted, views.visible))
    size = (len(poses), len(poses))
    costs = scipy.sparse.csr_array((2.0 - pairs.scores, (pairs.source, pairs.target)), size)
    tree = scipy.sparse.csr_array(scipy.sparse.csgraph.minimum_spanning_tree(costs))
    holding = tree.tocoo()
    holds = np.isin(pairs.source * len(poses) + pairs.target, holding.row.astype(np.int64) * len(poses) + holding.col)
    shares = [contradicted[rows].sum() / max(visible[rows].sum(), 1.0) for rows in (holds, ~holds)]
    excess, num_connected, weakest = shares[1] - shares[0], *_weakest_connection(tree)
    limit = min(_CONTRADICTION_FLOOR + _CONTRADICTION_FACTOR * shares[0], _MAX_CONTRADICTION)
    is_clear = excess <= limit and scans.noise <= _MAX_NOISE * scans.typical_range
    is_whole = num_connected >= _LEAST_REGISTERED * len(poses) and weakest >= _MIN_CONNECTION
    is_alone = best <= _LEAST_SCORE
    if prior is not None:
        lost = np.convolve(is_alone, np.ones(_MAX_ALONE + 1))
        is_whole &= bool(lost.max(initial=0.0) <= _MAX_ALONE)
    steps = None if prior is None else slide_steps(scans, se2.relative(poses[:-1], poses[1:]), prior)
    parts = slide_parts(scans, poses, prior) if scans.is_ordered else None
    is_open = _deviations(scans, len(poses), pairs, steps, parts) > _MAX_DEVIATION * scans.typical_range
    if prior is None:
        is_open |= _turns_freely(scans)
    if parts is not None:
        alone = steps or slid_steps(scans, poses)
        for is_torn in (parts.is_torn, alone.is_torn & (alone.scores > _MIN_CONNECTION)):
            later = 1 + np.flatnonzero(is_torn)
            later = later if prior is None else later[~is_alone[later] & ~is_alone[later - 1]]
            is_open[np.concatenate([later, later - 1])] = True
    is_open &= ~is_alone
    is_trusted = is_clear and is_whole and not is_open.any() and fault is None
    uncertain = tuple(np.flatnonzero(is_alone | is_open).tolist())
    return Assessment(weakest, float(excess), bool(is_trusted), uncertain, fault)


def _turns_freely(scans: PlanarScans) -> Bool[np.ndarray, " n"]:
    """Returns True for scans between round walls, which look the same after a turn about the middle of these.

    The information of a turn is that of point-to-line residuals, less what a shift of the position takes away.
    """
    points, normals = (np.asarray(x, np.float64) for x in (scans.points / scans.typical_range, scans.normals))
    is_used = np.asarray(scans.mask & scans.is_on_line)[..., None]
    turn = normals[..., 1] * points[..., 0] - normals[..., 0] * points[..., 1]
    jacobian = np.where(is_used, np.concatenate([normals, turn[..., None]], axis=-1), 0.0)
    num = np.maximum(is_used.sum(axis=1), 1)[..., None]
    information = np.einsum("nbi,nbj->nij", jacobian, jacobian) / num
    shifts, across = information[:, :2, :2] + _LEAST_SHIFT * np.eye(2), information[:, :2, 2:]
    left = information[:, 2, 2] - np.einsum("nik,nik->n", across, np.linalg.solve(shifts, across))
    return (left < _LEAST_TURN) & (num[:, 0, 0] > 1)


def _deviations(
    scans: PlanarScans, num_scans: int, pairs: Hypotheses, steps: Slides | None, parts: Slides | None
) -> Floats:
    """Returns the standard deviation (n,) of each scan's position relative to the largest fully constrained part.

    A pair is closed where its shift along the weak direction is constrained. Other pairs enter with the variance of
    this shift. These variances, those of the n - 1 steps with a prior, and those of all pairs across a step together
    (`slide_parts`) are the resistances of a network. The variance of a scan is the resistance between the scan and that
    part, infinite where they are not connected.
    """
    slides = slide_steps(scans, pairs.poses, pairs=(pairs.source, pairs.target))
    is_used = ~slides.is_torn & (pairs.scores > _MIN_CONNECTION)
    if steps is not None:
        # A step between neighbours in time counts with its prior.
        is_used &= pairs.source != pairs.target + 1
    source, target, information = pairs.source[is_used], pairs.target[is_used], slides.information()[is_used]
    if steps is not None:
        rows = np.flatnonzero(~steps.is_torn)
        source, target = np.concatenate([source, rows + 1]), np.concatenate([target, rows])
        information = np.concatenate([information, steps.information()[rows]])
    is_closed = np.isinf(information)
    label = label_parts(num_scans, source[is_closed], target[is_closed])
    source, target, information = source[~is_closed], target[~is_closed], information[~is_closed]
    if parts is not None:
        rows = np.flatnonzero(label[1:] != label[:-1])
        source, target = np.concatenate([source, rows + 1]), np.concatenate([target, rows])
        information = np.concatenate([information, parts.above_flat()[rows]])
    # A closed part moves as one.
    network = np.zeros((label.max() + 1, label.max() + 1))
    np.add.at(network, (label[source], label[target]), -information)
    network += network.T
    ground = np.bincount(label).argmax()
    part = label_parts(len(network), *np.nonzero(network))
    variances, rows = np.full(len(network), np.inf), np.flatnonzero(part == part[ground])
    variances[ground], rows = 0.0, rows[rows != ground]
    np.fill_diagonal(network, 0.0)
    np.fill_diagonal(network, -network.sum(axis=1))
    variances[rows] = np.diag(np.linalg.inv(network[np.ix_(rows, rows)]))
    return np.sqrt(np.maximum(variances[label], 0.0))


def _weakest_connection(tree: scipy.sparse.csr_array) -> tuple[int, float]:
    """Returns the number of scans of the largest tree, and its lowest score between two parts of several scans."""
    label = label_parts(tree.shape[0], *tree.nonzero())
    root = int(np.flatnonzero(label == np.bincount(label).argmax())[0])
    order, parent = scipy.sparse.csgraph.breadth_first_order(tree, root, directed=False)
    size = np.ones(tree.shape[0], np.int64)
    for scan in order[:0:-1]:
        size[parent[scan]] += size[scan]
    count, below = len(order), order[1:]
    if not len(below):
        return count, 0.0
    cost = np.asarray((tree + tree.T)[below, parent[below]]).reshape(-1)
    smaller = np.minimum(size[below], count - size[below])
    is_part = smaller >= (1 if count <= _FEW_SCANS else max(_PART_SCANS, _PART_SHARE * count))
    return count, float(2.0 - cost[is_part].max()) if is_part.any() else 1.0
