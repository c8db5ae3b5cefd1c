"""One turn of a lidar in the town: rays, hits, noise and lost returns. Pure and jitted; `vmap` it over poses."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dpmjax.checks import require_shape
from dpmjax.simulation.town import cast
from dpmjax.simulation.town.cast import CastConfig, Hits, cast_turn, num_sectors
from dpmjax.simulation.town.primitives import TownPrimitives
from dpmjax.simulation.town.sensors import LidarSensor
from dpmjax.types import AnyArray, PointCloud

_HIGHEST = jax.lax.Precision.HIGHEST
# Reflectivity of each surface (nothing, ground, solid, soft, pole, moving): asphalt is dark, leaves and paint are not.
_REFLECTIVITY = np.array([0.0, 0.17, 0.35, 0.4, 0.35, 0.3], np.float32)
_GLASS_RETURNS = 0.35
# How sharply returns end at the sensor's reach, in natural logarithms of range.
_FADE = 0.18


def scan_town(
    town: TownPrimitives,
    T_world_lidar: AnyArray,
    time: AnyArray | float,
    *,
    key: PRNGKeyArray,
    sensor: LidarSensor,
    config: CastConfig = CastConfig(),  # noqa: B008 (frozen)
) -> PointCloud:
    """Takes one scan.

    The sensor stands still during its turn. Ranges carry Gaussian noise; returns are lost with distance, dark surface
    and grazing angle, behind glass, and at random.

    Args:
        town: the world, from `make_town`.
        T_world_lidar: (4, 4) pose of the sensor, x forward, y left, z up.
        time: s, moves the traffic.
        key: of noise, lost returns and foliage.
        sensor: the lidar.
        config: capacities of the ray caster.

    Returns:
        (b, 3) points in the sensor frame, m, with b = beams times azimuths: beam by beam from the highest down, each
        clockwise from straight behind; masked where nothing came back (points there are zero).

    Raises:
        ValueError: the pose is not (4, 4).
    """
    pose = jnp.asarray(T_world_lidar, jnp.float32)
    require_shape("T_world_lidar", pose, (4, 4))
    return _scan(town, pose, jnp.asarray(time, jnp.float32), key, sensor=sensor, config=config)


@partial(jax.jit, static_argnames=("sensor", "config"))
def _scan(
    town: TownPrimitives,
    pose: Float[Array, "4 4"],
    time: Float[Array, ""],
    key: PRNGKeyArray,
    *,
    sensor: LidarSensor,
    config: CastConfig,
) -> PointCloud:
    """The kernel of `scan_town`."""
    key_phase, key_depth, key_noise, key_loss = jax.random.split(key, 4)
    shape = ray_shape(sensor, config)
    phase = jax.random.uniform(key_phase, (), minval=0.0, maxval=2 * np.pi / sensor.num_azimuths)
    rays = ray_directions(sensor, config, phase)
    depths = -jnp.log(jax.random.uniform(key_depth, shape, minval=1e-6, maxval=1.0))
    hits = cast_rays_3d(town, pose, time, rays, phase, depths, sensor=sensor, config=config)
    ranges = hits.ranges + sensor.range_noise_m * jax.random.normal(key_noise, shape)
    is_back = jax.random.uniform(key_loss, shape) < return_probability(hits, sensor)
    mask = is_back & (ranges >= sensor.min_range_m) & (ranges <= sensor.max_range_m)
    points = jnp.where(mask[..., None], ranges[..., None] * rays, 0.0)
    return PointCloud(points=by_beam(points, sensor), mask=by_beam(mask, sensor))


def ray_shape(sensor: LidarSensor, config: CastConfig) -> tuple[int, int]:
    """Sectors, and rays of a sector.

    Args:
        sensor: the lidar.
        config: capacities.

    Returns:
        The shape in which rays are followed.
    """
    count = num_sectors(sensor.num_azimuths, config.max_sectors)
    return count, sensor.num_rays // count


def ray_directions(sensor: LidarSensor, config: CastConfig, phase: Float[Array, ""]) -> Float[Array, "s r 3"]:
    """Unit directions of the rays in the sensor frame, by sector.

    Args:
        sensor: the lidar.
        config: capacities.
        phase: by how much the turn is turned to the left, radians.

    Returns:
        The directions; a sector holds whole columns.
    """
    count = ray_shape(sensor, config)[0]
    azimuth = phase + jnp.asarray(_azimuths(sensor).reshape(count, -1, 1))
    elevation = np.radians(np.array(sensor.elevations_deg, np.float32))
    flat, up = jnp.cos(elevation), jnp.sin(elevation)
    columns = jnp.broadcast_to(azimuth, (*azimuth.shape[:2], len(elevation)))
    rays = jnp.stack([flat * jnp.cos(columns), flat * jnp.sin(columns), jnp.broadcast_to(up, columns.shape)], axis=-1)
    return rays.reshape(count, -1, 3)


def cast_rays_3d(
    town: TownPrimitives,
    T_world_lidar: Float[Array, "4 4"],
    time: Float[Array, ""],
    rays: Float[Array, "s r 3"],
    phase: Float[Array, ""],
    depths: Float[Array, "s r"],
    *,
    sensor: LidarSensor,
    config: CastConfig,
) -> Hits:
    """What the rays of a turn meet, without noise and loss.

    Args:
        town: the world.
        T_world_lidar: pose of the sensor.
        time: s.
        rays: from `ray_directions`.
        phase: the same as there.
        depths: for each ray, how many mean ways it goes into foliage.
        sensor: the lidar.
        config: capacities.

    Returns:
        The hits, by sector.
    """
    count = rays.shape[0]
    middles = phase + jnp.asarray(_azimuths(sensor).reshape(count, -1).mean(axis=1))
    directions = jnp.einsum("ij,srj->sri", T_world_lidar[:3, :3], rays, precision=_HIGHEST)
    return cast_turn(
        town,
        T_world_lidar,
        time,
        directions,
        middles,
        np.pi / count,
        depths,
        max_range=sensor.max_range_m,
        config=config,
    )


def return_probability(hits: Hits, sensor: LidarSensor) -> Float[Array, "s r"]:
    """Probability that a ray comes back.

    Half of the returns are lost at `reach_m`, scaled by the root of the reflectivity (the energy falls with the square
    of the range) and by the fourth root of the cosine: real surfaces are rough, and asphalt is seen farther than a
    smooth one would be.

    Args:
        hits: what the rays meet.
        sensor: the lidar.

    Returns:
        Probabilities; 0 for nothing.
    """
    reflectivity = jnp.asarray(_REFLECTIVITY)[hits.surfaces]
    reach = sensor.reach_m * jnp.sqrt(reflectivity / 0.2) * jnp.maximum(hits.cosines, 1e-4) ** 0.25
    excess = jnp.log(jnp.maximum(reach, 1e-3)) - jnp.log(jnp.minimum(hits.ranges, 1e6))
    is_hit = hits.surfaces != cast.NOTHING
    base = (1.0 - sensor.drop_rate) * jnp.where(hits.is_glass, _GLASS_RETURNS, 1.0)
    return jnp.where(is_hit, base * jax.nn.sigmoid(excess / _FADE), 0.0)


def by_beam(values: Array, sensor: LidarSensor) -> Array:
    """Rays by sector (s, r, ...) brought into the order of points: beam by beam.

    Args:
        values: anything by ray.
        sensor: the lidar.

    Returns:
        (beams * azimuths, ...).
    """
    tail = values.shape[2:]
    grid = values.reshape(sensor.num_azimuths, len(sensor.elevations_deg), *tail)
    return jnp.swapaxes(grid, 0, 1).reshape(sensor.num_rays, *tail)


def range_image(cloud: PointCloud, sensor: LidarSensor) -> tuple[Float[Array, "beams a"], Bool[Array, "beams a"]]:
    """Ranges of a simulated scan as a picture: highest beam on top, straight ahead in the middle.

    Args:
        cloud: from `scan_town`.
        sensor: the lidar that took it.

    Returns:
        Ranges in m (0 where nothing came back), and where something did.
    """
    shape = (len(sensor.elevations_deg), sensor.num_azimuths)
    return jnp.linalg.norm(cloud.points, axis=-1).reshape(shape), jnp.asarray(cloud.mask).reshape(shape)


def _azimuths(sensor: LidarSensor) -> np.ndarray:
    """Middle of each column, radians: clockwise from straight behind."""
    step = 2 * np.pi / sensor.num_azimuths
    return (np.pi - step * (np.arange(sensor.num_azimuths) + 0.5)).astype(np.float32)
