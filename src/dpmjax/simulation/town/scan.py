"""Lidars, and one turn of a lidar in the town: rays, hits, noise and lost returns.

A scan is pure and jitted; `vmap` it over poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Array, Float, PRNGKeyArray

from dpmjax.checks import require_fields, require_shape, require_value
from dpmjax.geometry import rigid
from dpmjax.simulation.town.cast import Hits, NearWorld, Rays, cast_turn, near_world
from dpmjax.simulation.town.primitives import NOTHING, TownPrimitives
from dpmjax.types import AnyArray, PointCloud

# Reflectivity of each surface (nothing, ground, solid, soft, pole, moving): asphalt is dark, leaves and paint are not.
_REFLECTIVITY = np.array([0.0, 0.17, 0.35, 0.4, 0.35, 0.3], np.float32)
# Roughness of each surface, for shutters, plaster and paintwork.
_ROUGHNESS_M = np.array([0.0, 0.0, 0.025, 0.0, 0.01, 0.02], np.float32)
# Least and largest step in range that the length of a pulse can mix, m.
_EDGE_M = (0.2, 2.5)


@dataclass(frozen=True)
class LidarSensor:
    """A spinning lidar: one column of beams that turns about z.

    Hashable, so that it can be a static argument of a kernel.

    Attributes:
        name: name for titles and files.
        elevations_deg: angle of each beam above the horizontal, highest first.
        num_azimuths: number of columns of a turn, clockwise from straight behind, as in a range image.
        min_range_m: smallest range of a return.
        max_range_m: largest range of a return.
        range_noise_m: standard deviation of a range.
        drop_rate: share of lost returns at any range.
        half_loss_m: range at which half of the returns of a surface of 20 % reflectivity, met head-on, are lost.
        height_m: mounting height above the ground, for drives.
        beam_bias_m: standard deviation of the constant range errors of the beams after calibration.
        mixed_rate: share of the beams on an edge that return a range between foreground and background.
        view_deg: width of the view around straight ahead; less than 360 for a lidar that does not spin.

    Raises:
        ValueError: no beams, fewer than 8 columns, ranges that are not 0 <= min < max, or no view.
    """

    name: str
    elevations_deg: tuple[float, ...]
    num_azimuths: int
    min_range_m: float = 1.0
    max_range_m: float = 100.0
    range_noise_m: float = 0.02
    drop_rate: float = 0.03
    half_loss_m: float = 75.0
    height_m: float = 1.73
    beam_bias_m: float = 0.01
    mixed_rate: float = 0.25
    view_deg: float = 360.0

    def __post_init__(self) -> None:
        require_value(self.elevations_deg, "elevations_deg", "at least one beam", "none")
        require_fields(self, "num_azimuths", low=8)
        low, high = self.min_range_m, self.max_range_m
        require_value(0 <= low < high, "min_range_m, max_range_m", "0 <= min < max", f"{low} and {high}")
        require_value(0 < self.view_deg <= 360, "view_deg", "above 0 and at most 360", self.view_deg)

    @property
    def num_rays(self) -> int:
        """Number of rays of a turn."""
        return len(self.elevations_deg) * self.num_azimuths

    def with_azimuths(self, num_azimuths: int) -> LidarSensor:
        """Returns the same sensor with another number of columns."""
        return replace(self, num_azimuths=num_azimuths)


def _spread(top_deg: float, bottom_deg: float, count: int) -> tuple[float, ...]:
    return tuple(float(v) for v in np.linspace(top_deg, bottom_deg, count))


# Velodyne's manual: 32 lasers a third of a degree apart, and 32 below them half a degree apart (as on KITTI's car).
HDL64E = LidarSensor(
    "hdl64e", _spread(2.0, -8.33, 32) + _spread(-8.83, -24.33, 32), 1800, max_range_m=80.0, beam_bias_m=0.025
)
# Ouster OS1-64 of the first generation, as on MulRan's car.
OS1_64 = LidarSensor("os1_64", _spread(16.6, -16.6, 64), 1024, range_noise_m=0.03, half_loss_m=60.0, height_m=1.85)
# The same with 128 beams, and a wider view.
OS1_128 = LidarSensor("os1_128", _spread(22.5, -22.5, 128), 1024, range_noise_m=0.03, half_loss_m=70.0, height_m=1.85)
# Hesai's manual: most beams a sixth of a degree apart around the horizontal (as on PandaSet's car).
_PANDAR64_DEG = (15.0, 11.0, 8.0, 5.0, 3.0, *_spread(2.0, -6.0, 49), *_spread(-7.0, -14.0, 8), -19.0, -25.0)
PANDAR64 = LidarSensor("pandar64", _PANDAR64_DEG, 1800, half_loss_m=110.0, height_m=1.9)
HDL32E = LidarSensor("hdl32e", _spread(10.67, -30.67, 32), 1080, max_range_m=80.0, height_m=1.84)
VLP16 = LidarSensor("vlp16", _spread(15.0, -15.0, 16), 1800, range_noise_m=0.03)
# A lidar that does not spin: RoboSense's M1 by its data sheet, every other line.
SOLID_STATE = LidarSensor("solid_state", _spread(12.5, -12.5, 64), 1800, half_loss_m=110.0, view_deg=120.0)


def scan_town(
    town: TownPrimitives,
    T_world_lidar: AnyArray,
    time: AnyArray | float,
    *,
    key: PRNGKeyArray,
    sensor: LidarSensor,
    motion: AnyArray | None = None,
) -> PointCloud:
    """Simulates one scan.

    Ranges have Gaussian noise; beams on an edge may mix both ranges; returns are lost with distance, dark surface and
    grazing angle, behind glass, and at random. The kernel of the rays compiles once for each sensor.

    Args:
        town: the world, from `make_town` or `make_interior`.
        T_world_lidar: (4, 4) pose of the sensor in the middle of its turn, x forward, y left, z up.
        time: time of the traffic, s.
        key: key of noise, lost returns and foliage.
        sensor: the lidar.
        motion: (6,) twist of the sensor during one turn (m, radians; see `geometry.rigid.exp`), in its own frame.
            Points stay in the frame of the moment of their beam, as in a raw scan. None for a sensor that stands still.

    Returns:
        (b, 3) points in the sensor frame, m, with b = beams times azimuths. Their order is beam by beam from the
        highest down, each clockwise from straight behind. They are masked, and zero, where no return came back.

    Raises:
        ValueError: the pose is not (4, 4), or the motion not (6,).
    """
    pose, time = jnp.asarray(T_world_lidar, jnp.float32), jnp.asarray(time, jnp.float32)
    twist = jnp.zeros(6) if motion is None else jnp.asarray(motion, jnp.float32)
    require_shape("T_world_lidar", pose, (4, 4))
    require_shape("motion", twist, (6,))
    near = near_world(town, pose[:3, 3], time, max_range=sensor.max_range_m)
    return _scan_near(near, pose, twist, key=key, sensor=sensor)


@partial(jax.jit, static_argnames="sensor")
def _scan_near(near: NearWorld, pose: Array, twist: Array, *, key: PRNGKeyArray, sensor: LidarSensor) -> PointCloud:
    key_phase, key_rays = jax.random.split(key)
    phase = jax.random.uniform(key_phase, (), minval=0.0, maxval=2 * np.pi / sensor.num_azimuths)
    # One draw for all, because each separate draw would take a second to compile.
    depth, noise, loss, mix, part = jax.random.uniform(key_rays, (5, sensor.num_rays), minval=1e-6, maxval=1.0)
    rays = make_rays(sensor, phase, twist)
    rays = rays._replace(depths=-jnp.log(depth).reshape(rays.depths.shape))
    hits = cast_turn(near, pose, rays, max_range=sensor.max_range_m)
    probability = _by_beam(_return_probability(hits, sensor), sensor)
    directions = _by_beam(rays.directions, sensor)
    ranges = _mix_edges(_by_beam(hits.ranges, sensor), sensor, mix, part)
    rough = jnp.asarray(_ROUGHNESS_M)[_by_beam(hits.surfaces, sensor)]
    # The constant range error of each beam is the same in every scan.
    biases = np.random.default_rng(8152).normal(size=len(sensor.elevations_deg)).astype(np.float32)
    bias = np.repeat(np.float32(sensor.beam_bias_m) * biases, sensor.num_azimuths)
    ranges += jnp.sqrt(sensor.range_noise_m**2 + rough**2) * ndtri(noise) + bias
    azimuths_deg = 180 - 360 / sensor.num_azimuths * (np.arange(sensor.num_azimuths) + 0.5)
    is_in_view = np.tile(np.abs(azimuths_deg) <= 0.5 * sensor.view_deg, len(sensor.elevations_deg))
    mask = (loss < probability) & is_in_view & (ranges >= sensor.min_range_m) & (ranges <= sensor.max_range_m)
    return PointCloud(points=jnp.where(mask[:, None], ranges[:, None] * directions, 0.0), mask=mask)


def _mix_edges(ranges: Float[Array, " b"], sensor: LidarSensor, choice: Array, part: Array) -> Float[Array, " b"]:
    """Mixes foreground and background ranges of beams beside an edge; `choice` and `part` are uniform draws."""
    grid = ranges.reshape(-1, sensor.num_azimuths)
    gap = jnp.roll(grid, 1, axis=1) - grid
    is_edge = (jnp.abs(gap) > _EDGE_M[0]) & (jnp.abs(gap) < _EDGE_M[1])
    is_mixed = is_edge.reshape(-1) & (choice < sensor.mixed_rate)
    return jnp.where(is_mixed, ranges + part * gap.reshape(-1), ranges)


def make_rays(sensor: LidarSensor, phase: Float[Array, ""], motion: Float[Array, " 6"]) -> Rays:
    """Makes the rays of a turn, by sectors of whole columns; foliage is hit at its surface.

    Args:
        sensor: the lidar.
        phase: offset of the azimuths to the left, radians.
        motion: twist of the sensor during the turn, in its own frame.

    Returns:
        The rays, in the sensor frame.
    """
    num_beams = len(sensor.elevations_deg)
    # Sectors of whole columns, and bands of whole beams.
    num_sectors = max(count for count in range(1, 73) if sensor.num_azimuths % count == 0)
    num_bands = 2 if num_beams % 2 == 0 else 1
    step = 2 * np.pi / sensor.num_azimuths
    # Clockwise from straight behind.
    columns = (np.pi - step * (np.arange(sensor.num_azimuths) + 0.5)).astype(np.float32)
    columns = columns.reshape(num_sectors, -1)
    elevation = np.radians(np.array(sensor.elevations_deg, np.float32))
    # Each band holds neighbouring beams.
    elevation = np.broadcast_to(
        elevation.reshape(num_bands, 1, -1), (num_bands, columns.shape[1], num_beams // num_bands)
    )
    flat, up = jnp.cos(elevation), jnp.sin(elevation)
    azimuth = (phase + jnp.asarray(columns))[:, None, :, None]
    rays = jnp.stack(jnp.broadcast_arrays(flat * jnp.cos(azimuth), flat * jnp.sin(azimuth), up), axis=-1)
    moments = (np.arange(num_sectors, dtype=np.float32) + 0.5) / num_sectors - 0.5
    T_lidar_sector = rigid.exp(jnp.asarray(moments)[:, None] * motion)
    return Rays(rays, phase + jnp.asarray(columns.mean(axis=1)), jnp.zeros(rays.shape[:-1]), T_lidar_sector)


def _return_probability(hits: Hits, sensor: LidarSensor) -> Float[Array, "s g c b"]:
    """Computes the probability of a return of each ray; 0 without a hit."""
    # Half of the returns are lost at `half_loss_m`, scaled by the root of the reflectivity (the energy falls with the
    # square of the range) and by the fourth root of the cosine, because rough asphalt is visible farther than a smooth
    # surface.
    reflectivity = jnp.asarray(_REFLECTIVITY)[hits.surfaces]
    half_loss = sensor.half_loss_m * jnp.sqrt(reflectivity / 0.2) * jnp.maximum(hits.cosines, 1e-4) ** 0.25
    excess = jnp.log(jnp.maximum(half_loss, 1e-3)) - jnp.log(jnp.minimum(hits.ranges, 1e6))
    is_hit = hits.surfaces != NOTHING
    base = (1.0 - sensor.drop_rate) * jnp.where(hits.is_glass, 0.35, 1.0)
    return jnp.where(is_hit, base * jax.nn.sigmoid(excess / 0.18), 0.0)


def _by_beam(values: Array, sensor: LidarSensor) -> Array:
    """Reorders values (s, g, c, b, ...) by sector and band beam by beam, as points: (beams * azimuths, ...)."""
    order = (1, 3, 0, 2, *range(4, values.ndim))
    return jnp.transpose(values, order).reshape(sensor.num_rays, *values.shape[4:])
