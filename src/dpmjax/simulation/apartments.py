"""Depth images of random walks through furnished apartments of boxes, both made by seed.

World frame: x and z span the floor, y points down; the camera travels in the plane y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dpmjax.checks import require_fields, require_value, runs_on_host
from dpmjax.geometry.se3 import motion_matrices
from dpmjax.sequences import ACTIVE_VISION, BoolArray, DepthSequence, FloatArray
from dpmjax.types import AnyArray

_CAMERA_HEIGHT_M, _ROOM_HEIGHT_M, _WALL_M, _DOOR_M = 1.1, 2.6, 0.12, 0.95
_PARALLEL = 1e-9
_KINDS, _KIND_SHARES = ("cupboard", "table", "picture", "shelf", "bench"), (0.26, 0.16, 0.26, 0.16, 0.16)
_Box = tuple[list[float], list[float], float]  # centre, half sizes, yaw
# DeepMapping section 4.2: distance of places, angle between views, share of the steps that are moves instead of turns.
_GRID_M, _TURN_DEG, _MOVE_SHARE = 0.3, 30.0, 0.5

_CLEARANCE_M, _FREE_CLEARANCE_M = 0.2, 0.1  # Places keep these distances from walls and furniture; after jitter.
# Walks that move and turn at once: share of the steps with a move, and with a turn; standard deviations.
_BOTH_SHARE, _JITTER_M, _JITTER_DEG = 0.8, 0.05, 5.0


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
    require_value(seed >= 0, "seed", "zero or more", seed)
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
        boxes += _place_furniture(rng, (size_x, size_z), (cut, door))
    centres, halves, yaws = zip(*boxes, strict=True)
    is_shell = np.arange(len(boxes)) == 0
    return Apartment(f"apartment-{seed}", np.array(centres), np.array(halves), np.array(yaws), size_x, size_z, is_shell)


def _place_furniture(rng: np.random.Generator, size: tuple[float, float], doorway: tuple[float, float]) -> list[_Box]:
    """Places one piece at a wall, on a wall, or in one of the two rooms; none where it would block the doorway.

    Args:
        rng: source of all choices.
        size: sides of the floor, m.
        doorway: x of the wall between the rooms, z of its door, m.

    Returns:
        The boxes of the piece.
    """
    (size_x, size_z), (wall_x, door_z) = size, doorway
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
    floor, ceiling = _CAMERA_HEIGHT_M, _CAMERA_HEIGHT_M - _ROOM_HEIGHT_M
    if kind == "cupboard":
        height = rng.uniform(0.7, 2.1)
        parts = [(floor - height / 2, [width / 2, height / 2, depth / 2])]
    elif kind == "picture":
        y = rng.uniform(ceiling + 0.3, ceiling + 0.6)
        parts = [(y, [width / 2, rng.uniform(0.15, 0.3), depth / 2])]
    elif kind == "shelf":
        levels = np.arange(1, 4) * rng.uniform(0.4, 0.6)
        parts = [(floor - level, [width / 2, 0.04, depth / 2]) for level in levels]
    elif kind == "bench":
        back = rng.uniform(0.4, 1.2)
        parts = [(floor - 0.22, [width / 2, 0.22, depth / 2]), (floor - back / 2, [width / 2, back / 2, 0.05])]
    else:
        parts = [(floor - 0.74, [width / 2 + 0.2, 0.03, depth / 2 + 0.15]), (floor - 0.37, [0.1, 0.37, 0.1])]
    return [([place[0], y, place[1]], half, yaw) for y, half in parts]


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


@dataclass(frozen=True)
class DepthWalkConfig:
    """Properties of the clouds of a walk, and of the motion of the camera.

    Attributes:
        height: rows of a cloud.
        width: columns of a cloud.
        depth_noise_m: standard deviation of the depth at one metre; it grows with the square of the depth, as a
            structured-light camera's does.
        dropout_share: share of the pixels without a depth at three metres; it grows with the square of the depth, too.
        steps: "one": one move of 0.3 m or one turn of 30 degrees between views, as in the Active Vision Dataset.
            "both": moves and turns at once, both with jitter.
        min_spread_m: least root mean square distance of the cameras from their mean, which is the ATE of a constant
            position; walks are drawn until it is reached.

    Raises:
        ValueError: a number out of range.
    """

    height: int = 27
    width: int = 48
    depth_noise_m: float = 0.0
    dropout_share: float = 0.0
    steps: Literal["one", "both"] = "one"
    min_spread_m: float = 0.0

    def __post_init__(self) -> None:
        require_fields(self, "height", "width", low=1)
        require_fields(self, "depth_noise_m", "min_spread_m", low=0)
        require_fields(self, "dropout_share", low=0, high=1)


# Walks for which a constant position exceeds the paper's threshold of 450 mm, with noise of a structured-light camera
# (Khoshelham and Elberink 2012: 1.4 mm at one metre).
HARD_WALK = DepthWalkConfig(depth_noise_m=0.0015, dropout_share=0.1, steps="both", min_spread_m=0.45)


@runs_on_host("call it outside, and pass its arrays in")
def simulate_depth_sequence(
    apartment: int | Apartment = 0, num_views: int = 16, *, seed: int = 0, config: DepthWalkConfig | None = None
) -> DepthSequence:
    """Simulates a random walk of a level depth camera over the grid of an apartment.

    Args:
        apartment: seed for `make_apartment`, or an apartment.
        num_views: 8 or 16 in the paper.
        seed: seed of walk and noise.
        config: settings of clouds and motion; those of the paper without noise where None.

    Returns:
        The sequence; its motion is planar.

    Raises:
        ValueError: fewer than two views, an apartment without free places, or one without a walk of the spread.
    """
    require_value(num_views >= 2, "num_views", "at least 2", num_views)
    config = config or DepthWalkConfig()
    home = apartment if isinstance(apartment, Apartment) else make_apartment(apartment)
    rng = np.random.default_rng([seed, 11])
    T_world_camera = np.asarray(motion_matrices(_wide_walk(home, num_views, config, rng)))
    rows, columns = ACTIVE_VISION.sample_pixels(config.height, config.width)
    rays = ACTIVE_VISION.rays(columns, rows)
    # One capacity for all apartments, so that the caster compiles once.
    spare = -len(home.centres) % 32
    boxes = (np.pad(home.centres, ((0, spare), (0, 0))), np.pad(home.half_sizes, ((0, spare), (0, 0))))
    cast = jax.vmap(cast_depth, in_axes=(0, None, None, None, None))
    depth = np.asarray(cast(T_world_camera, rays, *boxes, np.pad(home.yaws, (0, spare))), np.float64)
    mask = np.isfinite(depth) & (depth <= 6.0) & (depth > 0.05)
    depth = np.where(mask, depth, 0.0)
    depth += config.depth_noise_m * depth**2 * rng.standard_normal(depth.shape)
    mask &= rng.random(depth.shape) >= config.dropout_share * (depth / 3.0) ** 2
    points = np.where(mask[..., None], rays * depth[..., None], 0.0).astype(np.float32)
    return DepthSequence(f"{home.name}, walk {seed}", points, mask, is_planar=True, T_world_camera=T_world_camera)


def _wide_walk(home: Apartment, num_views: int, config: DepthWalkConfig, rng: np.random.Generator) -> FloatArray:
    """Draws walks until one is wide enough."""
    for _ in range(1000):
        poses = _walk(home, num_views, config, rng)
        spread_m = np.sqrt(np.mean(np.sum((poses[:, :2] - poses[:, :2].mean(axis=0)) ** 2, axis=1)))
        if spread_m >= config.min_spread_m:
            return poses
    raise ValueError(f"min_spread_m: no walk of {num_views} views in {home.name} is {config.min_spread_m} m wide")


def _walk(home: Apartment, num_views: int, config: DepthWalkConfig, rng: np.random.Generator) -> FloatArray:
    """Draws x, z and angle about y (n, 3) of neighbouring views at neighbouring positions of a grid."""
    x, z = np.arange(0.0, home.size_x_m, _GRID_M), np.arange(0.0, home.size_z_m, _GRID_M)
    places = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1)
    is_free = home.is_free(places.reshape(-1, 2), _CLEARANCE_M).reshape(places.shape[:2])
    free = np.argwhere(is_free)
    if len(free) == 0:
        raise ValueError(f"{home.name} has no free place with {_CLEARANCE_M} m of clearance")
    at, view = free[rng.integers(len(free))], int(rng.integers(round(360.0 / _TURN_DEG)))
    turn_sign = int(rng.choice([-1, 1]))
    poses = []
    for _ in range(num_views):
        poses.append([*places[tuple(at)], np.deg2rad(view * _TURN_DEG)])
        neighbours = at + np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        inside = ((neighbours >= 0) & (neighbours < is_free.shape)).all(1)
        reachable = [place for place in neighbours[inside] if is_free[tuple(place)]]
        share = _MOVE_SHARE if config.steps == "one" else _BOTH_SHARE
        does_move = bool(reachable) and rng.random() < share
        does_turn = not does_move if config.steps == "one" else rng.random() < share
        if does_move:
            at = reachable[rng.integers(len(reachable))]
        if does_turn:
            # Every fifth turn changes its sign.
            turn_sign = -turn_sign if rng.random() < 0.2 else turn_sign
            view += turn_sign
    drawn = np.array(poses)
    if config.steps == "one":
        return drawn
    # Noise is added to each pose, unless the new position is not free.
    moved = drawn + np.array([_JITTER_M, _JITTER_M, np.deg2rad(_JITTER_DEG)]) * rng.standard_normal(drawn.shape)
    return np.where(home.is_free(moved[:, :2], _FREE_CLEARANCE_M)[:, None], moved, drawn)
