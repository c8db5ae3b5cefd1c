"""Binary worlds of 1024 x 1024 pixels in the manner of DeepMapping Figure 4, and exact beams of a planar lidar in them.

A world is made by its seed. The index selects one of three kinds in turn. Index 0 is an office (rooms by repeated
division). Index 1 is a yard (free-standing blocks, open to the border of the image). Index 2 is a clinic (a corridor
between two rows of rooms). All have round, square and triangular obstacles, so that no two places look alike. A further
kind has a name only: a grove has trees, bushes and rocks within the edge of a forest, but no straight wall.

Frame: pixel `is_obstacle[row, col]` fills the square [col, col + 1) x [row, row + 1). The x axis points right along the
columns, y points up along the rows (row 0 is the lowest). So the world is right-handed, and a plot with the origin
below shows it without a flip. Angles are counter-clockwise from x.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.checks import require_count, require_value
from dpmjax.sequences import BoolArray, FloatArray

SIZE_PX = 1024
_WALL_PX = 10
_DOOR_PX = 72
# Deviations of an outline as shares of its radius, two numbers a wave: two and more waves round the outline.
_BLOB_WAVES = 0.3 / np.arange(2, 9)
_EDGE_WAVES = 0.08 / np.arange(2, 60) ** 0.8

_Painter = Callable[[BoolArray, FloatArray, FloatArray, float], None]


@dataclass(frozen=True)
class World:
    """A planar world of unit pixels.

    Attributes:
        name: name for titles.
        is_obstacle: (h, w) bool, True where a pixel is solid; row 0 is the lowest.

    Raises:
        ValueError: another shape or dtype, or no free space.
    """

    name: str
    is_obstacle: BoolArray = field(repr=False)

    def __post_init__(self) -> None:
        if self.is_obstacle.ndim != 2 or self.is_obstacle.dtype != np.bool_:
            raise ValueError(f"is_obstacle must be (h, w) bool, got {self.is_obstacle.shape} {self.is_obstacle.dtype}")
        if self.is_obstacle.all():
            raise ValueError("is_obstacle must leave free space, got a solid world")


def largest_region(is_free: BoolArray) -> BoolArray:
    """Finds the largest connected region of a raster.

    Args:
        is_free: (h, w).

    Returns:
        (h, w) True where a pixel is free and of the largest region.
    """
    from scipy.ndimage import label

    labels, _ = label(is_free)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return is_free & (labels == sizes.argmax())


def make_world(world: int | str) -> World:
    """Builds the world of an index or of a name; the same one every time.

    Args:
        world: 0, 1 and 2 are the three worlds of the demo; any other non-negative number is the seed of a further one
            of the kind `world % 3`. Or a kind (office, yard, clinic, grove), alone or with a seed: "grove-7".

    Returns:
        The world; its free space is connected.

    Raises:
        ValueError: a negative index, or a name that is no kind with a number.
    """
    require_value(isinstance(world, str) or world >= 0, "world", "zero or more", world)
    name = f"{list(_KINDS)[world % 3]}-{world}" if isinstance(world, int) else world
    found = re.fullmatch(rf"({'|'.join(_KINDS)})(?:-(\d+))?", name)
    if found is None:
        raise ValueError(
            f"world: expected a number, or one of {', '.join(_KINDS)} with a seed (grove-7); got {world!r}"
        )
    kind, index = found[1], int(found[2] or 0)
    rng = np.random.default_rng([2024, index])
    grid = np.zeros((SIZE_PX, SIZE_PX), bool)
    _KINDS[kind](grid, rng)
    # Free pixels that cannot be reached from the largest free space become solid.
    return World(f"{kind}-{index}", ~largest_region(~grid))


def _build_office(grid: BoolArray, rng: np.random.Generator) -> None:
    """Builds rooms by repeated division, each wall with its doors."""
    _paint_frame(grid)
    _divide(grid, rng, (0, 0, SIZE_PX, SIZE_PX), depth=0)
    _furnish(grid, rng, num_tries=320, gap=40)


def _build_yard(grid: BoolArray, rng: np.random.Generator) -> None:
    """Builds blocks of one to three boxes on a jittered 4 x 4 raster, with an open border as in the authors' worlds."""
    for x, y in rng.permutation([(x, y) for x in range(4) for y in range(4)])[:13]:
        centre = (np.array([x, y]) + 0.5) * SIZE_PX / 4 + rng.uniform(-25, 25, 2)
        for _ in range(rng.integers(1, 4)):
            _paint_box(grid, centre + rng.uniform(-42, 42, 2), rng.uniform(18, [78, 50])[:: rng.choice([-1, 1])], 0.0)
    _furnish(grid, rng, num_tries=160, gap=40)


