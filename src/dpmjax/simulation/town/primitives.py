"""What a town is made of, as the ray caster sees it: boxes, poles, spheroids, a height field, and traffic on lanes.

Lists have a capacity (a power of two) and a mask, so that towns of similar size share one compiled kernel. All
coordinates are in the world frame: metres, z up.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray


@flax.struct.dataclass
class Boxes:
    """Upright boxes, turned about z only.

    Attributes:
        centres: in the world, m.
        half_sizes: along the box's own x, y, z, m.
        headings: cosine and sine of the angle from the world's x to the box's x.
        softness: mean way, m, that a beam goes into the box before it is reflected (hedges, fences); 0 for a solid one.
        window_depth: how far windows and doors lie behind the faces, m; 0 for faces without any.
        mask: which boxes exist.
    """

    centres: Float[Array, "n 3"]
    half_sizes: Float[Array, "n 3"]
    headings: Float[Array, "n 2"]
    softness: Float[Array, " n"]
    window_depth: Float[Array, " n"]
    mask: Bool[Array, " n"]


@flax.struct.dataclass
class Cylinders:
    """Upright solid cylinders: poles, trunks.

    Attributes:
        centres: in the world, m.
        radii: m.
        half_heights: m.
        mask: which cylinders exist.
    """

    centres: Float[Array, "n 3"]
    radii: Float[Array, " n"]
    half_heights: Float[Array, " n"]
    mask: Bool[Array, " n"]


@flax.struct.dataclass
class Spheroids:
    """Ellipsoids of revolution about z: the tufts that crowns and bushes are made of.

    Attributes:
        centres: in the world, m.
        radii: horizontal, m.
        half_heights: vertical semi-axes, m.
        softness: mean way, m, that a beam goes into the foliage before it is reflected; 0 for a solid one.
        mask: which spheroids exist.
    """

    centres: Float[Array, "n 3"]
    radii: Float[Array, " n"]
    half_heights: Float[Array, " n"]
    softness: Float[Array, " n"]
    mask: Bool[Array, " n"]


@flax.struct.dataclass
class Ground:
    """Heights on a square grid, bilinear between the nodes; outside, the border goes on.

    Attributes:
        heights: heights[i, j] is z at origin + cell * (j, i), m.
        origin: x and y of heights[0, 0], m.
        cell: distance of the nodes, m.
    """

    heights: Float[Array, "h w"]
    origin: Float[Array, " 2"]
    cell: Float[Array, ""]


@flax.struct.dataclass
class Traffic:
    """Cars that drive and people that walk, each at its own speed along a lane.

    Attributes:
        lane_points: x, y, z of each lane at equal steps; lanes are padded to one length by repeating their end.
        lane_lengths: length of each lane, m.
        lanes: lane of each road user.
        starts: way along the lane at time 0, m.
        speeds: m/s, positive; who reaches the end of the lane starts again.
        sides: distance to the left of the lane, m.
        half_sizes: of the box around the road user, m; cars (longer than 1 m) get a cabin on top.
        mask: which road users exist.
    """

    lane_points: Float[Array, "k s 3"]
    lane_lengths: Float[Array, " k"]
    lanes: Int[Array, " n"]
    starts: Float[Array, " n"]
    speeds: Float[Array, " n"]
    sides: Float[Array, " n"]
    half_sizes: Float[Array, "n 3"]
    mask: Bool[Array, " n"]


@flax.struct.dataclass
class TownPrimitives:
    """Everything that a beam can meet.

    Attributes:
        boxes: what stands still and is angular.
        cylinders: poles and trunks.
        spheroids: foliage.
        ground: streets, pavements and meadows.
        traffic: what moves.
    """

    boxes: Boxes
    cylinders: Cylinders
    spheroids: Spheroids
    ground: Ground
    traffic: Traffic


LANE_STEP_M = 2.0


def capacity_for(count: int, *, least: int = 64) -> int:
    """The power of two that holds so many entries.

    Args:
        count: number of entries.
        least: smallest capacity.

    Returns:
        The capacity.
    """
    return max(least, 1 << max(count - 1, 0).bit_length())


def padded(rows: NDArray[np.float64], capacity: int) -> jax.Array:
    """The rows as float32, followed by zeros up to the capacity.

    Args:
        rows: (n, ...) values.
        capacity: number of rows to return, at least n.

    Returns:
        (capacity, ...) on the device.
    """
    whole = np.zeros((capacity, *rows.shape[1:]), np.float32)
    whole[: len(rows)] = rows
    return jnp.asarray(whole)


def mask_of(count: int, capacity: int) -> jax.Array:
    """True for the first `count` of `capacity` entries."""
    return jnp.asarray(np.arange(capacity) < count)


def pack_boxes(table: NDArray[np.float64]) -> Boxes:
    """Boxes out of rows.

    Args:
        table: (n, 9) x y z, half sizes, heading in radians, softness, window depth.

    Returns:
        The boxes, padded.
    """
    table = table.reshape(-1, 9)
    capacity = capacity_for(len(table))
    rows = padded(table, capacity)
    headings = np.column_stack([np.cos(table[:, 6]), np.sin(table[:, 6])])
    return Boxes(
        centres=rows[:, :3],
        half_sizes=rows[:, 3:6],
        headings=padded(headings, capacity),
        softness=rows[:, 7],
        window_depth=rows[:, 8],
        mask=mask_of(len(table), capacity),
    )


def pack_cylinders(table: NDArray[np.float64]) -> Cylinders:
    """Cylinders out of rows.

    Args:
        table: (n, 5) x y z, radius, half height.

    Returns:
        The cylinders, padded.
    """
    table = table.reshape(-1, 5)
    rows = padded(table, capacity_for(len(table)))
    return Cylinders(
        centres=rows[:, :3], radii=rows[:, 3], half_heights=rows[:, 4], mask=mask_of(len(table), len(rows))
    )


def pack_spheroids(table: NDArray[np.float64]) -> Spheroids:
    """Spheroids out of rows.

    Args:
        table: (n, 6) x y z, radius, half height, softness.

    Returns:
        The spheroids, padded.
    """
    table = table.reshape(-1, 6)
    rows = padded(table, capacity_for(len(table)))
    return Spheroids(
        centres=rows[:, :3],
        radii=rows[:, 3],
        half_heights=rows[:, 4],
        softness=rows[:, 5],
        mask=mask_of(len(table), len(rows)),
    )
