"""Depth images by the protocol of the Active Vision Dataset: a grid of places, views in steps of 30 degrees."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray

from dpmjax.io.depth.camera import ACTIVE_VISION, Camera, sample_positions
from dpmjax.io.depth.depth_sequence import DepthSequence
from dpmjax.simulation.apartment.plan import Apartment, make_apartment
from dpmjax.simulation.apartment.ray_depth import cast_depth


@dataclass(frozen=True)
class GridWalkConfig:
    """How the camera travels (DeepMapping section 4.2).

    Attributes:
        grid_m: distance of neighbouring places.
        turn_deg: angle between neighbouring views.
        move_share: share of the steps that go to a neighbouring place; the others turn.
        clearance_m: places keep this distance from walls and furniture.
        height: rows of a cloud.
        width: columns of a cloud.
        max_depth_m: deeper pixels are masked.
        depth_noise_m: standard deviation of the depth at one metre; it grows with the square of the depth, as a
            structured-light camera's does.
    """

    grid_m: float = 0.3
    turn_deg: float = 30.0
    move_share: float = 0.5
    clearance_m: float = 0.2
    height: int = 27
    width: int = 48
    max_depth_m: float = 6.0
    depth_noise_m: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.move_share <= 1.0 or not min(self.grid_m, self.turn_deg) > 0.0 or self.depth_noise_m < 0.0:
            raise ValueError(f"expected a grid, a turn above 0, a share of 0 to 1 and noise of 0 or more, got {self}")


def simulate_depth_sequence(
    apartment: int | Apartment = 0,
    num_views: int = 16,
    *,
    seed: int = 0,
    config: GridWalkConfig | None = None,
    camera: Camera = ACTIVE_VISION,
) -> DepthSequence:
    """A random walk over the grid of an apartment, seen by a depth camera that looks level.

    Args:
        apartment: seed for `make_apartment`, or an apartment.
        num_views: 8 or 16 in the paper.
        seed: of walk and noise.
        config: of the walk; the paper's protocol where None.
        camera: whose rays are cast.

    Returns:
        The sequence; its motion is planar.

    Raises:
        ValueError: fewer than two views, or an apartment without free places.
    """
    if num_views < 2:
        raise ValueError(f"num_views: expected at least 2, got {num_views}")
    config = config or GridWalkConfig()
    home = apartment if isinstance(apartment, Apartment) else make_apartment(apartment)
    rng = np.random.default_rng([seed, 11])
    T_world_camera = _planar_to_matrices(_walk(home, num_views, config, rng))
    rows, columns = sample_positions(camera.height, config.height), sample_positions(camera.width, config.width)
    rays = camera.rays(columns.astype(np.float64), rows.astype(np.float64))
    # One capacity for all apartments, so that the caster compiles once.
    spare = -len(home.centres) % 32
    boxes = (np.pad(home.centres, ((0, spare), (0, 0))), np.pad(home.half_sizes, ((0, spare), (0, 0))))
    cast = jax.vmap(cast_depth, in_axes=(0, None, None, None, None))
    depth = np.asarray(cast(T_world_camera, rays, *boxes, np.pad(home.yaws, (0, spare))), np.float64)
    mask = np.isfinite(depth) & (depth <= config.max_depth_m) & (depth > 0.05)
    depth = np.where(mask, depth, 0.0)
    depth += config.depth_noise_m * depth**2 * rng.standard_normal(depth.shape)
    points = np.where(mask[..., None], rays * depth[..., None], 0.0).astype(np.float32)
    return DepthSequence(f"{home.name}, walk {seed}", points, mask, is_planar=True, T_world_camera=T_world_camera)


def _walk(home: Apartment, num_views: int, config: GridWalkConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    """(n, 3) x, z and angle about y: one step to a neighbouring place, or one turn, from view to view."""
    x, z = np.arange(0.0, home.size_x_m, config.grid_m), np.arange(0.0, home.size_z_m, config.grid_m)
    places = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1)
    is_free = home.is_free(places.reshape(-1, 2), config.clearance_m).reshape(places.shape[:2])
    free = np.argwhere(is_free)
    if len(free) == 0:
        raise ValueError(f"{home.name} has no free place with {config.clearance_m} m of clearance")
    at, view = free[rng.integers(len(free))], int(rng.integers(round(360.0 / config.turn_deg)))
    turn_sign = int(rng.choice([-1, 1]))
    poses = []
    for _ in range(num_views):
        poses.append([*places[tuple(at)], np.deg2rad(view * config.turn_deg)])
        neighbours = at + np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        inside = ((neighbours >= 0) & (neighbours < is_free.shape)).all(1)
        reachable = [n for n, ok in zip(neighbours, inside, strict=True) if ok and is_free[tuple(n)]]
        if reachable and rng.random() < config.move_share:
            at = reachable[rng.integers(len(reachable))]
        else:
            turn_sign = -turn_sign if rng.random() < 0.2 else turn_sign
            view += turn_sign
    return np.array(poses)


def _planar_to_matrices(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 4, 4) T_world_camera of x, z and the angle about y."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, 0, 0], T[:, 0, 2], T[:, 2, 0], T[:, 2, 2] = cos, sin, -sin, cos
    T[:, 0, 3], T[:, 2, 3] = poses[:, 0], poses[:, 1]
    return T
