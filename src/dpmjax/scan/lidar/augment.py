"""Augmentation for training: random gaps, shadows of near objects, any attitude, noise (DeepPointMap section 3.3).

A vehicle nearby empties a large part of a scan ("Random Occlusion"). The paper describes boxes, its published
configuration uses azimuth sectors; both are here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dpmjax.geometry import rigid
from dpmjax.geometry.bearing import to_ray_frame
from dpmjax.geometry.rigid import namespace_of
from dpmjax.scan.lidar.preprocess import farthest_first
from dpmjax.types import AnyArray, PointCloud, Poses

# Lower and upper bound of a uniform draw.
Interval = tuple[float, float]

# Largest number of azimuth sectors that are empty beyond some range; all numbers from 1 on are equally likely.
MAX_SECTORS = 3

# Width of the first sector; the width of the i-th sector is divided by i (DeepPointMap's published configuration).
SECTOR_WIDTH_DEG = (10.0, 150.0)

# Range beyond which a sector hides its points (DeepPointMap's published configuration).
SECTOR_MIN_RANGE_M = (2.0, 10.0)

# Largest number of upright boxes around the sensor, from the size of a car to that of a truck; the paper has no
# numbers.
MAX_BOXES = 3

# Free space between the sensor and the circle around a box.
BOX_GAP_M = (1.0, 10.0)

# Height of the centre of the box, in the frame of the lidar.
BOX_CENTRE_Z_M = (-1.5, 0.5)

# Height of the box.
BOX_HEIGHT_M = (1.0, 3.5)

# Shorter side on the ground.
BOX_WIDTH_M = (0.5, 2.5)

# Longer side on the ground.
BOX_LENGTH_M = (2.0, 10.0)

# Bounds of the number of points that a sparse scan keeps at most, uniform in its logarithm.
SPARSE_POINTS = (300.0, 20000.0)

# The noise is clipped at this many standard deviations.
JITTER_CLIP_SIGMAS = 3.0

TURN = (-math.pi, math.pi)


@dataclass(frozen=True)
class AugmentConfig:
    """Strength of the augmentation (defaults: DeepPointMap section 3.3 and its published configuration).

    Attributes:
        max_drop_ratio: largest share of points that a scan loses; the share is uniform from 0 to this.
        sparse_probability: probability that a scan is thinned further, as by a lidar of few beams.
        sector_probability: probability that sectors occlude a scan, as in the published program. A scan has sectors or
            boxes, never both.
        box_probability: probability that boxes occlude a scan, as in the paper.
        max_yaw_rad: largest rotation about z, to either side.
        max_tilt_rad: largest rotation about x and about y, to either side.
        tilt_power: exponent of the uniform number of a tilt; above 1, most scans stand upright.
        translation_sigma_m: standard deviation of the translation in x and y; half of it in z.
        jitter_sigma_m: standard deviation of the noise of each coordinate.
    """

    max_drop_ratio: float = 0.5
    sparse_probability: float = 0.0
    sector_probability: float = 0.0
    box_probability: float = 0.1
    max_yaw_rad: float = math.pi
    max_tilt_rad: float = math.pi / 10
    tilt_power: float = 1.0
    translation_sigma_m: float = 3.0
    jitter_sigma_m: float = 0.005


class AugmentedScan(NamedTuple):
    """A scan after augmentation.

    Attributes:
        cloud: the points in a new frame, metres; the valid point farthest from the origin stands first.
        T_augmented_lidar: the motion that was applied, (4, 4). The pose of the new frame is
            `T_world_augmented = T_world_lidar @ rigid.inverse(T_augmented_lidar)`, and the pose of b in a is
            `T_augmented_lidar_a @ T_a_b @ rigid.inverse(T_augmented_lidar_b)`.
    """

    cloud: PointCloud
    T_augmented_lidar: Float[Array, "4 4"]


def augment_scan(cloud: PointCloud, config: AugmentConfig, *, key: PRNGKeyArray) -> AugmentedScan:
    """Drops points, occludes, moves and jitters one scan, in this order (DeepPointMap section 3.3).

    Use `vmap` over clouds and keys for several scans; each then gets a motion of its own. The overlap of two
    scans follows from their true poses before augmentation.

    Args:
        cloud: a preprocessed scan, metres, in the frame of the lidar.
        config: strength of the augmentation.
        key: used once.

    Returns:
        The scan and the motion that was applied to it.
    """
    drop_key, occlusion_key, motion_key, jitter_key = jax.random.split(key, 4)
    points = jnp.where(cloud.mask[:, None], cloud.points, 0)
    is_lost = _is_dropped(cloud.mask, config, drop_key) | _is_occluded(points, config, occlusion_key)
    mask = cloud.mask & ~is_lost
    T_augmented_lidar = random_motion(config, key=motion_key).astype(points.dtype)
    noise, limit = jax.random.normal(jitter_key, points.shape, points.dtype), JITTER_CLIP_SIGMAS
    points = rigid.transform_points(T_augmented_lidar, points) + config.jitter_sigma_m * jnp.clip(noise, -limit, limit)
    return AugmentedScan(farthest_first(PointCloud(jnp.where(mask[:, None], points, 0), mask)), T_augmented_lidar)


def random_motion(config: AugmentConfig, *, key: PRNGKeyArray) -> Float[Array, "4 4"]:
    """Draws a rotation Rx Ry Rz by uniform angles, and a normal translation.

    Args:
        config: bounds of the angles and sigma of the translation.
        key: used once.

    Returns:
        A homogeneous matrix (4, 4), metres.
    """
    angle_key, translation_key = jax.random.split(key)
    angles = jax.random.uniform(angle_key, (3,), minval=-1, maxval=1)
    return _motion(angles, jax.random.normal(translation_key, (3,)), config)


def random_motions_on_host(config: AugmentConfig, num: int, rng: np.random.Generator) -> Poses:
    """Draws motions as `random_motion` does, in NumPy.

    Args:
        config: bounds of the angles and sigma of the translation.
        num: number of motions.
        rng: source of the draws.

    Returns:
        Homogeneous matrices (s, 4, 4) in float64, metres.
    """
    return np.asarray(_motion(rng.uniform(-1, 1, (num, 3)), rng.normal(size=(num, 3)), config))


def _motion(angles: AnyArray, translation: AnyArray, config: AugmentConfig) -> Any:
    # From uniform and normal numbers (..., 3), of NumPy or of JAX.
    xp = namespace_of(angles)
    power = xp.array([config.tilt_power, config.tilt_power, 1.0])
    angles = xp.sign(angles) * xp.abs(angles) ** power
    angles = angles * xp.array([config.max_tilt_rad, config.max_tilt_rad, config.max_yaw_rad])
    translation = translation * config.translation_sigma_m * xp.array([1, 1, 0.5])
    (sx, sy, sz), (cx, cy, cz) = (xp.moveaxis(f(angles), -1, 0) for f in (xp.sin, xp.cos))
    x, y, z = xp.moveaxis(translation, -1, 0)
    zero, one = xp.zeros_like(x), xp.ones_like(x)
    T = [  # the product of the three, written out: exact on devices with short matrix products
        [cy * cz, -cy * sz, sy, x],
        [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy, y],
        [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy, z],
        [zero, zero, zero, one],
    ]
    return xp.stack([xp.stack(row, axis=-1) for row in T], axis=-2)


def _is_dropped(mask: Bool[AnyArray, " n"], config: AugmentConfig, key: PRNGKeyArray) -> Bool[Array, " n"]:
    draws = jax.random.uniform(key, (len(mask) + 1,))
    kept = 1 - draws[0] * config.max_drop_ratio
    coin, place = jax.random.uniform(jax.random.fold_in(key, 1), (2,))
    low, high = jnp.log(jnp.array(SPARSE_POINTS))
    share = jnp.exp(low + place * (high - low)) / jnp.maximum(jnp.sum(mask) * kept, 1)
    kept *= jnp.where(coin < config.sparse_probability, jnp.minimum(share, 1), 1)
    return draws[1:] < 1 - kept


def _is_occluded(points: Float[Array, "n 3"], config: AugmentConfig, key: PRNGKeyArray) -> Bool[Array, " n"]:
    coin_key, sector_key, box_key = jax.random.split(key, 3)
    coin = jax.random.uniform(coin_key)
    has_sectors = coin < config.sector_probability
    has_boxes = ~has_sectors & (coin < config.sector_probability + config.box_probability)
    by_sectors = has_sectors & is_behind_sectors(points, key=sector_key)
    return by_sectors | (has_boxes & is_behind_boxes(points, key=box_key))


def is_behind_sectors(points: Float[AnyArray, "n 3"], *, key: PRNGKeyArray) -> Bool[Array, " n"]:
    """Returns True for points in a random sector beyond its range; metres, in the frame of the sensor, z up."""
    draws, index = jax.random.uniform(key, (4, MAX_SECTORS)), jnp.arange(1, MAX_SECTORS + 1)
    count = _count(draws[0, 0], MAX_SECTORS)
    width_deg, start, min_range = _between((SECTOR_WIDTH_DEG, TURN, SECTOR_MIN_RANGE_M), draws[1:])
    width = jnp.deg2rad(width_deg) / index
    azimuth = jnp.arctan2(points[:, 1], points[:, 0])[:, None]
    is_in_sector = jnp.mod(azimuth - start, 2 * jnp.pi) <= width
    is_far = jnp.sum(points**2, axis=1)[:, None] > min_range**2
    return jnp.any(is_in_sector & is_far & (index <= count), axis=1)


def is_behind_boxes(points: Float[AnyArray, "n 3"], *, key: PRNGKeyArray) -> Bool[Array, " n"]:
    """Returns True for points that a random box hides; metres, in the frame of the sensor, z up."""
    draws = jax.random.uniform(key, (8, MAX_BOXES))
    count = _count(draws[0, 0], MAX_BOXES)
    bounds = (BOX_LENGTH_M, BOX_WIDTH_M, BOX_HEIGHT_M, BOX_CENTRE_Z_M, TURN, TURN, BOX_GAP_M)
    length, width, height, z, azimuth, heading, gap = _between(bounds, draws[1:])
    # The gap keeps the sensor outside of the box: inside, everything would be hidden.
    distance = gap + jnp.hypot(length, width) / 2
    centres = jnp.stack([distance * jnp.cos(azimuth), distance * jnp.sin(azimuth), z], axis=1)
    sizes = jnp.stack([length, width, height], axis=1)
    is_hidden = jax.vmap(is_behind_box, (None, 0, 0, 0))(points, centres, sizes, heading)
    return jnp.any(is_hidden & (jnp.arange(MAX_BOXES) < count)[:, None], axis=0)


def is_behind_box(
    points: Float[AnyArray, "n 3"], centre: Float[AnyArray, " 3"], size: Float[AnyArray, " 3"], heading: jax.Array
) -> Bool[Array, " n"]:
    """Finds the points whose segment to the origin meets one upright box (slab method).

    Args:
        points: metres, in the frame of the sensor.
        centre: centre of the box, same frame.
        size: length, width and height of the box.
        heading: direction of the length, radians about z.

    Returns:
        True for hidden points.
    """
    along = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    direction, origin = to_ray_frame(points, along), -to_ray_frame(centre, along)
    # A beam parallel to a slab never crosses its planes; with a tiny slope, both crossings are far away.
    tiny = jnp.finfo(points.dtype).eps
    slope = jnp.where(jnp.abs(direction) < tiny, tiny, direction)
    crossings = jnp.stack([(-size / 2 - origin) / slope, (size / 2 - origin) / slope])
    enters = jnp.max(jnp.min(crossings, axis=0), axis=1)
    leaves = jnp.min(jnp.max(crossings, axis=0), axis=1)
    return (enters <= leaves) & (leaves >= 0) & (enters <= 1)


def _between(bounds: tuple[Interval, ...], draws: Float[Array, "k c"]) -> Float[Array, "k c"]:
    low, high = jnp.array(bounds).T[..., None]
    return low + (high - low) * draws


def _count(draw: Float[Array, ""], max_count: int) -> Array:
    return 1 + jnp.floor(draw * max_count).astype(jnp.int32)
