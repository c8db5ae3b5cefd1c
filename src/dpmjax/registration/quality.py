"""Quality of a registration without the truth: scores of trajectories, the choice among them, and trust in one.

A map is as good as few nats write all its beams down (`map_code_length`) and as its surfaces agree (`surface_misfit`).
It is wrong where a weak connection holds it together, or where beams pass through what others have hit; so trust rests
on the beams of the weakest connection, if every scan hangs on the best chain of others, and on the share of beams that
contradict another scan (`assess_trajectory`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import scipy.spatial
import scipy.special

from dpmjax.geometry import se2
from dpmjax.registration.planar_scans import Floats, Indices, PlanarScans
from dpmjax.registration.range_profiles import compare_pairs, make_profiles
from dpmjax.registration.refinement import surface_misfit

# Maps whose code lengths differ by less than this part are equally good as maps (how walls lie in the cells is worth
# some percent); then their surfaces decide.
_SAME_MAP = 0.1
# Hits and passages that are counted at most; more would only take longer.
_MAX_BEAMS = 40_000
_SAMPLES_A_BEAM = 32
_GRID_TURNS = (0.2, 0.5, 0.9, 1.3)
# Side of a cell in typical ranges: some thicknesses of a wall. Finer agreement is the business of `surface_misfit`.
_CELL = 0.015
# Calibrated on right and wrong maps of simulated worlds (docs/deepmapping_notes.md).
# The share of beams that the weakest connection of a right map holds by, each scan compared with so many nearest ones.
_MIN_CONNECTION, _NUM_NEIGHBOURS = 0.36, 12
# Share of beams that may contradict others in a right map: without noise, and so much more at the noisy end.
_MAX_CONTRADICTION, _NOISY_CONTRADICTION = 0.01, 0.03
# Range noise in typical ranges at which that allowance is full, and above which right and wrong maps look alike: no map
# is trusted there.
_NOISY, _MAX_NOISE = 0.015, 0.0225


class Score(NamedTuple):
    """What is wrong with a trajectory; lower is better.

    Attributes:
        code_length: nats a beam for the map (`map_code_length`): whether the map is right as a whole.
        misfit: share of beams off their surface in scans nearby (`surface_misfit`): how sharp it is.
    """

    code_length: float
    misfit: float


def choose_trajectory(scans: PlanarScans, candidates: Mapping[str, Floats]) -> tuple[str, dict[str, Score]]:
    """The best trajectory: among those whose maps are about as short to describe as the shortest, the sharpest.

    Args:
        scans: n scans.
        candidates: (n, 3) poses by name.

    Returns:
        The name of the best, and the scores of all.

    Raises:
        ValueError: there is no candidate.
    """
    if not candidates:
        raise ValueError("candidates: expected at least one trajectory")
    scores = {
        name: Score(map_code_length(scans, poses), surface_misfit(scans, poses)) for name, poses in candidates.items()
    }
    shortest = min(score.code_length for score in scores.values())
    as_short = [name for name, score in scores.items() if score.code_length <= (1.0 + _SAME_MAP) * shortest]
    return min(as_short, key=lambda name: scores[name].misfit), scores


def map_code_length(scans: PlanarScans, poses: Floats) -> float:
    """Nats a beam that the map of all scans needs at these poses; lower is better.

    The world is cut into cells. Each beam calls the cells that it passes free and the one where it ends occupied. A
    cell that all beams call the same costs next to nothing; one that has been called both, or that no other beam has
    seen, costs nats (a Krichevsky-Trofimov code for each cell). A doubled wall costs twice: it contradicts beams that
    pass through it, and it opens new cells. It is the occupancy loss of DeepMapping with the best possible M-Net.
    Only beams on a line are coded. How the walls lie in the cells must not decide, so the mean over turned grids is
    taken.

    Args:
        scans: n scans.
        poses: (n, 3) x, y, heading.

    Returns:
        Code length divided by the number of beams; comparable among poses of one set of scans.
    """
    points, mask = np.asarray(scans.points), np.asarray(scans.is_on_line)
    world = se2.transform_points(poses, points)
    sensors = np.broadcast_to(poses[:, None, :2], world.shape)
    stride = max(1, int(np.ceil(mask.sum() / _MAX_BEAMS)))
    hits, sensors, cell = world[mask][::stride], sensors[mask][::stride], _CELL * scans.typical_range
    turns = [se2.rotation(np.float64(angle)) for angle in _GRID_TURNS]
    return float(np.mean([_code_length(hits @ turn, sensors @ turn, cell) for turn in turns]))


def _code_length(hits: Floats, sensors: Floats, cell: float) -> float:
    """The same in one grid; hits and the sensors that made them, (m, 2) in the frame of the grid."""
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
    # Only cells that were hit are coded: how much is seen free depends on the room, not on the poses.
    nats = np.log(np.pi) - scipy.special.betaln(num_hits + 0.5, passages + 0.5)
    return float(nats.sum() / len(hits))


class Assessment(NamedTuple):
    """How far a registration can be trusted, without the truth.

    Attributes:
        weakest_connection: share of beams, 0 to 1, that hold the weakest connection of the best chain.
        contradiction: share of beams, 0 to 1, that end in the free space of another scan.
        is_trusted: both are within what right maps reach, and there is not too much noise to tell.
    """

    weakest_connection: float
    contradiction: float
    is_trusted: bool


def assess_trajectory(scans: PlanarScans, poses: Floats) -> Assessment:
    """Tells whether the registration of scans can be trusted.

    Args:
        scans: n scans, two at least.
        poses: (n, 3) x, y, heading.

    Returns:
        Assessment.
    """
    num_scans = len(poses)
    num_nearest = min(_NUM_NEIGHBOURS + 1, num_scans)
    nearest = scipy.spatial.cKDTree(poses[:, :2]).query(poses[:, :2], k=num_nearest)[1]
    row = np.repeat(np.arange(num_scans), num_nearest)
    pairs = np.unique(np.sort(np.stack([row, nearest.reshape(-1)], -1), axis=1), axis=0)
    target, source = pairs[pairs[:, 0] < pairs[:, 1]].astype(np.int64).T
    views = compare_pairs(make_profiles(scans), source, target, se2.relative(poses[target], poses[source]))
    num_beams = np.maximum(np.asarray(scans.mask).sum(axis=1), 1)
    share = np.clip(views.matched / (num_beams[source] + num_beams[target]), 1e-6, 1.0)
    graph = scipy.sparse.csr_matrix((2.0 - share, (source, target)), shape=(num_scans, num_scans))
    tree = scipy.sparse.csgraph.minimum_spanning_tree(graph)
    connection = 2.0 - float(tree.data.max()) if tree.nnz == num_scans - 1 else 0.0
    contradiction = float(np.sum(views.contradicted)) / max(float(np.sum(views.visible)), 1.0)
    noise = scans.noise / scans.typical_range
    limit = _MAX_CONTRADICTION + min(1.0, noise / _NOISY) * _NOISY_CONTRADICTION
    is_clear = contradiction <= limit and noise <= _MAX_NOISE
    return Assessment(connection, contradiction, is_clear and connection >= _MIN_CONNECTION)
