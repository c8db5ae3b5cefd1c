"""The step of training: descriptors, maps, losses, AdamW; on one device or many.

    state = init(key, config)
    step = make_step(config)
    state, report = step(state, batch)

Nothing in the step is random: what is, the samples and their augmentation, is drawn when a batch is made. A batch of
`RegistrationSample` trains everything but the overlap head, which the losses do not reach; one of `OverlapSample` the
overlap head alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dpmjax.deeppointmap.batches import MapOfScans, OverlapSample, RegistrationSample
from dpmjax.deeppointmap.curriculum import TrainingConfig
from dpmjax.deeppointmap.merging import merge_clouds
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
    registration_loss,
)
from dpmjax.losses.overlap import overlap_loss
from dpmjax.types import AnyArray, DescriptorCloud, PointPyramid

Sample = RegistrationSample | OverlapSample
BATCH_AXIS = "batch"
TreeT = TypeVar("TreeT")


@flax.struct.dataclass
class TrainingState:
    """What a step changes, and a checkpoint holds.

    Attributes:
        params: of the model.
        registration_optimizer: of all parameters.
        overlap_optimizer: of those of the overlap head.
        step: how many steps are done, both parts together.
    """

    params: dict[str, Any]
    registration_optimizer: optax.OptState
    overlap_optimizer: optax.OptState
    step: Int[Array, ""]


class TrainingReport(NamedTuple):
    """What a step says of itself; the parameters are those before it. NaN for what the part does not have.

    Attributes:
        loss: that the step made smaller.
        terms: of the registration loss, means over all groups; `num_positives` of both maps of one group.
        overlap_accuracy: share of pairs on the right side of one half.
        gradient_norm: before it is shortened.
        learning_rate: of this step.
    """

    loss: Float[Array, ""]
    terms: ObjectiveTerms
    overlap_accuracy: Float[Array, ""]
    gradient_norm: Float[Array, ""]
    learning_rate: Float[Array, ""]


Step = Callable[[TrainingState, Sample], tuple[TrainingState, TrainingReport]]


def init(key: PRNGKeyArray, config: TrainingConfig) -> TrainingState:
    """An untrained model, and optimisers that have seen nothing."""
    params = init_model(key, config.model).params
    return TrainingState(
        params=params,
        registration_optimizer=_optimizer(config, is_overlap=False).init(params),
        overlap_optimizer=_optimizer(config, is_overlap=True).init(params["decoder"]["overlap_head"]),
        step=jnp.zeros((), jnp.int32),
    )


def model_of(state: TrainingState, config: TrainingConfig) -> Model:
    """The model as it is now."""
    return Model(state.params, config.model)


def make_step(config: TrainingConfig, mesh: Mesh | None = None) -> Step:
    """The jitted step. It compiles once for each shape of batch: once a stage of the curriculum, once for the overlap.

    Batches carry samples along their first axis and may be spread over devices by `shard_batch`; the loss is the mean
    over all groups of all samples, so that the number of devices changes nothing but the speed. With a mesh, each of
    its devices gets the whole state and the whole report, so that every process can read them.
    """
    if mesh is None:
        return functools.partial(_step, config=config)
    return jax.jit(functools.partial(_one_step, config=config), out_shardings=NamedSharding(mesh, PartitionSpec()))


def _one_step(state: TrainingState, batch: Sample, *, config: TrainingConfig) -> tuple[TrainingState, TrainingReport]:
    if isinstance(batch, OverlapSample):
        return _overlap_step(state, batch, config)
    return _registration_step(state, batch, config)


_step = jax.jit(_one_step, static_argnames="config")


def batch_loss(
    params: dict[str, Any], batch: RegistrationSample, config: TrainingConfig
) -> tuple[Float[Array, ""], ObjectiveTerms]:
    """Mean of the registration loss over all groups of all samples, and of its terms."""
    model = Model(params, config.model)

    def of_sample(sample: RegistrationSample) -> tuple[Array, ObjectiveTerms]:
        clouds = _in_parts(functools.partial(encode_pyramid, model), sample.pyramids, config.scans_at_once)

        def of_group(group: tuple[MapOfScans, MapOfScans, AnyArray]) -> tuple[Array, ObjectiveTerms]:
            source, target, T_target_source = group
            return map_pair_loss(
                model, _merged(clouds, source), _merged(clouds, target), T_target_source, config.objective
            )

        scans_of_group = sample.source.rows.shape[-1] + sample.target.rows.shape[-1]
        groups = (sample.source, sample.target, sample.T_target_source)
        return _in_parts(of_group, groups, config.scans_at_once // scans_of_group)

    losses, terms = jax.vmap(of_sample)(batch)
    count = jnp.maximum(jnp.sum(batch.mask), 1)
    loss, terms = jax.tree.map(lambda x: jnp.sum(jnp.where(batch.mask, x, 0)) / count, (losses, terms))
    return loss, terms


def map_pair_loss(
    model: Model, a: DescriptorCloud, b: DescriptorCloud, T_b_a: Float[AnyArray, "4 4"], config: ObjectiveConfig
) -> tuple[Float[Array, ""], ObjectiveTerms]:
    """What the networks say of two maps, and the losses of it (DeepPointMap eq. 4 to 7)."""
    correlated_a, correlated_b = correlate(model, a, b)
    close_a, close_b = close_pairs(a.positions, b.positions, T_b_a, a.mask, b.mask, config=config)
    sides = (
        _side(model, a, correlated_a, correlated_b, close_a),
        _side(model, b, correlated_b, correlated_a, close_b),
    )
    return registration_loss(*sides, T_b_a, config=config)


def _in_parts(function: Callable[[Any], Any], trees: Any, at_once: int) -> Any:
    """The function of each entry along the first axis, about so many at a time, at least one.

    What happens inside is computed again for the gradient instead of being kept: a tenth of the memory, and on a CPU
    no time is lost, for what stays small stays in the cache.
    """
    num = len(jax.tree.leaves(trees)[0])
    # A divisor: a last part of another size would be compiled apart.
    size = max(size for size in range(1, max(1, min(at_once, num)) + 1) if num % size == 0)
    return jax.lax.map(jax.checkpoint(function), trees, batch_size=size)


def _side(
    model: Model,
    cloud: DescriptorCloud,
    correlated: DescriptorCloud,
    other: DescriptorCloud,
    close: ClosePairs,
) -> TrainingSide:
    partners = other.features[close.indices]
    own = jnp.broadcast_to(correlated.features[:, None], partners.shape)
    return TrainingSide(
        positions=cloud.positions,
        mask=cloud.mask,
        matched_features=similarity_features(model, correlated),
        coarse_features=coarse_features(model, cloud),
        close=close,
        offsets=predict_offsets(model, own, partners),
    )


def _merged(clouds: DescriptorCloud, scans: MapOfScans) -> DescriptorCloud:
    chosen: DescriptorCloud = jax.tree.map(lambda x: x[scans.rows], clouds)
    return merge_clouds(replace(chosen, mask=chosen.mask & scans.mask[:, None]), scans.T_map_scan)


def _registration_step(
    state: TrainingState, batch: RegistrationSample, config: TrainingConfig
) -> tuple[TrainingState, TrainingReport]:
    (loss, terms), gradient = jax.value_and_grad(batch_loss, has_aux=True)(state.params, batch, config)
    optimizer = _optimizer(config, is_overlap=False)
    updates, optimizer_state = optimizer.update(gradient, state.registration_optimizer, state.params)
    report = TrainingReport(
        loss=loss,
        terms=terms,
        overlap_accuracy=jnp.full((), jnp.nan),
        gradient_norm=_length(gradient),
        learning_rate=jnp.asarray(_schedule(config, is_overlap=False)(state.step)),
    )
    params = optax.apply_updates(state.params, updates)
    return replace(state, params=params, registration_optimizer=optimizer_state, step=state.step + 1), report


def _overlap_step(
    state: TrainingState, batch: OverlapSample, config: TrainingConfig
) -> tuple[TrainingState, TrainingReport]:
    head = state.params["decoder"]["overlap_head"]
    correlated = _correlated_pairs(Model(state.params, config.model), batch, config.scans_at_once // 2)
    labels = batch.is_overlap.reshape(-1)

    def loss_of(head: dict[str, Any]) -> tuple[Array, Array]:
        model = Model(_with_head(state.params, head), config.model)
        logits = jax.vmap(overlap_logit, (None, 0, 0))(model, *correlated)
        return overlap_loss(logits, labels), jnp.mean((logits > 0) == labels)

    (loss, accuracy), gradient = jax.value_and_grad(loss_of, has_aux=True)(head)
    optimizer = _optimizer(config, is_overlap=True)
    updates, optimizer_state = optimizer.update(gradient, state.overlap_optimizer, head)
    nothing = jnp.full((), jnp.nan)
    report = TrainingReport(
        loss=loss,
        terms=ObjectiveTerms(nothing, nothing, nothing, nothing, nothing),
        overlap_accuracy=accuracy,
        gradient_norm=_length(gradient),
        learning_rate=jnp.asarray(_schedule(config, is_overlap=True)(state.step - config.registration_steps)),
    )
    params = _with_head(state.params, optax.apply_updates(head, updates))
    return replace(state, params=params, overlap_optimizer=optimizer_state, step=state.step + 1), report


def _correlated_pairs(
    model: Model, batch: OverlapSample, pairs_at_once: int
) -> tuple[DescriptorCloud, DescriptorCloud]:
    """Of all pairs of all samples, one after the other; no gradient is asked of it."""

    def of_pair(pair: tuple[PointPyramid, PointPyramid]) -> tuple[DescriptorCloud, DescriptorCloud]:
        first, second = pair
        return correlate(model, encode_pyramid(model, first), encode_pyramid(model, second))

    def of_sample(first: PointPyramid, second: PointPyramid) -> tuple[DescriptorCloud, DescriptorCloud]:
        return _in_parts(of_pair, (first, second), pairs_at_once)

    clouds = jax.vmap(of_sample)(batch.first, batch.second)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), clouds)


def _length(gradient: Any) -> Float[Array, ""]:
    return jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradient)))


def _with_head(params: dict[str, Any], head: Any) -> dict[str, Any]:
    return {**params, "decoder": {**params["decoder"], "overlap_head": head}}


def _schedule(config: TrainingConfig, *, is_overlap: bool) -> optax.Schedule:
    """A cosine from the first learning rate to the last, after the warm-up."""
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


def device_mesh() -> Mesh:
    """All devices of all processes in a row."""
    return Mesh(np.array(jax.devices()), (BATCH_AXIS,))


def shard_batch(samples: TreeT, mesh: Mesh) -> TreeT:
    """The samples of this process, stacked along the first axis, as its part of the batch of all devices.

    Args:
        samples: as many as this process has devices in the mesh, or a multiple.
        mesh: from `device_mesh`.
    """
    sharding = NamedSharding(mesh, PartitionSpec(BATCH_AXIS))
    return jax.tree.map(lambda x: jax.make_array_from_process_local_data(sharding, np.asarray(x)), samples)


def replicate(tree: TreeT, mesh: Mesh) -> TreeT:
    """The same on every device of the mesh; every process has to give the same."""
    sharding = NamedSharding(mesh, PartitionSpec())
    return jax.tree.map(lambda x: jax.make_array_from_process_local_data(sharding, np.asarray(x)), tree)
