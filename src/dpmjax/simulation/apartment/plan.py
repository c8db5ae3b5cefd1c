"""A furnished apartment of boxes, made by its seed: rooms with doors, cupboards, tables, shelves, a bed, lamps.

World frame: x and z span the floor, y points down; the camera travels in the plane y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_CAMERA_HEIGHT_M, _ROOM_HEIGHT_M, _WALL_M, _DOOR_M = 1.1, 2.6, 0.12, 0.95


@dataclass(frozen=True)
class Apartment:
    """Boxes that stand in a rectangle.

    Attributes:
        name: for titles.
        centres: (b, 3) metres.
        half_sizes: (b, 3) metres.
        yaws: (b,) radians about y.
        size_x_m: the rectangle is [0, size_x_m] x [0, size_z_m].
        size_z_m: the same along z.
        is_seen_through: (b,) True for the shell, which is seen from within.
    """

    name: str
    centres: NDArray[np.float64]
    half_sizes: NDArray[np.float64]
    yaws: NDArray[np.float64]
    size_x_m: float
    size_z_m: float
    is_seen_through: NDArray[np.bool_]

    def is_free(self, places: NDArray[np.float64], clearance_m: float) -> NDArray[np.bool_]:
        """Which (m, 2) places x, z keep `clearance_m` from walls and from what stands at the camera's height.

        Lower furniture counts too: the robot below the camera has to pass.
        """
        far = np.array([self.size_x_m, self.size_z_m]) - clearance_m
        inside: NDArray[np.bool_] = np.all((places > clearance_m) & (places < far), axis=1)
        for centre, half, yaw in zip(
            self.centres[~self.is_seen_through],
            self.half_sizes[~self.is_seen_through],
            self.yaws[~self.is_seen_through],
            strict=True,
        ):
            if centre[1] + half[1] < -0.9:  # hangs above the robot
                continue
            dx, dz = (places - centre[[0, 2]]).T
            u, v = np.cos(yaw) * dx - np.sin(yaw) * dz, np.sin(yaw) * dx + np.cos(yaw) * dz
            inside &= (np.abs(u) > half[0] + clearance_m) | (np.abs(v) > half[2] + clearance_m)
        return inside


def make_apartment(seed: int) -> Apartment:
    """Builds the apartment of a seed, the same one every time.

    Raises:
        ValueError: a negative seed.
    """
    if seed < 0:
        raise ValueError(f"seed: expected zero or more, got {seed}")
    rng = np.random.default_rng([7, seed])
    size_x, size_z = rng.uniform(5.5, 7.5), rng.uniform(5.0, 6.5)
    floor, ceiling = _CAMERA_HEIGHT_M, _CAMERA_HEIGHT_M - _ROOM_HEIGHT_M
    middle_y, half_y = (floor + ceiling) / 2, _ROOM_HEIGHT_M / 2
    boxes: list[tuple[list[float], list[float], float]] = [
        ([size_x / 2, middle_y, size_z / 2], [size_x / 2, half_y, size_z / 2], 0.0)
    ]
    cut = size_x * rng.uniform(0.42, 0.58)
    door = rng.uniform(0.25, 0.75) * size_z
    for low, high in ((0.0, door - _DOOR_M / 2), (door + _DOOR_M / 2, size_z)):
        boxes.append(([cut, middle_y, (low + high) / 2], [_WALL_M / 2, half_y, (high - low) / 2], 0.0))
    boxes.append(([cut, ceiling + 0.2, door], [_WALL_M / 2, 0.2, _DOOR_M / 2], 0.0))
    doorway = np.array([cut, door])
    for _ in range(26):
        boxes += _furniture(rng, size_x, size_z, floor, ceiling, cut, doorway)
    centres, halves, yaws = zip(*boxes, strict=True)
    is_shell = np.arange(len(boxes)) == 0
    return Apartment(f"apartment-{seed}", np.array(centres), np.array(halves), np.array(yaws), size_x, size_z, is_shell)


def _furniture(
    rng: np.random.Generator,
    size_x: float,
    size_z: float,
    floor: float,
    ceiling: float,
    cut: float,
    doorway: NDArray[np.float64],
) -> list[tuple[list[float], list[float], float]]:
    """One piece at a wall, on a wall, or in the room; nothing where it would block the doorway."""
    kind = rng.choice(["cupboard", "table", "picture", "shelf", "bench"], p=[0.26, 0.16, 0.26, 0.16, 0.16])
    width, depth = rng.uniform(0.3, 1.1), rng.uniform(0.25, 0.6)
    wall = int(rng.integers(6))
    along = rng.uniform(0.15, 0.85)
    if kind == "picture":
        depth = rng.uniform(0.06, 0.3)
    if kind == "table":
        place, yaw = np.array([rng.uniform(0.8, size_x - 0.8), rng.uniform(0.8, size_z - 0.8)]), rng.uniform(0, np.pi)
        if abs(place[0] - cut) < 0.9:
            return []
    elif wall < 4:  # the outer walls
        at = [depth / 2, size_x - depth / 2, depth / 2, size_z - depth / 2][wall]
        place = np.array([at, along * size_z]) if wall < 2 else np.array([along * size_x, at])
        yaw = np.pi / 2 if wall < 2 else 0.0
    else:  # the inner wall, either side
        place = np.array([cut + (depth + _WALL_M) / 2 * (1 if wall == 4 else -1), along * size_z])
        yaw = np.pi / 2
    if np.linalg.norm(place - doorway) < _DOOR_M + 0.3 and kind != "picture":
        return []
    x, z = place
    if kind == "cupboard":
        height = rng.uniform(0.7, 2.1)
        return [([x, floor - height / 2, z], [width / 2, height / 2, depth / 2], yaw)]
    if kind == "picture":
        y = rng.uniform(ceiling + 0.3, ceiling + 0.6)
        return [([x, y, z], [width / 2, rng.uniform(0.15, 0.3), depth / 2], yaw)]
    if kind == "shelf":
        levels = np.arange(1, 4) * rng.uniform(0.4, 0.6)
        return [([x, floor - level, z], [width / 2, 0.04, depth / 2], yaw) for level in levels]
    if kind == "bench":
        back = rng.uniform(0.4, 1.2)
        return [
            ([x, floor - 0.22, z], [width / 2, 0.22, depth / 2], yaw),
            ([x, floor - back / 2, z], [width / 2, back / 2, 0.05], yaw),
        ]
    top = [([x, floor - 0.74, z], [width / 2 + 0.2, 0.03, depth / 2 + 0.15], yaw)]
    return [*top, ([x, floor - 0.37, z], [0.1, 0.37, 0.1], yaw)]
