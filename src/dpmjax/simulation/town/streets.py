"""Streets of a town and routes along them: a shaken, bent lattice of blocks, or one street laid along a trajectory.

Curves are dense polylines; the lower half of this file resamples, smooths and shifts them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dpmjax.sequences import FloatArray

# From the middle of a street to the middle of a lane.
LANE_M = 1.7
_STEP_M = 0.5
_CORNER_M = 4.0


@dataclass(frozen=True)
class Streets:
    """The streets, by their middle lines.

    Attributes:
        paths: (k, 2) points of each street at steps of half a metre, from side street to side street.
        half_widths: distance from the middle to the kerb of each street, m.
        lanes: (k, 2) points of the lanes of the traffic, in one direction; traffic drives in both directions.
        route: (k, 2) points of the drive's middle line at steps of half a metre.
        is_closed: True for a route that ends where it began.
    """

    paths: tuple[FloatArray, ...]
    half_widths: tuple[float, ...]
    lanes: tuple[FloatArray, ...]
    route: FloatArray
    is_closed: bool


def make_streets(
    rng: np.random.Generator, kind: str, length: float, block: float, half_width: tuple[float, float] = (4.6, 5.6)
) -> Streets:
    """Draws blocks and a closed route round them.

    Args:
        rng: source of all choices.
        kind: kind of route. A "loop" goes once round some blocks. A route "there_and_back" goes along a street, round a
            block, back on the opposite side, and round a block there. A "wander" is a random walk and the shortest
            way back.
        length: wanted length of the route, m; met within a block or two.
        block: side of a block, m.
        half_width: narrowest and widest street, from the middle to the kerb, m.

    Returns:
        The streets.
    """
    corners, size = _plan(rng, kind, max(round(length / block), 4))
    place = _bend(rng, block)
    shaken = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1]), indexing="ij"), -1).astype(np.float64)
    shaken = (shaken + rng.uniform(-0.14, 0.14, shaken.shape)) * block

    def street(start: tuple[int, int], end: tuple[int, int]) -> FloatArray:
        line = np.linspace(shaken[start], shaken[end], 60)
        return resample(place(line), _STEP_M)

    paths = [
        street((i, j), (i + di, j + dj))
        for i in range(size[0])
        for j in range(size[1])
        for di, dj in ((1, 0), (0, 1))
        if i + di < size[0] and j + dj < size[1]
    ]
    rows = [np.vstack([street((i, j), (i, j + 1)) for j in range(size[1] - 1)]) for i in range(size[0])]
    columns = [np.vstack([street((i, j), (i + 1, j)) for i in range(size[0] - 1)]) for j in range(size[1])]
    route = np.vstack([street(a, b)[:-1] for a, b in pairwise(corners)])
    route = resample(np.vstack([route, route[:1]]), _STEP_M)
    route = resample(smooth(route, _CORNER_M / _STEP_M, is_closed=True), _STEP_M)
    widths = tuple(float(w) for w in rng.uniform(*half_width, len(paths)))
    return Streets(tuple(paths), widths, tuple(resample(lane, _STEP_M) for lane in rows + columns), route, True)


def streets_along(trajectory: FloatArray, rng: np.random.Generator) -> Streets:
    """Makes streets along a driven trajectory, which is the right lane.

    Args:
        trajectory: (n, 2) positions of the car, m, in order.
        rng: source of the widths.

    Returns:
        One street for about every 120 m, each with its own width.

    Raises:
        ValueError: the trajectory is shorter than 20 m.
    """
    moved = np.concatenate([[True], np.linalg.norm(np.diff(trajectory, axis=0), axis=1) > 0.02])
    driven = trajectory[moved]
    if len(driven) < 2 or arc_lengths(driven)[-1] < 20:
        raise ValueError("a trajectory must be at least 20 m long")
    line = smooth(resample(driven, _STEP_M), 1.5 / _STEP_M, is_closed=False)
    middle = resample(shift_left(line, LANE_M), _STEP_M)
    count = max(round(arc_lengths(middle)[-1] / 120), 1)
    pieces = [piece for piece in np.array_split(middle, count) if len(piece) > 1]
    widths = tuple(float(w) for w in rng.uniform(4.6, 5.4, len(pieces)))
    return Streets(tuple(pieces), widths, (middle,), middle, False)


def _bend(rng: np.random.Generator, block: float) -> Callable[[FloatArray], FloatArray]:
    """Draws a smooth displacement of the plane, which bends straight streets by some metres."""
    waves = rng.normal(size=(4, 2)) / (4 * block)
    sway = rng.normal(size=(4, 2)) * 0.05 * block
    phases = rng.uniform(0, 2 * np.pi, 4)

    def place(points: FloatArray) -> FloatArray:
        return points + np.sin(2 * np.pi * points @ waves.T + phases) @ sway

    return place


def _plan(rng: np.random.Generator, kind: str, num_blocks: int) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Draws the corners of a closed route on the lattice, and returns the size of the lattice."""
    if kind == "loop":
        around = max(num_blocks // 2, 2)
        high = int(rng.integers(max(around // 3, 1), max(2 * around // 3, 1) + 1))
        return _rectangle(high, around - high), (high + 1, around - high + 1)
    if kind == "there_and_back":
        stem = max((num_blocks - 8) // 2, 1)
        there = [(1, j) for j in range(1, stem + 2)]
        east = [(0, stem + 1), (0, stem + 2), (1, stem + 2)]
        west = [(1, 0), (2, 0), (2, 1), (1, 1)]
        return [*there, *east, *there[::-1], *west], (3, stem + 3)
    side = max(round(np.sqrt(num_blocks) * 0.8), 3)
    return _wander(rng, side, num_blocks), (side, side)


def _rectangle(high: int, wide: int) -> list[tuple[int, int]]:
    up = [(i, 0) for i in range(high)]
    across = [(high, j) for j in range(wide)]
    down = [(i, wide) for i in range(high, 0, -1)]
    home = [(0, j) for j in range(wide, -1, -1)]
    return up + across + down + home


def _wander(rng: np.random.Generator, side: int, num_blocks: int) -> list[tuple[int, int]]:
    """Draws a random walk without U-turns, and back to its start; drawn again if it ends on its first street."""
    while True:
        route = [(0, 0), (0, 1)]
        while len(route) < 0.85 * num_blocks:
            steps = _neighbours(route, side)
            route.append(steps[rng.integers(len(steps))])
        while route[-1] != (0, 0):
            # Leftwards, but not along the first row, on which the route set out; then down the first column.
            (i, j), steps = route[-1], _neighbours(route, side)
            preferred = [(i, j - 1), (i - 1, j), (i + 1, j), (i, j + 1)] if i else [(1, j), (0, j - 1), (0, j + 1)]
            route.append(next(step for step in preferred if step in steps))
        if route[-2] == (1, 0):
            return route


def _neighbours(route: list[tuple[int, int]], side: int) -> list[tuple[int, int]]:
    """Returns the corners to which the route can continue without a turn on the spot."""
    i, j = route[-1]
    steps = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
    return [s for s in steps if s != route[-2] and 0 <= s[0] < side and 0 <= s[1] < side]


def lane_of(streets: Streets, *, is_reversed: bool) -> FloatArray:
    """Returns the right lane of the route.

    Args:
        streets: streets with the route.
        is_reversed: True for the lane of the route in reverse, on the opposite side of the street.

    Returns:
        (k, 2) points at steps of about half a metre.
    """
    line = streets.route[::-1] if is_reversed else streets.route
    return resample(shift_left(line, -LANE_M), 0.5)


def arc_lengths(path: FloatArray) -> FloatArray:
    """Computes the length of a curve from its start to each of its points.

    Args:
        path: (k, 2) points, m.

    Returns:
        (k,) m.
    """
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])


def at_way(path: FloatArray, way: FloatArray) -> FloatArray:
    """Interpolates points linearly at given path lengths.

    Args:
        path: (k, d) points; path lengths are those of x and y.
        way: (m,) path lengths, m, clipped to the path.

    Returns:
        (m, d).
    """
    lengths = arc_lengths(path)
    return np.column_stack([np.interp(way, lengths, column) for column in path.T])


def on_path(path: FloatArray, way: FloatArray) -> FloatArray:
    """Interpolates points of a path and its directions there linearly at given path lengths.

    Args:
        path: (k, 2) points; consecutive ones differ.
        way: (m,) path lengths, m, clipped to the path.

    Returns:
        (m, 4) x, y and the direction, of a length of 1 or a little less.
    """
    return at_way(np.column_stack([path, tangents(path)]), way)


def resample(path: FloatArray, step: float) -> FloatArray:
    """Resamples a path at (nearly) equal steps, with both ends.

    Args:
        path: (k, d) points.
        step: m.

    Returns:
        (m, d), m at least 2.
    """
    length = arc_lengths(path)[-1]
    return at_way(path, np.linspace(0.0, length, max(round(length / step), 1) + 1))


def tangents(path: FloatArray) -> FloatArray:
    """Computes unit directions along the path.

    Args:
        path: (k, 2) points; consecutive ones differ.

    Returns:
        (k, 2).
    """
    slope = np.gradient(path[:, :2], axis=0)
    return slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)


def shift_left(path: FloatArray, distance: float) -> FloatArray:
    """Shifts a path to its left.

    Args:
        path: (k, 2) points.
        distance: m; negative to the right.

    Returns:
        (k, 2).
    """
    along = tangents(path)
    return path[:, :2] + distance * np.column_stack([-along[:, 1], along[:, 0]])


def smooth(path: FloatArray, sigma: float, *, is_closed: bool) -> FloatArray:
    """Rounds the corners of a curve with a Gaussian along it.

    Args:
        path: (k, d) points at equal steps of `sigma / 6` or less.
        sigma: standard deviation in steps.
        is_closed: True where the last point is the first one again.

    Returns:
        (k, d); the ends are unchanged, unless the path is closed.
    """
    from scipy.ndimage import gaussian_filter1d

    if is_closed:
        ring = gaussian_filter1d(path[:-1], sigma, axis=0, mode="wrap")
        return np.vstack([ring, ring[:1]])
    line = np.linspace(0.0, 1.0, len(path))[:, None] * (path[-1] - path[0]) + path[0]
    # The difference to the straight line vanishes at both ends; mirrored with a change of sign, it stays zero there.
    padded = np.concatenate([-(path - line)[::-1][:-1], path - line, -(path - line)[::-1][1:]])
    rounded = gaussian_filter1d(padded, sigma, axis=0)
    return line + rounded[len(path) - 1 : 2 * len(path) - 1]
