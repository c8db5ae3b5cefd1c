"""Motions that most point pairs agree on, even if most pairs are wrong.

A rigid motion keeps distances: two right pairs have the same distance between their points on both sides. So right
pairs agree with each other, and wrong ones only by chance (spectral matching, Leordeanu and Hebert 2005). Two pairs
that agree and have many third pairs in common that agree with both are right with far better odds (second-order
compatibility, Chen et al. 2022). Each of the best pairs proposes a motion from the pairs that are most compatible with
it. Proposals are ranked by their support, and of near-equal ones only the best is kept (non-maximum suppression).
"""

from __future__ import annotations

from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import as_float, as_mask, as_points, require_fields, require_shape
from dpmjax.geometry import rigid
from dpmjax.geometry.alignment import motions_of_weights
from dpmjax.geometry.traced import is_usable, typed_jit
from dpmjax.types import AnyArray

# Two pairs agree if the distances between their points differ by less than this on the two sides, metres. Points nearer
# to each other than this, on either side, are not compared.
AGREEMENT_M = 1.0
# A pair farther apart than this under a motion does not support it, metres.
INLIER_M = 2.0
# Number of pairs that support each pair.
NUM_PARTNERS = 8
# Of two motions that put the source points nearer to each other than this, on average, only the one with more support
# is returned, metres.
DISTINCT_M = 2.0


@dataclass(frozen=True)
class ConsensusConfig:
    """Numbers of motions.

    Attributes:
        num_seeds: number of pairs that propose a motion.
        num_rounds: number of times that a motion is fitted again to the pairs that support it.
        num_motions: largest number of motions that are returned.
    """

    num_seeds: int = 128
    num_rounds: int = 5
    num_motions: int = 24

    def __post_init__(self) -> None:
        require_fields(self, "num_seeds", "num_rounds", "num_motions", low=1)


@flax.struct.dataclass
class Consensus:
    """The best distinct motions, best first, and the pairs that support each.

    Attributes:
        T_target_source: the motions; where there are fewer, the first is repeated with support 0.
        is_inlier: True for pairs nearer than `INLIER_M` under each.
        support: sum of 1 - error / INLIER_M over the inliers; pairs of nearly the same points count as one. Only the
            caller can estimate the support that arises by chance.
    """

    T_target_source: Float[Array, "*b h 4 4"]
    is_inlier: Bool[Array, "*b h k"]
    support: Float[Array, "*b h"]


@typed_jit("config")
def find_consensus(
    source: Float[AnyArray, "k 3"],
    target: Float[AnyArray, "k 3"],
    mask: Bool[AnyArray, " k"] | None = None,
    *,
    config: ConsensusConfig = ConsensusConfig(),
) -> Consensus:
    """The motions from source to target that most pairs support. For one set of pairs; `vmap` for more.

    Memory and time grow with the square and the cube of the number of pairs; 1,000 take tens of milliseconds.

    Args:
        source: metres, source frame.
        target: metres, target frame, row for row.
        mask: False for pairs that are not there; they may hold anything. A pair with a coordinate that is not a number
            from -1e15 to 1e15 is not there either.
        config: numbers of motions.

    Returns:
        `config.num_motions` motions, best first; with fewer than three pairs that agree the first is a guess with
        little support. Without derivative.

    Raises:
        ValueError: the shapes do not match.
    """
    source, target = as_points("source", source, dimensions=(3,)), as_points("target", target, dimensions=(3,))
    require_shape("target", target, source.shape)
    is_there: Bool[Array, " k"] = as_mask("mask", mask, source.shape[:1])
    if len(source) == 0:
        num, dtype = config.num_motions, source.dtype
        motions = jnp.tile(jnp.eye(4, dtype=dtype), (num, 1, 1))
        return Consensus(motions, jnp.zeros((num, 0), bool), jnp.zeros(num, dtype))
    source, target = lax.stop_gradient((source, target))
    is_there = is_there & is_usable(source) & is_usable(target)
    source, target = (as_float("points", jnp.where(is_there[:, None], points, 0)) for points in (source, target))
    agreement, worth = _second_order(source, target, is_there)
    _, seeds = lax.top_k(jnp.sum(agreement, axis=1), min(config.num_seeds, len(source)))
    strength, partners = lax.top_k(agreement[seeds], min(NUM_PARTNERS, len(source)))
    rows = jnp.arange(len(seeds))
    weights = jnp.zeros((len(seeds), len(source)), source.dtype)
    weights = weights.at[rows[:, None], partners].set(strength > 0).at[rows, seeds].set(1)
    motions = motions_of_weights(source, target, jnp.where(is_there, weights, 0))

    def refit(_: Int[Array, ""], motions: Array) -> Array:
        weights = worth * _closeness(motions, source, target)
        # Two pairs leave a rotation open: then the motion stays.
        is_enough = jnp.sum(weights > 0, axis=1) >= 3
        return jnp.where(is_enough[:, None, None], motions_of_weights(source, target, weights), motions)

    motions = lax.fori_loop(0, config.num_rounds, refit, motions)
    supports = jnp.sum(worth * _closeness(motions, source, target), axis=1)
    chosen, supports = _distinct(motions, supports, source, is_there, config)
    motions = motions[chosen]
    closeness = _closeness(motions, source, target)
    return Consensus(motions, is_there & (closeness > 0) & (supports > 0)[:, None], supports)


