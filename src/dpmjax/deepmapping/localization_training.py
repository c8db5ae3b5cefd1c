"""Training of L-Net on the poses of a fit, with scans that are turned, shifted, masked or rendered from the map."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from dpmjax.checks import require_count
from dpmjax.deepmapping.config import DeepMappingConfig
from dpmjax.deepmapping.mapping import Fitted
from dpmjax.deepmapping.problem import MapFrame, Params, bind_map, choose_frame
from dpmjax.deepmapping.sensors import as_scan_set, choose_beams, localize_scans
from dpmjax.geometry import se2
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
# Learning rate of Adam at the start; a cosine schedule reduces it to a hundredth.
_LEARNING_RATE = 2e-3
# Largest random heading of a scan; `relocalize` tries all turns, so L-Net needs only a range of headings.
_MAX_TURN_DEG = 20.0
# Largest distance, in units of the fit, to which scans are re-projected (`shift_scan`), so that L-Net learns the
# surroundings of the trajectory.
_MAX_SHIFT = 0.2
# Number of scans of a step, drawn with replacement. Number of scans rendered from the map at random free positions;
# half of each step are rendered scans, so that L-Net learns observed places off the trajectory.
_SCANS_PER_STEP, _NUM_RENDERED = 64, 4096
# Largest share of masked beams of a scan.
_LARGEST_DROP = 0.2


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


def has_windows(fitted: Fitted) -> bool:
    """Returns True where the fit has an L-Net for each of several windows instead of one for all scans.

    Args:
        fitted: result of `fit_deepmapping` or of `train_localization`.

    Returns:
        True if a leading axis of L-Net's weights is that of the windows.
    """
    biases = fitted.params.localization["params"]["Dense_0"]["bias"]
    return biases.ndim > 1


def train_localization(fitted: Fitted, scans: ScanSet | ArrayLike, *, num_steps: int = 5000, key: jax.Array) -> Fitted:
    """Trains L-Net on the poses of the fit, for `relocalize` in the same world frame.

    The labels are the poses of the fit, not ground truth. Scans are turned, shifted and partly masked. Further scans
    are rendered from the map of M-Net at positions off the trajectory.

    Args:
        fitted: any fit, also from given poses.
        scans: (n, b, 2) the scans of the fit.
        num_steps: number of steps of Adam.
        key: key of the batches.

    Returns:
        The fit with another L-Net and with zero start poses; poses and map are the same.

    Raises:
        ValueError: the number of scans is not that of the fit, or there is no step.
    """
    require_count("num_steps", num_steps)
    scans = as_scan_set(scans)
    if len(scans.points) != len(fitted.poses):
        raise ValueError(f"scans: expected the {len(fitted.poses)} scans of the fit, got {len(scans.points)}")
    poses = jnp.asarray(fitted.poses / [fitted.unit, fitted.unit, 1.0], jnp.float32)
    measured = replace(scans, points=scans.points / fitted.unit)
    render_key, train_key = jax.random.split(key)
    raster = make_raster(fitted)
    rendered = render_scans(raster, measured, _NUM_RENDERED, key=render_key)
    begin = fitted.params.localization
    if has_windows(fitted):
        begin = jax.tree.map(lambda weights: weights[0], begin)
    sources = ((measured, poses), rendered) if len(rendered[1]) else ((measured, poses),)
    net = _train(begin, sources, train_key, config=fitted.config, num_steps=num_steps)
    params = replace(fitted.params, localization=net, start=jnp.zeros_like(fitted.params.start))
    return fitted._replace(params=params)


@partial(jax.jit, static_argnames=("config", "num_steps"))
def _train(
    params: Any,
    sources: tuple[tuple[ScanSet, Float[Array, "_n 3"]], ...],
    key: jax.Array,
    *,
    config: DeepMappingConfig,
    num_steps: int,
) -> Any:
    optimizer = optax.adam(optax.cosine_decay_schedule(_LEARNING_RATE, num_steps, 0.01))
    count = _SCANS_PER_STEP // len(sources)

    def loss_of(params: Any, step_key: jax.Array) -> Array:
        parts = [
            _draw_training_batch(*source, config, count, key=jax.random.fold_in(step_key, index))
            for index, source in enumerate(sources)
        ]
        batch, labels = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
        error = localize_scans(params, batch.points, batch.mask, config) - labels
        return jnp.mean(jnp.sum(jnp.abs(error[:, :2]), -1) + jnp.abs(se2.wrap_angle(error[:, 2])))

    def one_step(carry: tuple[Any, Any], step: Array) -> tuple[tuple[Any, Any], None]:
        params, state = carry
        gradient = jax.grad(loss_of)(params, jax.random.fold_in(key, step))
        updates, state = optimizer.update(gradient, state, params)
        return (optax.apply_updates(params, updates), state), None

    return jax.lax.scan(one_step, (params, optimizer.init(params)), jnp.arange(num_steps))[0][0]


def _draw_training_batch(
    scans: ScanSet, poses: Float[Array, "n 3"], config: DeepMappingConfig, count: int, *, key: jax.Array
) -> tuple[ScanSet, Float[Array, "m 3"]]:
    """Draws scans that are turned, shifted and partly masked, and their poses."""
    row_key, first_key, turn_key, share_key, drop_key, shift_key = jax.random.split(key, 6)
    num_scans, num_beams = scans.mask.shape
    rows = jax.random.randint(row_key, (count,), 0, num_scans)
    beams = choose_beams(num_beams, config.cold_phases[0], jax.random.randint(first_key, (), 0, num_beams))
    points, mask = scans.points[rows][:, beams], scans.mask[rows][:, beams]
    limit = np.deg2rad(_MAX_TURN_DEG)
    turn = jax.random.uniform(turn_key, rows.shape, minval=-limit, maxval=limit) - poses[rows, 2]
    shift = _draw_shifts(shift_key, len(rows), _MAX_SHIFT)
    points = jax.vmap(shift_scan)(points, mask, shift)
    moved = jax.vmap(turn_scan)(shift[:, None], -poses[rows, 2])[:, 0]
    points = jax.vmap(turn_scan)(points, turn)
    share = _LARGEST_DROP * jax.random.uniform(share_key, (*rows.shape, 1))
    hidden = jax.random.uniform(drop_key, mask.shape) < share
    # At least one beam of a scan remains.
    seen = jnp.where((mask & ~hidden).any(-1, keepdims=True), mask & ~hidden, mask)
    return ScanSet(points, seen), poses[rows] + jnp.concatenate([moved, turn[:, None]], axis=-1)


def _draw_shifts(key: jax.Array, count: int, largest: float) -> Float[Array, "n 2"]:
    """Draws shifts of random direction and length; half of them are zero, because shifted scans are approximate."""
    length_key, side_key = jax.random.split(key)
    length = largest * jax.random.uniform(length_key, (count,), minval=-1.0).clip(0.0)
    side = jax.random.uniform(side_key, (count,), maxval=2.0 * jnp.pi)
    return length[:, None] * jnp.stack([jnp.cos(side), jnp.sin(side)], axis=-1)


def turn_scan(points: Float[Array, "b 2"], turn: Float[Array, ""]) -> Float[Array, "b 2"]:
    """Simulates the scan of a sensor whose heading is larger by `turn`, by turning all points back.

    Args:
        points: points in the sensor frame.
        turn: radians.

    Returns:
        Points in the frame of the turned sensor.
    """
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    return jnp.stack([cos * points[:, 0] + sin * points[:, 1], cos * points[:, 1] - sin * points[:, 0]], axis=-1)


def shift_scan(points: Float[Array, "b 2"], mask: Bool[Array, " b"], shift: Float[Array, " 2"]) -> Float[Array, "b 2"]:
    """Approximates the scan of a sensor nearby, at the same angles.

    Occlusion is ignored: the points are sorted by their new angles, and ranges are interpolated between them.

    Args:
        points: points in the sensor frame.
        mask: True for valid beams; other beams keep their points.
        shift: position of the new sensor in the frame of the old one.

    Returns:
        Points in the frame of the new sensor; unchanged without a shift.
    """
    safe = jnp.where(mask[:, None], points, 1.0)
    moved = safe - shift
    angle = jnp.where(mask, jnp.arctan2(moved[:, 1], moved[:, 0]), jnp.inf)
    order = jnp.argsort(angle)
    # The inverse range along a straight wall is nearly linear in the angle.
    inverse = 1.0 / jnp.maximum(jnp.linalg.norm(moved, axis=-1), 1e-6)
    target = jnp.arctan2(safe[:, 1], safe[:, 0])
    last = jnp.maximum(mask.sum() - 1, 0)
    known = jnp.where(jnp.arange(len(order)) <= last, angle[order], 4.0)
    ranges = 1.0 / jnp.interp(target, known, jnp.where(known < 4.0, inverse[order], inverse[order][last]))
    seen = ranges[:, None] * jnp.stack([jnp.cos(target), jnp.sin(target)], -1)
    return jnp.where(mask[:, None], jnp.where((shift == 0).all(), points, seen), points)
