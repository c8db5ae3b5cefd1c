"""DeepMapping of 3-D lidar clouds: the problem, and `register_clouds` around the engine (section 3, in SE(3)).

`spatial` has the poses, `cloud_scans` the scans, `plane_distance` how they are compared.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike, NDArray

from dpmjax.deepmapping.batches import draw_offsets, draw_rows, scans_in_block
from dpmjax.deepmapping.cloud_scans import CloudScans, as_cloud_scans, find_partners
from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig, PlaneComparison
from dpmjax.deepmapping.engine import Fit, Report, fit
from dpmjax.deepmapping.objective import Terms, WorldBatch, chamfer_term, interpolate_log
from dpmjax.deepmapping.plane_distance import PlaneCloud, clouds_of, misfit_of_pairs, take_rows, trajectory_misfit
from dpmjax.deepmapping.presets import cloud_preset
from dpmjax.deepmapping.problem import MappingData, MappingFunctions, Params, Problem, mapping_loss, mapping_problem
from dpmjax.deepmapping.spatial import (
    fitted_poses,
    init_spatial,
    next_spatial_phase,
    poses_of_scans,
    spatial_poses,
    start_poses,
)
from dpmjax.geometry import rigid
from dpmjax.geometry.sampling import typical_range

# Kernel width, in typical ranges, of the misfit by which the start and the fit are compared.
_MISFIT_KERNEL_WIDTH = 0.004


class CloudFitted(NamedTuple):
    """Result of `register_clouds`.

    Attributes:
        T_world_scan: (n, 4, 4) float64, unit of the points: of the fit, or the start where that fits better.
        params: parameters of L-Net and M-Net.
        report: report of the last call of the step.
        unit: the length that the parameters count in, unit of the points.
        kept: source of the poses, the fit or the start.
        misfit: share of planes that do not meet the planes of other scans, 0 to 1, at the poses of the fit.
        start_misfit: the same at the start; None after a cold start.
    """

    T_world_scan: NDArray[np.float64]
    params: Params
    report: Report | None
    unit: float
    kept: Literal["fit", "start"]
    misfit: float
    start_misfit: float | None


def cloud_data(scans: CloudScans | Sequence[ArrayLike], start: ArrayLike | None = None) -> tuple[MappingData, float]:
    """Scans and poses with the typical range of the scans as the unit of length, as the problem takes them.

    Args:
        scans: (m_i, 3) points in the lidar frames; or CloudScans.
        start: (n, 4, 4) T_world_scan to start from; None: cold start.

    Returns:
        The data, and the typical range in the unit of the scans.

    Raises:
        ValueError: as `as_cloud_scans`, or `start` has a wrong shape or is not finite.
    """
    scans = scans if isinstance(scans, CloudScans) else as_cloud_scans(scans)
    unit = typical_range(scans.points, scans.mask)
    T_start = None if start is None else start_poses(start, len(scans.points), unit)
    scaled = replace(scans, points=scans.points / unit, spacing=scans.spacing / unit)
    if T_start is not None:
        scaled = replace(scaled, partners=find_partners(np.asarray(T_start), 1.0))
    return MappingData(scaled, T_start), unit


def cloud_problem(config: DeepMappingConfig, data: MappingData) -> Problem:
    """DeepMapping of lidar clouds; poses are (n, 4, 4) T_world_scan.

    Args:
        config: settings of the fit.
        data: data of `cloud_data`.

    Returns:
        The problem.

    Raises:
        ValueError: the motion is not "full".
    """
    if config.motion != "full":
        raise ValueError(f"motion: expected 'full' of clouds, got {config.motion!r}")
    return mapping_problem(config, data, MappingFunctions(init_spatial, _loss, spatial_poses, next_spatial_phase))


def register_clouds(
    scans: CloudScans | Sequence[ArrayLike],
    config: DeepMappingConfig | None = None,
    *,
    key: jax.Array,
    start: ArrayLike | None = None,
    engine: Callable[..., Fit] = fit,
) -> CloudFitted:
    """Registers 3-D lidar scans by optimising L-Net and M-Net on them alone (DeepMapping eq. 6, in SE(3)).

    The fit replaces a given start only if its planes meet better than those of the start; no ground truth is used.

    Args:
        scans: (m_i, 3) points in the lidar frames, any unit, in the order of time; or CloudScans.
        config: settings; None: `cloud_preset("fast")`.
        key: key of the whole run.
        start: (n, 4, 4) T_world_scan to start from; None: cold start.
        engine: what trains, called as `engine(problem, data, key=key)`;
            `functools.partial(fit, on_report=..., stop=...)` reports each call of the step and can be stopped.

    Returns:
        CloudFitted, in the world of `start`, or an arbitrary one after a cold start.

    Raises:
        ValueError: as `cloud_data`.
    """
    config = config or cloud_preset("fast")
    data, unit = cloud_data(scans, start)
    return _as_fitted(engine(cloud_problem(config, data), data, key=key), data, unit)


def _as_fitted(done: Fit, data: MappingData, unit: float) -> CloudFitted:
    """Returns the fit or its start, the one that fits better by the scans, in the unit of the points."""
    misfit, start_misfit = float(trajectory_misfit(data.scans, done.poses, _MISFIT_KERNEL_WIDTH)), None
    T, kept = fitted_poses(done.poses, unit), "fit"
    if data.start is not None:
        start_misfit = float(trajectory_misfit(data.scans, data.start, _MISFIT_KERNEL_WIDTH))
        # A fit that is not finite is not better.
        if not misfit < start_misfit:
            T, kept = fitted_poses(data.start, unit), "start"
    return CloudFitted(T, done.state.params, done.report, unit, kept, misfit, start_misfit)  # type: ignore[arg-type]


def _draw_points(scans: PlaneCloud, count: int, *, key: jax.Array) -> PlaneCloud:
    """Other points of each scan in every step."""
    num_scans, capacity = scans.mask.shape
    if count >= capacity:
        return scans
    first = jax.random.randint(key, (num_scans, 1), 0, capacity)
    rows = (first + jnp.arange(count)) % capacity
    return PlaneCloud(*(jax.vmap(lambda leaf, row: leaf[row])(leaf, rows) for leaf in scans))


def _draw_partners(scans: CloudScans, rows: Int[Array, " m"], count: int, *, key: jax.Array) -> Int[Array, "r m"]:
    """Scans near in space of each scan; -1: none."""
    columns = jax.random.choice(key, scans.partners.shape[1], (count,), replace=False)
    return scans.partners[rows][:, columns].T


def _loss(
    config: DeepMappingConfig,
    phase: PhaseConfig,
    params: Params,
    data: MappingData,
    step: Int[Array, ""],
    key: jax.Array,
) -> tuple[Float[Array, ""], Terms]:
    """DeepMapping eq. 6 of a batch of scans and points; scans are compared by planes or by the Chamfer distance."""
    row_key, point_key, partner_key, free_key, offset_key = jax.random.split(key, 5)
    scans, progress = data.scans, step / phase.num_steps
    count = scans.mask.shape[0]
    rows, block = draw_rows(phase, count, step, key=row_key)
    offsets = draw_offsets(phase, scans_in_block(phase, count) - 1, key=offset_key)
    comparison = phase.comparison
    num_revisits = comparison.num_revisits if isinstance(comparison, PlaneComparison) else 0
    partners = _draw_partners(scans, rows, num_revisits, key=partner_key)
    seen = jnp.concatenate([rows, jnp.maximum(partners, 0).reshape(-1)])
    T = poses_of_scans(config, phase, params, scans, seen)
    clouds = take_rows(clouds_of(scans), seen)
    samples = _draw_points(clouds, phase.beams_per_step, key=point_key)
    own = jnp.arange(len(rows))
    points = rigid.transform_points(T[own], samples.points[own])
    world = WorldBatch(points, T[own, :3, 3], samples.mask[own], rows, block, progress)
    if not isinstance(comparison, PlaneComparison):
        pair_term = chamfer_term(world, offsets, comparison)
    else:
        later = jnp.minimum(own + offsets[:, None], len(rows) - 1)
        is_later = (rows[later] == rows + offsets[:, None]) & (block[later] == block)
        others = jnp.concatenate([later.reshape(-1), jnp.arange(len(rows), len(seen))])
        pairs = jnp.stack([jnp.resize(own, others.shape), others], axis=-1)
        is_pair = jnp.concatenate([is_later.reshape(-1), partners.reshape(-1) >= 0])
        width = interpolate_log(comparison.width, progress)
        pair_term = misfit_of_pairs(T, samples, clouds, pairs, is_pair, (width, scans.spacing))
    return mapping_loss(config, phase, params, world, pair_term, key=free_key)
