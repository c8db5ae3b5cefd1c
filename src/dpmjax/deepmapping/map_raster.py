"""Rasters of M-Net: for rendered scans, and as a picture (DeepMapping figure 5)."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from dpmjax.deepmapping.config import DeepMappingConfig
from dpmjax.deepmapping.mapping import Fitted
from dpmjax.deepmapping.problem import MapFrame, Params, bind_map
from dpmjax.geometry import se2
from dpmjax.types import ScanSet

NUM_NODES = 513
"""Number of nodes of the raster along each side of the map's frame."""
# Absolute log odds above which a node is observed, free or occupied; M-Net is zero where no beam has passed.
_SEEN = 0.3
# Largest share of unobserved nodes along a rendered beam.
_MAX_UNSEEN = 0.1
# Longest rendered beam in nodes.
_MAX_NODES = 400
# Least share of the beams of a rendered scan that hit the map.
_LEAST_BEAMS = 0.5


class MapRaster(NamedTuple):
    """Log odds of the map at the nodes of a raster.

    Attributes:
        logits: rows along x, columns along y.
        frame: frame of the map, equal to that of the raster.
    """

    logits: Float[Array, "r r"]
    frame: MapFrame

    @property
    def spacing(self) -> Float[Array, ""]:
        """Distance of two nodes, in typical ranges."""
        return 2.0 * self.frame.half_side / (NUM_NODES - 1)


@partial(jax.jit, static_argnames="config")
def make_raster(params: Params, config: DeepMappingConfig) -> MapRaster:
    """Evaluates M-Net at all nodes.

    Args:
        params: parameters of a fit.
        config: settings of the fit.

    Returns:
        MapRaster.
    """
    axis = jnp.linspace(-1.0, 1.0, NUM_NODES)
    local = jnp.stack(jnp.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    logits = bind_map(params, config)(params.frame.centre + params.frame.half_side * local)
    return MapRaster(logits.reshape(NUM_NODES, NUM_NODES), params.frame)


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
        scans: (n, b, 2) in typical ranges; rendered scans have the same bearings.
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


# Number of samples on a beam that mark cells as explored.
_SAMPLES = 64


class MapPicture(NamedTuple):
    """A raster of the world; row 0 has the smallest y.

    Attributes:
        probability: (h, w) occupancy probability.
        explored: (h, w) True where a beam has passed or ended.
        extent: x_min, x_max, y_min, y_max in the unit of the points.
    """

    probability: NDArray[np.float32]
    explored: NDArray[np.bool_]
    extent: tuple[float, float, float, float]


def map_picture(
    fitted: Fitted, points: NDArray[np.floating], mask: NDArray[np.bool_], *, num_cells: int = 500
) -> MapPicture:
    """Evaluates M-Net on a raster over all hits, with the explored cells.

    Args:
        fitted: the fit.
        points: (n, b, 2) scans of the fit in the sensor frames, unit of the poses.
        mask: (n, b) False for invalid beams.
        num_cells: number of cells along the longer side.

    Returns:
        MapPicture in the frame of `fitted.poses`.
    """
    poses = fitted.poses
    world = se2.transform_points(poses, points)
    hits = world[mask]
    low, high = hits.min(axis=0), hits.max(axis=0)
    margin = 0.03 * float((high - low).max())
    low, high = low - margin, high + margin
    cell = float((high - low).max()) / num_cells
    width, height = (np.ceil((high - low) / cell)).astype(int)
    explored = np.zeros((height, width), bool)
    sensors = np.broadcast_to(poses[:, None, :2], world.shape)[mask]
    for share in np.linspace(0.0, 1.0, _SAMPLES):
        column, row = ((sensors + share * (hits - sensors) - low) / cell).astype(int).T
        explored[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] = True
    x, y = low[0] + cell * (np.arange(width) + 0.5), low[1] + cell * (np.arange(height) + 0.5)
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) / fitted.unit
    occupied = jax.jit(lambda params, points: jax.nn.sigmoid(bind_map(params, fitted.config)(points)))
    probability = np.asarray(occupied(fitted.params, centres.astype(np.float32))).reshape(height, width)
    extent = (float(low[0]), float(low[0] + cell * width), float(low[1]), float(low[1] + cell * height))
    return MapPicture(probability, _close_gaps(explored), extent)


def _close_gaps(explored: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Marks cells between two neighbouring beams as explored."""
    from scipy.ndimage import binary_closing

    return binary_closing(explored, iterations=2) | explored
