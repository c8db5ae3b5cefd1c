"""Binary worlds of 1024 x 1024 pixels in the manner of DeepMapping Figure 4, each made by its seed.

The index selects one of three kinds in turn. 0 is an office (rooms by repeated division). 1 is a yard (free-standing
blocks, open to the border of the image). 2 is a clinic (a corridor between two rows of rooms). All have round, square
and triangular obstacles, so that no two places look alike. Two more kinds have names only. A grove has trees, bushes
and rocks within the edge of a forest, without a straight wall. A crowd is an office with walking people. The frame is
that of `raycast2d`: row 0 is the lowest.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from dpmjax.sequences import BoolArray, FloatArray, World, largest_region

SIZE_PX = 1024
_WALL_PX = 10
_DOOR_PX = 72
# Deviations of an outline as shares of its radius, two numbers a wave: two and more waves round the outline.
_BLOB_WAVES = 0.3 / np.arange(2, 9)
_EDGE_WAVES = 0.08 / np.arange(2, 60) ** 0.8
# People in a crowd.
_NUM_PEOPLE = 15

_Painter = Callable[[BoolArray, FloatArray, FloatArray, float], None]


def make_world(world: int | str) -> World:
    """Builds the world of an index or of a name; the same one every time.

    Args:
        world: 0, 1 and 2 are the three worlds of the demo; any other non-negative number is the seed of a further one
            of the kind `world % 3`. Or a kind (office, yard, clinic, grove, crowd), alone or with a seed: "grove-7".

    Returns:
        The world; its free space is connected.

    Raises:
        ValueError: a negative index, or a name that is no kind with a number.
    """
    if isinstance(world, int) and world < 0:
        raise ValueError(f"index must not be negative, got {world}")
    name = f"{list(_KINDS)[world % 3]}-{world}" if isinstance(world, int) else world
    found = re.fullmatch(rf"({'|'.join(_KINDS)})(?:-(\d+))?", name)
    if found is None:
        kinds = ", ".join(_KINDS)
        raise ValueError(f"world: expected a number or one of {kinds}, with a seed as in grove-7; got {world!r}")
    kind, index = found[1], int(found[2] or 0)
    rng = np.random.default_rng([2024, index])
    grid = np.zeros((SIZE_PX, SIZE_PX), bool)
    _KINDS[kind](grid, rng)
    # Free pixels that cannot be reached from the largest free space become solid.
    return World(f"{kind}-{index}", ~largest_region(~grid), _NUM_PEOPLE if kind == "crowd" else 0)


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
    "crowd": _build_office,
}