def _build_clinic(grid: BoolArray, rng: np.random.Generator) -> None:
    """Builds a crooked corridor from left to right, rows of rooms above and below, and doors from room to room."""
    _paint_frame(grid)
    for sign, wall_y in ((1, 570), (-1, 430)):
        widths = rng.dirichlet(np.full(4, 12.0)) * SIZE_PX
        edges = np.concatenate([[0.0], np.cumsum(widths)])
        for left, right in pairwise(edges):
            # Walls of rooms are offset, because no scan constrains the position along a straight corridor.
            y = wall_y + sign * rng.uniform(-15, 45)
            door = rng.uniform(left + 0.2 * (right - left), left + 0.8 * (right - left) - _DOOR_PX)
            _paint_span(grid, 0, y, (left, right), [door])
            if right < SIZE_PX - 1:
                span = (y, SIZE_PX) if sign > 0 else (0, y)
                doors = [rng.uniform(span[0] + 50, span[1] - 50 - _DOOR_PX)] if rng.random() < 0.7 else []
                _paint_span(grid, 1, right, (span[0] - sign * 30 * (sign > 0), span[1] + 30 * (sign < 0)), doors)
    _furnish(grid, rng, num_tries=320, gap=38)


def _build_grove(grid: BoolArray, rng: np.random.Generator) -> None:
    """Builds a clearing within the uneven edge of a forest, with round trunks, bushes and rocks."""
    middle = np.full(2, SIZE_PX / 2)
    clearing = np.zeros_like(grid)
    _paint_outline(clearing, middle, 0.39 * SIZE_PX, _EDGE_WAVES * rng.normal(size=(2, len(_EDGE_WAVES))))
    grid |= ~clearing
    blob = partial(_paint_blob, rng=rng)
    _furnish(grid, rng, num_tries=500, gap=36, painters=(_paint_disc, blob, blob))


def _divide(grid: BoolArray, rng: np.random.Generator, room: tuple[int, int, int, int], depth: int) -> None:
    """Divides a room (x, y, width, height) by a wall with one or two doors, and then both halves in turn."""
    x, y, width, height = room
    if max(width, height) < 330 or (depth >= 3 and max(width, height) < 420):
        return
    along = 1 if width > height else 0  # The wall runs across the longer side.
    extent, start, other = (width, x, height) if along else (height, y, width)
    cut = start + int(extent * rng.uniform(0.36, 0.64))
    low = y if along else x
    starts = low + other * rng.uniform(0.12, 0.88, 2 if other > 600 else 1) - _DOOR_PX / 2
    doors = np.clip(starts, low + 20, low + other - 20 - _DOOR_PX).tolist()
    _paint_span(grid, along, cut, (low, low + other), doors)
    first = (x, y, cut - x, height) if along else (x, y, width, cut - y)
    second = (cut, y, x + width - cut, height) if along else (x, cut, width, y + height - cut)
    for half in (first, second):
        _divide(grid, rng, half, depth + 1)
    for door in doors:
        # Later walls must not stand in the doorway.
        reach, width_of_door = slice(max(cut - 40, _WALL_PX), cut + 40), slice(int(door), int(door) + _DOOR_PX)
        grid[(width_of_door, reach) if along else (reach, width_of_door)] = False


def _furnish(
    grid: BoolArray, rng: np.random.Generator, num_tries: int, gap: int, painters: Sequence[_Painter] | None = None
) -> None:
    """Adds obstacles of different shapes where a passage of `gap` pixels remains all round."""
    painters = painters or (_paint_box, _paint_disc, _paint_triangle)
    for _ in range(num_tries):
        centre, size = rng.uniform(40, SIZE_PX - 40, 2), rng.uniform(9, 34, 2)
        reach = int(np.hypot(*size)) + gap
        row, col = (int(v) for v in centre[::-1])
        if grid[max(row - reach, 0) : row + reach, max(col - reach, 0) : col + reach].any():
            continue
        painters[int(rng.integers(len(painters)))](grid, centre, size, rng.uniform(0, np.pi))


def _paint_frame(grid: BoolArray) -> None:
    grid[:_WALL_PX], grid[-_WALL_PX:], grid[:, :_WALL_PX], grid[:, -_WALL_PX:] = True, True, True, True


