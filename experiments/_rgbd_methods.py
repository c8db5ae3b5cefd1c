"""What deepmapping_rgbd compares: DeepMapping cold and warm, the direct optimisation, the starts themselves."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dpmjax.deepmapping import DeepMappingConfig
    from dpmjax.io import DepthSequence

METHODS = (
    "zero",
    "placed",
    "placed-no-prior",
    "deepmapping",
    "deepmapping-cold",
    "direct",
    "icp",
    "deepmapping-icp",
    "multiway",
)
_ICP_POINTS = 800


def run_method(
    name: str,
    sequence: DepthSequence,
    settings: DeepMappingConfig,
    found: Mapping[str, NDArray[np.float64]],
    *,
    seed: int,
) -> NDArray[np.float64]:
    """(n, 4, 4) T_world_camera by one method.

    Args:
        name: one of `METHODS`. "zero": all cameras at one place. "placed": the search for first poses;
            "placed-no-prior": the same without a cost of translations. "deepmapping": from "placed".
            "deepmapping-cold": L-Net from zero. "direct": its losses without L-Net, from L-Net's first forward pass, as
            in the paper. "icp": each image onto the one before; "deepmapping-icp": from there. "multiway": Open3D's
            multiway registration. Of a start and the fit from it, the one of the larger projective consistency is kept.
        sequence: depth images.
        settings: of DeepMapping.
        found: results of other methods for this sequence: a start that is there is not computed again.
        seed: of everything random.

    Returns:
        The poses.
    """
    import jax

    from dpmjax import deepmapping as dm
    from experiments.baselines.multiway import multiway_images

    scans, key = dm.as_depth_scans(sequence.points, sequence.mask), jax.random.key(seed)
    if name == "zero":
        return np.tile(np.eye(4), (len(sequence), 1, 1))
    if name == "placed":
        return dm.initialize_depth(scans, motion=settings.motion, key=key)
    if name == "placed-no-prior":
        search = dm.FULL_SEARCH if settings.motion == "full" else dm.PLANAR_SEARCH
        return dm.initialize_depth(scans, replace(search, translation_weight=0.0), motion=settings.motion, key=key)
    if name == "multiway":
        return multiway_images(sequence.points, sequence.mask)
    if name == "icp":
        return chain_icp(sequence, seed=seed)
    if name in ("deepmapping", "deepmapping-icp"):
        first = "placed" if name == "deepmapping" else "icp"
        start = found.get(first)
        if start is None and first == "icp":
            start = chain_icp(sequence, seed=seed)
        return dm.register_depth(scans, settings, key=key, start=start).T_world_camera
    used = dm.as_direct(settings) if name == "direct" else settings
    return dm.fit_depth(scans, used, key=key).T_world_camera


def chain_icp(sequence: DepthSequence, *, seed: int) -> NDArray[np.float64]:
    """Point-to-plane ICP of each image onto the one before, from where it stands."""
    from dpmjax.registration import icp

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
    """Root mean square distance of the cameras from their mean, mm: the ATE of not moving at all."""
    assert sequence.T_world_camera is not None
    positions = sequence.T_world_camera[:, :3, 3]
    return 1e3 * float(np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1))))


def errors_of(T: NDArray[np.float64], sequence: DepthSequence) -> dict[str, float]:
    """ATE (mm), mean point distance (mm) and the largest error of a turn between neighbours (degrees)."""
    from dpmjax.metrics import absolute_trajectory_error, point_distance

    reference = sequence.T_world_camera
    assert reference is not None
    ate = absolute_trajectory_error(T[:, :3, 3], reference[:, :3, 3])
    count = len(sequence)
    points = sequence.points.reshape(count, -1, 3)
    distance = point_distance(points, sequence.mask.reshape(count, -1), T, reference)
    relative = np.swapaxes(T[:-1, :3, :3], 1, 2) @ T[1:, :3, :3]
    true = np.swapaxes(reference[:-1, :3, :3], 1, 2) @ reference[1:, :3, :3]
    cosine = (np.einsum("nij,nij->n", relative, true) - 1.0) / 2.0
    turn = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return {"ate_mm": 1e3 * ate, "point_distance_mm": 1e3 * distance, "largest_turn_error_deg": float(turn.max())}
