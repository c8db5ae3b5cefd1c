"""Depth images in the layouts of the data sets."""

import json
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.io import savemat


def write_png(path: Path, depth_mm: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(depth_mm, np.uint16)).save(path)


def write_pose_folder(folder: Path) -> Path:
    """Images of 1 and 5 m, at x = 2 and 10; the first pixel has no depth, the second the largest number."""
    np.savetxt(folder / "camera-intrinsics.txt", [[6.0, 0, 3.5], [0, 6.5, 2.5], [0, 0, 1]])
    for index in (2, 10):
        depth_mm = np.full((6, 8), 500 * index)
        depth_mm[0, 0], depth_mm[0, 1] = 0, 65535
        write_png(folder / f"frame-{index}.depth.png", depth_mm)
        pose = np.eye(4)
        pose[0, 3] = index
        np.savetxt(folder / f"frame-{index}.pose.txt", pose)
    return folder


def write_scene(root: Path) -> Path:
    """Four views in the layout of the Active Vision Dataset: two places, two directions; returns the scene."""
    folder = root / "Home_999_1"
    names = [f"0009990000{k}0101.jpg" for k in range(4)]
    turn = np.array([[np.cos(0.5), 0, np.sin(0.5)], [0, 1, 0], [-np.sin(0.5), 0, np.cos(0.5)]])
    structs = np.zeros(4, [("image_name", object), ("R", object), ("t", object)])
    for k, name in enumerate(names):
        R, position = (turn if k % 2 else np.eye(3)), np.array([0.1 * (k // 2), 0.0, 0.0])
        structs[k] = (name, R.T, -R.T @ position)
        write_png(folder / "high_res_depth" / f"{name[:-6]}03.png", np.full((6, 8), 2000 + k))
    savemat(folder / "image_structs.mat", {"image_structs": structs, "scale": 3000.0})
    links = {
        name: {"forward": "", "rotate_cw": names[k ^ 1], "rotate_ccw": "", "left": names[k ^ 2]}
        for k, name in enumerate(names)
    }
    (folder / "annotations.json").write_text(json.dumps(links))
    (folder / "cameras.txt").write_text("# cameras\n1 OPENCV 8 6 6.0 6.5 3.5 2.5 0 0 0 0\n")
    return folder
