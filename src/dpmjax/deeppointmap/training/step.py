"""The training step: descriptors, maps, losses and AdamW, on one device or many.

    state = init_training(key, config)
    step = make_step(config)
    state, report = step(state, batch)

The step is deterministic: samples and their augmentation are drawn when a batch is made. All parts learn except the
overlap head, which the second stage trains (`training.overlap_stage`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dpmjax.checks import require_count
from dpmjax.deeppointmap.matching import merge_clouds
from dpmjax.deeppointmap.model import Model, correlate, decode, encode_pyramid, init_model, predict_offsets
from dpmjax.deeppointmap.training.curriculum import TrainingConfig
from dpmjax.deeppointmap.training.objective import (
    ObjectiveTerms,
    TrainingPairs,
    TrainingSide,
    matching_loss,
    training_pairs,
)
from dpmjax.deeppointmap.training.sampling import GroupBatch, MapOfScans, RegistrationSample, SampleScans
from dpmjax.geometry.bearing import directions_of
from dpmjax.geometry.pyramid_storage import moved_pyramid
from dpmjax.nets.neighbourhood import WINNERS
from dpmjax.types import AnyArray, DescriptorCloud

# Groups with about this number of scans are decoded at the same time, or with `scans_at_once` scans if that is larger.
GROUP_SCANS_AT_ONCE = 16

# Largest number of descriptors of a thinned map (ours). Thinning leaves a fifth of a map of 16 scans, and attention
# over all of them would cost twenty times as much.
MAX_DESCRIPTORS = 1024

# Weight decay of AdamW.
WEIGHT_DECAY = 1e-4


@flax.struct.dataclass
class TrainingState:
    """State of training: a step changes it, a checkpoint holds it.

    Attributes:
        params: parameters of the model.
        optimizer: state of the optimiser.
        step: number of steps done.
        end: step after the last.
        planned_at: step at which this end was set.
        planned_progress: progress of the learning rate at that step, from 0 to 1.
    """

    params: dict[str, Any]
    optimizer: optax.OptState
    step: Int[AnyArray, ""]
    end: Int[AnyArray, ""]
    planned_at: Int[AnyArray, ""]
    planned_progress: Float[AnyArray, ""]


class TrainingReport(NamedTuple):
    """Measures of one step, at the parameters before it.

    Attributes:
        loss: loss of the batch.
        terms: terms of the matching loss, means over all groups.
        gradient_norm: norm of the gradient before it is scaled down.
        learning_rate: learning rate of the step.
    """

    loss: Float[Array, ""]
    terms: ObjectiveTerms
    gradient_norm: Float[Array, ""]
    learning_rate: Float[Array, ""]


Step = Callable[[TrainingState, RegistrationSample], tuple[TrainingState, TrainingReport]]


def init_training(key: PRNGKeyArray, config: TrainingConfig) -> TrainingState:
    """Makes the state before the first step.

    Args:
        key: used once, for the parameters.
        config: settings of training.

    Returns:
        The state.
    """
    params = init_model(key, config.model, distribution=config.initialization).params
    return TrainingState(
        params=params,
        optimizer=_optimizer(config).init(params),
        step=jnp.zeros((), jnp.int32),
        end=jnp.asarray(config.num_steps, jnp.int32),
        planned_at=jnp.zeros((), jnp.int32),
        planned_progress=jnp.zeros((), jnp.float32),
    )


def finish(state: TrainingState, num_steps: int) -> TrainingState:
    """Sets the number of remaining steps, in which the learning rate falls to the end of its cosine.

    Args:
        state: state before any step.
        num_steps: number of further steps, at least 1.

    Returns:
        The state with its new end.
    """
    require_count("num_steps", num_steps)
    end = state.step + num_steps
    return replace(state, end=end, planned_at=state.step, planned_progress=_progress(state))


def make_step(config: TrainingConfig, mesh: Mesh | None = None) -> Step:
    """Makes the jitted step, which compiles once for each capacity of a layout.

    Batches carry samples along their first axis and may be spread over devices by `place`. The loss is the mean
    over all groups of all samples, so the number of devices changes the speed only.

    Args:
        config: settings of training.
        mesh: if given, each of its devices gets the whole state and report, so that every process can read them.

    Returns:
        A function of state and batch that returns the new state and the report.
    """
    if mesh is None:
        return functools.partial(_step, config=config)
    return jax.jit(functools.partial(_one_step, config=config), out_shardings=NamedSharding(mesh, PartitionSpec()))


def _one_step(
    state: TrainingState, batch: RegistrationSample, *, config: TrainingConfig
) -> tuple[TrainingState, TrainingReport]:
    loss_of = jax.value_and_grad(batch_loss, has_aux=True)
    (loss, terms), gradient = loss_of(state.params, batch, config)
    learning_rate = _learning_rate(state, config)
    gradient_norm = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradient)))
    report = TrainingReport(loss, terms, gradient_norm, learning_rate)
    updates, optimizer = _optimizer(config).update(gradient, state.optimizer, state.params)
    params = jax.tree.map(lambda value, update: value - learning_rate * update, state.params, updates)
    return replace(state, params=params, optimizer=optimizer, step=state.step + 1), report


_step = jax.jit(_one_step, static_argnames="config")


def batch_loss(
    params: dict[str, Any], batch: RegistrationSample, config: TrainingConfig
) -> tuple[Float[Array, ""], ObjectiveTerms]:
    """Computes the mean of the matching loss and of its terms over all groups of all samples.

    Args:
        params: parameters of the model.
        batch: samples along the first axis.
        config: settings of training.

    Returns:
        The loss and its terms; 0 without any group.
    """
    if not config.model.decoder.predicts_offsets:
        config = replace(config, objective=replace(config.objective, offset_weight=0.0))
    model = Model(params, config.model)

    def of_sample(sample: RegistrationSample) -> tuple[Array, ObjectiveTerms]:
        clouds = _in_parts(functools.partial(encode_sample, model), sample.scans, config.scans_at_once)
        merged = functools.partial(_merged, thins=config.thins_maps)
        in_groups = max(GROUP_SCANS_AT_ONCE, config.scans_at_once)

        def of_group(group: GroupBatch) -> tuple[Array, ObjectiveTerms]:
            # Applies the networks to two maps, and computes the losses (DeepPointMap eq. 4 to 7).
            maps, T = (merged(clouds, group.source), merged(clouds, group.target)), group.T_target_source
            correlated = correlate(model, *maps)
            close = training_pairs(*maps, T, config=config.objective)
            sides = zip(maps, correlated, correlated[::-1], close, strict=True)
            return matching_loss(*(_side(model, *side) for side in sides), T, config=config.objective)

        num_scans = sample.groups.source.rows.shape[1] + sample.groups.target.rows.shape[1]
        return _in_parts(of_group, sample.groups, in_groups // num_scans)

    losses, terms = _over_samples(of_sample, batch)
    mask = batch.groups.mask
    count = jnp.maximum(jnp.sum(mask), 1)
    loss, terms = jax.tree.map(lambda x: jnp.sum(jnp.where(mask, x, 0)) / count, (losses, terms))
    return loss, terms


def encode_sample(model: Model, scan: SampleScans) -> DescriptorCloud:
    """Encodes one stored scan after its motion.

    Args:
        model: a model whose `config.pyramid` built the pyramid.
        scan: one scan of a sample.

    Returns:
        As `encode_pyramid`, in the frame after the motion.
    """
    # A rigid motion in metres is one in normalised coordinates with a shorter translation.
    unit = jnp.ones((4, 4), scan.T_augmented_lidar.dtype).at[:3, 3].set(1 / model.config.scale_m)
    return encode_pyramid(model, moved_pyramid(scan.pyramids, scan.T_augmented_lidar * unit))


def _over_samples(function: Callable[[Any], Any], batch: Any) -> Any:
    # A single sample is not mapped: one more axis makes gathers and scatters slower on a CPU.
    if len(jax.tree.leaves(batch)[0]) > 1:
        return jax.vmap(function)(batch)
    result = function(jax.tree.map(lambda x: jnp.asarray(x)[0], batch))
    return jax.tree.map(lambda x: x[None], result)


def _in_parts(function: Callable[[Any], Any], trees: Any, at_once: int) -> Any:
    # Maps the function over the first axis, about `at_once` entries at a time. The gradient recomputes inner
    # values instead of storing them, except in loops over neighbours: a tenth of the memory, and small parts stay
    # cached.
    num = len(jax.tree.leaves(trees)[0])
    # A divisor, because a last part of another size would be compiled separately.
    size = max(size for size in range(1, max(1, min(at_once, num)) + 1) if num % size == 0)
    if size == num:
        return jax.vmap(function)(trees)
    keep_winners = jax.checkpoint_policies.save_only_these_names(WINNERS)
    return jax.lax.map(jax.checkpoint(function, policy=keep_winners), trees, batch_size=size)


def _side(
    model: Model, cloud: DescriptorCloud, correlated: DescriptorCloud, other: DescriptorCloud, close: TrainingPairs
) -> TrainingSide:
    directions = directions_of(cloud)[:, None]
    own = correlated.features[:, None]
    return TrainingSide(
        positions=cloud.positions,
        mask=cloud.mask,
        matched_features=decode(model, correlated.features, part="similarity_head"),
        coarse_features=decode(model, cloud.features, part="coarse_head"),
        close=close,
        offsets=predict_offsets(model, own, other.features, directions, close.indices),
    )


def _merged(clouds: DescriptorCloud, scans: MapOfScans, *, thins: bool) -> DescriptorCloud:
    chosen: DescriptorCloud = jax.tree.map(lambda x: x[scans.rows], clouds)
    union = merge_clouds(replace(chosen, mask=chosen.mask & scans.mask), scans.T_map_scan)
    if not thins or len(union.mask) <= MAX_DESCRIPTORS:
        return union
    # Valid rows stand in front, those of the nearest scan first.
    order = jnp.argsort(~union.mask, stable=True)[:MAX_DESCRIPTORS]
    compact: DescriptorCloud = jax.tree.map(lambda x: x[order], union)
    return compact


def _progress(state: TrainingState) -> Float[Array, ""]:
    length = jnp.maximum(state.end - state.planned_at, 1)
    share = jnp.clip((state.step - state.planned_at) / length, 0, 1).astype(jnp.float32)
    return jnp.asarray(state.planned_progress + (1 - state.planned_progress) * share)


def _learning_rate(state: TrainingState, config: TrainingConfig) -> Float[Array, ""]:
    share = (1 + jnp.cos(jnp.pi * _progress(state))) / 2
    rate = config.final_learning_rate + share * (config.learning_rate - config.final_learning_rate)
    return rate * jnp.minimum(1, (state.step + 1) / max(1, config.warmup_steps))


def _optimizer(config: TrainingConfig) -> optax.GradientTransformation:
    # AdamW without its learning rate, which depends on the state.
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm),
        optax.scale_by_adam(),
        optax.add_decayed_weights(WEIGHT_DECAY),
    )
