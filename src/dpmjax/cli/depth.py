"""Registers depth images of one camera into one map, without poses (DeepMapping, section 4.2).

    dpmjax depth                         a walk through a simulated apartment
    dpmjax depth images                  a folder of NAME.depth.png with an intrinsics file, as 7-Scenes has it
    dpmjax depth images -n 12 -o out     its first 12 images
    dpmjax depth images --jump 10        every tenth image
    dpmjax depth --resume                continue the latest run

Depth is 16 bit, millimetres, 0 or 65535 for nothing. Where each image has a NAME.pose.txt, the result is measured by
these poses. Results go to results/depth/<time>/ (latest links to the newest): metrics.json, trajectories as TUM, KITTI
and npy (T_world_camera, metres), map.ply, and pictures: map.png (from above) and loss.png. A search gives the first
poses and DeepMapping improves them; the poses of higher consistency are kept, chosen without ground truth. Consistency
is the share of pixels that other images confirm; flat walls alone confirm many motions.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, deepmapping, geometry, io, metrics, registration_rgbd, simulation, viz
from dpmjax.sequences import DepthSequence, FloatArray

NAME = "depth"
_NUM_SIMULATED = 8
# Names of the sets of poses, in the order of the picture.
METHODS = {"start": "search of first poses", "fit": "DeepMapping"}
# Typical ranges that a radian equals in the alignment of poses, for positions on a line.
_LEVER = 0.1


@dataclass(frozen=True, kw_only=True)
class Config(cli.ScanOptions, cli.RunOptions):
    """Options of the run."""

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """Folder of NAME.depth.png with an intrinsics file, and poses or none. Without it: a simulated apartment."""
    preset: Literal["fast", "paper"] = "fast"
    """fast: minutes on two cores; paper: networks and sampling of the paper."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, n_scans=2, jump=1)


def main(config: Config) -> None:
    """Registers depth images and writes the results."""
    import jax

    started = time.perf_counter()
    sequence = read_images(config)
    images = registration_rgbd.as_depth_scans(sequence.points, sequence.mask)
    folder = cli.open_run_folder(config, NAME)
    with cli.recording(folder), cli.StopFlag() as stop:
        print(f"{sequence.name}: {len(sequence)} images", flush=True)
        recorder = cli.FitRecorder(folder, "m", stop=lambda _run_s: stop.is_requested)
        settings = deepmapping.preset(config.preset, "depth", motion="planar" if sequence.is_planar else "full")
        key, search = jax.random.key(config.seed), registration_rgbd.depth_search(settings.motion)
        with cli.progress_bar("search of first poses", " images") as on_image:
            start = registration_rgbd.initialize_depth(images, search, key=key, on_image=on_image)
        found = deepmapping.register_depth(images, settings, key=key, start=start, engine=recorder)
        numbers = {
            **depth_numbers(sequence, found),
            **recorder.numbers,
            "status": stop.status,
        }
        write_depth_results(folder, sequence, found.T_world_scan)
        draw(folder, sequence, found)
        numbers["wall_s"] = time.perf_counter() - started
        cli.write_metrics(folder, numbers, seed=config.seed)
        print(depth_report(numbers), f"results in {folder.path}", sep="\n")


def read_images(config: Config) -> DepthSequence:
    """Returns the chosen images of DATA or of a simulated walk."""
    if config.data is None:
        sequence = simulation.simulate_depth_sequence(0, config.selection.stop or _NUM_SIMULATED, seed=config.seed)
    else:
        sequence = io.read_pose_folder(config.data)
    chosen = sequence.take(config.selection)
    if len(chosen) < 2:
        raise ValueError(f"{sequence.name}: {len(chosen)} of {len(sequence)} images are chosen; choose two or more")
    return chosen


