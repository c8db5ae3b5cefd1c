"""Planar lidar: exact intersections of beams with a world of unit pixel squares, and scans of a walk.

Frame: pixel `is_obstacle[row, col]` fills the square [col, col + 1) x [row, row + 1). The x axis points right along the
columns, y points up along the rows (row 0 is the lowest). So the world is right-handed, and a plot with the origin
below shows it without a flip. Angles are counter-clockwise from x.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.sequences import BoolArray, FloatArray, ScanSequence, World
from dpmjax.simulation.trajectory2d import simulate_odometry, simulate_people, simulate_trajectory, stop_at_people
from dpmjax.simulation.world2d import make_world


def beam_angles(num_beams: int) -> FloatArray:
    """Returns the angles of a 360-degree scan in the order of the DeepMapping authors.

    Args:
        num_beams: number of beams.

    Returns:
        (num_beams,) radians in the sensor frame, from 0 (straight ahead) counter-clockwise, 2 pi excluded.

    Raises:
        ValueError: fewer than one beam.
    """
    if num_beams < 1:
        raise ValueError(f"num_beams must be at least 1, got {num_beams}")
    return np.arange(num_beams, dtype=np.float64) * (2.0 * np.pi / num_beams)


def cast_scans(is_obstacle: BoolArray, poses: ArrayLike, *, num_beams: int = 256) -> FloatArray:
    """Computes the ranges of noise-free scans of 360 degrees.

    Args:
        is_obstacle: (h, w), True where a pixel is solid.
        poses: (n, 3) x, y (px) and heading (radians) in the world, in free pixels.
        num_beams: beams of a scan.

    Returns:
        (n, num_beams) px.
    """
    at = np.asarray(poses, np.float64).reshape(-1, 3)
    angles = (at[:, 2:] + beam_angles(num_beams)).ravel()
    return cast_rays(is_obstacle, np.repeat(at[:, :2], num_beams, axis=0), angles).reshape(-1, num_beams)


def cast_rays(is_obstacle: BoolArray, origins: ArrayLike, angles: ArrayLike) -> FloatArray:
    """Follows beams through the pixel grid to the first obstacle edge, or to the border of the image.

    Grid traversal of Amanatides and Woo (1987); a beam crosses a whole square of free pixels at once. The result is
    exact after a few dozen steps for all beams together. A beam through the common corner of two diagonal neighbours is
    stopped by the one beside it in x.

    Args:
        is_obstacle: (h, w), True where a pixel is solid.
        origins: (m, 2) x, y of the beams' starts, px, in free pixels.
        angles: (m,) directions in the world, radians.

    Returns:
        (m,) ranges, px.

    Raises:
        ValueError: an origin is not finite, outside of the image or inside an obstacle.
    """
    from scipy.ndimage import distance_transform_cdt

    start = np.asarray(origins, np.float64).reshape(-1, 2)
    theta = np.asarray(angles, np.float64).reshape(-1)
    if len(start) != len(theta):
        raise ValueError(f"origins and angles must be of one length, got {len(start)} and {len(theta)}")
    _check_origins(is_obstacle, start)
    # Chessboard distances to the nearest solid pixel, with a solid frame round the image.
    distance = distance_transform_cdt(~np.pad(is_obstacle, 1, constant_values=True), metric="chessboard")
    direction = np.stack([np.cos(theta), np.sin(theta)], axis=1)

    cell = np.floor(start).astype(np.int64)
    length = np.zeros(len(start))
    active = np.arange(len(start))
    while len(active):
        reach = distance[cell[active, 1] + 1, cell[active, 0] + 1].astype(np.int64)
        cell[active], length[active] = _leap(start[active], direction[active], cell[active], reach, length[active])
        active = active[distance[cell[active, 1] + 1, cell[active, 0] + 1] > 0]
    return length


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
    if range_noise_px > 0 and rng is None:
        raise ValueError("range_noise_px needs an rng")
    ranges = cast_scans(is_obstacle, poses, num_beams=num_beams)
    mask = np.ones(ranges.shape, bool) if max_range is None else ranges <= max_range
    return np.where(mask[..., None], _measured_points(ranges, range_noise_px, rng), np.float32(0.0)), mask


def _measured_points(ranges: FloatArray, range_noise_px: float, rng: np.random.Generator | None) -> NDArray[np.float32]:
    """Computes beam end points (n, b, 2) in the sensor frame, with range noise."""
    angles = beam_angles(ranges.shape[1])
    if rng is not None and range_noise_px > 0:
        ranges = np.maximum(ranges + rng.normal(0.0, range_noise_px, ranges.shape), 0.0)
    points = ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.asarray(points, np.float32)


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

    Walk, noise, odometry and people have separate random streams: a seed gives the same walk with and without noise.

    Args:
        world: index or name for `make_world`, or a world. The people of a world walk while it is scanned.
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
    if num_scans < 2:
        raise ValueError(f"num_scans must be at least 2, got {num_scans}")
    scene = world if isinstance(world, World) else make_world(world)
    # The name is part of the seed, so that walks through two worlds are independent.
    streams = ([seed, zlib.crc32(scene.name.encode()), stream] for stream in range(4))
    walk_rng, noise_rng, odometry_rng, people_rng = map(np.random.default_rng, streams)
    poses = simulate_trajectory(scene, num_scans, rng=walk_rng)
    ranges = cast_scans(scene.is_obstacle, poses, num_beams=num_beams)
    people = simulate_people(scene, num_scans, rng=people_rng)
    ranges = stop_at_people(ranges, poses, beam_angles(num_beams), people)
    points, mask = _measured_points(ranges, range_noise_px, noise_rng), np.ones(ranges.shape, bool)
    odometry = simulate_odometry(poses, rng=odometry_rng) if with_odometry else None
    return ScanSequence(scene.name, points, mask, "px", reference_poses=poses, odometry_poses=odometry)


def _check_origins(is_obstacle: BoolArray, origins: FloatArray) -> None:
    height, width = is_obstacle.shape
    is_inside = ((origins >= 0) & (origins < [width, height])).all(axis=1)
    if not is_inside.all():
        raise ValueError(f"origins must lie in the {width} x {height} image, got {origins[~is_inside][0]}")
    cell = np.floor(origins).astype(np.int64)
    is_blocked = is_obstacle[cell[:, 1], cell[:, 0]]
    if is_blocked.any():
        raise ValueError(f"origins must lie in free space, got {origins[is_blocked][0]} inside an obstacle")


def _leap(
    start: FloatArray, direction: FloatArray, cell: NDArray[np.int64], reach: NDArray[np.int64], reached: FloatArray
) -> tuple[NDArray[np.int64], FloatArray]:
    """Moves each beam into the first pixel outside of the free square of half-width `reach` round its pixel.

    With reach 1 this is one step of the plain grid traversal.

    Args:
        start: (m, 2) origins.
        direction: (m, 2) unit directions.
        cell: (m, 2) current pixels of the beams.
        reach: (m,) half-widths of the free squares.
        reached: (m,) current lengths of the beams.

    Returns:
        The new cells (m, 2), and the lengths (m,) at which they are entered.
    """
    ahead = np.where(direction > 0, reach[:, None], -reach[:, None])
    edge = cell + ahead + (direction < 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        time = np.where(direction == 0, np.inf, (edge - start) / direction)
    axis = np.argmin(time, axis=1)
    rows, other = np.arange(len(cell)), 1 - axis
    # Rounding may give an earlier crossing for a beam nearly along an edge, so lengths never decrease.
    length = np.maximum(time[rows, axis], reached)
    entered = np.empty_like(cell)
    entered[rows, axis] = cell[rows, axis] + ahead[rows, axis]
    # Rounding must not push the beam backwards or out of the square sideways.
    side = np.floor(start[rows, other] + length * direction[rows, other]).astype(np.int64)
    near, far = cell[rows, other], cell[rows, other] + ahead[rows, other] - np.sign(ahead[rows, other])
    entered[rows, other] = np.clip(side, np.minimum(near, far), np.maximum(near, far))
    return entered, length