def _paint_span(grid: BoolArray, along: int, at: float, span: tuple[float, float], doors: list[float]) -> None:
    """Paints a wall along x (0) or y (1) at the second coordinate `at`, over `span`, with gaps from `doors` on."""
    line = np.zeros(SIZE_PX, bool)
    line[max(int(span[0]), 0) : int(span[1])] = True
    for door in doors:
        line[max(int(door), 0) : int(door) + _DOOR_PX] = False
    band = slice(int(at) - _WALL_PX // 2, int(at) + _WALL_PX // 2)
    grid[(slice(None), band) if along else (band, slice(None))] |= line[:, None] if along else line


def _pixel_coordinates(centre: FloatArray, angle: float) -> tuple[FloatArray, FloatArray]:
    """Computes coordinates of all pixel centres of the world in the frame of an obstacle."""
    x, y = centre
    axis = np.arange(SIZE_PX) + 0.5
    dx, dy = (axis - x)[None, :], (axis - y)[:, None]
    return np.cos(angle) * dx + np.sin(angle) * dy, np.cos(angle) * dy - np.sin(angle) * dx


def _paint_box(grid: BoolArray, centre: FloatArray, size: FloatArray, angle: float) -> None:
    (u, v), (half_u, half_v) = _pixel_coordinates(centre, angle), size
    grid |= (np.abs(u) < half_u) & (np.abs(v) < half_v)


def _paint_disc(grid: BoolArray, centre: FloatArray, size: FloatArray, angle: float) -> None:
    u, v = _pixel_coordinates(centre, angle)
    grid |= u**2 + v**2 < np.mean(size) ** 2


def _paint_triangle(grid: BoolArray, centre: FloatArray, size: FloatArray, angle: float) -> None:
    (u, v), (half_u, half_v) = _pixel_coordinates(centre, angle), size
    grid |= (v > -half_v) & (np.abs(u) / half_u < (half_v - v) / (2 * half_v))


def _paint_blob(
    grid: BoolArray, centre: FloatArray, size: FloatArray, _angle: float, *, rng: np.random.Generator
) -> None:
    """Paints a bush or a rock."""
    _paint_outline(grid, centre, float(np.mean(size)), _BLOB_WAVES * rng.normal(size=(2, len(_BLOB_WAVES))))


def _paint_outline(grid: BoolArray, centre: FloatArray, radius: float, waves: FloatArray) -> None:
    """Paints pixels within a radius that varies with the direction: cosines and sines (2, k) of two and more waves."""
    turn = np.linspace(-np.pi, np.pi, 4096)
    phase = turn[:, None] * np.arange(2, 2 + waves.shape[1])
    outline = radius * np.exp(np.cos(phase) @ waves[0] + np.sin(phase) @ waves[1])
    (left, bottom), size = np.maximum(centre - outline.max(), 0).astype(int), int(2 * outline.max()) + 2
    box = slice(bottom, bottom + size), slice(left, left + size)
    u, v = (x[box] for x in np.broadcast_arrays(*_pixel_coordinates(centre, 0.0)))
    grid[box] |= np.hypot(u, v) < np.interp(np.arctan2(v, u), turn, outline)


# Builders of the kinds; the first three are those of numbers.
_KINDS: dict[str, Callable[[BoolArray, np.random.Generator], None]] = {
    "office": _build_office,
    "yard": _build_yard,
    "clinic": _build_clinic,
    "grove": _build_grove,
}


def beam_angles(num_beams: int) -> FloatArray:
    """Returns the angles of a 360-degree scan in the order of the DeepMapping authors.

    Args:
        num_beams: number of beams.

    Returns:
        (num_beams,) radians in the sensor frame, from 0 (straight ahead) counter-clockwise, 2 pi excluded.

    Raises:
        ValueError: fewer than one beam.
    """
    require_count("num_beams", num_beams)
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
    is_inside = np.asarray(((start >= 0) & (start < is_obstacle.shape[::-1])).all(axis=1))
    cell = np.floor(np.where(is_inside[:, None], start, 0)).astype(np.int64)
    is_good = is_inside & ~is_obstacle[cell[:, 1], cell[:, 0]]
    if not is_good.all():
        raise ValueError(f"origins must lie in free space of the image, got {start[~is_good][0]}")
    # Chessboard distances to the nearest solid pixel, with a solid frame round the image.
    distance = distance_transform_cdt(~np.pad(is_obstacle, 1, constant_values=True), metric="chessboard")
    direction = np.stack([np.cos(theta), np.sin(theta)], axis=1)
    length, active = np.zeros(len(start)), np.arange(len(start))
    while len(active):
        reach = distance[cell[active, 1] + 1, cell[active, 0] + 1].astype(np.int64)
        cell[active], length[active] = _leap(start[active], direction[active], cell[active], reach, length[active])
        active = active[distance[cell[active, 1] + 1, cell[active, 0] + 1] > 0]
    return length


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
