"""Poses in space, of depth images and lidar clouds: T_start @ motion, their start, their map frame.

The given start does not change; L-Net's output, or the free parameter, is a motion after it.
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
    """Checked poses to start from.

    Args:
        poses: (n, 4, 4), unit of the points.
        num_scans: how many there must be.
        unit: the typical range.

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
    """Poses in the unit of the points.

    Args:
        poses: (n, 4, 4) in typical ranges.
        unit: the typical range.

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
    """Poses of some scans.

    Args:
        config: settings of the fit.
        phase: phase of the fit; L-Net gives the motions, or they are free.
        params: parameters of the fit.
        scans: all scans.
        rows: indices of the scans.

    Returns:
        T_start @ motion of each, in typical ranges.
    """
    return rigid.compose(params.start[rows], motion_matrices(_motions(config, phase, params, scans, rows)))


def spatial_poses(
    config: DeepMappingConfig, phase: PhaseConfig, params: Params, data: MappingData
) -> Float[Array, "n 4 4"]:
    """Poses of all scans, as a Problem has them."""
    return poses_of_scans(config, phase, params, data.scans)


def _choose_frame(config: DeepMappingConfig, scans: SpatialScans, T: Float[Array, "n 4 4"]) -> MapFrame:
    """The cube that the scans cover at these poses."""
    count = scans.mask.shape[0]
    world = rigid.transform_points(T, scans.points.reshape(count, -1, 3))
    return choose_frame(world, scans.mask.reshape(count, -1), config.map_margin)


def init_spatial(config: DeepMappingConfig, key: jax.Array, data: MappingData) -> Params:
    """Fresh parameters, as a Problem has them; without a start all sensors are at one place."""
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
        # The paper's direct baseline starts where L-Net's first forward pass puts the sensors.
        params = replace(params, poses=_motions(config, replace(first, poses="network"), params, scans, _ALL))
    return params


def next_spatial_phase(config: DeepMappingConfig, phase: PhaseConfig, params: Params, data: MappingData) -> Params:
    """The poses reached are the new start, in a map frame around them; as a Problem has it."""
    T = spatial_poses(config, phase, params, data)
    return replace(params, poses=jnp.zeros_like(params.poses), start=T, frame=_choose_frame(config, data.scans, T))
