"""Quality of a registration without ground truth: scores of trajectories, and the choice among them.

A map is good if few nats encode all its beams (`map_code_length`) and if near scans agree (`view_misfit`). A trajectory
is good if its steps are those of the odometry, within its noise. `assessment.py` accepts or rejects the best
trajectory.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy.spatial
import scipy.special

from dpmjax.geometry import se2
from dpmjax.registration2d.planar_scans import Floats, Indices, PlanarScans
from dpmjax.registration2d.range_profiles import compare_pairs, make_profiles
from dpmjax.registration2d.step_prior import StepPrior

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
# Number of bearings of the profiles of the misfit, exact to less than that tolerance.
_NUM_BEARINGS = 4096
# Number of nearest scans, by position and once more by position and heading, that each scan is compared with.
_NUM_NEAREST = 12
# Typical ranges that a radian of heading equals in the second of these searches.
_HEADING_WEIGHT = 0.5
# Range noise in typical ranges above which correct and wrong maps have equal scores, so no map is trusted.
MAX_NOISE = 0.0225


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

    With range noise above `MAX_NOISE`, misfits do not separate correct maps from wrong ones, and the trajectory with
    the shortest code length is chosen.

    Args:
        scans: n scans.
        candidates: (n, 3) poses by name.
        prior: of their steps; None: none.

    Returns:
        The name of the best, and the scores of all.

    Raises:
        ValueError: there is no candidate.
    """
    if not candidates:
        raise ValueError("candidates: expected at least one trajectory")
    scores = {
        name: Score(map_code_length(scans, poses), view_misfit(scans, poses), _surprise(poses, prior))
        for name, poses in candidates.items()
    }
    lengths = {name: score.code_length + _STEP_WEIGHT * score.surprise for name, score in scores.items()}
    same_map = 0.0 if scans.noise > MAX_NOISE * scans.typical_range else _SAME_MAP
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
    coded. The mean over turned grids reduces the influence of the position of the walls in the cells.

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
    profiles, relative = make_profiles(scans, _NUM_BEARINGS), se2.relative(poses[target], poses[source])
    views = compare_pairs(profiles, source, target, relative, match_tolerance=tolerance)
    return 1.0 - float(np.sum(views.matched) / max(float(np.sum(views.visible)), 1.0))


def near_pairs(poses: Floats, typical_range: float) -> tuple[Indices, Indices]:
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