def _distinct(
    motions: Float[Array, "s 4 4"],
    supports: Float[Array, " s"],
    source: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    config: ConsensusConfig,
) -> tuple[Int[Array, " h"], Float[Array, " h"]]:
    """Returns rows and supports of the best motions after non-maximum suppression; support 0 where there are fewer."""
    # The mean distance over the points grows with the translation and with the rotation.
    moved = jax.vmap(lambda T: rigid.transform_points(T, source))(motions)
    first = jnp.argmax(supports)

    def pick(remaining: Float[Array, " s"], _: None) -> tuple[Array, tuple[Array, Array]]:
        best = jnp.argmax(remaining)
        support = remaining[best]
        apart = jnp.sqrt(jnp.sum((moved - moved[best]) ** 2, axis=2))
        is_same = jnp.sum(jnp.where(mask, apart, 0), axis=1) <= DISTINCT_M * jnp.sum(mask)
        return jnp.where(is_same, 0, remaining), (jnp.where(support > 0, best, first), support)

    _, (rows, kept) = lax.scan(pick, supports, None, length=config.num_motions)
    return rows, kept


def motion_support(
    T_target_source: Float[Array, "4 4"],
    source: Float[Array, "k 3"],
    target: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
) -> Float[Array, ""]:
    """The support of any motion, as `Consensus.support`.

    Args:
        T_target_source: the motion.
        source: metres, source frame.
        target: metres, target frame, row for row.
        mask: False for pairs that are not there; they may hold anything finite.

    Returns:
        The support.
    """
    worth = _worth(_distances(source), _distances(target), mask)
    return jnp.sum(worth * _closeness(T_target_source[None], source, target)[0])


def _second_order(
    source: Float[Array, "k 3"], target: Float[Array, "k 3"], mask: Bool[Array, " k"]
) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
    """Returns second-order compatibility and votes.

    The compatibility of two pairs that agree is the number of other pairs that agree with both, else 0. Pairs whose
    points are nearer to each other than `AGREEMENT_M` on both sides share one vote.
    """
    lengths, other_lengths = _distances(source), _distances(target)
    is_pair = mask[:, None] & mask[None, :]
    is_apart = jnp.minimum(lengths, other_lengths) > AGREEMENT_M
    agrees = (jnp.abs(lengths - other_lengths) < AGREEMENT_M) & is_apart & is_pair
    agrees = agrees.astype(jnp.float32)
    return agrees * (agrees @ agrees), _worth(lengths, other_lengths, mask)


def _worth(
    lengths: Float[Array, "k k"], other_lengths: Float[Array, "k k"], mask: Bool[Array, " k"]
) -> Float[Array, " k"]:
    is_same = (jnp.maximum(lengths, other_lengths) <= AGREEMENT_M) & mask[:, None] & mask[None, :]
    return mask / jnp.maximum(jnp.sum(is_same, axis=1), 1).astype(lengths.dtype)


def _distances(points: Float[Array, "k 3"]) -> Float[Array, "k k"]:
    squared = [(points[:, None, axis] - points[None, :, axis]) ** 2 for axis in range(3)]
    return jnp.sqrt(squared[0] + squared[1] + squared[2])


def _closeness(
    T: Float[Array, "h 4 4"], source: Float[Array, "k 3"], target: Float[Array, "k 3"]
) -> Float[Array, "h k"]:
    """Returns 1 for a pair that meets under a motion, falling to 0 at `INLIER_M`."""
    # Coordinate by coordinate: arrays whose last axis is 3 are four times slower on a CPU.
    x, y, z = source.T
    squared = sum(
        (row[:, :1] * x + row[:, 1:2] * y + row[:, 2:3] * z + row[:, 3:] - along) ** 2
        for row, along in zip(jnp.moveaxis(T[:, :3], 1, 0), target.T, strict=True)
    )
    return jnp.maximum(1 - jnp.sqrt(squared) / INLIER_M, 0)
