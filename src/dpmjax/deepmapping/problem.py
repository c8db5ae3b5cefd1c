"""A `Problem` for the engine, and the parts that problems with an L-Net and an M-Net share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig
from dpmjax.deepmapping.objective import MapLogits, Terms, WorldBatch, free_factors, num_batches, occupancy_term
from dpmjax.nets.mapping import make_map_net

# Number of points that an MLP as M-Net evaluates at once: 16 MB for each layer of 512.
_MLP_CHUNK = 1 << 13
# Up to this number of points, the hidden layers are kept for the backward pass (6 KB a point). For more, they would
# take gigabytes and are evaluated again, which makes a step a third longer.
_MLP_KEPT = 1 << 18
# Learning rates of M-Net; a step changes few nodes of a grid and all weights of an MLP.
_MAP_LEARNING_RATE = {"grid": 0.1, "mlp": 1e-3}
# Weight of the mean square of a grid's nodes.
_GRID_DECAY = 1e-3
# Share of a phase with free poses after which all levels of a grid have weight 1.
_ANNEAL_UNTIL = 0.7


def no_poses(config: Any, phase: Any, params: Any, data: Any) -> None:
    """Returns no poses, for problems without any."""


def keep_params(config: Any, phase: Any, params: Any, data: Any) -> Any:
    """Begins a phase with the parameters of the phase before it."""
    return params


@dataclass(frozen=True)
class Problem:
    """Functions and settings of an optimisation of parameters on one data set.

    The functions are pure and belong to a module, so that problems of equal settings are equal. A Problem is a static
    argument of the compiled step; the data are not part of it.

    Attributes:
        config: settings, given to every function as its first argument; hashable.
        phases: settings of each phase, with `name` and `num_steps`; second argument of the functions of a phase.
        init: (config, key, data) -> Params; the data have the initial poses where there are some.
        optimizer: (config, phase) -> optax optimiser, whose state has the same structure in all phases.
        loss: (config, phase, params, data, step, key) -> (scalar, terms); `step` counts from 0 within the phase.
        steps_per_call: the largest number of steps that are compiled into one call.
        poses: (config, phase, params, data) -> poses of the whole data set; None by default.
        next_phase: (config, phase, params, data) -> Params at the start of the phase after `phase`; the same Params by
            default.
    """

    config: Any
    phases: tuple[Any, ...]
    init: Callable[..., Any]
    optimizer: Callable[..., optax.GradientTransformation]
    loss: Callable[..., tuple[Float[Array, ""], Any]]
    steps_per_call: int
    poses: Callable[..., Any] = no_poses
    next_phase: Callable[..., Any] = keep_params


class MappingData(NamedTuple):
    """Data of DeepMapping, in units of the fit (`DeepMappingConfig.unit`), by default typical ranges.

    Attributes:
        scans: ScanSet or DepthScans.
        start: initial poses in the parametrisation of the sensor; None: cold start.
    """

    scans: Any
    start: Float[Array, "n ..."] | None = None


@flax.struct.dataclass
class MapFrame:
    """Square or cube of the world that maps to [-1, 1]^d, the domain of M-Net; in units of the fit."""

    centre: Float[Array, " d"]
    half_side: Float[Array, ""]


@flax.struct.dataclass
class Params:
    """Parameters of a fit; lengths in units of the fit, angles in radians.

    Attributes:
        localization: weights of L-Net; with windows, a leading axis has one L-Net for each window.
        poses: free poses, or free motions relative to `start`; for each window where windows have free poses.
        occupancy: weights of M-Net.
        start: poses that L-Net's outputs are relative to; not trained.
        frame: frame of the map; not trained.
    """

    localization: Any
    poses: Float[Array, "*rows k"]
    occupancy: Any
    start: Float[Array, "n ..."]
    frame: MapFrame


def phases_of(config: DeepMappingConfig, data: MappingData) -> tuple[PhaseConfig, ...]:
    """Returns the phases of a fit: cold from zero poses, or warm from given poses; epochs are counted as steps.

    Args:
        config: settings of the fit.
        data: data with initial poses, or without.

    Returns:
        The phases, each with its number of steps.
    """
    num_scans = data.scans.mask.shape[0]

    def count_steps(phase: PhaseConfig) -> PhaseConfig:
        if not phase.num_epochs:
            return phase
        return replace(phase, num_steps=phase.num_epochs * num_batches(phase, num_scans), num_epochs=0)

    return tuple(map(count_steps, config.cold_phases if data.start is None else config.warm_phases))


def make_optimizer(config: DeepMappingConfig, phase: PhaseConfig) -> optax.GradientTransformation:
    """Returns Adam for the trained parameters of a phase; other parameters and their moments are constant.

    Args:
        config: settings of the fit.
        phase: phase of the fit.

    Returns:
        The optimiser of Params.
    """
    decay = optax.cosine_decay_schedule(phase.learning_rate, phase.num_steps, phase.final_learning_rate)
    moving = optax.adam(decay, *phase.adam_decay)
    has_grid = config.occupancy.kind == "grid"
    map_rate = _MAP_LEARNING_RATE["grid" if has_grid else "mlp"]
    map_adam = optax.adam(map_rate, 0.8 if has_grid and phase.poses == "free" else 0.9, phase.adam_decay[1])
    labels: Any = Params(localization="network", poses="free", occupancy="map", start="fixed", frame="fixed")  # type: ignore[arg-type]
    return optax.multi_transform(
        {
            "network": moving if phase.poses == "network" else _frozen(moving),
            "free": moving if phase.poses == "free" else _frozen(moving),
            "map": map_adam if phase.occupancy_weight > 0.0 else _frozen(map_adam),
            "fixed": optax.set_to_zero(),
        },
        labels,
    )


def _frozen(optimizer: optax.GradientTransformation) -> optax.GradientTransformation:
    """Returns an optimiser with the same state and zero updates, so that all phases have one state structure."""

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        return jax.tree.map(jnp.zeros_like, updates), state

    return optax.GradientTransformation(optimizer.init, update)


def choose_frame(points_world: Float[Array, "... d"], mask: Array, margin: float) -> MapFrame:
    """Computes the frame of M-Net: the square or cube around points, with a margin.

    Args:
        points_world: (..., d).
        mask: (...) False for invalid points.
        margin: ratio of the side of the frame to the largest extent of the points.

    Returns:
        MapFrame.
    """
    axes = tuple(range(mask.ndim))
    low = jnp.where(mask[..., None], points_world, jnp.inf).min(axes)
    high = jnp.where(mask[..., None], points_world, -jnp.inf).max(axes)
    return MapFrame(centre=0.5 * (low + high), half_side=0.5 * margin * jnp.max(high - low))


def bind_map(params: Params, config: DeepMappingConfig, level_weights: Float[Array, " l"] | None = None) -> MapLogits:
    """Returns M-Net as a function of points in the world frame, in units of the fit.

    Args:
        params: parameters of the fit.
        config: settings of the fit.
        level_weights: weights of the levels of a grid, 0 (off) to 1; None: all 1.

    Returns:
        The function: points (n, d) -> logits (n,).
    """
    occupancy = config.occupancy
    apply: Callable[..., Any] = make_map_net(occupancy).apply
    weights = jnp.ones(occupancy.num_levels) if level_weights is None else level_weights

    def logits(points: Float[Array, "n d"]) -> Float[Array, " n"]:
        local = (points - params.frame.centre) / params.frame.half_side
        if occupancy.kind == "grid" or len(points) <= _MLP_CHUNK:
            return apply(params.occupancy, local, weights)
        count = -(-len(points) // _MLP_CHUNK)
        parts = jnp.pad(local, ((0, count * _MLP_CHUNK - len(points)), (0, 0))).reshape(count, _MLP_CHUNK, -1)

        def logits_of(part: Float[Array, "c d"]) -> Float[Array, " c"]:
            return apply(params.occupancy, part, weights)

        is_kept = len(points) <= _MLP_KEPT
        return jax.lax.map(logits_of if is_kept else jax.checkpoint(logits_of), parts).reshape(-1)[: len(points)]

    return logits


def level_weights(phase: PhaseConfig, num_levels: int, progress: Float[Array, ""]) -> Float[Array, " l"]:
    """Computes the weights of the levels of the map; in phases with free poses, coarse levels start first.

    Args:
        phase: phase of the fit.
        num_levels: number of levels of the map.
        progress: 0 at the start of the phase, 1 at its end.

    Returns:
        0 (off) to 1 for each level.
    """
    if phase.poses == "network":
        return jnp.ones(num_levels)
    return jnp.clip(progress / _ANNEAL_UNTIL * num_levels - jnp.arange(num_levels) + 1.5, 0.0, 1.0)


def mapping_loss(
    config: DeepMappingConfig,
    phase: PhaseConfig,
    params: Params,
    world: WorldBatch,
    pair_term: Float[Array, ""],
    *,
    key: jax.Array,
) -> tuple[Float[Array, ""], Terms]:
    """Computes DeepMapping eq. 6 in the convex form gamma BCE + (1 - gamma) * (comparison of pairs).

    Args:
        config: settings of the fit.
        phase: phase of the fit.
        params: parameters with M-Net and its frame.
        world: scans of the batch in the world frame.
        pair_term: eq. 7, or another comparison of pairs of scans.
        key: key of the free samples.

    Returns:
        The loss with weight decay of the map, and the terms before weighting.
    """
    gamma, loss, occupancy = phase.occupancy_weight, pair_term, jnp.zeros(())
    if gamma > 0.0:
        logits = bind_map(params, config, level_weights(phase, config.occupancy.num_levels, world.progress))
        factors = free_factors(world, phase, key=key)
        occupancy = occupancy_term(world, logits, factors, has_equal_scans=phase.is_as_published)
        loss = gamma * occupancy + (1.0 - gamma) * pair_term
        if config.occupancy.kind == "grid":
            squares = sum(jnp.sum(x**2) for x in jax.tree.leaves(params.occupancy))
            loss += _GRID_DECAY * squares / world.mask.size
    return loss, Terms(occupancy, pair_term)
