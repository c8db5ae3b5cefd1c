"""Walks of the robot through a planar world, and scans on the way (DeepMapping section 4.1).

The lidar has a view of 360 degrees, so the robot may move in any direction. Steps follow the route, and the heading
turns by an independent uniform angle, so that the step statistics of the paper hold exactly.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.checks import require_count, require_value, runs_on_host
from dpmjax.geometry import se2
from dpmjax.sequences import BoolArray, FloatArray, ScanSequence
from dpmjax.simulation.world2d import World, beam_angles, cast_scans, largest_region, make_world

# Section 4.1: headings of consecutive scans differ by a uniform angle within plus or minus this, and translations have
# this mean; steps are uniform between 0.6 and 1.4 of it.
_MAX_ROTATION_DEG, _MEAN_STEP_PX = 10.0, 8.16
_CLEARANCE_PX = 8.0  # No point of the path comes closer to an obstacle or to the border of the image.
_CELL_PX = 8  # Raster of the route planner.
_LOOKAHEAD_PX = 36.0


def simulate_trajectory(world: World, num_poses: int, *, rng: np.random.Generator) -> FloatArray:
    """Simulates a walk through a world: repeatedly to new places and back by another route.

    Args:
        world: the world.
        num_poses: number of poses.
        rng: source of all choices; the same state gives the same walk.

    Returns:
        (num_poses, 3) x, y in px and heading in radians, in (-pi, pi], in the frame of the world.

    Raises:
        ValueError: fewer than one pose, or a world too narrow to move in.
    """
    require_count("num_poses", num_poses)
    clearance = _clearance(world.is_obstacle)
    route = _plan_route(clearance, 1.15 * num_poses * _MEAN_STEP_PX + 200.0, rng)
    positions = _walk(route, clearance, num_poses, rng)
    turns = rng.uniform(-1, 1, num_poses - 1) * np.deg2rad(_MAX_ROTATION_DEG)
    first = rng.uniform(-np.pi, np.pi)
    heading = first + np.concatenate([[0.0], np.cumsum(turns)])
    return np.column_stack([positions, np.pi - (np.pi - heading) % (2 * np.pi)])


def simulate_odometry(
    poses: FloatArray,
    *,
    rng: np.random.Generator,
    translation_noise: float = 0.05,
    rotation_noise_deg: float = 1.0,
    bias: float = 0.01,
) -> FloatArray:
    """Simulates wheel odometry: chained relative motions with a constant scale error and white noise.

    Args:
        poses: (n, 3) true x, y, heading (radians).
        rng: source of the errors.
        translation_noise: standard deviation of each step's error per length travelled, along and across.
        rotation_noise_deg: standard deviation of each step's heading error, degrees.
        bias: standard deviation of the constant scale errors of a drive.

    Returns:
        (n, 3) float64 poses in the frame of the odometry; the first is zero.
    """
    pose = np.asarray(poses, np.float64).reshape(-1, 3)
    forward, left, turn = se2.relative(pose[:-1], pose[1:]).T
    length = np.hypot(forward, left)
    scale, scale_turn = 1.0 + bias * rng.normal(size=2)
    forward = scale * forward + translation_noise * length * rng.normal(size=len(turn))
    left = scale * left + translation_noise * length * rng.normal(size=len(turn))
    turn = scale_turn * turn + np.deg2rad(rotation_noise_deg) * rng.normal(size=len(turn))
    return se2.chain(np.column_stack([forward, left, turn]))[: len(pose)]


def _clearance(is_obstacle: BoolArray) -> FloatArray:
    """Computes a lower bound (h, w) of the distance (px) of a pixel to the next obstacle or to the border."""
    from scipy.ndimage import distance_transform_edt

    distance = distance_transform_edt(np.pad(~is_obstacle, 1, constant_values=False))[1:-1, 1:-1]
    return np.maximum(np.asarray(distance, np.float64) - np.sqrt(2.0), 0.0)


def _plan_route(clearance: FloatArray, length_px: float, rng: np.random.Generator) -> FloatArray:
    """Plans raster points (k, 2) of a route of at least the wanted length, every third leg back to its start."""
    coarse = clearance[_CELL_PX // 2 :: _CELL_PX, _CELL_PX // 2 :: _CELL_PX]
    cells = np.argwhere(largest_region(coarse >= _CLEARANCE_PX + 8.0))
    if len(cells) < 2:
        raise ValueError("world is too narrow to move in: no connected free space with the wanted clearance")
    centres = (cells[:, ::-1].astype(np.float64) + 0.5) * _CELL_PX
    visits = np.zeros(len(cells))
    # The most central of three positions, because few places are reachable from a corner.
    drawn = rng.integers(len(cells), size=3)
    home = place = int(drawn[np.argmin(np.linalg.norm(centres[drawn] - centres.mean(axis=0), axis=1))])
    route, travelled, leg = [place], 0.0, 0
    while travelled < length_px:
        cost, before = _shortest_paths(cells, coarse, visits, place)
        leg += 1
        goal = home if leg % 3 == 0 and place != home else _choose_goal(cost, visits, rng)
        path = _trace(before, place, goal)
        travelled += float(np.linalg.norm(np.diff(centres[[place, *path]], axis=0), axis=1).sum())
        for cell in path:
            visits += np.exp(-0.5 * np.sum(((centres - centres[cell]) / 40.0) ** 2, axis=1)) * 0.1
        route += path
        place = goal
    return centres[route]


def _shortest_paths(
    cells: NDArray[np.int64], coarse: FloatArray, visits: FloatArray, start: int
) -> tuple[FloatArray, NDArray[np.int32]]:
    """Computes costs (k,) from the start cell and predecessors (k,), higher near walls and on visited cells."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra

    index = np.full(np.add(coarse.shape, 2), -1)
    index[cells[:, 0] + 1, cells[:, 1] + 1] = np.arange(len(cells))
    toll = 1.0 + 2.0 * np.exp(-coarse[cells[:, 0], cells[:, 1]] / 15.0) + 1.5 * np.minimum(visits, 1.0)
    steps = np.array([[0, 1], [1, 0], [0, -1], [-1, 0]])
    near = index[cells[:, 0] + 1 + steps[:, :1], cells[:, 1] + 1 + steps[:, 1:]]
    step, tail = np.nonzero(near >= 0)
    head = near[step, tail]
    weights = _CELL_PX * 0.5 * (toll[tail] + toll[head])
    graph = coo_matrix((weights, (tail, head)), shape=(len(cells), len(cells))).tocsr()
    cost, before = dijkstra(graph, indices=np.array([start]), return_predecessors=True)
    return cost[0], before[0]


