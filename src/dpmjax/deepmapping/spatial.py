"""Poses of depth images and lidar clouds in SE(3): T_start @ motion.

T_start is constant in a phase; the motion is L-Net's output or a free parameter.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike, NDArray

from dpmjax.deepmapping.cloud_scans import CloudScans
from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig
from dpmjax.deepmapping.problem import MapFrame, MappingData, Params, choose_frame
from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import motion_matrices
from dpmjax.nets.localization import LocalizationNet
from dpmjax.nets.occupancy import init_map_net
from dpmjax.registration_rgbd.depth_images import DepthScans

SpatialScans = DepthScans | CloudScans
_ALL = slice(None)


def scaled_start(poses: ArrayLike, num_scans: int, unit: float) -> Float[Array, "n 4 4"]:
    """Checks initial poses and scales them to typical ranges.

    Args:
        poses: (n, 4, 4), unit of the points.
        num_scans: required number of poses.
        unit: typical range, in the unit of the points.

    Returns:
        The poses in typical ranges.

    Raises:
        ValueError: another shape, or numbers that are not finite.
    """
    T = np.array(poses, np.float64)
    if T.shape != (num_scans, 4, 4) or not np.isfinite(T).all():
        raise ValueError(f"start: expected finite numbers of shape ({num_scans}, 4, 4), got {T.shape}")
    T[:, :3, 3] /= unit
    return jnp.asarray(T, jnp.float32)


def unscaled_poses(poses: ArrayLike, unit: float) -> NDArray[np.float64]:
    """Scales poses to the unit of the points.

    Args:
        poses: (n, 4, 4) in typical ranges.
        unit: typical range, in the unit of the points.

    Returns:
        (n, 4, 4) rigid motions.
    """
    T = np.array(poses, np.float64)
    T[..., :3, 3] *= unit
    return T


def _net(config: DeepMappingConfig) -> LocalizationNet:
    return LocalizationNet(config.localization, 3 if config.motion == "planar" else 6)


def _motions(
    config: DeepMappingConfig, phase: PhaseConfig, params: Params, scans: SpatialScans, rows: Int[Array, " m"] | slice
) -> Float[Array, "m k"]:
    if phase.poses == "free":
        return params.poses[rows]
    localize = jax.vmap(_net(config).apply, in_axes=(None, 0, 0))
    return localize(params.localization, scans.points[rows], scans.mask[rows])  # type: ignore[return-value]


def poses_of_scans(
    config: DeepMappingConfig,
    phase: PhaseConfig,
    params: Params,
    scans: SpatialScans,
    rows: Int[Array, " m"] | slice = _ALL,
) -> Float[Array, "m 4 4"]:
    """Computes the poses of these scans.

    Args:
        config: settings of the fit.
        phase: phase of the fit, with motions by L-Net or free motions.
        params: parameters of the fit.
        scans: all scans.
        rows: indices of the scans.

    Returns:
        T_start @ motion of each scan, in typical ranges.
    """
    return rigid.compose(params.start[rows], motion_matrices(_motions(config, phase, params, scans, rows)))


def spatial_poses(
    config: DeepMappingConfig, phase: PhaseConfig, params: Params, data: MappingData
) -> Float[Array, "n 4 4"]:
    """Computes the poses of all scans (`Problem.poses`)."""
    return poses_of_scans(config, phase, params, data.scans)


def _choose_frame(config: DeepMappingConfig, scans: SpatialScans, T: Float[Array, "n 4 4"]) -> MapFrame:
    """Computes the cube that the scans cover at these poses, with the margin of the map."""
    count = scans.mask.shape[0]
    world = rigid.transform_points(T, scans.points.reshape(count, -1, 3))
    return choose_frame(world, scans.mask.reshape(count, -1), config.map_margin)


def init_spatial(config: DeepMappingConfig, key: jax.Array, data: MappingData) -> Params:
    """Makes initial parameters (`Problem.init`); without initial poses all poses are the identity."""
    net_key, map_key = jax.random.split(key)
    scans, start = data
    count, net = scans.mask.shape[0], _net(config)
    T_start = jnp.tile(jnp.eye(4), (count, 1, 1)) if start is None else start
    localization: Any = net.init(net_key, scans.points[0], scans.mask[0])
    params = Params(
        localization=localization,
        poses=jnp.zeros((count, net.num_outputs)),
        occupancy=init_map_net(config.occupancy, key=map_key, num_dimensions=3),
        start=T_start,
        frame=_choose_frame(config, scans, T_start),
    )
    first = config.cold_phases[0]
    if first.poses == "free" and start is None:
        # The paper's direct baseline starts from the output of an untrained L-Net.
        params = replace(params, poses=_motions(config, replace(first, poses="network"), params, scans, _ALL))
    return params


def next_spatial_phase(config: DeepMappingConfig, phase: PhaseConfig, params: Params, data: MappingData) -> Params:
    """Starts the next phase from the estimated poses, resets the motions to zero, and re-centres the map frame."""
    T = spatial_poses(config, phase, params, data)
    return replace(params, poses=jnp.zeros_like(params.poses), start=T, frame=_choose_frame(config, data.scans, T))
