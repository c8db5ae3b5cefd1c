"""Methods that deepmapping_rgbd compares, their errors, and the surfaces that hold a camera."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dpmjax import deepmapping as dm
from dpmjax import registration_rgbd as rgbd
from dpmjax.cli import depth_errors
from dpmjax.geometry import image_normals
from dpmjax.io import DepthSequence
from dpmjax.metrics import absolute_trajectory_error

METHODS = (
    "zero", "placed", "placed-no-prior", "deepmapping", "deepmapping-cold", "direct", "icp", "deepmapping-icp",
    "multiway",
)  # fmt: skip
_ICP_POINTS = 800


def run_method(
    name: str,
    sequence: DepthSequence,
    settings: dm.DeepMappingConfig,
    found: Mapping[str, NDArray[np.float64]],
    *,
    seed: int,
) -> NDArray[np.float64]:
    """Returns (n, 4, 4) T_world_camera by one method.

    Args:
        name: one of `METHODS`. "zero": all cameras at one place. "placed": the search for first poses;
            "placed-no-prior": the same without a cost of translations. "deepmapping": from "placed".
            "deepmapping-cold": L-Net from zero. "direct": its losses without L-Net, from L-Net's first forward pass, as
            in the paper. "icp": each image onto the one before; "deepmapping-icp": from there. "multiway": Open3D's
            multiway registration. Of a start and the fit from it, the one of the larger projective consistency is kept.
        sequence: depth images.
        settings: settings of DeepMapping.
        found: results of other methods for this sequence: a start that is there is not computed again.
        seed: seed of everything random.

    Returns:
        The poses.
    """
    import jax

    from experiments.baselines.multiway import multiway_images

    scans, key = rgbd.as_depth_scans(sequence.points, sequence.mask), jax.random.key(seed)
    if name == "zero":
        return np.tile(np.eye(4), (len(sequence), 1, 1))
    if name.startswith("placed"):
        search = rgbd.depth_search(settings.motion)
        search = replace(search, translation_weight=0.0) if name == "placed-no-prior" else search
        return rgbd.initialize_depth(scans, search, key=key)
    if name == "multiway":
        return multiway_images(sequence.points, sequence.mask)
    if name == "icp":
        return chain_icp(sequence, seed=seed)
    if name in ("deepmapping", "deepmapping-icp"):
        start = found.get("placed" if name == "deepmapping" else "icp")
        if start is None and name == "deepmapping-icp":
            start = chain_icp(sequence, seed=seed)
        return dm.register_depth(scans, settings, key=key, start=start).T_world_scan
    used = dm.as_direct(settings) if name == "direct" else settings
    return dm.fit_deepmapping(scans, used, key=key).T_world_scan


def chain_icp(sequence: DepthSequence, *, seed: int) -> NDArray[np.float64]:
    """Returns poses by point-to-plane ICP of each image onto the one before, from the same pose."""
    from dpmjax.registration2d import icp

    rng = np.random.default_rng(seed)
    # One size for all clouds, so that ICP compiles once.
    clouds = [
        points[mask][rng.choice(int(mask.sum()), _ICP_POINTS)]
        for points, mask in zip(sequence.points, sequence.mask, strict=True)
    ]
    T = [np.eye(4)]
    for before, after in itertools.pairwise(clouds):
        T.append(T[-1] @ np.asarray(icp(after, before, metric="plane").T_target_source, np.float64))
    return np.stack(T)


def spread_of(sequence: DepthSequence) -> float:
    """Returns the root mean square distance of the cameras from their mean, mm: the ATE of not moving at all."""
    assert sequence.T_world_camera is not None
    positions = sequence.T_world_camera[:, :3, 3]
    return 1e3 * float(np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1))))


def errors_of(T: NDArray[np.float64], sequence: DepthSequence) -> dict[str, float]:
    """Returns ATE (mm), mean point distance (mm) and the largest error of a turn between neighbours (degrees)."""
    errors = depth_errors(sequence, T)
    return {
        "ate_mm": 1e3 * errors["ate_m"],
        "point_distance_mm": 1e3 * errors["point_distance_m"],
        "largest_turn_error_deg": errors["largest_turn_error_deg"],
    }


# Standard deviations: of the length of a move without any measurement, and of a pixel at depth 0.
_MOVE_M, _FLOOR_M = 0.3, 0.002
# Pixels whose depths differ by more than this share see different surfaces.
_SAME_DEPTH = 0.03
_NUM_DRAWS = 200


def surface_spread(sequence: DepthSequence, depth_noise_m: float) -> float:
    """Returns the median ATE of the trajectories that the surfaces cannot tell from the true one.

    They are drawn from the normal distribution whose information matrix is that of point-to-plane distances between all
    pairs of images.

    Args:
        sequence: noise-free images of a level camera with their true poses.
        depth_noise_m: standard deviation of the depth at one metre; it grows with the square of the depth.

    Returns:
        Millimetres.
    """
    T = sequence.T_world_camera
    assert T is not None
    count = len(sequence)
    information = _information_of_moves(count)
    pinhole = rgbd.as_depth_scans(sequence.points, sequence.mask).pinhole
    surfaces = image_normals(sequence.points, sequence.mask)
    for one in range(count):
        for other in range(count):
            if one != other:
                _add_pair(information, sequence, pinhole, surfaces, (one, other), depth_noise_m)
    # The first camera stays: the world has no frame of its own.
    root = np.linalg.cholesky(np.linalg.inv(information[3:, 3:]))
    draws = np.random.default_rng(0).standard_normal((_NUM_DRAWS, len(root))) @ root.T
    moved = np.concatenate([np.zeros((_NUM_DRAWS, 3)), draws], axis=1).reshape(_NUM_DRAWS, count, 3)
    errors = []
    for move in moved:
        positions = T[:, :3, 3].copy()
        positions[:, [0, 2]] += move[:, :2]
        errors.append(absolute_trajectory_error(positions, T[:, :3, 3]))
    return 1e3 * float(np.median(errors))


def _information_of_moves(count: int) -> Float[np.ndarray, "m m"]:
    """Returns the information matrix of x, z and angle of all cameras if nothing is seen."""
    step = np.zeros((2 * (count - 1), 3 * count))
    for row in range(len(step)):
        camera, axis = divmod(row, 2)
        step[row, 3 * camera + axis], step[row, 3 * camera + 3 + axis] = -1.0, 1.0
    return step.T @ step / _MOVE_M**2


def _add_pair(
    information: NDArray[np.float64],
    sequence: DepthSequence,
    pinhole: rgbd.Pinhole,
    surfaces: tuple[NDArray[np.float64], NDArray[np.bool_]],
    pair: tuple[int, int],
    depth_noise_m: float,
) -> None:
    """Adds the information of the points of one image on the surfaces (normals and mask) of another image."""
    T = sequence.T_world_camera
    assert T is not None
    one, other = pair
    normals, is_surface = (values[other] for values in surfaces)
    fx, fy, cx, cy = (float(value) for value in pinhole)
    height, width = sequence.mask.shape[1:]
    points = np.asarray(sequence.points[one][sequence.mask[one]], np.float64)
    world = points @ T[one, :3, :3].T + T[one, :3, 3]
    seen = (world - T[other, :3, 3]) @ T[other, :3, :3]
    depth = np.maximum(seen[:, 2], 1e-3)
    row, column = np.rint(fy * seen[:, 1] / depth + cy).astype(int), np.rint(fx * seen[:, 0] / depth + cx).astype(int)
    is_seen = (seen[:, 2] > 0.05) & (row >= 0) & (row < height - 1) & (column >= 0) & (column < width - 1)
    row, column = np.where(is_seen, row, 0), np.where(is_seen, column, 0)
    there = np.asarray(sequence.points[other, row, column, 2], np.float64)
    is_seen &= is_surface[row, column] & (np.abs(there - depth) < _SAME_DEPTH * depth)
    normal = normals[row, column][is_seen] @ T[other, :3, :3].T
    noise = depth_noise_m**2 * (points[is_seen, 2] ** 4 + there[is_seen] ** 4) + _FLOOR_M**2
    blocks = []
    for camera, sign in ((one, 1.0), (other, -1.0)):
        arm = world[is_seen] - T[camera, :3, 3]
        turned = normal[:, 0] * arm[:, 2] - normal[:, 2] * arm[:, 0]
        blocks.append(sign * np.stack([normal[:, 0], normal[:, 2], turned], axis=-1))
    for i, left in zip((one, other), blocks, strict=True):
        for j, right in zip((one, other), blocks, strict=True):
            information[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += (left / noise[:, None]).T @ right
