"""Training of L-Net on the poses of a fit, with scans that are turned, shifted, masked or rendered from the map."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from dpmjax.checks import require_count
from dpmjax.deepmapping.config import DeepMappingConfig
from dpmjax.deepmapping.map_raster import make_raster, render_scans
from dpmjax.deepmapping.mapping import Fitted
from dpmjax.deepmapping.planar import as_scan_set, choose_beams, localize_scans
from dpmjax.geometry import se2
from dpmjax.types import ScanSet

# Learning rate of Adam at the start; a cosine schedule reduces it to a hundredth.
_LEARNING_RATE = 2e-3
# Largest random heading of a scan; `relocalize` tries all turns, so L-Net needs only a range of headings.
_MAX_TURN_DEG = 20.0
# Largest distance, in typical ranges, to which scans are re-projected (`shift_scan`), so that L-Net learns the
# surroundings of the trajectory.
_MAX_SHIFT = 0.2
# Number of scans of a step, drawn with replacement. Number of scans rendered from the map at random free positions;
# half of each step are rendered scans, so that L-Net learns observed places off the trajectory.
_SCANS_PER_STEP, _NUM_RENDERED = 64, 4096
# Largest share of masked beams of a scan.
_LARGEST_DROP = 0.2


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
    raster = make_raster(fitted.params, fitted.config)
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
    sources: tuple[tuple[ScanSet, Float[Array, "n 3"]], ...],
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
    scans: ScanSet,
    poses: Float[Array, "n 3"],
    config: DeepMappingConfig,
    count: int,
    *,
    key: jax.Array,
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
