"""Scans rendered from the map of a fit, on which L-Net learns places off the trajectory (DeepMapping figure 7)."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dpmjax.deepmapping.config import DeepMappingConfig
from dpmjax.deepmapping.mapping import Fitted
from dpmjax.deepmapping.problem import MapFrame, Params, bind_map, choose_frame
from dpmjax.types import ScanSet

# Number of nodes of the raster along each side of the map's frame.
NUM_NODES = 513
# Absolute log odds above which a node is observed, free or occupied; M-Net is zero where no beam has passed.
_SEEN = 0.3
# Largest share of unobserved nodes along a rendered beam.
_MAX_UNSEEN = 0.1
# Distance from a scan that the raster of an MLP covers, in units of the fit.
_REACH = 1.5
# Longest rendered beam in nodes.
_MAX_NODES = 400
# Least share of the beams of a rendered scan that hit the map.
_LEAST_BEAMS = 0.5


class MapRaster(NamedTuple):
    """Log odds of the map at the nodes of a raster.

    Attributes:
        logits: rows along x, columns along y.
        frame: square that the raster covers.
    """

    logits: Float[Array, "r r"]
    frame: MapFrame

    @property
    def spacing(self) -> Float[Array, ""]:
        """Distance of two nodes, in units of the fit."""
        return 2.0 * self.frame.half_side / (NUM_NODES - 1)


def make_raster(fitted: Fitted) -> MapRaster:
    """Evaluates M-Net at all nodes.

    Args:
        fitted: a fit of planar scans.

    Returns:
        MapRaster, over the frame of a grid. An MLP is defined everywhere: the raster covers what its scans see.
    """
    frame = fitted.params.frame
    if fitted.config.occupancy.kind == "mlp":
        positions = jnp.asarray(fitted.poses[:, :2] / fitted.unit, jnp.float32)
        ends = jnp.stack([positions - _REACH, positions + _REACH])
        frame = choose_frame(ends, jnp.ones(ends.shape[:2], bool), margin=1.0)
    return _raster(fitted.params, frame, fitted.config)


@partial(jax.jit, static_argnames="config")
def _raster(params: Params, frame: MapFrame, config: DeepMappingConfig) -> MapRaster:
    axis = jnp.linspace(-1.0, 1.0, NUM_NODES)
    local = jnp.stack(jnp.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    logits = bind_map(params, config)(frame.centre + frame.half_side * local)
    return MapRaster(logits.reshape(NUM_NODES, NUM_NODES), frame)


def nearest_nodes(frame: MapFrame, points: Float[Array, "... 2"]) -> tuple[Int[Array, "..."], Bool[Array, "..."]]:
    """Finds the nearest nodes of points.

    Args:
        frame: frame of the map.
        points: points in the world, typical ranges.

    Returns:
        Index of the nearest node in the flat raster, and True where the point is inside the raster.
    """
    position = (0.5 * (points - frame.centre) / frame.half_side + 0.5) * (NUM_NODES - 1)
    index = jnp.clip(jnp.round(position).astype(jnp.int32), 0, NUM_NODES - 1)
    is_inside = ((position >= 0.0) & (position <= NUM_NODES - 1)).all(-1)
    return index[..., 0] * NUM_NODES + index[..., 1], is_inside


def render_scans(
    raster: MapRaster, scans: ScanSet, count: int, *, key: jax.Array
) -> tuple[ScanSet, Float[Array, "m 3"]]:
    """Renders scans at random free places of the map, at heading zero.

    Args:
        raster: raster of the map.
        scans: (n, b, 2) in units of the fit; rendered scans have the same bearings.
        count: number of positions that are tried.
        key: key of the positions.

    Returns:
        Scans and poses at the positions where enough beams hit occupied nodes of M-Net.
    """
    place_key, row_key = jax.random.split(key)
    free = np.flatnonzero(np.asarray(raster.logits) < -_SEEN)
    chosen = free[np.asarray(jax.random.randint(place_key, (count if len(free) else 0,), 0, max(len(free), 1)))]
    nodes = np.stack(np.divmod(chosen, NUM_NODES), axis=-1).astype(np.float32)
    places = raster.frame.centre - raster.frame.half_side + raster.spacing * nodes
    rows = jax.random.randint(row_key, (len(chosen),), 0, len(scans.points))
    ranges, is_met = _follow_beams(raster, places, scans.points[rows])
    mask = is_met & scans.mask[rows]
    reach = jnp.linalg.norm(jnp.where(mask[..., None], scans.points[rows], 1.0), axis=-1)
    points = jnp.where(mask[..., None], scans.points[rows] * (ranges / reach)[..., None], 0.0)
    kept = np.flatnonzero(np.asarray(mask.mean(axis=1)) >= _LEAST_BEAMS)
    poses = jnp.concatenate([places, jnp.zeros((len(chosen), 1))], axis=1)
    return ScanSet(points[kept], mask[kept]), poses[kept]


@jax.jit
def _follow_beams(
    raster: MapRaster, places: Float[Array, "m 2"], towards: Float[Array, "m b 2"]
) -> tuple[Float[Array, "m b"], Bool[Array, "m b"]]:
    """Computes ranges to the first occupied node towards points of the sensor frame, and True for valid ranges."""
    ranges = raster.spacing * jnp.arange(1, _MAX_NODES + 1)

    def follow(beams: tuple[Float[Array, " 2"], Float[Array, "b 2"]]) -> tuple[Array, Array]:
        place, points = beams
        direction = points / jnp.maximum(jnp.linalg.norm(points, axis=-1, keepdims=True), 1e-9)
        row, is_inside = nearest_nodes(raster.frame, place + ranges[:, None, None] * direction)
        logits = jnp.where(is_inside, raster.logits.reshape(-1)[row], 0.0)
        first = jnp.argmax(logits > _SEEN, axis=0)
        is_before = jnp.arange(_MAX_NODES)[:, None] < first
        unseen = jnp.sum(is_before & (logits > -_SEEN), axis=0)
        return ranges[first], (logits.max(axis=0) > _SEEN) & (unseen <= 1 + _MAX_UNSEEN * first)

    return jax.lax.map(follow, (places, towards), batch_size=16)