def _choose_goal(cost: FloatArray, visits: FloatArray, rng: np.random.Generator) -> int:
    """Chooses the least visited of several cells about a leg away."""
    # After two legs of about 260 px the robot comes home by another way.
    off = np.abs(cost / (1.5 * 260.0) - 1.0)
    near_enough = np.flatnonzero((off <= max(0.4, float(np.partition(off, 1)[1]))) & (cost > 0))
    options = rng.choice(near_enough, size=min(8, len(near_enough)), replace=False)
    return int(options[np.argmin(visits[options])])


def _trace(before: NDArray[np.int32], start: int, goal: int) -> list[int]:
    """Returns the cells after `start` up to and including `goal`."""
    path = [goal]
    while path[-1] != start:
        path.append(int(before[path[-1]]))
    return path[-2::-1]


def _walk(route: FloatArray, clearance: FloatArray, num_poses: int, rng: np.random.Generator) -> FloatArray:
    """Simulates positions (num_poses, 2): steps of random length and direction towards the farthest visible point."""
    positions, along = [route[0]], 0
    lengths = _MEAN_STEP_PX * rng.uniform(0.6, 1.4, num_poses - 1)
    sway = np.deg2rad(12.0) * rng.normal(size=num_poses - 1)
    for length, swing in zip(lengths, sway, strict=True):
        here = positions[-1]
        along = _aim(route, along, here, clearance)
        bearing = np.arctan2(*(route[along] - here)[::-1])
        # Smaller swings, then other directions, are tried before a step would touch a wall.
        others = np.deg2rad(np.arange(5, 180, 5).repeat(2)) * np.tile([1, -1], 35)
        angles = bearing + np.concatenate([[swing, 0.5 * swing, 0.0], others])
        ends = here + length * np.column_stack([np.cos(angles), np.sin(angles)])
        clear = next((end for end in ends if _is_clear(here, end, clearance)), None)
        if clear is None:
            raise ValueError("world is too narrow to move in: a step would touch an obstacle in every direction")
        positions.append(clear)
    return np.array(positions)


