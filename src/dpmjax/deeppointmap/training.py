"""The training step: descriptors, maps, losses and AdamW, on one device or many.

    state = init_training(key, config)
    step = make_step(config)
    state, report = step(state, batch)

The step is deterministic: samples and their augmentation are drawn when a batch is made. A batch of
`RegistrationSample` trains all parts except the overlap head; a batch of `OverlapSample` trains the overlap head only.
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

from dpmjax.deeppointmap.curriculum import TrainingConfig
from dpmjax.deeppointmap.matching import merge_clouds
from dpmjax.deeppointmap.model import (
    Model,
    coarse_features,
    correlate,
    encode_pyramid,
    init_model,
    overlap_logit,
    predict_offsets,
    similarity_features,
)
from dpmjax.deeppointmap.objective import (
    ClosePairs,
    ObjectiveConfig,
    ObjectiveTerms,
    TrainingSide,
    close_pairs,
    matching_loss,
)
from dpmjax.deeppointmap.sampling import MapOfScans, OverlapSample, RegistrationSample, Sample
from dpmjax.geometry.bearing import directions_of
from dpmjax.losses.descriptors import overlap_loss
from dpmjax.types import AnyArray, DescriptorCloud, PointPyramid


@flax.struct.dataclass
class TrainingState:
    """State of training: a step changes it, a checkpoint holds it.

    Attributes:
        params: parameters of the model.
        registration_optimizer: state of the optimiser of all parameters.
        overlap_optimizer: state of the optimiser of the overlap head.
        step: number of steps done, both parts together.
    """

    params: dict[str, Any]
    registration_optimizer: optax.OptState
    overlap_optimizer: optax.OptState
    step: Int[AnyArray, ""]


class TrainingReport(NamedTuple):
    """Measures of one step, at the parameters before it; NaN for those that its part does not have.

    Attributes:
        loss: loss of the batch.
        terms: terms of the matching loss, means over all groups.
        overlap_accuracy: share of the overlap pairs that are classified correctly.
        gradient_norm: norm of the gradient before it is scaled down.
        learning_rate: learning rate of the step.
    """

    loss: Float[Array, ""]
    terms: ObjectiveTerms
    overlap_accuracy: Float[Array, ""]
    gradient_norm: Float[Array, ""]
    learning_rate: Float[Array, ""]


Step = Callable[[TrainingState, Sample], tuple[TrainingState, TrainingReport]]


def init_training(key: PRNGKeyArray, config: TrainingConfig) -> TrainingState:
    """Makes the state before the first step.

    Args:
        key: used once, for the parameters.
        config: settings of training.

    Returns:
        The state.
    """
    params = init_model(key, config.model).params
    return TrainingState(
        params=params,
        registration_optimizer=_optimizer(config, is_overlap=False).init(params),
        overlap_optimizer=_optimizer(config, is_overlap=True).init(params["decoder"]["overlap_head"]),
        step=jnp.zeros((), jnp.int32),
    )


def make_step(config: TrainingConfig, mesh: Mesh | None = None) -> Step:
    """Makes the jitted step, which compiles once for each stage of the curriculum and once for the overlap part.

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


