"""What the loops of the planar fit and of depth images share: what Adam changes, and M-Net in its part of the world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig
from dpmjax.deepmapping.depth_config import DepthMappingConfig
from dpmjax.deepmapping.objective import MapLogits
from dpmjax.nets.occupancy import OccupancyConfig, make_map_net

FitConfig = DeepMappingConfig | DepthMappingConfig

# Points that M-Net's hidden layers hold at once when it is an MLP: 16 MB a layer of 512.
_MLP_CHUNK = 1 << 13


@flax.struct.dataclass
class MapFrame:
    """The square of the world that M-Net sees as [-1, 1]^2, or the cube, in reaches."""

    centre: Float[Array, " d"]
    half_side: Float[Array, ""]


@flax.struct.dataclass
class Params:
    """What Adam changes: L-Net, the free poses or motions (in reaches and radians), M-Net."""

    localization: Any
    poses: Float[Array, "n k"]
    occupancy: Any


def make_optimizer(phase: PhaseConfig) -> optax.GradientTransformation:
    """Adam for what the phase optimises; the rest stands still."""
    decay = optax.cosine_decay_schedule(phase.learning_rate, phase.num_steps, phase.final_learning_rate)
    moving = optax.adam(decay, *phase.adam_decay)
    map_adam = optax.adam(phase.map_learning_rate, 0.8 if phase.poses == "free" else 0.9, phase.adam_decay[1])
    labels = {"network": ("moving", "fixed"), "free": ("fixed", "moving")}[phase.poses]
    occupancy = "map" if phase.occupancy_weight > 0.0 else "fixed"
    return optax.multi_transform(
        {"moving": moving, "map": map_adam, "fixed": optax.set_to_zero()},
        Params(localization=labels[0], poses=labels[1], occupancy=occupancy),  # type: ignore[arg-type]
    )


def bind_map(params: Any, config: OccupancyConfig, frame: MapFrame, weights: Float[Array, " l"]) -> MapLogits:
    """M-Net as a function of points in the world, in reaches; its levels count by their weights."""
    apply: Callable[..., Any] = make_map_net(config).apply

    def logits(points: Float[Array, "n d"]) -> Float[Array, " n"]:
        local = (points - frame.centre) / frame.half_side
        if config.kind == "grid" or len(points) <= _MLP_CHUNK:
            return apply(params, local, weights)
        # The hidden layers of all samples at once would take gigabytes: a part at a time, again on the way back.
        count = -(-len(points) // _MLP_CHUNK)
        parts = jnp.pad(local, ((0, count * _MLP_CHUNK - len(points)), (0, 0))).reshape(count, _MLP_CHUNK, -1)
        logits_of_parts = jax.lax.map(jax.checkpoint(lambda part: apply(params, part, weights)), parts)
        return logits_of_parts.reshape(-1)[: len(points)]

    return logits


def level_weights(phase: PhaseConfig, config: FitConfig, progress: Float[Array, ""]) -> Float[Array, " l"]:
    """How much each level of the map counts: coarse ones first, all of them from `anneal_until` on."""
    count = config.occupancy.num_levels
    if phase.anneal_until == 0.0:
        return jnp.ones(count)
    return jnp.clip(progress / phase.anneal_until * count - jnp.arange(count) + 1.5, 0.0, 1.0)


def steps_per_call(config: FitConfig, phase: PhaseConfig) -> int:
    """Steps of one call: the calls share those of the phase evenly, so that the last one hardly goes beyond."""
    num_calls = -(-phase.num_steps // config.steps_per_call)
    return -(-phase.num_steps // num_calls)
