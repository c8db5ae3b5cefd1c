"""What stands close to the sensor hides what lies behind it: random sectors and random boxes of shadow.

DeepPointMap section 3.3, "Random Occlusion": a vehicle nearby empties a large part of the scan. The paper tells of
boxes, its published configuration of azimuth sectors; here are both.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dpmjax.checks import require_count

Interval = tuple[float, float]


@dataclass(frozen=True)
class SectorConfig:
    """Azimuth sectors that are empty from some range on (defaults: DeepPointMap's published configuration).

    Attributes:
        max_count: from 1 to so many sectors, each number equally likely.
        width_deg: of the first sector; that of the i-th is divided by i.
        min_range_m: points of a sector that are farther than this are hidden.
    """

    max_count: int = 3
    width_deg: Interval = (10.0, 150.0)
    min_range_m: Interval = (2.0, 10.0)

    def __post_init__(self) -> None:
        require_count("max_count", self.max_count)
        require_interval("width_deg", self.width_deg)
        require_interval("min_range_m", self.min_range_m)


@dataclass(frozen=True)
class BoxConfig:
    """Upright boxes about the sensor, of the size of a car to that of a truck (the paper gives no numbers).

    Attributes:
        max_count: from 1 to so many boxes, each number equally likely.
        length_m: the longer side on the ground.
        width_m: the shorter side.
        height_m: from bottom to top.
        gap_m: free space between the sensor and the circle about the box.
        centre_z_m: of the box, in the frame of the lidar.
    """

    max_count: int = 3
    length_m: Interval = (2.0, 10.0)
    width_m: Interval = (0.5, 2.5)
    height_m: Interval = (1.0, 3.5)
    gap_m: Interval = (1.0, 10.0)
    centre_z_m: Interval = (-1.5, 0.5)

    def __post_init__(self) -> None:
        require_count("max_count", self.max_count)
        for name in ("length_m", "width_m", "height_m", "gap_m"):
            require_interval(name, getattr(self, name))
        if self.centre_z_m[0] > self.centre_z_m[1]:
            raise ValueError(f"centre_z_m: expected lower and upper bound, got {self.centre_z_m}")


def require_interval(name: str, interval: Interval) -> None:
    """Raises a ValueError where two bounds are not in order or below zero."""
    if not 0 <= interval[0] <= interval[1]:
        raise ValueError(f"{name}: expected 0 <= lower <= upper bound, got {interval}")


def is_behind_sectors(points: Float[Array, "n 3"], config: SectorConfig, *, key: PRNGKeyArray) -> Bool[Array, " n"]:
    """True for points in a random sector beyond its range; the sensor is the origin, z is up, metres."""
    draws = jax.random.uniform(key, (4, config.max_count))
    index = jnp.arange(1, config.max_count + 1)
    count = _count(draws[0, 0], config.max_count)
    width = jnp.deg2rad(_between(config.width_deg, draws[1])) / index
    start = _between((-jnp.pi, jnp.pi), draws[2])
    min_range = _between(config.min_range_m, draws[3])
    azimuth = jnp.arctan2(points[:, 1], points[:, 0])[:, None]
    is_in_sector = jnp.mod(azimuth - start, 2 * jnp.pi) <= width
    is_far = jnp.sum(points**2, axis=1)[:, None] > min_range**2
    return jnp.any(is_in_sector & is_far & (index <= count), axis=1)


def is_behind_boxes(points: Float[Array, "n 3"], config: BoxConfig, *, key: PRNGKeyArray) -> Bool[Array, " n"]:
    """True for points whose beam from the sensor, the origin, meets a random box; z is up, metres."""
    draws = jax.random.uniform(key, (8, config.max_count))
    count = _count(draws[0, 0], config.max_count)
    length = _between(config.length_m, draws[1])
    width = _between(config.width_m, draws[2])
    height = _between(config.height_m, draws[3])
    z = _between(config.centre_z_m, draws[4])
    azimuth = _between((-jnp.pi, jnp.pi), draws[5])
    heading = _between((-jnp.pi, jnp.pi), draws[6])
    # The gap keeps the sensor outside: from within a box, everything would be hidden.
    distance = _between(config.gap_m, draws[7]) + jnp.hypot(length, width) / 2
    centres = jnp.stack([distance * jnp.cos(azimuth), distance * jnp.sin(azimuth), z], axis=1)
    sizes = jnp.stack([length, width, height], axis=1)
    is_hidden = jax.vmap(is_behind_box, (None, 0, 0, 0))(points, centres, sizes, heading)
    return jnp.any(is_hidden & (jnp.arange(config.max_count) < count)[:, None], axis=0)


def is_behind_box(
    points: Float[Array, "n 3"], centre: Float[Array, " 3"], size: Float[Array, " 3"], heading: Float[Array, ""]
) -> Bool[Array, " n"]:
    """True for points whose segment to the origin meets one upright box (slab method).

    Args:
        points: in the frame of the sensor.
        centre: of the box, same frame.
        size: length, width and height.
        heading: of its length, radians about z.
    """
    cos, sin = jnp.cos(heading), jnp.sin(heading)

    def turn(vectors: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
        return jnp.stack([cos * x + sin * y, cos * y - sin * x, z], axis=-1)

    direction, origin = turn(points), -turn(centre)
    # A beam along a slab never crosses its planes: a tiny slope stands in for none, and both crossings are far away.
    tiny = jnp.finfo(points.dtype).eps
    slope = jnp.where(jnp.abs(direction) < tiny, tiny, direction)
    crossings = jnp.stack([(-size / 2 - origin) / slope, (size / 2 - origin) / slope])
    enters = jnp.max(jnp.min(crossings, axis=0), axis=1)
    leaves = jnp.min(jnp.max(crossings, axis=0), axis=1)
    return (enters <= leaves) & (leaves >= 0) & (enters <= 1)


def _between(bounds: Interval, draws: Float[Array, " c"]) -> Float[Array, " c"]:
    """Uniform draws in [0, 1) stretched to the bounds."""
    return bounds[0] + (bounds[1] - bounds[0]) * draws


def _count(draw: Float[Array, ""], max_count: int) -> Array:
    return 1 + jnp.floor(draw * max_count).astype(jnp.int32)
