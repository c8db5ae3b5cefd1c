"""The ground under a ray: heights between the nodes of a grid, and where a ray first goes below them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dpmjax.simulation.town.primitives import Ground

# Geometric steps of the search, then halvings of the interval that was found: millimetres at 20 m, less nearer.
_NUM_STEPS = 14
_NUM_REFINEMENTS = 5
_NEAREST_M = 1.0


def ground_height(ground: Ground, positions: Float[Array, "... 2"]) -> Float[Array, "..."]:
    """Height of the ground at places in the world.

    Args:
        ground: the height field.
        positions: x and y, m.

    Returns:
        z, m; bilinear between the nodes, and that of the nearest border outside.
    """
    rows, columns = ground.heights.shape
    at = (positions - ground.origin) / ground.cell
    x, y = jnp.clip(at[..., 0], 0.0, columns - 1.001), jnp.clip(at[..., 1], 0.0, rows - 1.001)
    column, row = jnp.floor(x).astype(jnp.int32), jnp.floor(y).astype(jnp.int32)
    along, up = x - column, y - row
    flat, corner = ground.heights.reshape(-1), row * columns + column
    low = flat[corner] * (1.0 - along) + flat[corner + 1] * along
    high = flat[corner + columns] * (1.0 - along) + flat[corner + columns + 1] * along
    return low * (1.0 - up) + high * up


def cross_ground(
    ground: Ground, start: Float[Array, " 3"], direction: Float[Array, "... 3"], max_range: float
) -> Float[Array, "..."]:
    """Distance at which rays first go below the ground.

    The height over ground is looked at in steps that grow with the distance; within the first step that ends below, the
    place is found by the false position method (Illinois).

    Args:
        ground: the height field.
        start: common start of the rays, in the world, m.
        direction: of the rays, unit length, in the world.
        max_range: rays are followed so far, m.

    Returns:
        Distance, m; infinite where a ray stays above the ground.
    """
    steps = np.geomspace(_NEAREST_M, max_range, _NUM_STEPS)

    def clearance(distance: Float[Array, "..."]) -> Float[Array, "..."]:
        place = start[:2] + distance[..., None] * direction[..., :2]
        return start[2] + distance * direction[..., 2] - ground_height(ground, place)

    def look(
        carry: tuple[Array, Array, Array, Array], distance: Array
    ) -> tuple[tuple[Array, Array, Array, Array], None]:
        near, far, above, below = carry
        here = clearance(jnp.broadcast_to(distance, near.shape))
        is_open = below > 0
        near, above = jnp.where(is_open & (here > 0), distance, near), jnp.where(is_open & (here > 0), here, above)
        far, below = jnp.where(is_open, distance, far), jnp.where(is_open, here, below)
        return (near, far, above, below), None

    def refine(_: int, carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        near, far, above, below = carry
        middle = near + (far - near) * jnp.clip(above / jnp.maximum(above - below, 1e-9), 0.02, 0.98)
        return _narrow(carry, middle, clearance(middle))

    zero = jnp.zeros(direction.shape[:-1], direction.dtype)
    top = start[2] - ground_height(ground, start[:2])
    begin = (zero, zero, jnp.broadcast_to(top, zero.shape), zero + 1.0)
    found, _ = jax.lax.scan(look, begin, jnp.asarray(steps, direction.dtype))
    near, far, above, below = jax.lax.fori_loop(0, _NUM_REFINEMENTS, refine, found)
    last = near + (far - near) * jnp.clip(above / jnp.maximum(above - below, 1e-9), 0.0, 1.0)
    return jnp.where(found[3] <= 0, last, jnp.inf)


def _narrow(
    bracket: tuple[Array, Array, Array, Array], middle: Float[Array, "..."], here: Float[Array, "..."]
) -> tuple[Array, Array, Array, Array]:
    """The part of (near, far, height at near, height at far) that holds the crossing (Illinois).

    The end that stays counts half the next time, or it would stay for ever.
    """
    near, far, above, below = bracket
    is_above = here > 0
    return (
        jnp.where(is_above, middle, near),
        jnp.where(is_above, far, middle),
        jnp.where(is_above, here, 0.5 * above),
        jnp.where(is_above, 0.5 * below, here),
    )
