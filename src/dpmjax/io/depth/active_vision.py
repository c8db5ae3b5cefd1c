"""The Active Vision Dataset's own layout (Ammirato et al. 2017): one folder a scene.

    Home_001_1/high_res_depth/000110000010103.png   16 bit, millimetres, 0 for nothing
    Home_001_1/image_structs.mat                    poses: image_name, R, t (world to camera) of each image; scale, mm
    Home_001_1/annotations.json                     for each image the next one forward, backward, left, right, turned
    Home_001_1/cameras.txt                          intrinsics as COLMAP writes them (where it is missing: the known)

A scene is a grid of places with twelve views each; a trajectory is a random walk over what annotations.json connects.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.depth.camera import ACTIVE_VISION, Camera, back_project
from dpmjax.io.depth.depth_sequence import DepthSequence
from dpmjax.io.depth.pose_folder import read_depth_png
from dpmjax.io.errors import InputError

_MOVES, _TURNS = ("forward", "backward", "left", "right"), ("rotate_cw", "rotate_ccw")


def read_active_vision(
    path: str | Path,
    num_views: int = 16,
    *,
    seed: int = 0,
    height: int = 27,
    width: int = 48,
    max_depth_m: float = 7.0,
    move_share: float = 0.5,
) -> DepthSequence:
    """Reads one random trajectory through a scene (DeepMapping section 4.2).

    Args:
        path: folder of the scene.
        num_views: 8 or 16 in the paper.
        seed: of the walk.
        height: rows of a cloud.
        width: columns of a cloud.
        max_depth_m: deeper pixels are masked; the published program drops 7 m and more.
        move_share: share of the steps that move instead of turn.

    Returns:
        The sequence; its motion is planar, its reference that of the dataset, in metres.

    Raises:
        InputError: a file is missing or damaged, or no image has a depth image and a pose.
        ValueError: fewer than two views.
    """
    if num_views < 2:
        raise ValueError(f"num_views: expected at least 2, got {num_views}")
    scene = Path(path)
    if not scene.is_dir():
        raise InputError(scene, "no such folder", "give the folder of a scene, such as Home_001_1")
    poses = _read_poses(scene / "image_structs.mat")
    links = _read_links(scene / "annotations.json")
    depth_of = {name: scene / "high_res_depth" / f"{Path(name).stem[:-2]}03.png" for name in poses}
    known = sorted(name for name in poses if name in links and depth_of[name].is_file())
    if not known:
        raise InputError(scene, "no image with links, pose and depth", "unpack the scene's high_res_depth folder too")
    camera = _read_camera(scene / "cameras.txt")
    names = _walk(known, links, num_views, move_share, np.random.default_rng([seed, 13]))
    clouds = [
        back_project(
            read_depth_png(depth_of[name]) / 1000.0, camera, height=height, width=width, max_depth_m=max_depth_m
        )
        for name in names
    ]
    points, mask = (np.stack(part) for part in zip(*clouds, strict=True))
    T_world_camera = np.stack([poses[name] for name in names])
    return DepthSequence(f"{scene.name}, walk {seed}", points, mask, True, T_world_camera)


def is_active_vision(path: Path) -> bool:
    """Whether a folder looks like a scene."""
    return (path / "image_structs.mat").is_file()


def _walk(
    known: list[str], links: dict[str, Any], num_views: int, move_share: float, rng: np.random.Generator
) -> list[str]:
    """Names of the images; where no step of one kind is known, one of the other kind is taken."""
    is_known = set(known)

    def reachable(name: str, kinds: tuple[str, ...]) -> list[str]:
        return [links[name][kind] for kind in kinds if links[name].get(kind) in is_known]

    name = known[rng.integers(len(known))]
    names = [name]
    while len(names) < num_views:
        moves, turns = reachable(name, _MOVES), reachable(name, _TURNS)
        options = moves if (rng.random() < move_share and moves) or not turns else turns
        if not options:
            raise InputError(name, "no neighbour with a depth image and a pose", "unpack the whole scene")
        name = options[rng.integers(len(options))]
        names.append(name)
    return names


def _read_poses(path: Path) -> dict[str, NDArray[np.float64]]:
    """T_world_camera of every image that the reconstruction has placed, metres."""
    from scipy.io import loadmat

    try:
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
        structs, scale_mm = np.atleast_1d(content["image_structs"]), float(content["scale"])
    except Exception as error:  # SciPy raises whatever its parser trips over.
        found = f"not the dataset's pose file ({type(error).__name__})"
        raise InputError(path, found, "copy image_structs.mat of the scene") from error
    poses = {}
    for entry in structs:
        R, t = np.asarray(entry.R, np.float64), np.asarray(entry.t, np.float64).reshape(-1)
        if R.shape != (3, 3) or t.shape != (3,) or not (np.isfinite(R).all() and np.isfinite(t).all()):
            continue  # not placed by the reconstruction
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.T, -R.T @ t * scale_mm / 1000.0
        poses[str(entry.image_name)] = T
    return poses


def _read_links(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(path, f"not readable ({error})", "copy annotations.json of the scene") from error


def _read_camera(path: Path) -> Camera:
    """Size and pinhole part of a COLMAP camera; the dataset's usual one without the file."""
    if not path.is_file():
        return ACTIVE_VISION
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.split()
        if len(words) >= 8 and not line.startswith("#"):
            try:
                return Camera(int(words[2]), int(words[3]), *(float(word) for word in words[4:8]))
            except ValueError as error:
                raise InputError(
                    path, f"not a camera: {line.strip()} ({error})", "give COLMAP's cameras.txt"
                ) from error
    raise InputError(path, "no camera in it", "give COLMAP's cameras.txt")
