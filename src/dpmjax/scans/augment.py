"""What training does to a scan, so that the network meets what it will meet: gaps, shadows, any attitude, noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dpmjax.geometry import rigid
from dpmjax.scans.occlusion import BoxConfig, SectorConfig, is_behind_boxes, is_behind_sectors
from dpmjax.scans.preprocess import farthest_first
from dpmjax.types import PointCloud


@dataclass(frozen=True)
class AugmentConfig:
    """How much is done (defaults: DeepPointMap's published configuration, the boxes aside).

    Attributes:
        max_drop_ratio: each scan loses a share of its points between 0 and this.
        sector_probability: of a scan being occluded by sectors.
        sectors: which ones.
        box_probability: of a scan being occluded by boxes.
        boxes: which ones.
        max_yaw_rad: rotation about z, to either side.
        max_tilt_rad: rotation about x and about y, to either side.
        translation_sigma_m: of x and y; half of it for z.
        jitter_sigma_m: noise of each coordinate.
        jitter_clip_sigmas: no noise is larger than this.
    """

    max_drop_ratio: float = 0.5
    sector_probability: float = 0.1
    sectors: SectorConfig = field(default_factory=SectorConfig)
    box_probability: float = 0.1
    boxes: BoxConfig = field(default_factory=BoxConfig)
    max_yaw_rad: float = math.pi
    max_tilt_rad: float = math.pi / 10
    translation_sigma_m: float = 3.0
    jitter_sigma_m: float = 0.005
    jitter_clip_sigmas: float = 3.0

    def __post_init__(self) -> None:
        for name in ("max_drop_ratio", "sector_probability", "box_probability"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: expected from 0 to 1, got {getattr(self, name)}")
        for name in ("max_yaw_rad", "max_tilt_rad", "translation_sigma_m", "jitter_sigma_m", "jitter_clip_sigmas"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected at least 0, got {getattr(self, name)}")


class AugmentedScan(NamedTuple):
    """A scan after augmentation.

    Attributes:
        cloud: in a frame of its own, metres; the valid point farthest from its origin stands first.
        T_augmented_lidar: the motion that was applied, (4, 4). So the pose of the new frame is
            `T_world_augmented = T_world_lidar @ rigid.inverse(T_augmented_lidar)`, and that of b in a is
            `T_augmented_lidar_a @ T_a_b @ rigid.inverse(T_augmented_lidar_b)`.
    """

    cloud: PointCloud
    T_augmented_lidar: Float[Array, "4 4"]


def augment_scan(cloud: PointCloud, config: AugmentConfig, *, key: PRNGKeyArray) -> AugmentedScan:
    """Random drop, random occlusion, random rigid motion and jitter, in this order (DeepPointMap section 3.3).

    For one scan; use `vmap` over clouds and keys for more, each of which then moves on its own. Whether two scans see
    the same place is to be asked of the true poses, before augmentation.

    Args:
        cloud: a preprocessed scan, metres, in the frame of the lidar.
        config: how much is done.
        key: used once.
    """
    drop_key, occlusion_key, motion_key, jitter_key = jax.random.split(key, 4)
    points = jnp.where(cloud.mask[:, None], cloud.points, 0)
    is_lost = _is_dropped(len(points), config, drop_key) | _is_occluded(points, config, occlusion_key)
    mask = cloud.mask & ~is_lost
    T_augmented_lidar = random_motion(config, key=motion_key).astype(points.dtype)
    noise = jnp.clip(
        jax.random.normal(jitter_key, points.shape, points.dtype), -config.jitter_clip_sigmas, config.jitter_clip_sigmas
    )
    points = rigid.transform_points(T_augmented_lidar, points) + config.jitter_sigma_m * noise
    return AugmentedScan(farthest_first(PointCloud(jnp.where(mask[:, None], points, 0), mask)), T_augmented_lidar)


def random_motion(config: AugmentConfig, *, key: PRNGKeyArray) -> Float[Array, "4 4"]:
    """A rotation Rx Ry Rz by uniform angles, and a normal translation."""
    angle_key, translation_key = jax.random.split(key)
    bounds = jnp.array([config.max_tilt_rad, config.max_tilt_rad, config.max_yaw_rad])
    roll, pitch, yaw = bounds * jax.random.uniform(angle_key, (3,), minval=-1, maxval=1)
    sigmas = config.translation_sigma_m * jnp.array([1, 1, 0.5])
    translation = sigmas * jax.random.normal(translation_key, (3,))
    (sx, sy, sz), (cx, cy, cz) = (f(jnp.stack([roll, pitch, yaw])) for f in (jnp.sin, jnp.cos))
    R = [  # the product of the three, written out: exact on devices with short matrix products
        [cy * cz, -cy * sz, sy],
        [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy],
        [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy],
    ]
    T = jnp.eye(4).at[:3, :3].set(jnp.stack([jnp.stack(row) for row in R]))
    return T.at[:3, 3].set(translation)


def _is_dropped(num_points: int, config: AugmentConfig, key: PRNGKeyArray) -> Bool[Array, " n"]:
    draws = jax.random.uniform(key, (num_points + 1,))
    return draws[1:] < draws[0] * config.max_drop_ratio


def _is_occluded(points: Float[Array, "n 3"], config: AugmentConfig, key: PRNGKeyArray) -> Bool[Array, " n"]:
    coin_key, sector_key, box_key = jax.random.split(key, 3)
    probabilities = jnp.array([config.sector_probability, config.box_probability])
    has_sectors, has_boxes = jax.random.uniform(coin_key, (2,)) < probabilities
    by_sectors = has_sectors & is_behind_sectors(points, config.sectors, key=sector_key)
    return by_sectors | (has_boxes & is_behind_boxes(points, config.boxes, key=box_key))
