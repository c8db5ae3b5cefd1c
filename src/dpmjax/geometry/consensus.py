"""The motion that most point pairs agree on, even if most pairs are wrong.

A rigid motion keeps distances: two right pairs have the same distance between their points on both sides. So right
pairs agree with each other, and wrong ones only by chance (spectral matching, Leordeanu and Hebert 2005). Two pairs
that agree and have many third pairs in common that agree with both are right with far better odds (second-order
compatibility, Chen et al. 2022). Each of the best pairs proposes a motion from the pairs it goes best with; the one
with the most support is taken.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import as_float, as_mask, as_points, require_count, require_positive, require_shape
from dpmjax.geometry import rigid
from dpmjax.geometry.alignment import weighted_svd
from dpmjax.types import AnyArray


@dataclass(frozen=True)
class ConsensusConfig:
    """Tolerances, and how many motions are tried.

    Attributes:
        agreement_m: two pairs agree if the distances between their points differ by less than this on the two sides.
            Points nearer to each other than this, on either side, are not compared.
        inlier_m: a pair farther apart than this under a motion does not support it.
        num_seeds: how many pairs propose a motion.
        num_partners: from how many other pairs each.
        num_rounds: how often a motion is fitted again to what supports it.
    """

    agreement_m: float = 1.0
    inlier_m: float = 2.0
    num_seeds: int = 40
    num_partners: int = 8
    num_rounds: int = 5

    def __post_init__(self) -> None:
        for name in ("agreement_m", "inlier_m"):
            require_positive(name, getattr(self, name))
        for name in ("num_seeds", "num_partners", "num_rounds"):
            require_count(name, getattr(self, name))


@flax.struct.dataclass
class Consensus:
    """A motion and the pairs that support it.

    Attributes:
        T_target_source: the motion.
        is_inlier: which pairs are nearer than `inlier_m` under it.
        support: sum of 1 - error / inlier_m over the inliers; pairs of nearly the same points count as one. The caller
            knows how much support arises by chance.
    """

    T_target_source: Float[Array, "*b 4 4"]
    is_inlier: Bool[Array, "*b k"]
    support: Float[Array, "*b"]


def find_consensus(
    source: Float[AnyArray, "k 3"],
    target: Float[AnyArray, "k 3"],
    mask: Bool[AnyArray, " k"] | None = None,
    *,
    config: ConsensusConfig = ConsensusConfig(),
) -> Consensus:
    """The motion from source to target that most pairs support. For one set of pairs; `vmap` for more.

    Memory and time grow with the square and the cube of the number of pairs; 1,000 take tens of milliseconds.

    Args:
        source: metres, source frame.
        target: metres, target frame, row for row.
        mask: False for pairs that are not there; they may hold anything.
        config: tolerances.

    Returns:
        The motion; with fewer than three pairs that agree it is a guess with little support. Without derivative.

    Raises:
        ValueError: the shapes do not match.
    """
    source, target = as_points("source", source, dimensions=(3,)), as_points("target", target, dimensions=(3,))
    require_shape("target", target, source.shape)
    mask = as_mask("mask", mask, source.shape[:1])
    if len(source) == 0:
        return Consensus(jnp.eye(4, dtype=source.dtype), jnp.zeros(0, bool), jnp.zeros((), source.dtype))
    return _find_consensus(*lax.stop_gradient((source, target)), mask, config=config)


@functools.partial(jax.jit, static_argnames="config")
def _find_consensus(source: jax.Array, target: jax.Array, mask: jax.Array, *, config: ConsensusConfig) -> Consensus:
    source, target = (as_float("points", jnp.where(mask[:, None], points, 0)) for points in (source, target))
    agreement, worth = _second_order(source, target, mask, config)
    _, seeds = lax.top_k(jnp.sum(agreement, axis=1), min(config.num_seeds, len(source)))

    def propose(seed: Int[Array, ""]) -> tuple[Array, Array]:
        strength, partners = lax.top_k(agreement[seed], min(config.num_partners, len(source)))
        weights = jnp.zeros(len(source)).at[partners].set(jnp.where(strength > 0, 1.0, 0.0)).at[seed].set(1.0)
        weights = jnp.where(mask, weights, 0)
        T = lax.fori_loop(
            0,
            config.num_rounds,
            lambda _, T: _refitted(source, target, worth * _closeness(T, source, target, config), T),
            weighted_svd(source, target, weights),
        )
        return T, jnp.sum(worth * _closeness(T, source, target, config))

    motions, supports = jax.vmap(propose)(seeds)
    best = jnp.argmax(supports)
    is_inlier = mask & (_closeness(motions[best], source, target, config) > 0)
    return Consensus(motions[best], is_inlier, supports[best])


def _second_order(
    source: Float[Array, "k 3"], target: Float[Array, "k 3"], mask: Bool[Array, " k"], config: ConsensusConfig
) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
    """Returns second-order compatibility and votes.

    The compatibility of two pairs that agree is the number of other pairs that agree with both, else 0. Pairs whose
    points are nearer to each other than `agreement_m` on both sides share one vote.
    """
    lengths, other_lengths = _distances(source), _distances(target)
    is_pair = mask[:, None] & mask[None, :]
    is_apart = jnp.minimum(lengths, other_lengths) > config.agreement_m
    agrees = (jnp.abs(lengths - other_lengths) < config.agreement_m) & is_apart & is_pair
    agrees = agrees.astype(jnp.float32)
    says_the_same = (jnp.maximum(lengths, other_lengths) <= config.agreement_m) & is_pair
    worth = mask / jnp.maximum(jnp.sum(says_the_same, axis=1), 1).astype(source.dtype)
    return agrees * (agrees @ agrees), worth


def _distances(points: Float[Array, "k 3"]) -> Float[Array, "k k"]:
    squared = [(points[:, None, axis] - points[None, :, axis]) ** 2 for axis in range(3)]
    return jnp.sqrt(squared[0] + squared[1] + squared[2])


def _closeness(
    T: Float[Array, "4 4"], source: Float[Array, "k 3"], target: Float[Array, "k 3"], config: ConsensusConfig
) -> Float[Array, " k"]:
    """Returns 1 for a pair that meets under the motion, falling to 0 at `inlier_m`."""
    errors = jnp.sqrt(jnp.sum((rigid.transform_points(T, source) - target) ** 2, axis=1))
    return jnp.maximum(1 - errors / config.inlier_m, 0)


def _refitted(
    source: Float[Array, "k 3"], target: Float[Array, "k 3"], weights: Float[Array, " k"], T: Float[Array, "4 4"]
) -> Float[Array, "4 4"]:
    # Two pairs leave a rotation open: then the motion stays.
    return jnp.where(jnp.sum(weights > 0) >= 3, weighted_svd(source, target, weights), T)
