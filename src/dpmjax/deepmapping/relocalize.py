"""Where was a new scan taken? What L-Net has learned beyond the scans that it was fitted to (DeepMapping figure 7)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike, NDArray

from dpmjax.deepmapping.config import DeepMappingConfig
from dpmjax.deepmapping.fit import Fitted, as_scan_set
from dpmjax.geometry import se2
from dpmjax.nets.localization import LocalizationConfig, LocalizationNet
from dpmjax.types import ScanSet

# Scans that L-Net sees at once where there are many.
_CHUNK = 1024


class Relocalized(NamedTuple):
    """Poses of scans in the world of a fit.

    Attributes:
        T_world_scan: (3, 3), or (m, 3, 3) for m scans, float64.
        pose: (3,) or (m, 3) x, y, heading in (-pi, pi], unit of the points.
    """

    T_world_scan: NDArray[np.float64]
    pose: NDArray[np.float64]


@dataclass(frozen=True)
class TeachConfig:
    """How L-Net learns the poses that a fit has found.

    Attributes:
        num_steps: steps of Adam.
        learning_rate: at the start; it falls to a hundredth (cosine).
        scans_per_step: drawn with replacement.
        max_turn_deg: scans are turned by a random angle up to this, heading with them: L-Net becomes so much less
            dependent on the orientations that the sensor happened to have.
        max_shift: scans are taken again from places around their own (`shift_scan`), up to so far off, in parts of the
            reach of the scans: L-Net learns the surroundings of the trajectory.
        drop: share of the beams that is hidden from L-Net, at most; how many differs from scan to scan.
    """

    num_steps: int = 5000
    learning_rate: float = 2e-3
    scans_per_step: int = 64
    max_turn_deg: float = 20.0
    max_shift: float = 0.2
    drop: float = 0.2

    def __post_init__(self) -> None:
        if self.num_steps < 1 or self.scans_per_step < 1:
            raise ValueError(
                f"num_steps, scans_per_step: expected at least 1, got {self.num_steps}, {self.scans_per_step}"
            )
        if not self.max_shift >= 0.0:
            raise ValueError(f"max_shift: expected zero or more, got {self.max_shift}")
        if not 0.0 <= self.drop < 1.0:
            raise ValueError(f"drop: expected 0 to below 1, got {self.drop}")


def relocalize(fitted: Fitted, scan: ScanSet | ArrayLike) -> Relocalized:
    """Estimates where new scans were taken, by one forward pass of L-Net (DeepMapping section 4.1, figure 7).

    It is a coarse guess: right near the trajectory of the fit and at similar orientations, wrong elsewhere, and it does
    not say which. After the free poses of the fast preset L-Net lags behind the poses; `teach_localization` brings it
    back to them.

    Args:
        fitted: result of `fit_deepmapping` from zero poses, or of `teach_localization`.
        scan: (b, 2) one scan, or (m, b, 2), in the sensor frame, unit and order of the beams as in the fit; beams with
            coordinates that are not finite, or both zero, measured nothing.

    Returns:
        Relocalized, in the world of `fitted.poses`.

    Raises:
        ValueError: the shape is another one, a scan has no valid beam, or L-Net tells corrections of given start
            poses.
    """
    if np.any(np.asarray(fitted.state.start_poses) != 0.0):
        raise ValueError(
            "fitted: its L-Net corrects given start poses, which a new scan has not; call teach_localization first"
        )
    is_one = not isinstance(scan, ScanSet) and np.ndim(scan) == 2
    scans = _as_scans(np.asarray(scan)[None] if is_one else scan)
    beams = _beams_of_fit(scans.mask.shape[1], fitted.config)
    points, mask = scans.points[:, beams] / fitted.reach, scans.mask[:, beams]
    parts = [
        _apply(fitted.params.localization, points[k : k + _CHUNK], mask[k : k + _CHUNK], fitted.config.localization)
        for k in range(0, len(points), _CHUNK)
    ]
    poses = np.concatenate([np.asarray(part, np.float64) for part in parts])
    poses[:, :2] *= fitted.reach
    poses[:, 2] = se2.wrap_angle(poses[:, 2])
    T_world_scan = se2.to_matrix(poses)
    return Relocalized(T_world_scan[0], poses[0]) if is_one else Relocalized(T_world_scan, poses)


def teach_localization(
    fitted: Fitted, scans: ScanSet | ArrayLike, config: TeachConfig | None = None, *, key: jax.Array
) -> Fitted:
    """Fits L-Net to the poses that the fit has found, so that `relocalize` speaks of the same world.

    The labels are the fit's own: no ground truth enters. Scans are seen from turned and shifted sensors, with beams
    hidden.

    Args:
        fitted: any fit, also from given poses.
        scans: (n, b, 2) the scans of the fit.
        config: settings.
        key: of the batches.

    Returns:
        The fit with another L-Net and with zero start poses; poses and map are the same.

    Raises:
        ValueError: the number of scans is not that of the fit.
    """
    config = config or TeachConfig()
    scans = as_scan_set(scans)
    if len(scans.points) != len(fitted.poses):
        raise ValueError(f"scans: expected the {len(fitted.poses)} scans of the fit, got {len(scans.points)}")
    poses = jnp.asarray(fitted.poses / [fitted.reach, fitted.reach, 1.0], jnp.float32)
    scaled = replace(scans, points=scans.points / fitted.reach)
    params = _teach(fitted.params.localization, scaled, poses, fitted.config, config, key=key)
    new_params = replace(fitted.params, localization=params)
    state = replace(fitted.state, params=new_params, start_poses=jnp.zeros_like(fitted.state.start_poses))
    return fitted._replace(params=new_params, state=state)


def _teach(
    params: Any,
    scans: ScanSet,
    poses: Float[Array, "n 3"],
    fit_config: DeepMappingConfig,
    config: TeachConfig,
    *,
    key: jax.Array,
) -> Any:
    optimizer = optax.adam(optax.cosine_decay_schedule(config.learning_rate, config.num_steps, 0.01))
    num_scans, num_beams = scans.mask.shape
    stride = max(1, -(-num_beams // fit_config.cold_phases[0].beams_per_step))
    net: Callable[..., Array] = jax.vmap(LocalizationNet(fit_config.localization).apply, in_axes=(None, 0, 0))  # type: ignore[assignment]

    def loss_of(params: Any, step_key: jax.Array) -> Array:
        row_key, first_key, turn_key, share_key, drop_key, shift_key = jax.random.split(step_key, 6)
        rows = jax.random.randint(row_key, (config.scans_per_step,), 0, num_scans)
        first = jax.random.randint(first_key, (), 0, stride)
        beams = first + stride * jnp.arange(num_beams // stride)
        points, mask = scans.points[rows][:, beams], scans.mask[rows][:, beams]
        limit = np.deg2rad(config.max_turn_deg)
        turn = jax.random.uniform(turn_key, rows.shape, minval=-limit, maxval=limit)
        shift = _draw_shifts(shift_key, len(rows), config.max_shift)
        points = jax.vmap(shift_scan)(points, mask, shift)
        moved = jax.vmap(turn_scan)(shift[:, None], -poses[rows, 2])[:, 0]
        points = jax.vmap(turn_scan)(points, turn)
        hidden = jax.random.uniform(drop_key, mask.shape) < config.drop * jax.random.uniform(
            share_key, (*rows.shape, 1)
        )
        # A scan of one beam must keep it.
        seen = jnp.where((mask & ~hidden).any(-1, keepdims=True), mask & ~hidden, mask)
        error = net(params, points, seen) - poses[rows] - jnp.concatenate([moved, turn[:, None]], axis=-1)
        place, heading = error[:, :2], se2.wrap_angle(error[:, 2])
        return jnp.mean(jnp.sum(jnp.abs(place), -1) + jnp.abs(heading))

    def one_step(carry: tuple[Any, Any], step: Array) -> tuple[tuple[Any, Any], None]:
        params, state = carry
        gradient = jax.grad(loss_of)(params, jax.random.fold_in(key, step))
        updates, state = optimizer.update(gradient, state, params)
        return (optax.apply_updates(params, updates), state), None

    @jax.jit
    def run(params: Any) -> Any:
        return jax.lax.scan(one_step, (params, optimizer.init(params)), jnp.arange(config.num_steps))[0][0]

    return run(params)


def _draw_shifts(key: jax.Array, count: int, largest: float) -> Float[Array, "n 2"]:
    """Shifts of random sides and lengths; half of the scans stay where they are, which are the only true ones."""
    length_key, side_key = jax.random.split(key)
    length = largest * jax.random.uniform(length_key, (count,), minval=-1.0).clip(0.0)
    side = jax.random.uniform(side_key, (count,), maxval=2.0 * jnp.pi)
    return length[:, None] * jnp.stack([jnp.cos(side), jnp.sin(side)], axis=-1)


def turn_scan(points: Float[Array, "b 2"], turn: Float[Array, ""]) -> Float[Array, "b 2"]:
    """What the sensor would have seen with its heading larger by `turn`: every point turned back by it."""
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    return jnp.stack([cos * points[:, 0] + sin * points[:, 1], cos * points[:, 1] - sin * points[:, 0]], axis=-1)


def shift_scan(points: Float[Array, "b 2"], mask: Bool[Array, " b"], shift: Float[Array, " 2"]) -> Float[Array, "b 2"]:
    """About what the sensor would have seen from a place nearby, at the same angles.

    What hides behind what is not asked: the points are sorted by their new angles, and ranges are interpolated.

    Args:
        points: in the sensor frame; beams without a measurement keep none.
        mask: beams that measured something.
        shift: the new place in the sensor frame.

    Returns:
        Points in the frame of the sensor at the new place; without a shift the points themselves.
    """
    safe = jnp.where(mask[:, None], points, 1.0)
    moved = safe - shift
    angle = jnp.where(mask, jnp.arctan2(moved[:, 1], moved[:, 0]), jnp.inf)
    order = jnp.argsort(angle)
    # Walls are straight in the inverse range, nearly.
    inverse = 1.0 / jnp.maximum(jnp.linalg.norm(moved, axis=-1), 1e-6)
    target = jnp.arctan2(safe[:, 1], safe[:, 0])
    last = jnp.maximum(mask.sum() - 1, 0)
    known = jnp.where(jnp.arange(len(order)) <= last, angle[order], 4.0)
    ranges = 1.0 / jnp.interp(target, known, jnp.where(known < 4.0, inverse[order], inverse[order][last]))
    seen = ranges[:, None] * jnp.stack([jnp.cos(target), jnp.sin(target)], -1)
    return jnp.where(mask[:, None], jnp.where((shift == 0).all(), points, seen), points)


def _as_scans(scan: ScanSet | ArrayLike) -> ScanSet:
    """As `as_scan_set`, but one scan is enough."""
    if isinstance(scan, ScanSet):
        return as_scan_set(scan) if len(scan.points) > 1 else _first(as_scan_set(_twice(scan)))
    points = np.asarray(scan, np.float32)
    if points.ndim != 3 or points.shape[-1] != 2 or len(points) == 0:
        raise ValueError(f"scan: expected shape (b, 2) or (m, b, 2), got {points.shape}")
    return as_scan_set(points) if len(points) > 1 else _first(as_scan_set(np.concatenate([points, points])))


def _twice(scans: ScanSet) -> ScanSet:
    return jax.tree.map(lambda leaf: jnp.concatenate([jnp.asarray(leaf)] * 2), scans)


def _first(scans: ScanSet) -> ScanSet:
    return jax.tree.map(lambda leaf: leaf[:1], scans)


def _beams_of_fit(num_beams: int, config: DeepMappingConfig) -> slice:
    """The beams of a scan that L-Net sees: as many as in the fit."""
    stride = max(1, -(-num_beams // config.cold_phases[0].beams_per_step))
    return slice(0, stride * (num_beams // stride), stride)


@partial(jax.jit, static_argnames="config")
def _apply(
    params: Any, points: Float[Array, "m b 2"], mask: Bool[Array, "m b"], config: LocalizationConfig
) -> Float[Array, "m 3"]:
    return jax.vmap(LocalizationNet(config).apply, in_axes=(None, 0, 0))(params, points, mask)  # type: ignore[return-value]
