"""Depth images of random walks through furnished apartments.

World frame: x and z span the floor, y points down; the camera travels in the plane y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax
import numpy as np

from dpmjax.checks import require_fields
from dpmjax.sequences import ACTIVE_VISION, BoolArray, DepthSequence, FloatArray
from dpmjax.simulation.apartment import Apartment, cast_depth, make_apartment

# DeepMapping section 4.2: distance of places, angle between views, share of the steps that are moves instead of turns.
_GRID_M, _TURN_DEG, _MOVE_SHARE = 0.3, 30.0, 0.5
_REVERSAL_SHARE = 0.2
"""Share of the turns with the opposite sign of the turn before."""

_CLEARANCE_M, _FREE_CLEARANCE_M = 0.2, 0.1  # Places keep these distances from walls and furniture; after jitter.
_FARTHEST_M = 6.0  # Deeper pixels are masked.
_BOTH_SHARE, _JITTER_M, _JITTER_DEG = 0.8, 0.05, 5.0
"""Walks that move and turn at once: share of the steps with a move, and with a turn; standard deviations."""

_MAX_WALKS = 1000


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


HARD_WALK = DepthWalkConfig(depth_noise_m=0.0015, dropout_share=0.1, steps="both", min_spread_m=0.45)
"""Walks for which a constant position exceeds the paper's threshold of 450 mm, with noise of a structured-light camera
(Khoshelham and Elberink 2012: 1.4 mm at one metre)."""


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
    if num_views < 2:
        raise ValueError(f"num_views: expected at least 2, got {num_views}")
    config = config or DepthWalkConfig()
    home = apartment if isinstance(apartment, Apartment) else make_apartment(apartment)
    rng = np.random.default_rng([seed, 11])
    T_world_camera = _planar_to_matrices(_wide_walk(home, num_views, config, rng))
    rows, columns = ACTIVE_VISION.sample_pixels(config.height, config.width)
    rays = ACTIVE_VISION.rays(columns.astype(np.float64), rows.astype(np.float64))
    # One capacity for all apartments, so that the caster compiles once.
    spare = -len(home.centres) % 32
    boxes = (np.pad(home.centres, ((0, spare), (0, 0))), np.pad(home.half_sizes, ((0, spare), (0, 0))))
    cast = jax.vmap(cast_depth, in_axes=(0, None, None, None, None))
    depth = np.asarray(cast(T_world_camera, rays, *boxes, np.pad(home.yaws, (0, spare))), np.float64)
    mask = np.isfinite(depth) & (depth <= _FARTHEST_M) & (depth > 0.05)
    depth = np.where(mask, depth, 0.0)
    depth += config.depth_noise_m * depth**2 * rng.standard_normal(depth.shape)
    mask &= rng.random(depth.shape) >= config.dropout_share * (depth / 3.0) ** 2
    points = np.where(mask[..., None], rays * depth[..., None], 0.0).astype(np.float32)
    return DepthSequence(f"{home.name}, walk {seed}", points, mask, is_planar=True, T_world_camera=T_world_camera)


def _wide_walk(home: Apartment, num_views: int, config: DepthWalkConfig, rng: np.random.Generator) -> FloatArray:
    """Draws walks until one is wide enough."""
    for _ in range(_MAX_WALKS):
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
        reachable = _free_neighbours(is_free, at)
        if config.steps == "one":
            does_move = bool(reachable) and rng.random() < _MOVE_SHARE
            does_turn = not does_move
        else:
            does_move, does_turn = bool(reachable) and rng.random() < _BOTH_SHARE, rng.random() < _BOTH_SHARE
        if does_move:
            at = reachable[rng.integers(len(reachable))]
        if does_turn:
            turn_sign = -turn_sign if rng.random() < _REVERSAL_SHARE else turn_sign
            view += turn_sign
    return np.array(poses) if config.steps == "one" else _jittered(home, np.array(poses), rng)


def _free_neighbours(is_free: BoolArray, at: np.ndarray) -> list[np.ndarray]:
    neighbours = at + np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    inside = ((neighbours >= 0) & (neighbours < is_free.shape)).all(1)
    return [n for n, ok in zip(neighbours, inside, strict=True) if ok and is_free[tuple(n)]]


def _jittered(home: Apartment, poses: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Adds noise to each pose, unless the new position is not free."""
    moved = poses + rng.standard_normal(poses.shape) * [_JITTER_M, _JITTER_M, np.deg2rad(_JITTER_DEG)]
    is_free = home.is_free(moved[:, :2], _FREE_CLEARANCE_M)
    return np.where(is_free[:, None], moved, poses)


def _planar_to_matrices(poses: FloatArray) -> FloatArray:
    """Converts x, z and the angle about y to T_world_camera (n, 4, 4)."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, 0, 0], T[:, 0, 2], T[:, 2, 0], T[:, 2, 2] = cos, sin, -sin, cos
    T[:, 0, 3], T[:, 2, 3] = poses[:, 0], poses[:, 1]
    return T