def depth_numbers(sequence: DepthSequence, found: deepmapping.Registered) -> dict[str, Any]:
    """Returns the numbers of a registration under the names of `metrics.json`."""
    assert found.start is not None
    assert found.start_misfit is not None
    before, after = (depth_errors(sequence, T) for T in (found.start, found.T_world_scan))
    return {
        "num_images": len(sequence),
        "kept": METHODS[found.kept],
        "consistency": 1 - (found.misfit if found.kept == "fit" else found.start_misfit),
        "consistency_initial": 1 - found.start_misfit,
        **after,
        **cli.named_initial(before),
    }


def depth_errors(sequence: DepthSequence, T_world_camera: FloatArray) -> dict[str, float]:
    """Computes ATE, mean distance of map points, and the largest error of a turn between neighbours.

    Args:
        sequence: the images; their reference may be missing.
        T_world_camera: (n, 4, 4) poses, metres.

    Returns:
        The numbers by name; empty without a reference.
    """
    from scipy.spatial.transform import Rotation

    reference = sequence.T_world_camera
    if reference is None:
        return {}
    count = len(sequence)
    points, mask = sequence.points.reshape(count, -1, 3), sequence.mask.reshape(count, -1)
    lever = _LEVER * geometry.typical_range(points, mask)
    T_reference_world = np.asarray(metrics.align_poses(T_world_camera, reference, lever=lever))
    aligned = T_reference_world @ T_world_camera
    off = np.einsum("nij,nbj->nbi", aligned[:, :3, :3] - reference[:, :3, :3], points)
    off += aligned[:, None, :3, 3] - reference[:, None, :3, 3]
    turns = [Rotation.from_matrix(T[:, :3, :3]) for T in (T_world_camera, reference)]
    steps = [turn[:-1].inv() * turn[1:] for turn in turns]
    return {
        "ate_m": float(metrics.absolute_trajectory_error(T_world_camera[:, :3, 3], reference[:, :3, 3])),
        "point_distance_m": float(np.linalg.norm(off, axis=-1)[mask].mean()),
        "largest_turn_error_deg": float(np.degrees((steps[1].inv() * steps[0]).magnitude().max())),
    }


def write_depth_results(folder: cli.RunFolder, sequence: DepthSequence, T_world_camera: FloatArray) -> None:
    """Writes the trajectory and map.ply."""
    cli.write_poses(folder.path, T_world_camera)
    points = np.einsum("nij,nhwj->nhwi", T_world_camera[:, :3, :3], sequence.points)
    points += T_world_camera[:, None, None, :3, 3]
    io.write_ply(folder / "map.ply", points[sequence.mask].astype(np.float32))


def draw(folder: cli.RunFolder, sequence: DepthSequence, found: deepmapping.Registered) -> None:
    """Draws map.png: the search, DeepMapping, the reference; and loss.png."""
    assert found.start is not None
    poses = {"start": found.start, "fit": found.fitted.T_world_scan}
    panels = []
    for name, T_world_camera in poses.items():
        errors = depth_errors(sequence, T_world_camera)
        ate = f"\nATE {errors['ate_m']:.3f} m, map points {errors['point_distance_m']:.3f} m" if errors else ""
        panels.append((METHODS[name] + " (kept)" * (found.kept == name) + ate, T_world_camera))
    if sequence.T_world_camera is not None:
        panels.append(("reference", sequence.T_world_camera))
    viz.save_figure(viz.from_above_figure(panels, sequence.points, sequence.mask), folder / "map.png", dpi=110)
    cli.draw_loss(folder, "m")


def depth_report(numbers: dict[str, Any]) -> str:
    """Returns the last lines on the console."""
    lines = [f"kept: {numbers['kept']}; the images agree to {numbers['consistency']:.0%}"]
    if "ate_m" in numbers:
        ate, points, turn = (numbers[name] for name in ("ate_m", "point_distance_m", "largest_turn_error_deg"))
        lines.append(f"ATE {ate:.3f} m, map points {points:.3f} m, largest error of a turn {turn:.2f} degrees")
    return "\n".join(lines)
