"""The training objective of DeepPointMap: similar descriptors at the same place, and correct offsets.

`training_pairs` finds, from true poses, the descriptors that lie close to each other. The offset head predicts their
offsets. `matching_loss` combines the three losses. All functions take arrays, not networks.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import require_fields, require_positive_fields
from dpmjax.deeppointmap.matching import TEMPERATURE
from dpmjax.geometry import rigid
from dpmjax.geometry.neighbours import radius_search
from dpmjax.losses.descriptors import info_nce, offset_loss
from dpmjax.types import AnyArray, DescriptorCloud


@dataclass(frozen=True)
class ObjectiveConfig:
    """Weights and distances (DeepPointMap section 3.3).

    Attributes:
        coarse_weight: weight of the coarse pairing loss.
        offset_weight: weight of the offset loss; 0 leaves it out, and its term is 0.
        positive_radius_m: largest distance of the positive, which is the nearest descriptor; further descriptors within
            it are neutral.
        offset_radius_m: largest distance of the pairs whose offsets are learned.
        max_close: largest number of such pairs for each descriptor, the nearest first. Two scans need 4, maps of many
            scans need more.
    """

    coarse_weight: float = 0.1
    offset_weight: float = 1.0
    positive_radius_m: float = 1.0
    offset_radius_m: float = 2.0
    max_close: int = 16

    def __post_init__(self) -> None:
        require_positive_fields(self, "positive_radius_m", "offset_radius_m")
        require_fields(self, "coarse_weight", "offset_weight", low=0)
        require_fields(self, "max_close", low=1)


@flax.struct.dataclass
class TrainingPairs:
    """Descriptors of a second cloud that lie close to each descriptor of a first one, nearest first.

    Attributes:
        indices: row in the second cloud; 0 where `mask` is False.
        mask: False where there are fewer.
        offsets: offsets from the descriptor to its neighbour, metres, in the frame of the cloud of the descriptor; 0
            where `mask` is False.
    """

    indices: Int[AnyArray, "*b m k"]
    mask: Bool[AnyArray, "*b m k"]
    offsets: Float[AnyArray, "*b m k 3"]


@flax.struct.dataclass
class TrainingSide:
    """Input of the losses from one of two clouds.

    Attributes:
        positions: metres, in the frame of the cloud.
        mask: True for descriptors that are there; others may hold anything.
        matched_features: correlated descriptors after the similarity head.
        coarse_features: uncorrelated descriptors after the coarse head.
        close: close pairs from `training_pairs`.
        offsets: predicted offsets of the close pairs, metres, in the frame of the cloud.
    """

    positions: Float[AnyArray, "*b m 3"]
    mask: Bool[AnyArray, "*b m"]
    matched_features: Float[AnyArray, "*b m c"]
    coarse_features: Float[AnyArray, "*b m e"]
    close: TrainingPairs
    offsets: Float[AnyArray, "*b m k 3"]


class ObjectiveTerms(NamedTuple):
    """Unweighted parts of the loss, each the mean of both directions.

    Attributes:
        pairing: pairing loss, eq. 4, on correlated descriptors.
        coarse: coarse pairing loss, eq. 5, on uncorrelated descriptors.
        offset: offset loss, eq. 6.
        top1_accuracy: share of the descriptors with a positive that are most similar to this positive.
        num_positives: number of descriptors with a positive, in both clouds together.
    """

    pairing: Float[Array, ""]
    coarse: Float[Array, ""]
    offset: Float[Array, ""]
    top1_accuracy: Float[Array, ""]
    num_positives: Int[Array, ""]


def training_pairs(
    a: DescriptorCloud, b: DescriptorCloud, T_b_a: Float[AnyArray, "4 4"], *, config: ObjectiveConfig
) -> tuple[TrainingPairs, TrainingPairs]:
    """Finds the pairs closer than `offset_radius_m`, and their true offsets.

    Args:
        a: descriptors in their own frame, metres; positions and mask are read; masked ones may be anything.
        b: the same in the frame of b.
        T_b_a: the true motion.
        config: radius and capacity.

    Returns:
        The pairs of each descriptor of a, and those of each descriptor of b.
    """
    T_b_a = jnp.asarray(T_b_a)
    of_a = _close_of(a, b, rigid.inverse(T_b_a), config)
    return of_a, _close_of(b, a, T_b_a, config)


@functools.partial(jax.jit, static_argnames="config")
def matching_loss(
    a: TrainingSide, b: TrainingSide, T_b_a: Float[AnyArray, "4 4"], *, config: ObjectiveConfig
) -> tuple[Float[Array, ""], ObjectiveTerms]:
    """Combines pairing, coarse pairing and offset loss, the mean of both directions (DeepPointMap eq. 4 to 7).

    Use `vmap` for several pairs of clouds. Without any close pair, the loss and its gradient are 0.

    Args:
        a: one cloud, with the predictions of the networks.
        b: the second cloud.
        T_b_a: the true motion, metres.
        config: weights and distances.

    Returns:
        The weighted sum, and its parts.
    """
    is_pair = a.mask[:, None] & b.mask
    squared = jnp.sum((rigid.transform_points(T_b_a, a.positions)[:, None] - b.positions) ** 2, axis=-1)
    squared = lax.stop_gradient(jnp.where(is_pair, squared, jnp.inf))
    forward = _direction(a, b, squared, config)
    backward = _direction(b, a, squared.T, config)
    mean = jax.tree.map(lambda one, other: (one + other) / 2, forward, backward)
    terms = mean._replace(num_positives=forward.num_positives + backward.num_positives)
    total = terms.pairing + config.coarse_weight * terms.coarse + config.offset_weight * terms.offset
    return total, terms


def _direction(
    source: TrainingSide, target: TrainingSide, squared: Float[Array, "m n"], config: ObjectiveConfig
) -> ObjectiveTerms:
    is_close = squared <= config.positive_radius_m**2
    has_positive = jnp.any(is_close, axis=1)
    positives = jnp.where(has_positive, jnp.argmin(squared, axis=1), -1)
    is_absent = jnp.broadcast_to(~target.mask, squared.shape)
    loss = functools.partial(info_nce, positives=positives, temperature=TEMPERATURE)
    close = source.close
    offsets = source.offsets.reshape(-1, 3), close.offsets.reshape(-1, 3)
    return ObjectiveTerms(
        pairing=loss(source.matched_features, target.matched_features, ignore=is_absent),
        coarse=loss(source.coarse_features, target.coarse_features, ignore=is_absent | is_close),
        offset=offset_loss(*offsets, close.mask.reshape(-1)) if config.offset_weight else jnp.zeros(()),
        top1_accuracy=_top1_accuracy(source, target, positives),
        num_positives=jnp.sum(has_positive),
    )


def _top1_accuracy(source: TrainingSide, target: TrainingSide, positives: Int[Array, " m"]) -> Float[Array, ""]:
    is_counted = positives >= 0
    queries = jnp.where(is_counted[:, None], source.matched_features, 0)
    keys = jnp.where(target.mask[:, None], target.matched_features, 0)
    length = jnp.linalg.norm(lax.stop_gradient(keys), axis=1)
    cosines = jnp.matmul(queries, keys.T, precision=lax.Precision.HIGHEST) / jnp.where(length > 0, length, 1)
    best = jnp.argmax(jnp.where(target.mask, cosines, -jnp.inf), axis=1)
    return jnp.sum(is_counted & (best == positives)) / jnp.maximum(jnp.sum(is_counted), 1)


def _close_of(
    cloud: DescriptorCloud, other: DescriptorCloud, T_cloud_other: Float[Array, "4 4"], config: ObjectiveConfig
) -> TrainingPairs:
    positions = jnp.where(cloud.mask[:, None], cloud.positions, 0)
    others = rigid.transform_points(T_cloud_other, other.positions)
    near = radius_search(positions, others, config.offset_radius_m, config.max_close, other.mask)
    is_close = near.mask & cloud.mask[:, None]
    offsets = jnp.where(is_close[..., None], others[near.indices] - positions[:, None], 0)
    return TrainingPairs(jnp.where(is_close, near.indices, 0), is_close, offsets)
