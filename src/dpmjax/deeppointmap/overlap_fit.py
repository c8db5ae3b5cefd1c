"""Fit of the overlap probability: a small network on the evidence of thousands of pairs, and its calibration.

The evidence of each pair is computed once (`deeppointmap.overlap`), so a step costs less than a millisecond. Towns are
divided into three parts: one to learn from, one that says when to stop, one that scales the log odds to probabilities
(temperature and bias; Platt 1999).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import require_fields, require_positive_fields
from dpmjax.deeppointmap.confidence import logistic_weights
from dpmjax.deeppointmap.overlap import evidence_logit
from dpmjax.losses.descriptors import overlap_loss

NUM_PARTS = 5
"""Of five towns, three are learned from, one says when to stop, one calibrates."""


@dataclass(frozen=True)
class OverlapFitConfig:
    """Settings of the fit.

    Attributes:
        hidden_channels: width of the network.
        num_steps: steps of AdamW, each on all pairs.
        learning_rate: at the first step; it falls to 0 by half a cosine.
        weight_decay: of AdamW.
    """

    hidden_channels: int = 16
    num_steps: int = 1500
    learning_rate: float = 5e-3
    weight_decay: float = 1e-2

    def __post_init__(self) -> None:
        require_fields(self, "hidden_channels", "num_steps", low=1)
        require_positive_fields(self, "learning_rate")
        require_fields(self, "weight_decay", low=0)


class OverlapPairs(NamedTuple):
    """Pairs with known distance.

    Attributes:
        evidence: from `overlap_evidence`.
        is_overlap: whether the two are less than 20 m apart.
        town: number of the town of each pair.
    """

    evidence: Float[np.ndarray, "n f"]
    is_overlap: Bool[np.ndarray, " n"]
    town: Int[np.ndarray, " n"]

    def select(self, rows: Bool[np.ndarray, " n"]) -> OverlapPairs:
        """Selects pairs.

        Args:
            rows: True for those to keep.

        Returns:
            The pairs.
        """
        return OverlapPairs(*(part[rows] for part in self))


def fit_overlap(pairs: OverlapPairs, config: OverlapFitConfig = OverlapFitConfig()) -> dict[str, Any]:
    """Fits the network that turns evidence into log odds.

    Args:
        pairs: of at least three towns that the encoder was not trained on.
        config: settings.

    Returns:
        The parameters, for `Model.params["overlap"]`.

    Raises:
        ValueError: if a part of the towns has overlapping pairs only, or none.
    """
    towns = np.unique(pairs.town)
    parts = np.searchsorted(towns, pairs.town) % NUM_PARTS
    stop, calibrate = (1, 2) if len(towns) < NUM_PARTS else (3, 4)
    part_of = [~np.isin(parts, (stop, calibrate)), parts == stop, parts == calibrate]
    learned, watched, calibrated = map(pairs.select, part_of)
    for some in (learned, watched, calibrated):
        if some.is_overlap.all() or not some.is_overlap.any():
            found = f"got {some.is_overlap.sum()} of {len(some.town)} in a part of the towns"
            raise ValueError(f"pairs: expected pairs with and without overlap, {found}")
    params = _learn(learned, watched, config)
    logits = np.asarray(evidence_logit(params, calibrated.evidence), np.float64)
    weights, bias = logistic_weights(logits[:, None], calibrated.is_overlap)
    last = params["output"]
    last = {"kernel": last["kernel"] * weights[0], "bias": last["bias"] * weights[0] + bias}
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), {**params, "output": last})


def held_out_probability(
    pairs: OverlapPairs, config: OverlapFitConfig = OverlapFitConfig()
) -> Float[np.ndarray, " n"]:
    """Computes the probability of each pair by a fit on other towns.

    Args:
        pairs: of at least six towns.
        config: settings.

    Returns:
        The probabilities.
    """
    towns = np.unique(pairs.town)
    found = np.empty(len(pairs.town))
    for part in range(NUM_PARTS):
        rows = np.searchsorted(towns, pairs.town) // -(-len(towns) // NUM_PARTS) == part
        if rows.any():
            params = fit_overlap(pairs.select(~rows), config)
            found[rows] = jax.nn.sigmoid(evidence_logit(params, jnp.asarray(pairs.evidence[rows], jnp.float32)))
    return found


def area_under_curve(score: Float[np.ndarray, " n"], is_overlap: Bool[np.ndarray, " n"]) -> float:
    """Computes the area under the ROC curve: how often an overlapping pair scores higher than another one.

    Args:
        score: of each pair.
        is_overlap: which of them overlap.

    Returns:
        In [0, 1]; ties count half. NaN without a pair of either kind.
    """
    near, far = score[is_overlap], score[~is_overlap]
    wins = (near[:, None] > far[None]) + 0.5 * (near[:, None] == far[None])
    return float(wins.mean()) if wins.size else float("nan")


def _learn(learned: OverlapPairs, watched: OverlapPairs, config: OverlapFitConfig) -> dict[str, Any]:
    num, width = learned.evidence.shape[1], config.hidden_channels
    rng = np.random.default_rng(0)
    start = {
        "mean": learned.evidence.mean(axis=0),
        "scale": np.maximum(learned.evidence.std(axis=0), 1e-6),
        "hidden": {"kernel": rng.normal(0, num**-0.5, (num, width)), "bias": np.zeros(width)},
        "output": {"kernel": rng.normal(0, width**-0.5, (width, 1)), "bias": np.zeros(1)},
    }
    start = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), start)
    data = [(jnp.asarray(some.evidence, jnp.float32), jnp.asarray(some.is_overlap)) for some in (learned, watched)]
    return _descend(start, *data, config=config)


@partial(jax.jit, static_argnames="config")
def _descend(
    start: dict[str, Any], learned: tuple[Array, Array], watched: tuple[Array, Array], *, config: OverlapFitConfig
) -> dict[str, Any]:
    """Returns the parameters of the step with the least loss on the watched pairs."""
    fixed = {name: start[name] for name in ("mean", "scale")}
    layers = {name: start[name] for name in ("hidden", "output")}
    rate = optax.cosine_decay_schedule(config.learning_rate, config.num_steps)
    optimizer = optax.adamw(rate, weight_decay=config.weight_decay)

    def loss_of(layers: dict[str, Any], data: tuple[Array, Array]) -> Float[Array, ""]:
        return overlap_loss(evidence_logit({**fixed, **layers}, data[0]), data[1])

    def step(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], None]:
        layers, state, best, least = carry
        updates, state = optimizer.update(jax.grad(loss_of)(layers, learned), state, layers)
        layers = optax.apply_updates(layers, updates)
        loss = loss_of(layers, watched)
        best = jax.tree.map(lambda new, old: jnp.where(loss < least, new, old), layers, best)
        return (layers, state, best, jnp.minimum(loss, least)), None

    begin = (layers, optimizer.init(layers), layers, jnp.asarray(jnp.inf))
    (_, _, best, _), _ = jax.lax.scan(step, begin, None, length=config.num_steps)
    return {**fixed, **best}