def _one_step(state: TrainingState, batch: Sample, *, config: TrainingConfig) -> tuple[TrainingState, TrainingReport]:
    is_overlap = isinstance(batch, OverlapSample)
    if isinstance(batch, OverlapSample):
        learned, optimizer_state = state.params["decoder"]["overlap_head"], state.overlap_optimizer
        loss_of, step = _overlap_loss_of(state, batch, config), state.step - config.registration_steps
    else:
        learned, optimizer_state, step = state.params, state.registration_optimizer, state.step

        def loss_of(params: dict[str, Any]) -> tuple[Array, tuple[ObjectiveTerms, Array]]:
            loss, terms = batch_loss(params, batch, config)
            return loss, (terms, jnp.asarray(jnp.nan))

    (loss, (terms, accuracy)), gradient = jax.value_and_grad(loss_of, has_aux=True)(learned)
    learning_rate = jnp.asarray(_schedule(config, is_overlap=is_overlap)(step))
    gradient_norm = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradient)))
    report = TrainingReport(loss, terms, accuracy, gradient_norm, learning_rate)
    updates, optimizer_state = _optimizer(config, is_overlap=is_overlap).update(gradient, optimizer_state, learned)
    learned = optax.apply_updates(learned, updates)
    if is_overlap:
        state = replace(state, params=_with_head(state.params, learned), overlap_optimizer=optimizer_state)
    else:
        state = replace(state, params=learned, registration_optimizer=optimizer_state)
    return replace(state, step=state.step + 1), report


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
    model = Model(params, config.model)

    def of_sample(sample: RegistrationSample) -> tuple[Array, ObjectiveTerms]:
        clouds = _in_parts(functools.partial(encode_pyramid, model), sample.pyramids, config.scans_at_once)

        def of_group(group: tuple[MapOfScans, MapOfScans, AnyArray]) -> tuple[Array, ObjectiveTerms]:
            source, target, T_target_source = group
            return _map_pair_loss(
                model, _merged(clouds, source), _merged(clouds, target), T_target_source, config.objective
            )

        scans_of_group = sample.source.rows.shape[-1] + sample.target.rows.shape[-1]
        groups = (sample.source, sample.target, sample.T_target_source)
        return _in_parts(of_group, groups, config.scans_at_once // scans_of_group)

    losses, terms = jax.vmap(of_sample)(batch)
    count = jnp.maximum(jnp.sum(batch.mask), 1)
    loss, terms = jax.tree.map(lambda x: jnp.sum(jnp.where(batch.mask, x, 0)) / count, (losses, terms))
    return loss, terms


def _map_pair_loss(
    model: Model, a: DescriptorCloud, b: DescriptorCloud, T_b_a: Float[AnyArray, "4 4"], config: ObjectiveConfig
) -> tuple[Float[Array, ""], ObjectiveTerms]:
    # Applies the networks to two maps, and computes the losses (DeepPointMap eq. 4 to 7).
    correlated_a, correlated_b = correlate(model, a, b)
    close_a, close_b = close_pairs(a, b, T_b_a, config=config)
    sides = (_side(model, a, correlated_a, correlated_b, close_a), _side(model, b, correlated_b, correlated_a, close_b))
    return matching_loss(*sides, T_b_a, config=config)


def _in_parts(function: Callable[[Any], Any], trees: Any, at_once: int) -> Any:
    # Maps the function over the first axis, about `at_once` entries at a time. The gradient computes the inside again
    # instead of keeping it: this takes a tenth of the memory, and no more time on a CPU, where small parts stay cached.
    num = len(jax.tree.leaves(trees)[0])
    # A divisor, because a last part of another size would be compiled separately.
    size = max(size for size in range(1, max(1, min(at_once, num)) + 1) if num % size == 0)
    return jax.lax.map(jax.checkpoint(function), trees, batch_size=size)


def _side(
    model: Model, cloud: DescriptorCloud, correlated: DescriptorCloud, other: DescriptorCloud, close: ClosePairs
) -> TrainingSide:
    partners = other.features[close.indices]
    own = jnp.broadcast_to(correlated.features[:, None], partners.shape)
    directions = directions_of(cloud)[:, None]
    return TrainingSide(
        positions=cloud.positions,
        mask=cloud.mask,
        matched_features=similarity_features(model, correlated),
        coarse_features=coarse_features(model, cloud),
        close=close,
        offsets=predict_offsets(model, own, partners, directions),
    )


def _merged(clouds: DescriptorCloud, scans: MapOfScans) -> DescriptorCloud:
    chosen: DescriptorCloud = jax.tree.map(lambda x: x[scans.rows], clouds)
    return merge_clouds(replace(chosen, mask=chosen.mask & scans.mask[:, None]), scans.T_map_scan)


def _overlap_loss_of(
    state: TrainingState, batch: OverlapSample, config: TrainingConfig
) -> Callable[[dict[str, Any]], tuple[Array, tuple[ObjectiveTerms, Array]]]:
    correlated = _correlated_pairs(Model(state.params, config.model), batch, config.scans_at_once // 2)
    labels = batch.is_overlap.reshape(-1)

    def loss_of(head: dict[str, Any]) -> tuple[Array, tuple[ObjectiveTerms, Array]]:
        model = Model(_with_head(state.params, head), config.model)
        logits = jax.vmap(overlap_logit, (None, 0, 0))(model, *correlated)
        terms = ObjectiveTerms(*[jnp.asarray(jnp.nan)] * len(ObjectiveTerms._fields))
        return overlap_loss(logits, labels), (terms, jnp.mean((logits > 0) == labels))

    return loss_of


def _correlated_pairs(
    model: Model, batch: OverlapSample, pairs_at_once: int
) -> tuple[DescriptorCloud, DescriptorCloud]:
    # All pairs of all samples along one axis; they need no gradient.

    def of_pair(pair: tuple[PointPyramid, PointPyramid]) -> tuple[DescriptorCloud, DescriptorCloud]:
        first, second = pair
        return correlate(model, encode_pyramid(model, first), encode_pyramid(model, second))

    def of_sample(first: PointPyramid, second: PointPyramid) -> tuple[DescriptorCloud, DescriptorCloud]:
        return _in_parts(of_pair, (first, second), pairs_at_once)

    clouds = jax.vmap(of_sample)(batch.first, batch.second)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), clouds)


def _with_head(params: dict[str, Any], head: Any) -> dict[str, Any]:
    return {**params, "decoder": {**params["decoder"], "overlap_head": head}}


def _schedule(config: TrainingConfig, *, is_overlap: bool) -> optax.Schedule:
    # A cosine from the first learning rate to the last, after the warm-up.
    ratio = config.overlap_ratio if is_overlap else 1.0
    return optax.warmup_cosine_decay_schedule(
        init_value=0.0 if config.warmup_steps > 0 and not is_overlap else ratio * config.learning_rate,
        peak_value=ratio * config.learning_rate,
        warmup_steps=0 if is_overlap else config.warmup_steps,
        decay_steps=max(1, config.overlap_steps if is_overlap else config.registration_steps),
        end_value=ratio * config.final_learning_rate,
    )


def _optimizer(config: TrainingConfig, *, is_overlap: bool) -> optax.GradientTransformation:
    ratio = config.overlap_ratio if is_overlap else 1.0
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm),
        optax.adamw(_schedule(config, is_overlap=is_overlap), weight_decay=ratio * config.weight_decay),
    )