def _aim(route: FloatArray, along: int, here: FloatArray, clearance: FloatArray) -> int:
    """Finds the index of the farthest visible route point ahead within the look-ahead distance."""
    last = min(along + int(2 * _LOOKAHEAD_PX / _CELL_PX), len(route) - 1)
    for index in range(last, along, -1):
        is_near = np.linalg.norm(route[index] - here) <= _LOOKAHEAD_PX
        if is_near and _is_clear(here, route[index], clearance):
            return index
    return along if np.linalg.norm(route[along] - here) > _CELL_PX else min(along + 1, len(route) - 1)


def _is_clear(start: FloatArray, end: FloatArray, clearance: FloatArray) -> bool:
    """Returns True where a straight step keeps the clearance, sampled every half pixel (a quarter is lost at most)."""
    count = int(np.linalg.norm(end - start) * 2) + 2
    samples = np.floor(np.linspace(start, end, count)).astype(np.int64)
    height, width = clearance.shape
    if (samples < 0).any() or (samples >= [width, height]).any():
        return False
    return bool((clearance[samples[:, 1], samples[:, 0]] >= _CLEARANCE_PX + 0.25).all())


def scan_world(
    is_obstacle: BoolArray,
    poses: ArrayLike,
    *,
    num_beams: int = 256,
    max_range: float | None = None,
    range_noise_px: float = 0.0,
    rng: np.random.Generator | None = None,
) -> tuple[NDArray[np.float32], BoolArray]:
    """Takes a 360-degree scan at every pose (DeepMapping section 4.1).

    Args:
        is_obstacle: (h, w), True where a pixel is solid.
        poses: (n, 3) x, y (px) and heading (radians) of the sensor in the world.
        num_beams: beams per scan.
        max_range: beams longer than this (px) are masked; None for an unlimited sensor, whose free beams end at the
            border.
        range_noise_px: standard deviation of Gaussian noise on the ranges; ranges never become negative.
        rng: source of the noise; needed where there is noise.

    Returns:
        points: (n, num_beams, 2) float32 in the sensor frame, px; zero where masked.
        mask: (n, num_beams) bool, True for valid beams.

    Raises:
        ValueError: a pose lies in an obstacle or outside of the image; or there is noise but no `rng`.
    """
    require_value(range_noise_px == 0 or rng is not None, "rng", "a generator for range_noise_px", rng)
    ranges, angles = cast_scans(is_obstacle, poses, num_beams=num_beams), beam_angles(num_beams)
    mask = np.ones(ranges.shape, bool) if max_range is None else ranges <= max_range
    if rng is not None and range_noise_px > 0:
        ranges = np.maximum(ranges + rng.normal(0.0, range_noise_px, ranges.shape), 0.0)
    points = (ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)).astype(np.float32)
    return np.where(mask[..., None], points, np.float32(0.0)), mask


@runs_on_host("call it outside, and pass its arrays in")
def simulate_sequence(
    world: int | str | World = 0,
    num_scans: int = 256,
    *,
    num_beams: int = 256,
    range_noise_px: float = 0.0,
    seed: int = 0,
    with_odometry: bool = False,
) -> ScanSequence:
    """Simulates a drive through a planar world (DeepMapping section 4.1).

    Walk, noise and odometry have separate random streams: a seed gives the same walk with and without noise.

    Args:
        world: index or name for `make_world`, or a world.
        num_scans: number of scans; the paper has 128 and 256.
        num_beams: beams per scan over 360 degrees.
        range_noise_px: standard deviation of Gaussian noise on the ranges, px.
        seed: seed of walk and noise.
        with_odometry: True to simulate wheel odometry, too.

    Returns:
        The sequence in px, organised, with the true poses in the world's frame as reference.

    Raises:
        ValueError: an argument out of its range, or a world too narrow to move in.
    """
    require_value(num_scans >= 2, "num_scans", "at least 2", num_scans)
    scene = world if isinstance(world, World) else make_world(world)
    # The name is part of the seed, so that walks through two worlds are independent.
    streams = ([seed, zlib.crc32(scene.name.encode()), stream] for stream in range(3))
    walk_rng, noise_rng, odometry_rng = map(np.random.default_rng, streams)
    poses = simulate_trajectory(scene, num_scans, rng=walk_rng)
    points, mask = scan_world(
        scene.is_obstacle, poses, num_beams=num_beams, range_noise_px=range_noise_px, rng=noise_rng
    )
    odometry = simulate_odometry(poses, rng=odometry_rng) if with_odometry else None
    return ScanSequence(scene.name, points, mask, "px", reference_poses=poses, odometry_poses=odometry)
