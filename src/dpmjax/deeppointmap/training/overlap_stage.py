"""The second stage of training: the overlap head alone, on the features of a frozen network (DeepPointMap section 3.3).

Half of the pairs are less than 20 m apart, a quarter 20 to 40 m, and a quarter farther apart or of different drives.
Labels are distances of true positions, before any augmentation. The loss is the binary cross entropy; the last
parameters count. A step depends on the seed and its number alone, so that a resumed run equals an unbroken one.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from dpmjax.deeppointmap.encoding import pooled_vector
from dpmjax.deeppointmap.evaluation import NO_OVERLAP_M, REVISIT_PATH_M
from dpmjax.deeppointmap.model import Model, correlate, decode
from dpmjax.deeppointmap.overlap_prediction import OVERLAP_M
from dpmjax.deeppointmap.training.curriculum import TrainingConfig
from dpmjax.deeppointmap.training.evaluation import in_chunks
from dpmjax.deeppointmap.training.sampling import NUM_ATTEMPTS, SampleScans, ScanTable
from dpmjax.deeppointmap.training.scan_store import ScanStore
from dpmjax.deeppointmap.training.step import WEIGHT_DECAY, encode_sample
from dpmjax.metrics.drives import path_lengths
from dpmjax.types import AnyArray, DescriptorCloud

POOL_STREAM, PAIR_STREAM, ORDER_STREAM = 3107, 3108, 3109
# Largest number of scans that the pairs of a pool are made of; 1,024 of `small` take 0.3 GB and some minutes.
MAX_POOL_SCANS = 1024
# Share of the pairs of a pool that are hard: half of one street that was seen twice, half that look alike. Without them
# the head learns from easy pairs alone; with more it sees too few of the usual ones.
HARD_SHARE = 0.25
# Number of scans, and of pairs, in one call of a compiled program.
SCANS_AT_ONCE, PAIRS_AT_ONCE = 16, 8
# AdamW without its learning rate and its weight decay, which `_step` applies.
OPTIMIZER = optax.scale_by_adam()


@flax.struct.dataclass
class OverlapState:
    """State of the second stage; a checkpoint of it resumes the stage exactly.

    Attributes:
        head: parameters of the overlap head.
        optimizer: state of the optimiser.
        step: number of steps done.
    """

    head: dict[str, Any]
    optimizer: optax.OptState
    step: Int[AnyArray, ""]


class OverlapRecord(NamedTuple):
    """Report after a step.

    Attributes:
        step: number of steps done.
        loss: binary cross entropy of the batch, before the step.
        accuracy: share of the pairs of the batch that the head classified right.
        learning_rate: learning rate of the step.
    """

    step: int
    loss: float
    accuracy: float
    learning_rate: float


class OverlapHooks(NamedTuple):
    """Functions that the stage calls.

    Attributes:
        on_report: gets the record and the state after each step.
        stop: called before each step; any number but 0 ends the stage.
    """

    on_report: Callable[[OverlapRecord, OverlapState], object] = lambda _record, _state: None
    stop: Callable[[], int] = int


class PairFeatures(NamedTuple):
    """Correlated features of pairs of scans.

    Attributes:
        features: features of both clouds, float16.
        mask: True for descriptors that are there.
        is_overlap: True for scans less than 20 m apart.
    """

    features: Float[AnyArray, "p 2 n c"]
    mask: Bool[AnyArray, "p 2 n"]
    is_overlap: Bool[AnyArray, " p"]


def train_overlap(
    store: ScanStore,
    model: Model,
    config: TrainingConfig,
    *,
    seed: int = 0,
    start: OverlapState | None = None,
    hooks: OverlapHooks | None = None,
) -> tuple[Model, OverlapState]:
    """Trains the overlap head of a model; all other parameters stay.

    Args:
        store: prepared scans.
        model: a model of `config.model` whose other parts are trained.
        config: settings of training.
        seed: seed of the pairs and of their augmentation.
        start: state to continue from; None begins with the head of the model.
        hooks: functions that are called: reports, and a request to stop.

    Returns:
        The model, `config.trained` with "overlap" if the stage came to its end; and the last state.

    Raises:
        ValueError: if no pair of the scans overlaps, or if all do.
    """
    if (reason := why_no_overlap(store.table)) is not None:
        raise ValueError(f"store: {reason}")
    hooks = hooks or OverlapHooks()
    settings, state = config.overlap, init_overlap(model) if start is None else start
    num_steps = settings.num_steps(len(store.table))
    schedule = optax.cosine_decay_schedule(
        config.learning_rate, num_steps, config.final_learning_rate / config.learning_rate
    )
    frozen = Model(model.params, replace(model.config, calibration=None, overlap=None, trained=()))
    pool = _make_pool(store, frozen, config, seed) if settings.pool_pairs and int(state.step) < num_steps else None
    for step in range(int(state.step), num_steps):
        if hooks.stop():
            break
        pairs = (
            _new_pairs(store, frozen, config, (seed, step)) if pool is None else _pool_batch(pool, config, seed, step)
        )
        # Either scan may be the first.
        sides = np.random.default_rng([ORDER_STREAM, seed, step]).permutation(2)
        batch = PairFeatures(pairs.features[:, sides], pairs.mask[:, sides], pairs.is_overlap)
        rate = settings.rate_share * float(schedule(step))
        state, loss, accuracy = _step(state, frozen, batch, rate, settings.rate_share * WEIGHT_DECAY)
        hooks.on_report(OverlapRecord(step + 1, float(loss), float(accuracy), rate), state)
    return with_head(model, state.head, is_trained=int(state.step) >= num_steps), state


def init_overlap(model: Model) -> OverlapState:
    """Makes the state before the first step: the head of a model.

    Args:
        model: a model.

    Returns:
        The state.
    """
    head = model.params["decoder"]["overlap_head"]
    return OverlapState(head, OPTIMIZER.init(head), jnp.zeros((), jnp.int32))


def with_head(model: Model, head: dict[str, Any], *, is_trained: bool) -> Model:
    """Puts an overlap head into a model.

    Args:
        model: the model.
        head: parameters of the head.
        is_trained: True if the head went through the whole second stage.

    Returns:
        A new model.
    """
    params = {**model.params, "decoder": {**model.params["decoder"], "overlap_head": head}}
    others = tuple(stage for stage in model.config.trained if stage != "overlap")
    return Model(params, replace(model.config, trained=(*others, "overlap") if is_trained else others))


def why_no_overlap(table: ScanTable) -> str | None:
    """Finds a reason against the second stage.

    Args:
        table: poses of the scans.

    Returns:
        The reason; None where there is none.
    """
    rows = np.unique(np.linspace(0, len(table) - 1, min(len(table), NUM_ATTEMPTS)).astype(int))
    distances = np.stack([table.distances_from(int(row)) for row in rows])
    distances[np.arange(len(rows)), rows] = np.nan
    if not np.any(distances < OVERLAP_M):
        return f"no two scans are less than {OVERLAP_M:g} m apart, so that no pair overlaps"
    if not np.any(distances >= OVERLAP_M):
        return f"all scans are less than {OVERLAP_M:g} m apart, so that all pairs overlap"
    return None


def draw_overlap_pairs(
    table: ScanTable, num_pairs: int, rng: np.random.Generator, *, anchors: Int[np.ndarray, " a"] | None = None
) -> Int[np.ndarray, "p 2"]:
    """Draws pairs of scans with and without overlap; the anchors are drawn from all scans.

    Half of the pairs are less than 20 m apart, a quarter 20 to 40 m, and a quarter farther, or of different drives.
    If there are no pairs at one of the larger distances, other pairs more than 20 m apart replace them.

    Args:
        table: poses of the scans, of which `why_no_overlap` is None.
        num_pairs: number of pairs.
        rng: source of the draws.
        anchors: scans that may be the first of a pair; None for all.

    Returns:
        Rows of the scans of each pair.
    """
    quarter, apart = num_pairs // 4, (OVERLAP_M, np.inf)
    bands = {
        (0.0, OVERLAP_M): num_pairs - 2 * quarter,
        (OVERLAP_M, NO_OVERLAP_M): quarter,
        (NO_OVERLAP_M, np.inf): quarter,
    }
    anchors = np.arange(len(table)) if anchors is None else anchors
    pairs = []
    for band, number in bands.items():
        for _ in range(number):
            found = _partner(table, band, anchors, rng)
            if found is None and band[0] > 0:
                found = _partner(table, apart, anchors, rng)
            pairs += [] if found is None else [found]
    return np.array(pairs, int).reshape(-1, 2)


def _partner(
    table: ScanTable, band: tuple[float, float], anchors: Int[np.ndarray, " a"], rng: np.random.Generator
) -> tuple[int, int] | None:
    """Draws an anchor and a scan at a distance from it; None where no anchor with such a scan was found."""
    for anchor in rng.choice(anchors, NUM_ATTEMPTS):
        distances = table.distances_from(int(anchor))
        is_inside = (distances >= band[0]) & ((distances < band[1]) | (band[1] == np.inf))
        is_inside[anchor] = False
        others = np.flatnonzero(is_inside)
        if len(others):
            return int(anchor), int(rng.choice(others))
    return None


def hard_pairs(
    table: ScanTable, vectors: Float[np.ndarray, "n d"], num_pairs: int, rng: np.random.Generator
) -> Int[np.ndarray, "p 2"]:
    """Draws pairs that are hard to tell: one street that was seen twice, and two places that look alike.

    Args:
        table: poses of the scans.
        vectors: unit vectors of the scans, from `pooled_vector`.
        num_pairs: largest number of pairs, half of each kind.
        rng: source of the draws.

    Returns:
        Rows of the scans; fewer pairs where there are fewer.
    """
    path = np.concatenate([path_lengths(table.T_world_lidar[table.scene == one]) for one in np.unique(table.scene)])
    # The mean of all vectors is common to all places.
    centred = vectors - vectors.mean(axis=0)
    centred /= np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-9)
    again, alike = list[tuple[int, int]](), list[tuple[int, int]]()
    for row in rng.permutation(len(table))[: 4 * num_pairs].tolist():
        distances = table.distances_from(row)
        passes = np.flatnonzero((distances < OVERLAP_M) & (np.abs(path - path[row]) > REVISIT_PATH_M))
        if len(passes):
            again.append((row, int(rng.choice(passes))))
        cosines = np.where(distances >= OVERLAP_M, centred @ centred[row], -np.inf)
        if np.isfinite(best := cosines.max()):
            alike.append((row, int(np.flatnonzero(cosines == best)[0])))
    half = num_pairs // 2
    return np.array(again[:half] + alike[:half], int).reshape(-1, 2)


def _make_pool(store: ScanStore, model: Model, config: TrainingConfig, seed: int) -> PairFeatures:
    """Encodes scans once, draws pairs of them, and correlates the pairs."""
    settings, rng = config.overlap, np.random.default_rng([POOL_STREAM, seed])
    num_scans = min(len(store.table), MAX_POOL_SCANS, 2 * settings.pool_pairs)
    rows = np.unique(np.linspace(0, len(store.table) - 1, num_scans).astype(int))
    clouds = in_chunks(lambda some: _encode(model, store.read(some, config, rng)[0]), rows, at_once=SCANS_AT_ONCE)
    table = ScanTable(store.table.T_world_lidar[rows], store.table.scene[rows])
    vectors = np.stack([pooled_vector(jax.tree.map(lambda leaf, k=k: leaf[k], clouds)) for k in range(len(rows))])
    hard = hard_pairs(table, vectors, round(HARD_SHARE * settings.pool_pairs), rng)
    pairs = np.concatenate([draw_overlap_pairs(table, settings.pool_pairs - len(hard), rng), hard])
    features, mask = in_chunks(lambda some: _correlated(model, *_sides(clouds, some)), pairs, at_once=PAIRS_AT_ONCE)
    return PairFeatures(features, mask, overlap_labels(table, pairs))


def _pool_batch(pool: PairFeatures, config: TrainingConfig, seed: int, step: int) -> PairFeatures:
    """Returns the batch of a step; every pair is in one batch of an epoch."""
    num_pairs, size = len(pool.is_overlap), config.overlap.batch_pairs
    epochs, places = np.divmod(np.arange(step * size, (step + 1) * size), num_pairs)
    orders = [np.random.default_rng([ORDER_STREAM, seed, one, 1]).permutation(num_pairs) for one in np.unique(epochs)]
    rows = np.concatenate(orders)[places + num_pairs * (epochs - epochs[0])]
    return PairFeatures(*(column[rows] for column in pool))


def _new_pairs(store: ScanStore, model: Model, config: TrainingConfig, seeds: tuple[int, int]) -> PairFeatures:
    """Draws the pairs of a step with new augmentations, as published, and encodes them."""
    rng = np.random.default_rng([PAIR_STREAM, *seeds])
    pairs = draw_overlap_pairs(store.table, config.overlap.batch_pairs, rng)
    scans, _ = store.read(pairs.ravel(), config, rng)
    features, mask = _correlated(model, *_sides(_encode(model, scans), np.arange(pairs.size).reshape(pairs.shape)))
    return PairFeatures(features, mask, overlap_labels(store.table, pairs))


def overlap_labels(table: ScanTable, pairs: Int[np.ndarray, "p 2"]) -> Bool[np.ndarray, " p"]:
    """Returns True for pairs of scans of one drive that are less than 20 m apart.

    Args:
        table: poses and drive of each scan.
        pairs: rows of the table.

    Returns:
        A label for each pair.
    """
    apart_m = np.linalg.norm(table.positions[pairs[:, 0]] - table.positions[pairs[:, 1]], axis=1)
    return np.asarray((apart_m < OVERLAP_M) & (table.scene[pairs[:, 0]] == table.scene[pairs[:, 1]]))


def _sides(clouds: DescriptorCloud, pairs: Int[np.ndarray, "p 2"]) -> Iterator[DescriptorCloud]:
    return (jax.tree.map(lambda leaf, side=side: leaf[side], clouds) for side in pairs.T)


@jax.jit
def _encode(model: Model, scans: SampleScans) -> DescriptorCloud:
    clouds = jax.lax.map(functools.partial(encode_sample, model), scans, batch_size=SCANS_AT_ONCE)
    return clouds.described


@jax.jit
def _correlated(model: Model, sources: DescriptorCloud, targets: DescriptorCloud) -> tuple[Array, Array]:
    pairs = jax.lax.map(lambda pair: correlate(model, *pair), (sources, targets), batch_size=PAIRS_AT_ONCE)
    features, mask = (jnp.stack([getattr(cloud, name) for cloud in pairs], axis=1) for name in ("features", "mask"))
    return features.astype(jnp.float16), mask


@jax.jit
def _step(
    state: OverlapState,
    model: Model,
    batch: PairFeatures,
    learning_rate: Float[AnyArray, ""] | float,
    weight_decay: Float[AnyArray, ""] | float,
) -> tuple[OverlapState, Array, Array]:
    def loss_of(head: dict[str, Any]) -> tuple[Array, Array]:
        logits = head_logits(with_head(model, head, is_trained=False), batch)
        losses = optax.sigmoid_binary_cross_entropy(logits, jnp.asarray(batch.is_overlap, jnp.float32))
        return jnp.mean(losses), jnp.mean((logits > 0) == batch.is_overlap)

    (loss, accuracy), gradient = jax.value_and_grad(loss_of, has_aux=True)(state.head)
    updates, optimizer = OPTIMIZER.update(gradient, state.optimizer)
    head = jax.tree.map(
        lambda value, update: value - learning_rate * (update + weight_decay * value), state.head, updates
    )
    return OverlapState(head, optimizer, state.step + 1), loss, accuracy


def head_logits(model: Model, pairs: PairFeatures) -> Float[Array, " p"]:
    """Applies the overlap head to the features of pairs.

    Args:
        model: the model.
        pairs: the features.

    Returns:
        The logits.
    """

    def one(features: Array, mask: Array) -> Array:
        clouds = [DescriptorCloud(jnp.zeros((mask.shape[1], 3)), features[side], mask[side]) for side in (0, 1)]
        return jnp.asarray(decode(model, *clouds, part="overlap_logit"))

    return jax.vmap(one)(jnp.asarray(pairs.features, jnp.float32), jnp.asarray(pairs.mask))
