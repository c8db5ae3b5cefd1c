"""Furnished apartments of boxes, made by seed, and depth images of them by ray casting.

World frame: x and z span the floor, y points down; the camera travels in the plane y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dpmjax.sequences import BoolArray, FloatArray
from dpmjax.types import AnyArray

_CAMERA_HEIGHT_M, _ROOM_HEIGHT_M, _WALL_M, _DOOR_M = 1.1, 2.6, 0.12, 0.95
_PARALLEL = 1e-9
_KINDS, _KIND_SHARES = ("cupboard", "table", "picture", "shelf", "bench"), (0.26, 0.16, 0.26, 0.16, 0.16)
_Box = tuple[list[float], list[float], float]  # centre, half sizes, yaw


@dataclass(frozen=True)
class Apartment:
    """Boxes that stand in a rectangle.

    Attributes:
        name: name for titles.
        centres: (b, 3) metres.
        half_sizes: (b, 3) metres.
        yaws: (b,) radians about y.
        size_x_m: the rectangle is [0, size_x_m] x [0, size_z_m].
        size_z_m: side of the rectangle along z.
        is_seen_through: (b,) True for the outer shell, which is visible from within.
    """

    name: str
    centres: FloatArray
    half_sizes: FloatArray
    yaws: FloatArray
    size_x_m: float
    size_z_m: float
    is_seen_through: BoolArray

    def is_free(self, places: FloatArray, clearance_m: float) -> BoolArray:
        """Finds the free places for the robot below the camera; lower furniture counts too.

        Args:
            places: (m, 2) x, z, m.
            clearance_m: distance to keep from walls and furniture.

        Returns:
            (m,) True where the place is free.
        """
        far = np.array([self.size_x_m, self.size_z_m]) - clearance_m
        inside = np.all((places > clearance_m) & (places < far), axis=1)
        hangs_above = self.centres[:, 1] + self.half_sizes[:, 1] < -0.9
        kept = ~self.is_seen_through & ~hangs_above
        dx, dz = np.moveaxis(places[:, None] - self.centres[kept][:, [0, 2]], -1, 0)
        cos, sin = np.cos(self.yaws[kept]), np.sin(self.yaws[kept])
        half = self.half_sizes[kept] + clearance_m
        is_apart = (np.abs(cos * dx - sin * dz) > half[:, 0]) | (np.abs(sin * dx + cos * dz) > half[:, 2])
        return inside & is_apart.all(axis=1)


def make_apartment(seed: int) -> Apartment:
    """Builds the apartment of a seed, the same one every time.

    Args:
        seed: zero or more.

    Returns:
        The apartment.

    Raises:
        ValueError: a negative seed.
    """
    if seed < 0:
        raise ValueError(f"seed: expected zero or more, got {seed}")
    rng = np.random.default_rng([7, seed])
    size_x, size_z = rng.uniform(5.5, 7.5), rng.uniform(5.0, 6.5)
    floor, ceiling = _CAMERA_HEIGHT_M, _CAMERA_HEIGHT_M - _ROOM_HEIGHT_M
    middle_y, half_y = (floor + ceiling) / 2, _ROOM_HEIGHT_M / 2
    boxes: list[_Box] = [([size_x / 2, middle_y, size_z / 2], [size_x / 2, half_y, size_z / 2], 0.0)]
    cut = size_x * rng.uniform(0.42, 0.58)
    door = rng.uniform(0.25, 0.75) * size_z
    for low, high in ((0.0, door - _DOOR_M / 2), (door + _DOOR_M / 2, size_z)):
        boxes.append(([cut, middle_y, (low + high) / 2], [_WALL_M / 2, half_y, (high - low) / 2], 0.0))
    boxes.append(([cut, ceiling + 0.2, door], [_WALL_M / 2, 0.2, _DOOR_M / 2], 0.0))
    for _ in range(26):
        boxes += _place_furniture(rng, _Rooms(size_x, size_z, cut, door))
    centres, halves, yaws = zip(*boxes, strict=True)
    is_shell = np.arange(len(boxes)) == 0
    return Apartment(f"apartment-{seed}", np.array(centres), np.array(halves), np.array(yaws), size_x, size_z, is_shell)


class _Rooms(NamedTuple):
    """Two rooms: size of the floor, x of the wall between them, z of its door, m."""

    size_x: float
    size_z: float
    wall_x: float
    door_z: float


def _place_furniture(rng: np.random.Generator, rooms: _Rooms) -> list[_Box]:
    """Places one piece at a wall, on a wall, or in the room; none where it would block the doorway."""
    size_x, size_z, wall_x, door_z = rooms
    kind = _KINDS[int(rng.choice(len(_KINDS), p=_KIND_SHARES))]
    width, depth = rng.uniform(0.3, 1.1), rng.uniform(0.25, 0.6)
    wall = int(rng.integers(6))
    along = rng.uniform(0.15, 0.85)
    if kind == "picture":
        depth = rng.uniform(0.06, 0.3)
    if kind == "table":
        place = rng.uniform(0.8, np.array([size_x, size_z]) - 0.8)
        yaw = rng.uniform(0, np.pi)
        if abs(place[0] - wall_x) < 0.9:
            return []
    elif wall < 4:  # the outer walls
        at = [depth / 2, size_x - depth / 2, depth / 2, size_z - depth / 2][wall]
        place = np.array([at, along * size_z]) if wall < 2 else np.array([along * size_x, at])
        yaw = np.pi / 2 if wall < 2 else 0.0
    else:  # the inner wall, either side
        place = np.array([wall_x + (depth + _WALL_M) / 2 * (1 if wall == 4 else -1), along * size_z])
        yaw = np.pi / 2
    if np.linalg.norm(place - [wall_x, door_z]) < _DOOR_M + 0.3 and kind != "picture":
        return []
    return _build_furniture(rng, kind, place, (width, depth, yaw))


def _build_furniture(
    rng: np.random.Generator, kind: str, place: FloatArray, footprint: tuple[float, float, float]
) -> list[_Box]:
    """Builds the boxes of a piece; the footprint is width, depth and yaw."""
    floor, ceiling = _CAMERA_HEIGHT_M, _CAMERA_HEIGHT_M - _ROOM_HEIGHT_M
    width, depth, yaw = footprint
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


@jax.jit
def cast_depth(
    T_world_camera: Float[AnyArray, "4 4"],
    rays: Float[AnyArray, "h w 3"],
    centres: Float[AnyArray, "b 3"],
    half_sizes: Float[AnyArray, "b 3"],
    yaws: Float[AnyArray, " b"],
) -> Float[Array, "h w"]:
    """Computes the depth along z of the first surface that each ray hits; `vmap` over cameras.

    Args:
        T_world_camera: pose of the camera.
        rays: directions in the camera frame with z = 1, so that a length along a ray is a depth.
        centres: centres of the boxes in the world, metres.
        half_sizes: half sizes of the boxes; a box of size 0 is never hit.
        yaws: turn of each box about y, radians.

    Returns:
        (h, w) metres; infinite without a hit. A ray from within a box hits the inside of the box.
    """
    T, rays = jnp.asarray(T_world_camera), jnp.asarray(rays)
    directions_world = jnp.einsum("ij,hwj->hwi", T[:3, :3], rays, precision=jax.lax.Precision.HIGHEST)

    def meet(centre: Array, half: Array, yaw: Array) -> Array:
        cos, sin = jnp.cos(yaw), jnp.sin(yaw)
        R_box_world = jnp.stack([jnp.stack([cos, 0.0, -sin]), jnp.array([0.0, 1.0, 0.0]), jnp.stack([sin, 0.0, cos])])
        origin = jnp.sum(R_box_world * (T[:3, 3] - centre), axis=-1)
        direction = jnp.einsum("ij,hwj->hwi", R_box_world, directions_world, precision=jax.lax.Precision.HIGHEST)
        safe = jnp.where(jnp.abs(direction) < _PARALLEL, _PARALLEL, direction)
        first, second = (-half - origin) / safe, (half - origin) / safe
        enter, leave = jnp.minimum(first, second).max(-1), jnp.maximum(first, second).min(-1)
        depth = jnp.where(enter > 0.0, enter, leave)
        return jnp.where((leave > jnp.maximum(enter, 0.0)) & (half > 0.0).all(), depth, jnp.inf)

    return jax.vmap(meet)(jnp.asarray(centres), jnp.asarray(half_sizes), jnp.asarray(yaws)).min(0)
