"""Folders of depth images with a pose file each and one file of intrinsics, as the 7-Scenes dataset has them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.depth.camera import Camera, back_project
from dpmjax.io.depth.depth_sequence import DepthSequence
from dpmjax.io.errors import InputError
from dpmjax.io.files import natural_key

_NOTHING_MM = 65535  # besides 0


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
        InputError: no such folder, no depth image, no intrinsics, poses for some images only, or a damaged file.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "give a folder of NAME.depth.png files")
    images = sorted(folder.glob("*.depth.png"), key=lambda file: natural_key(file.name))
    if len(images) < 2:
        raise InputError(folder, f"{len(images)} .depth.png files", "give at least two")
    matrix = _read_matrix(_intrinsics_file(folder), (3, 3))
    poses = [image.with_name(image.name.replace(".depth.png", ".pose.txt")) for image in images]
    missing = [pose.name for pose in poses if not pose.is_file()]
    if missing and len(missing) < len(poses):
        raise InputError(folder, f"no {missing[0]} ({len(missing)} missing)", "give a pose to every image or to none")
    points, masks = [], []
    for image in images:
        depth_mm = read_depth_png(image)
        rows, columns = depth_mm.shape
        camera = Camera(columns, rows, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        depth_m = np.where(depth_mm == _NOTHING_MM, 0, depth_mm) / 1000.0
        cloud, mask = back_project(depth_m, camera, height=height, width=width, max_depth_m=max_depth_m)
        points.append(cloud)
        masks.append(mask)
    T_world_camera = None if missing else np.stack([_read_matrix(pose, (4, 4)) for pose in poses])
    return DepthSequence(folder.name, np.stack(points), np.stack(masks), False, T_world_camera)


def read_depth_png(path: str | Path) -> NDArray[np.int64]:
    """The 16-bit numbers of a one-channel PNG.

    Raises:
        InputError: the file is missing, damaged, or has another kind of pixels.
    """
    from matplotlib.image import imread

    try:
        image = np.asarray(imread(path))
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(path, f"not a readable PNG ({error})", "copy the image again") from error
    if image.ndim != 2:
        raise InputError(path, f"pixels are {image.shape}", "give a PNG of one channel of 16 bits")
    # matplotlib divides by the largest number of 16 bits.
    return np.rint(image.astype(np.float64) * 65535.0).astype(np.int64)


def _intrinsics_file(folder: Path) -> Path:
    files = sorted(folder.glob("*intrinsics*.txt"))
    if not files:
        raise InputError(folder, "no *intrinsics*.txt", "add the 3 x 3 matrix of the depth camera")
    return files[0]


def _read_matrix(path: Path, shape: tuple[int, int]) -> NDArray[np.float64]:
    try:
        matrix = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(path, f"not a matrix ({error})", f"give {shape[0]} x {shape[1]} numbers") from error
    if matrix.shape != shape or not np.isfinite(matrix).all():
        raise InputError(path, f"a matrix of {matrix.shape}", f"give {shape[0]} x {shape[1]} finite numbers")
    return matrix
