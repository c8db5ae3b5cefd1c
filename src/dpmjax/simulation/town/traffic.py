"""Where cars and people are at a time: boxes on lanes."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dpmjax.simulation.town.primitives import LANE_STEP_M, Boxes, Traffic

# Who comes nearer to the sensor than this is left out: the sensor's own car is there.
_CLEARANCE_M = 4.0
_CAR_IS_LONGER_THAN_M = 0.5


def traffic_boxes(traffic: Traffic, sensor: Float[Array, " 3"], time: Float[Array, ""]) -> Boxes:
    """The road users at a time.

    Args:
        traffic: lanes and users.
        sensor: position of the sensor in the world, m; who is within 4 m of it is left out.
        time: s.

    Returns:
        Two boxes for each: body and cabin (masked for people).
    """
    way = jnp.mod(traffic.starts + traffic.speeds * time, traffic.lane_lengths[traffic.lanes])
    here, ahead = _on_lane(traffic, way), _on_lane(traffic, way + 0.5 * LANE_STEP_M)
    heading = ahead[:, :2] - here[:, :2]
    heading = heading / jnp.maximum(jnp.linalg.norm(heading, axis=-1, keepdims=True), 1e-6)
    left = jnp.stack([-heading[:, 1], heading[:, 0], jnp.zeros(len(heading))], axis=-1)
    foot = here + traffic.sides[:, None] * left
    is_free = ((foot[:, :2] - sensor[:2]) ** 2).sum(-1) > _CLEARANCE_M**2
    is_car = traffic.half_sizes[:, 0] > _CAR_IS_LONGER_THAN_M
    body_z, cabin_z = car_levels(traffic.half_sizes[:, 2])
    half_body = jnp.where(is_car, body_z, traffic.half_sizes[:, 2])
    lift = jnp.where(is_car, 0.25, 0.0)
    up = jnp.array([0.0, 0.0, 1.0], foot.dtype)
    zero = jnp.zeros(len(way), foot.dtype)
    body = Boxes(
        centres=foot + (lift + half_body)[:, None] * up,
        half_sizes=traffic.half_sizes.at[:, 2].set(half_body),
        headings=heading,
        softness=zero,
        window_depth=zero,
        mask=traffic.mask & is_free,
    )
    cabin = replace(
        body,
        centres=foot + (lift + 2 * half_body + cabin_z)[:, None] * up,
        half_sizes=traffic.half_sizes * jnp.array([0.55, 0.85, 0.0], foot.dtype) + cabin_z[:, None] * up,
        mask=body.mask & is_car,
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), body, cabin)


def car_levels(half_height: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Half heights of body and cabin of a car, m; 0.25 m below it are free.

    Args:
        half_height: of the whole car, m.

    Returns:
        Of the body and of the cabin; they share what is above the wheels 3 : 2.
    """
    room = half_height - 0.125
    return 0.6 * room, 0.4 * room


def _on_lane(traffic: Traffic, way: Float[Array, " n"]) -> Float[Array, "n 3"]:
    """Points of the lanes, linear between their samples."""
    at = jnp.clip(way / LANE_STEP_M, 0.0, traffic.lane_points.shape[1] - 1.001)
    low = jnp.floor(at).astype(jnp.int32)
    part = (at - low)[:, None]
    return traffic.lane_points[traffic.lanes, low] * (1 - part) + traffic.lane_points[traffic.lanes, low + 1] * part
