"""Search of the motion between two scans without a first guess: correlation of their views from above.

Upright surfaces are drawn into images by the direction of their normals, one image for each turn about the vertical.
One FFT gives the correlation for all shifts of one turn (correlative scan matching, Olson 2009). The best distinct
peaks are motions within a cell and half a step of the turn; `choose.py` aligns them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import fft
from scipy.ndimage import gaussian_filter

from dpmjax.checks import require_fields
from dpmjax.geometry import rigid
from dpmjax.scan.apart import apart
from dpmjax.scan.lidar.surfaces import MIN_FLATNESS, Surface
from dpmjax.types import Pose, Poses

# Two motions are also distinct if they differ by a larger turn than this, radians: one and a half steps.
DISTINCT_RAD = 1.5 * 2 * np.pi / 60

# Two motions are distinct if they differ by more cells than this.
DISTINCT_CELLS = 2.0

# Side of a cell; down to half of it where scans reach less than `FULL_EXTENT_M`, as in rooms.
CELL_M = 1.0

# Cells along a side, and turns of a circle.
NUM_CELLS, NUM_TURNS = 96, 60

# Points within these shares of a side, and shifts up to them, do not wrap around; others are left out.
RANGE_SHARE, SHIFT_SHARE = 0.36, 0.27

# Images by the direction of the normals; one more image holds points without a surface.
NUM_DIRECTIONS = 4

# Horizontal range of a tenth of the points of a scan that needs whole cells.
FULL_EXTENT_M = 25.0

# Normals with a smaller vertical component belong to upright surfaces.
STEEP_COSINE = 0.5

# Normals this near to the vertical belong to the ground, in each of `LEVEL_ROUNDS` rounds.
LEVEL_COSINE = 0.9

LEVEL_ROUNDS = 3
MIN_LEVEL_POINTS = 50
NUM_PEAKS = 4000
BLUR_CELLS = 0.7
EXTENT_PERCENT, MIN_EXTENT_SHARE = 90.0, 0.5


@dataclass(frozen=True)
class ViewCorrelationConfig:
    """Extent of the search.

    Attributes:
        num_motions: largest number of distinct motions; 0 switches the search off.
    """

    num_motions: int = 24

    def __post_init__(self) -> None:
        require_fields(self, "num_motions", low=0)


def correlate_views(
    source: Surface,
    target: Surface,
    config: ViewCorrelationConfig = ViewCorrelationConfig(),
    *,
    beside: Pose | None = None,
) -> Poses:
    """Finds the motions under which two scans look alike from above.

    Each scan is first turned until its ground is level; the ground of both then has one height.

    Args:
        source: surface of a scan.
        target: the second surface.
        config: resolution and extent.
        beside: T_target_source whose turn is searched alone, with its quarter-turns and half-turn; rooms, and rows of
            equal houses, look alike under these. None searches all turns.

    Returns:
        T_target_source, best first; at most `config.num_motions`, none where a scan has no upright surface. With
        `beside` an equal number for each turn, rounded up, turn by turn.
    """
    if len(source.points) == 0 or len(target.points) == 0:
        return np.zeros((0, 4, 4))
    levels = T_level_lidar(source), T_level_lidar(target)
    cell_m = CELL_M * _extent_share(source, target)
    turns = np.arange(NUM_TURNS) * (2 * np.pi / NUM_TURNS)
    if beside is not None:
        R = levels[1][:3, :3] @ beside[:3, :3] @ levels[0][:3, :3].T
        turns = np.arctan2(R[1, 0], R[0, 0]) + np.arange(4) * (np.pi / 2)
    images = _images(source, levels[0], turns, cell_m)
    fixed = _images(target, levels[1], np.zeros(1), cell_m)[0]
    fixed = gaussian_filter(fixed, (0, BLUR_CELLS, BLUR_CELLS), mode="wrap")
    norms = np.sqrt(np.sum(images**2, axis=(2, 3)).mean(axis=0) * np.sum(fixed**2, axis=(1, 2)))
    if not norms.any():
        return np.zeros((0, 4, 4))
    # Each direction of the target has the same weight, so that walls along a street do not outweigh those across. The
    # mean over all turns weights the source: a direction that few points have at one turn must not count as much.
    fixed /= np.where(norms > 0, norms, 1)[:, None, None]
    spectra = np.conj(fft.rfft2(images)) * fft.rfft2(fixed)
    scores = fft.irfft2(spectra.sum(axis=1), s=images.shape[2:])
    if beside is None:
        found = _best_peaks(scores, turns, cell_m, config.num_motions)
    else:  # each turn has its share, because one wide peak would fill the list
        share = -(-config.num_motions // len(turns))
        of_turns = zip(scores[:, None], turns[:, None], strict=True)
        found = [peak for of_turn, turn in of_turns for peak in _best_peaks(of_turn, turn, cell_m, share)]
    return np.stack([rigid.inverse(levels[1]) @ planar_motion(*row) @ levels[0] for row in found])


def _extent_share(source: Surface, target: Surface) -> float:
    extents = [np.percentile(np.hypot(*surface.points[:, :2].T), EXTENT_PERCENT) for surface in (source, target)]
    return float(np.clip(max(extents) / FULL_EXTENT_M, MIN_EXTENT_SHARE, 1))


def T_level_lidar(surface: Surface, min_flatness: float = MIN_FLATNESS) -> Pose:
    """Finds the turn that makes the ground of a scan level, and the shift that puts it at height 0.

    Args:
        surface: surface of the scan.
        min_flatness: least flatness of an element of the ground.

    Returns:
        The motion; the identity where there is too little ground.
    """
    T, up = np.eye(4), np.array([0.0, 0.0, 1.0])
    is_flat = surface.flatness > min_flatness
    points, normals = surface.points[is_flat], surface.normals[is_flat]
    normals = normals * np.where(normals[:, 2:] < 0, -1, 1)
    is_ground = np.zeros(len(points), bool)
    for _ in range(LEVEL_ROUNDS):
        is_ground = (normals @ up > LEVEL_COSINE) & (points @ up < 0)
        if is_ground.sum() < MIN_LEVEL_POINTS:
            return T
        up = normals[is_ground].sum(axis=0)
        up /= np.linalg.norm(up)
    # The shortest turn that takes `up` to the z axis; `up` is never opposite to it.
    x, y, z = up
    cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
    T[:3, :3] += cross + cross @ cross / (1 + z)
    T[2, 3] = -np.median(points[is_ground] @ up)
    return T


def _images(
    surface: Surface, T_level_lidar: Pose, turns: Float[np.ndarray, " t"], cell_m: float
) -> Float[np.ndarray, "t c n n"]:
    R = T_level_lidar[:3, :3]
    x, y, _ = (surface.points @ R.T).T
    normals = surface.normals @ R.T
    is_flat = surface.flatness > MIN_FLATNESS
    is_used = (np.hypot(x, y) < RANGE_SHARE * NUM_CELLS * cell_m) & (~is_flat | (np.abs(normals[:, 2]) < STEEP_COSINE))
    x, y, is_flat = x[is_used], y[is_used], is_flat[is_used]
    angles = np.arctan2(normals[is_used, 1], normals[is_used, 0])
    size, num = NUM_CELLS, NUM_DIRECTIONS
    shape = (len(turns), num + 1, size, size)
    cosine, sine = np.cos(turns)[:, None], np.sin(turns)[:, None]
    turned = cosine * x - sine * y, sine * x + cosine * y
    columns = [np.round(part / cell_m).astype(np.int64) % size for part in turned]
    channel = np.floor((angles + turns[:, None]) * (num / np.pi)).astype(np.int64) % num
    channel = np.where(is_flat, channel, num)
    number = np.arange(len(turns))[:, None]
    cells = ((number * (num + 1) + channel) * size + columns[0]) * size + columns[1]
    # A cell counts once: dense surfaces near the lidar must not outweigh far ones.
    images = np.zeros(int(np.prod(shape)), np.float32)
    images[cells.ravel()] = 1
    return images.reshape(shape)


def _best_peaks(
    scores: Float[np.ndarray, "t n n"], turns: Float[np.ndarray, " t"], cell_m: float, num_motions: int
) -> list[tuple[float, float, float]]:
    """Returns turn and shift of the best peaks after non-maximum suppression."""
    shifts = fft.fftfreq(NUM_CELLS, 1 / NUM_CELLS) * cell_m
    is_in_reach = np.hypot(shifts[:, None], shifts) <= SHIFT_SHARE * NUM_CELLS * cell_m
    flat = np.flatnonzero(is_in_reach)
    within = scores.reshape(len(turns), -1)[:, flat]
    last = min(NUM_PEAKS, within.size) - 1
    # Which of several equal values a partition keeps depends on the processor; the least of those kept does not.
    best = np.flatnonzero(within.ravel() >= -np.partition(-within, last, axis=None)[last])
    best = best[np.argsort(-within.ravel()[best], kind="stable")][: last + 1]
    turn, cell = np.unravel_index(best, within.shape)
    x, y = (shifts[part] for part in np.unravel_index(flat[cell], is_in_reach.shape))

    def is_near(k: int) -> Bool[np.ndarray, " m"]:
        is_same = np.cos(turns[turn] - turns[turn[k]]) >= np.cos(DISTINCT_RAD)
        return is_same & (np.hypot(x - x[k], y - y[k]) <= DISTINCT_CELLS * cell_m)

    chosen = apart(within.ravel()[best], is_near, num_motions)
    return [(float(turns[turn[k]]), float(x[k]), float(y[k])) for k in chosen]


def planar_motion(turn: float, x: float, y: float) -> Pose:
    """Makes a motion in the horizontal plane.

    Args:
        turn: about the vertical, radians.
        x: metres.
        y: metres.

    Returns:
        The matrix.
    """
    T = np.eye(4)
    T[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    T[:2, 3] = x, y
    return T
