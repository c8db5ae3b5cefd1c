"""Depth images as organised clouds: folders with a pose file each (7-Scenes), scenes of the Active Vision Dataset.

The Active Vision Dataset (Ammirato et al. 2017) has one folder a scene:

    Home_001_1/high_res_depth/000110000010103.png   16 bit, millimetres, 0 for nothing
    Home_001_1/image_structs.mat                    poses: image_name, R, t (world to camera) of each image; scale, mm
    Home_001_1/annotations.json                     for each image the next one forward, backward, left, right, turned
    Home_001_1/cameras.txt                          intrinsics as COLMAP writes them; optional

A scene is a grid of places with twelve views each; a trajectory is a random walk along the links of annotations.json.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.files import load_mat, natural_key, read_bytes, read_depth_png, read_lines, read_table, refusing
from dpmjax.io.poses import check_poses
from dpmjax.sequences import ACTIVE_VISION, BoolArray, Camera, DepthSequence, FloatArray, homogeneous, require

_log = logging.getLogger(__name__)
_MOVES, _TURNS = ("forward", "backward", "left", "right"), ("rotate_cw", "rotate_ccw")


def read_pose_folder(path: str | Path, *, height: int = 30, width: int = 40, max_depth_m: float = 5.0) -> DepthSequence:
    """Reads NAME.depth.png, NAME.pose.txt and one *intrinsics.txt.

    Args:
        path: the folder. Depth is 16 bit, millimetres, 0 or 65535 for nothing; poses are 4 x 4 camera to world, metres;
            intrinsics 3 x 3.
        height: rows of a cloud.
        width: columns of a cloud.
        max_depth_m: deeper pixels are masked.

    Returns:
        The sequence in natural order of the names, moving in SE(3); without a reference where no pose file is there.

    Raises:
        InputError: no such folder, no depth image, no intrinsics, poses for some images only, or a damaged file. Also
            for intrinsics of images of another size, poses that are no rigid motions, and images without valid pixels.
    """
    folder = Path(path)
    require(folder.is_dir(), folder, "no such folder", "check the path")
    images = sorted(folder.glob("*.depth.png"), key=lambda file: natural_key(file.name))
    require(len(images) >= 2, folder, f"{len(images)} .depth.png files", "give a folder of at least two")
    named = sorted(folder.glob("*intrinsics*.txt"))
    require(len(named) > 0, folder, "no *intrinsics*.txt", "add the 3 x 3 matrix of the depth camera")
    poses = [image.with_name(image.name.replace(".depth.png", ".pose.txt")) for image in images]
    missing = [pose.name for pose in poses if not pose.is_file()]
    found = f"no {next(iter(missing), None)} ({len(missing)} missing)"
    require(len(missing) in (0, len(poses)), folder, found, "give a pose to every image or to none")
    rows, columns = read_depth_png(images[0]).shape
    fx, fy, cx, cy = _read_matrix(named[0], 3)[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    advice = "give rows fx 0 cx, 0 fy cy, 0 0 1, with focal lengths above 0, of the size of the images"
    with refusing(named[0], "not a camera ({error})", advice, (ValueError,)):
        camera = Camera(columns, rows, fx, fy, cx, cy)
    found = f"the optical axis at column {cx:g}, row {cy:g}, beside the images of {columns} x {rows} pixels"
    require(0 < cx < columns - 1 and 0 < cy < rows - 1, named[0], found, advice)
    points, mask = _read_clouds(images, camera, (height, width), max_depth_m)
    matrices = [] if missing else [check_poses(_read_matrix(pose, 4)[None], pose) for pose in poses]
    return DepthSequence(folder.name, points, mask, False, np.concatenate(matrices) if matrices else None)


def read_active_vision(
    path: str | Path, num_views: int = 16, *, seed: int = 0, height: int = 27, width: int = 48, max_depth_m: float = 7.0
) -> DepthSequence:
    """Reads one random trajectory through a scene (DeepMapping section 4.2), with moves and turns in alternation.

    Args:
        path: folder of the scene.
        num_views: 8 or 16 in the paper.
        seed: seed of the walk.
        height: rows of a cloud.
        width: columns of a cloud.
        max_depth_m: deeper pixels are masked; the published program drops 7 m and more.

    Returns:
        The sequence; its motion is planar, its reference that of the dataset, in metres.

    Raises:
        InputError: a file is missing or damaged, or no image has a depth image and a pose.
        ValueError: fewer than two views.
    """
    if num_views < 2:
        raise ValueError(f"num_views: expected at least 2, got {num_views}")
    scene = Path(path)
    poses = _read_scene_poses(scene / "image_structs.mat")
    path, kinds = scene / "annotations.json", (ValueError, AttributeError, RecursionError)
    content = read_bytes(path)
    with refusing(path, "not readable ({error})", "copy annotations.json of the scene", kinds):
        links = {
            name: {kind: str(other) for kind, other in entry.items()} for name, entry in json.loads(content).items()
        }
    depth_of = {name: scene / "high_res_depth" / f"{Path(name).stem[:-2]}03.png" for name in poses}
    known = sorted(name for name in poses if name in links and depth_of[name].is_file())
    found = "no image with links, pose and depth"
    require(len(known) > 0, scene, found, "unpack the scene's high_res_depth folder too")
    names = _draw_walk(known, links, num_views, np.random.default_rng([seed, 13]))
    camera = _read_colmap_camera(scene / "cameras.txt")
    points, mask = _read_clouds([depth_of[name] for name in names], camera, (height, width), max_depth_m)
    return DepthSequence(f"{scene.name}, walk {seed}", points, mask, True, np.stack([poses[name] for name in names]))


def is_active_vision(path: Path) -> bool:
    """Returns True where a folder is a scene of the Active Vision Dataset.

    Args:
        path: the folder.

    Returns:
        True where it holds image_structs.mat.
    """
    return (path / "image_structs.mat").is_file()


def _read_clouds(
    images: Sequence[Path], camera: Camera, shape: tuple[int, int], max_depth_m: float
) -> tuple[NDArray[np.float32], BoolArray]:
    """Reads points (n, h, w, 3) and mask (n, h, w) of depth images in millimetres; warns of most pixels too deep."""
    rows, columns = camera.sample_pixels(*shape)
    rays, clouds, depths = camera.rays(columns, rows), [], []
    for image in images:
        depth_mm = read_depth_png(image)
        is_good = depth_mm.shape == (camera.height, camera.width) and np.greater_equal(depth_mm.shape, shape).all()
        advice = "give images of the camera's size, not smaller than a cloud"
        require(is_good, image, f"{depth_mm.shape} pixels, the camera has {camera.height, camera.width}", advice)
        # Some cameras write the largest number for nothing.
        depth_m = np.where(depth_mm == 65535, 0, depth_mm) / 1000.0
        depths.append(float(np.median(depth_m[depth_m > 0])) if (depth_m > 0).any() else 0.0)
        clouds.append(depth_m[np.ix_(rows, columns)])
    depth = np.stack(clouds)
    mask = (depth > 0) & (depth <= max_depth_m)
    median, blank = float(np.median(depths)), np.flatnonzero(~mask.any(axis=(1, 2)))
    found = f"the median depth is {median:.3g} m, deeper pixels than {max_depth_m:g} m are left out"
    advice = "give millimetres, 0 for nothing; TUM's images have 5000 a metre"
    # Where most pixels are too deep, the unit is wrong, not an image.
    require(len(blank) < (1 if median > max_depth_m else len(images)), images[0].parent, found, advice)
    if median > max_depth_m:
        _log.warning("%s: %s; %s", images[0].parent, found, advice)
    which = f"leave out such images, {len(blank)} of {len(images)}"
    require(not len(blank), images[[*blank, 0][0]], f"no pixel measures up to {max_depth_m:g} m", which)
    return (rays * np.where(mask, depth, 0.0)[..., None]).astype(np.float32), mask


def _read_matrix(path: Path, size: int) -> FloatArray:
    matrix = read_table(path)
    is_good = matrix.shape == (size, size) and bool(np.isfinite(matrix).all())
    require(is_good, path, f"a matrix of {matrix.shape}", f"give {size} x {size} finite numbers")
    return matrix


def _draw_walk(known: list[str], links: dict[str, Any], num_views: int, rng: np.random.Generator) -> list[str]:
    """Draws the names of the images of a walk; a turn replaces an unavailable move, and the reverse."""
    names, is_known = [known[rng.integers(len(known))]], set(known)
    while len(names) < num_views:
        moves, turns = (
            [links[names[-1]][kind] for kind in kinds if links[names[-1]].get(kind) in is_known]
            for kinds in (_MOVES, _TURNS)
        )
        options = moves if (rng.random() < 0.5 and moves) or not turns else turns
        require(len(options) > 0, names[-1], "no neighbour with a depth image and a pose", "unpack the whole scene")
        names.append(options[rng.integers(len(options))])
    return names


def _read_scene_poses(path: Path) -> dict[str, FloatArray]:
    """Reads T_world_camera of every image with a pose of the reconstruction, metres."""
    poses = {}
    variables = load_mat(read_bytes(path), path)
    found, advice = "not the dataset's pose file ({kind})", "copy image_structs.mat of the scene"
    with refusing(path, found, advice, (KeyError, ValueError, TypeError, AttributeError)):
        scale_m = float(variables["scale"]) / 1000.0
        for entry in variables["image_structs"]:
            R, t = np.asarray(entry["R"], np.float64), np.asarray(entry["t"], np.float64)
            # Images that the reconstruction has not placed have empty arrays.
            if R.shape == (3, 3) and t.shape == (3,) and np.isfinite(R).all() and np.isfinite(t).all():
                poses[str(entry["image_name"])] = homogeneous(R.T, -R.T @ t * scale_m)
    return poses


def _read_colmap_camera(path: Path) -> Camera:
    """Reads size and pinhole part of a COLMAP camera; the dataset's usual one where the file is missing."""
    if not path.is_file():
        return ACTIVE_VISION
    lines = (line.split() for line in read_lines(path) if not line.startswith("#"))
    words = next((words for words in lines if len(words) >= 8), [])
    found = f"no camera in it, or not a camera: {' '.join(words)} ({{error}})"
    with refusing(path, found, "give COLMAP's cameras.txt", (ValueError, IndexError)):
        return Camera(int(words[2]), int(words[3]), *map(float, words[4:8]))
