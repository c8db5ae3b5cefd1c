"""Poses of a scan near given ones at which M-Net explains it best: hits where it says occupied, free beams where free.

The search goes from coarse to fine. At each level every hypothesis tries a grid of poses around itself; the map is
blurred by the step of the grid, so that no narrow wall falls between two poses. Real-time correlative scan matching
(Olson 2009) with the map that M-Net has learned.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dpmjax.checks import require_count
from dpmjax.deepmapping.map_raster import NUM_NODES, MapRaster, nearest_nodes
from dpmjax.deepmapping.problem import MapFrame
from dpmjax.geometry import se2
from dpmjax.types import ScanSet

# Where on a beam the map is asked whether it is free: shares of its length.
_FREE_SHARES = (0.3, 0.6, 0.85)
# The most that one hit or one free sample can cost, nats: people and noise must not decide.
_MAX_NATS = 3.0
# Offsets of a grid of poses in its steps, the pose itself first: of equal poses the first is taken.
_OFFSETS = np.array(sorted(product(range(-2, 3), repeat=3), key=np.linalg.norm))


@dataclass(frozen=True)
class MapSearchConfig:
    """Settings of the search; lengths in typical ranges.

    Attributes:
        first_step: of the coarsest grid, along x and y, and in radians of heading; each level halves it.
        num_levels: grids from coarse to fine.
        num_kept: hypotheses that are kept after the first level.
        num_beams: of a scan that are compared, at most.
    """

    first_step: float = 0.08
    num_levels: int = 5
    num_kept: int = 6
    num_beams: int = 64

    def __post_init__(self) -> None:
        for name in ("num_levels", "num_kept", "num_beams"):
            require_count(name, getattr(self, name))
        if not self.first_step > 0.0:
            raise ValueError(f"first_step: expected a positive number, got {self.first_step}")


class MapFields(NamedTuple):
    """What hits and free samples cost at the nodes of a raster over the frame of the map, one raster a level.

    Attributes:
        hit: nats of a hit.
        free: nats of a free sample.
        frame: of the map.
    """

    hit: Float[Array, "l r r"]
    free: Float[Array, "l r r"]
    frame: MapFrame


class FoundPoses(NamedTuple):
    """The best pose of each scan.

    Attributes:
        poses: x, y, heading in typical ranges and radians.
        nats: mean cost of a beam, that of its hit and the mean of its free samples, weighted by the root of the range:
            near beams end on some surface everywhere. log 4 where the map is unknown.
    """

    poses: Float[Array, "m 3"]
    nats: Float[Array, " m"]


@partial(jax.jit, static_argnames="config")
def map_fields(raster: MapRaster, *, config: MapSearchConfig) -> MapFields:
    """What hits and free samples cost, blurred for each level by the step of its grid.

    Args:
        raster: of the map.
        config: of the search.

    Returns:
        MapFields.
    """
    # A hit on a surface lies between a free and an occupied node, so one node is the least.
    radii = jnp.maximum(0.5 * config.first_step * 0.5 ** np.arange(config.num_levels) / raster.spacing, 1.0)
    highest = jnp.stack([largest_nearby(raster.logits, radius) for radius in radii])
    lowest = -jnp.stack([largest_nearby(-raster.logits, radius) for radius in radii])
    hit, free = jax.nn.softplus(-highest), jax.nn.softplus(lowest)
    return MapFields(jnp.minimum(hit, _MAX_NATS), jnp.minimum(free, _MAX_NATS), raster.frame)


def largest_nearby(values: Float[Array, "r r"], radius: Float[Array, ""]) -> Float[Array, "r r"]:
    """The largest value in the square around each node, by doubling; the raster is closed at its ends.

    Args:
        values: at the nodes.
        radius: of the square in nodes; one less than a power of two, or the next smaller of these.

    Returns:
        The maxima.
    """
    for reach in 2 ** np.arange(int(np.log2(NUM_NODES))):
        moved = values
        for axis in (0, 1):
            moved = jnp.maximum(jnp.maximum(jnp.roll(moved, reach, axis), jnp.roll(moved, -reach, axis)), moved)
        values = jnp.where(2 * reach - 1 <= radius, moved, values)
    return values


def _nats(
    scan: ScanSet, pose: Float[Array, " 3"], hit: Float[Array, "r r"], free: Float[Array, "r r"], frame: MapFrame
) -> Array:
    """Mean cost of a beam of one scan at one pose."""
    shares = jnp.asarray((1.0, *_FREE_SHARES))[:, None, None]
    world = se2.transform_points(pose, (shares * scan.points).reshape(-1, 2)).reshape(len(shares), -1, 2)
    row, inside = nearest_nodes(frame, world)
    unknown = jnp.log(2.0)
    of_hit = jnp.where(inside[0], hit.reshape(-1)[row[0]], unknown)
    of_free = jnp.where(inside[1:], free.reshape(-1)[row[1:]], unknown).mean(0)
    weight = jnp.where(scan.mask, jnp.sum(jnp.where(scan.mask[:, None], scan.points, 1.0) ** 2, axis=-1) ** 0.25, 0.0)
    return jnp.sum(weight * (of_hit + of_free)) / jnp.maximum(weight.sum(), 1e-9)


@partial(jax.jit, static_argnames="config")
def search_map(
    scans: ScanSet, proposals: Float[Array, "m p 3"], fields: MapFields, *, config: MapSearchConfig
) -> FoundPoses:
    """Searches the poses of scans around proposals, coarse to fine.

    Args:
        scans: (m, b, 2) in typical ranges.
        proposals: poses to begin at.
        fields: of the map.
        config: settings.

    Returns:
        FoundPoses.
    """
    stride = -(-scans.mask.shape[1] // config.num_beams)
    thinned = ScanSet(scans.points[:, ::stride], scans.mask[:, ::stride])
    poses = jax.lax.map(lambda one: _search_one(one[0], one[1], fields, config), (thinned, proposals), batch_size=8)
    cost = partial(_nats, hit=fields.hit[-1], free=fields.free[-1], frame=fields.frame)
    return FoundPoses(poses, jax.lax.map(lambda one: cost(*one), (scans, poses), batch_size=64))


def _search_one(
    scan: ScanSet, proposals: Float[Array, "p 3"], fields: MapFields, config: MapSearchConfig
) -> Float[Array, " 3"]:
    poses = proposals
    for level in range(config.num_levels):
        around = poses[:, None] + config.first_step * 0.5**level * _OFFSETS
        cost = partial(_nats, scan, hit=fields.hit[level], free=fields.free[level], frame=fields.frame)
        nats = jax.vmap(jax.vmap(cost))(around)
        # The best pose around each hypothesis, and the best of these hypotheses.
        poses = jnp.take_along_axis(around, nats.argmin(axis=1)[:, None, None], axis=1)[:, 0]
        poses = poses[jnp.argsort(nats.min(axis=1))[: config.num_kept]]
    return poses[0]
