"""Trust in a registration without ground truth.

A map is wrong where a weak connection holds it together, where beams pass through the hits of other scans, or where a
relative pose is unconstrained along a corridor. Trust rests on three quantities. The first is the score of the weakest
connection of the best tree of pairs. The second is the share of contradicting beams of the pairs outside the tree,
beyond that of the pairs in it. The third is the standard deviation of each scan's position relative to the largest part
of the map without unconstrained connections.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import label_parts
from dpmjax.registration2d.pair_search import Hypotheses
from dpmjax.registration2d.planar_scans import Floats, PlanarScans
from dpmjax.registration2d.quality import MAX_NOISE, near_pairs
from dpmjax.registration2d.range_profiles import RangeProfiles, compare_pairs, make_profiles, pair_scores
from dpmjax.registration2d.step_prior import StepPrior
from dpmjax.registration2d.step_slides import Slides, slide_steps

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
# Largest standard deviation of a scan's position relative to the map, typical ranges.
_MAX_DEVIATION = 0.02


class Assessment(NamedTuple):
    """Trust in a registration, computed without ground truth.

    Attributes:
        weakest_connection: score, at most 1, of the weakest connection that holds two parts of the map together.
        contradiction: share of contradicting beams in the pairs outside the tree of best pairs, less that of the pairs
            in it. A beam contradicts where it ends in the free space of another scan.
        is_trusted: True where both values are within the limits of correct maps, no scan is unconstrained, the scans
            are not mirrored, and the range noise is below its limit.
        uncertain_scans: rows of the scans that fit no other scan, or whose position along a corridor is unconstrained.
        fault: sentence on axes or units that contradict the odometry; None: none found.
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
    Pairs outside the tree must contradict hardly more than the pairs in it. Few scans that fit no other scan are left
    out, up to two in sequence. The position of each other scan relative to the map must be constrained.

    Args:
        scans: n scans, two at least.
        poses: (n, 3) x, y, heading.
        prior: of the steps of ordered scans; None: the scans alone.
        fault: of the odometry or the scans against it; no map is trusted with one.

    Returns:
        Assessment.
    """
    profiles, (source, target) = make_profiles(scans), near_pairs(poses, scans.typical_range)
    relative = np.asarray(se2.relative(poses[target], poses[source]))
    pairs = Hypotheses(source, target, relative, pair_scores(profiles, source, target, relative))
    views = compare_pairs(profiles, source, target, relative)
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
    is_clear = excess <= limit and scans.noise <= MAX_NOISE * scans.typical_range
    is_whole = num_connected >= _LEAST_REGISTERED * len(poses) and weakest >= _MIN_CONNECTION
    is_alone = best <= _LEAST_SCORE
    if prior is not None:
        lost = np.convolve(is_alone, np.ones(_MAX_ALONE + 1))
        is_whole &= bool(lost.max(initial=0.0) <= _MAX_ALONE)
    steps = None if prior is None else slide_steps(profiles, se2.relative(poses[:-1], poses[1:]), prior)
    deviations = _deviations(profiles, len(poses), pairs, steps)
    if steps is not None:
        later = np.arange(1, len(poses))
        is_torn = steps.is_torn & (steps.scores > _MIN_CONNECTION) & ~is_alone[later] & ~is_alone[later - 1]
        deviations[np.concatenate([later[is_torn], later[is_torn] - 1])] = np.inf
    may_slide = (deviations > _MAX_DEVIATION * scans.typical_range) & ~is_alone
    is_trusted = is_clear and is_whole and not may_slide.any() and fault is None
    uncertain = tuple(np.flatnonzero(is_alone | may_slide).tolist())
    return Assessment(weakest, float(excess), bool(is_trusted), uncertain, fault)


def _deviations(profiles: RangeProfiles, num_scans: int, pairs: Hypotheses, steps: Slides | None) -> Floats:
    """Returns the standard deviation (n,) of each scan's position relative to the largest fully constrained part.

    A pair is closed where its shift along the weak direction is constrained. Other pairs enter with the variance of
    this shift. These variances, and those of the n - 1 steps with a prior, are the resistances of a network. The
    variance of a scan is the resistance between the scan and that part, infinite where they are not connected.
    """
    slides = slide_steps(profiles, pairs.poses, pairs=(pairs.source, pairs.target))
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
    # A closed part moves as one.
    network = np.zeros((label.max() + 1, label.max() + 1))
    np.add.at(network, (label[source[~is_closed]], label[target[~is_closed]]), -information[~is_closed])
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
