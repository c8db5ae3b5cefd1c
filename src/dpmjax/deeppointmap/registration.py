"""Registration of scans and maps without a first guess, the same from either side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpmjax.checks import require_pairs, require_type, runs_on_host
from dpmjax.deeppointmap.matching import MatchConfig
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.prepared_scans import ScanOrCloud, is_verified_pair, prepare_each
from dpmjax.deeppointmap.scan_registration import num_elements_of, register_each
from dpmjax.geometry import rigid
from dpmjax.scans.lidar import Scan
from dpmjax.types import DescriptorCloud, Registration

# Probability from which one way is enough: of 517 such motions of real pairs two were wrong.
SURE_PROBABILITY = 0.9


@runs_on_host("call correlate and weighted_svd there")
def register(
    model: Model,
    source: ScanOrCloud,
    target: ScanOrCloud,
    *,
    config: MatchConfig | None = None,
    refine: bool | None = None,
    scale: float = 1.0,
) -> Registration:
    """Registers two scans or maps without a first guess (DeepPointMap section 3.2).

    For two scans, the scans themselves verify the best distinct motions of their descriptors: points must meet surfaces
    and must not lie in free space. If none of these motions is clearly right, motions under which the scans look alike
    from above are tried too. In corridors, motions along the axis and half-turns are added. The motion under which the
    scans agree best is taken. Descriptor clouds have no points: the best motion of the descriptors is taken, and
    refined by their surface elements.

    With a calibrated model, exchanged scans give the inverse motion with the same probability. The library chooses
    which scan is the source. If the probability is below 0.9, it exchanges the scans and registers them again, and
    takes the more probable motion.

    Args:
        model: encoder and decoder.
        source: a raw scan (n, 3) in metres or its file, a scan from `prepare_scan`, or a descriptor cloud.
        target: the same; a scan can be registered with a map.
        config: choice of pairs and inliers; None takes that of the model.
        refine: True ends with a fine point-to-plane alignment, of two scans or else of the surface elements of both
            clouds, if they have some. False returns the motion of the short alignment that verified it for two
            scans, else that of the descriptors. None is True with a calibrated model; published weights give the
            published motion.
        scale: factor by which raw scans are enlarged for the encoder, or by which the scans of descriptors were.
            Prepared scans have their own. The result is in metres.

    Returns:
        `T_target_source`, `confidence`, `rmse` and the pairs. The confidence of a calibrated model
        (`model.config.calibration`) is the probability that the motion is right within 2 m and 5 degrees. Without
        calibration it is the mean score of the pairs, which is no probability. Refined clouds of single scans with 512
        elements or more have the agreement of their elements as evidence, too. The ends of corridors may look alike in
        all elements, so the confidence of clouds is at most 0.88 there. A motion that only the views from above
        suggested has no inliers, and without calibration the confidence 0. Failure is data. The motion is the identity
        and the confidence 0 if there is neither a pair nor a view, or if either side has fewer than 20 descriptors.
        With fewer than three distinct pairs, `rmse` is infinite.

    Raises:
        ValueError: if the model is none, the points are no real numbers (n, 3), features have another width than the
            model, the scale is not positive, or both have another scale.
    """
    return _register_either_way(model, [(source, target)], config=config, refine=refine, scale=scale)[0]


@runs_on_host("call correlate and weighted_svd there")
def register_pairs(
    model: Model,
    sources: Sequence[ScanOrCloud],
    targets: Sequence[ScanOrCloud],
    *,
    config: MatchConfig | None = None,
    refine: bool | None = None,
    scale: float = 1.0,
) -> Registration:
    """Registers many pairs as `register` does; a scan that is in several pairs is prepared once.

    Args:
        model: encoder and decoder.
        sources: raw scans, prepared scans or descriptor clouds; clouds must have one capacity.
        targets: the same, one for each source.
        config: see `register`.
        refine: see `register`.
        scale: see `register`; all raw scans share one.

    Returns:
        All fields with a leading axis, in the order of the pairs.

    Raises:
        ValueError: if the lengths differ or are 0, if some pairs are scans and others have a descriptor cloud, or where
            `register` raises one for a pair.
    """
    require_pairs(sources, targets)
    pairs = list(zip(sources, targets, strict=True))
    if len({any(isinstance(scan, DescriptorCloud) for scan in pair) for pair in pairs}) > 1:
        raise ValueError("sources, targets: expected scans in all pairs, or a descriptor cloud in each, got both")
    found = _register_either_way(model, pairs, config=config, refine=refine, scale=scale)
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *jax.device_get(found))


def _register_either_way(
    model: Model,
    pairs: Sequence[tuple[ScanOrCloud, ScanOrCloud]],
    *,
    refine: bool | None,
    scale: float,
    **options: MatchConfig | None,
) -> list[Registration]:
    """Registers each pair one way, and unsure pairs both ways. Without calibration, the given way is the only one."""
    require_type("model", model, Model, "load_model")
    if model.config.calibration is None:
        return register_each(model, pairs, refine=refine, scale=scale, **options)
    settings: dict[str, Any] = {"refine": refine, "scale": scale, **options}
    ready = prepare_each(model, pairs, scale, num_elements=num_elements_of(model, refine=refine))
    uses = [(*pair, is_verified_pair(pair)) for pair in pairs]
    prepared = [(ready[id(source), use], ready[id(target), use]) for source, target, use in uses]
    is_turned = [_order(source) > _order(target) for source, target in prepared]
    one_way = [pair[::-1] if turned else pair for pair, turned in zip(prepared, is_turned, strict=True)]
    found = register_each(model, one_way, **settings)
    unsure = [row for row, one in enumerate(found) if one.confidence < SURE_PROBABILITY]
    for row, other in zip(
        unsure, register_each(model, [one_way[row][::-1] for row in unsure], **settings), strict=True
    ):
        if other.confidence > found[row].confidence:
            found[row] = inverse_registration(other)
    return [inverse_registration(one) if turned else one for one, turned in zip(found, is_turned, strict=True)]


def _order(scan: Scan | DescriptorCloud) -> tuple[int, float]:
    """Returns an order of scans that does not depend on the side of the pair."""
    points = scan.surface.points if isinstance(scan, Scan) else np.where(scan.mask[:, None], scan.positions, 0)
    return len(points), float(np.sum(points))


def inverse_registration(found: Registration) -> Registration:
    """Exchanges source and target of a registration.

    Args:
        found: one registration.

    Returns:
        The motion from the target to the source, with the same confidence and evidence.
    """
    T = jnp.asarray(rigid.inverse(np.asarray(found.T_target_source)))
    swapped = replace(
        found, T_target_source=T, source_indices=found.target_indices, target_indices=found.source_indices
    )
    if found.weak_direction is not None and found.relative_size is not None:
        direction, size = T[:3, :3] @ found.weak_direction, 1 / found.relative_size
        swapped = replace(swapped, weak_direction=direction, relative_size=size)
    return swapped
