"""Many scans and many pairs at once: chunks of one size in one compiled program, while the host prepares the next."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dpmjax.deeppointmap.encoding import pyramid_of_scan
from dpmjax.deeppointmap.matching import MatchConfig
from dpmjax.deeppointmap.model import Model, encode_pyramid
from dpmjax.deeppointmap.overlap_prediction import overlap_evidence, overlap_probability
from dpmjax.deeppointmap.scan_registration import PreparedScan, Scale, ScanOrCloud, register_each
from dpmjax.types import AnyArray, DescriptorCloud, PointCloud, Registration

CHUNK = 4


def encode_scans(
    model: Model,
    scans: Sequence[PointCloud | Float[AnyArray, "_n 3"]],
    *,
    scale: float = 1.0,
    num_elements: int | None = None,
) -> DescriptorCloud:
    """Encodes many raw scans; they may have different numbers of points.

    A `ValueError` says if there is no scan, or if points are no real numbers (n, 3).

    Args:
        model: encoder and configuration.
        scans: points in metres, each in the frame of its lidar.
        scale: see `encode`.
        num_elements: see `encode`.

    Returns:
        Stacked clouds, as `merge_clouds` takes them: positions (s, n, 3), features (s, m, c), mask (s, n).
    """
    _require_some("scans", scans)
    parts = []
    for start in range(0, len(scans), CHUNK):
        # JAX still encodes the chunk before.
        pyramids = [pyramid_of_scan(points, model.config, scale=scale) for points in scans[start : start + CHUNK]]
        parts.append(_encode_chunk(model, _stacked(pyramids), num_elements=num_elements))
    return _joined(parts, len(scans))


def register_pairs(
    model: Model,
    sources: Sequence[ScanOrCloud],
    targets: Sequence[ScanOrCloud],
    *,
    config: MatchConfig | None = None,
    refine: bool | None = None,
    scale: Scale = 1.0,
) -> Registration:
    """Registers many pairs as `register` does; a scan that is in several pairs is prepared once.

    A `ValueError` says if the lengths differ or are 0, and what `register` would say of a pair.

    Args:
        model: encoder and decoder.
        sources: raw scans, prepared scans or descriptor clouds; clouds must have one capacity.
        targets: the same, one for each source.
        config: see `register`.
        refine: see `register`.
        scale: see `register`; all raw scans share one.

    Returns:
        All fields with a leading axis, in the order of the pairs.
    """
    _require_pairs(sources, targets)
    found = register_each(model, list(zip(sources, targets, strict=True)), config=config, refine=refine, scale=scale)
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *jax.device_get(found))


def overlap_pairs(model: Model, sources: Sequence[ScanOrCloud], targets: Sequence[ScanOrCloud]) -> Float[Array, " n"]:
    """Predicts the overlap probability of many pairs as `overlap` does; each scan is encoded once.

    A `ValueError` says if the lengths differ or are 0.

    Args:
        model: encoder and decoder.
        sources: raw scans, prepared scans or descriptor clouds; clouds must have one capacity.
        targets: the same, one for each source.

    Returns:
        The probabilities.
    """
    return _of_pairs(_overlap_chunk, model, sources, targets)


def evidence_pairs(model: Model, sources: Sequence[ScanOrCloud], targets: Sequence[ScanOrCloud]) -> Float[Array, "n f"]:
    """Computes the features of the overlap probability of many pairs.

    A `ValueError` says if the lengths differ or are 0.

    Args:
        model: encoder and decoder.
        sources: as in `overlap_pairs`.
        targets: the same, one for each source.

    Returns:
        A row for each pair, in the order of `confidence.OVERLAP_FEATURES`.
    """
    return _of_pairs(_evidence_chunk, model, sources, targets)


def _of_pairs(chunk: Any, model: Model, sources: Sequence[ScanOrCloud], targets: Sequence[ScanOrCloud]) -> Any:
    """Applies the function of a chunk of pairs to all of them; each scan is encoded once."""
    _require_pairs(sources, targets)
    scans = {id(scan): scan for scan in (*sources, *targets)}
    raw = [scan for scan in scans.values() if not isinstance(scan, DescriptorCloud | PreparedScan)]
    encoded = jax.device_get(encode_scans(model, raw)) if raw else None
    numbers = {id(scan): number for number, scan in enumerate(raw)}

    def cloud(scan: Any) -> DescriptorCloud:
        if id(scan) in numbers:
            found: DescriptorCloud = jax.tree.map(lambda leaf: leaf[numbers[id(scan)]], encoded)
        else:
            found = scan.descriptors if isinstance(scan, PreparedScan) else scan
        return found.described

    clouds = {key: cloud(scan) for key, scan in scans.items()}
    pairs = [(clouds[id(source)], clouds[id(target)]) for source, target in zip(sources, targets, strict=True)]
    chunks = (_stacked(pairs[start : start + CHUNK]) for start in range(0, len(pairs), CHUNK))
    return _joined([chunk(model, some) for some in chunks], len(pairs))


@functools.partial(jax.jit, static_argnames="num_elements")
def _encode_chunk(model: Model, pyramids: Any, *, num_elements: int | None) -> DescriptorCloud:
    return jax.lax.map(functools.partial(encode_pyramid, model, num_elements=num_elements), pyramids)


@jax.jit
def _overlap_chunk(model: Model, pairs: Any) -> Float[Array, " n"]:
    return jax.vmap(lambda pair: overlap_probability(model, *pair))(pairs)


@jax.jit
def _evidence_chunk(model: Model, pairs: Any) -> Float[Array, "n f"]:
    return jnp.stack(jax.vmap(lambda pair: overlap_evidence(model, *pair))(pairs), axis=1)


def _stacked(items: list[Any]) -> Any:
    """Returns a chunk of stacked items; the last is repeated to fill it."""
    filled = items + [items[-1]] * (CHUNK - len(items))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *filled)


def _joined(parts: Sequence[Any], num: int) -> Any:
    # On the host: there, another number of parts compiles nothing.
    parts = jax.device_get(parts)
    return jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)[:num]), *parts)


def _require_some(name: str, items: Sequence[Any]) -> None:
    if len(items) == 0:
        raise ValueError(f"{name}: expected at least one, got none")


def _require_pairs(sources: Sequence[Any], targets: Sequence[Any]) -> None:
    _require_some("sources", sources)
    if len(sources) != len(targets):
        raise ValueError(f"targets: expected {len(sources)}, one for each source, got {len(targets)}")
