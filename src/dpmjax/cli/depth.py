"""Registers depth images of one camera into one map, without poses (DeepMapping, section 4.2).

    dpmjax depth                         a walk through a simulated apartment
    dpmjax depth images                  a folder of NAME.depth.png with an intrinsics file, as 7-Scenes has it
    dpmjax depth images -n 12 -o out     its first 12 images
    dpmjax depth images --jump 10        every tenth image
    dpmjax depth --resume                continue the latest run

Depth is 16 bit, millimetres, 0 or 65535 for nothing. If each image has a NAME.pose.txt, these poses measure the errors
of the result. Results go to results/depth/<time>/ (latest links to the newest): metrics.json, trajectories as TUM,
KITTI and npy (T_world_camera, metres), map.ply, and pictures: map.png (from above) and loss.png.

The last motion gives the pose of each image. If this pose is not clear, a search finds it. DeepMapping then adjusts the
keyframes. Of the poses before and after DeepMapping, those of higher consistency are kept: the share of pixels that
further images confirm. The verdict names images that no further image explains.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tqdm import tqdm
from tyro.conf import Positional, arg

from dpmjax import cli, deepmapping, io, metrics, scan, simulation, viz
from dpmjax.sequences import DepthSequence

_NUM_SIMULATED = 8
# Names of the sets of poses, in the order of the picture.
METHODS = {"start": "tracking and search", "fit": "DeepMapping"}


@dataclass(frozen=True, kw_only=True)
class DepthOptions(cli.ScanOptions, cli.RunOptions):
    """Options of the run."""

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """Folder of NAME.depth.png with an intrinsics file, with or without poses. Default: a simulated apartment."""
    preset: Literal["fast", "paper"] = "fast"
    """fast: minutes on two cores; paper: networks and sampling of the paper."""


def main(options: DepthOptions, run: cli.Run) -> cli.Numbers:
    """Registers depth images and writes the results."""
    import jax

    sequence = read_images(options)
    images = scan.as_depth_scans(sequence.points, sequence.mask)
    run.open()
    run.say(f"{sequence.name}: {len(sequence)} images")
    recorder = cli.FitRecorder(run, "m")
    settings = deepmapping.preset(options.preset, "depth", motion="planar" if sequence.is_planar else "full")
    key = jax.random.key(options.seed)
    with tqdm(total=len(sequence), desc="poses from image to image", unit=" images", dynamic_ncols=True) as bar:

        def on_image(num_placed: int, _: int) -> None:
            bar.update(num_placed - bar.n)

        start = scan.initialize_depth(images, settings.motion, key=key, on_image=on_image)
    found = deepmapping.register_depth(images, settings, key=key, start=start, engine=recorder)
    numbers = {**depth_numbers(sequence, found), **recorder.numbers}
    cli.write_poses(run.path, found.T_world_scan)
    points = np.einsum("nij,nhwj->nhwi", found.T_world_scan[:, :3, :3], sequence.points)
    points += found.T_world_scan[:, None, None, :3, 3]
    io.write_ply(run / "map.ply", points[sequence.mask].astype(np.float32))
    run.write_numbers(numbers)  # also where a picture fails
    draw(run, sequence, found)
    return numbers


def read_images(options: DepthOptions) -> DepthSequence:
    """Returns the chosen images of DATA or of a simulated walk."""
    if options.data is None:
        sequence = simulation.simulate_depth_sequence(0, options.selection.stop or _NUM_SIMULATED, seed=options.seed)
    else:
        sequence = io.read_pose_folder(options.data)
    chosen = sequence.take(options.selection)
    if len(chosen) < 2:
        raise ValueError(f"{sequence.name}: {len(chosen)} of {len(sequence)} images are chosen; choose two or more")
    return chosen


def depth_numbers(sequence: DepthSequence, found: deepmapping.Registered) -> cli.Numbers:
    """Returns the numbers of a registration under the names of `metrics.json`."""
    assert found.start is not None
    assert found.start_misfit is not None
    assert found.placed is not None
    before, after = (metrics.depth_errors(sequence, T) for T in (found.start, found.T_world_scan))
    consistency = 1 - (found.misfit if found.kept == "fit" else found.start_misfit)
    is_trusted, uncertain = found.placed.is_trusted, list(found.placed.uncertain_images)
    verdict = f"{cli.trust_words(is_trusted)}: the images agree to {consistency:.0%}"
    if uncertain:
        verdict += f"; uncertain images, which others hardly explain or contradict: {', '.join(map(str, uncertain))}"
    elif not is_trusted:
        verdict += "; other poses explain the images as well"
    if after:
        verdict += f"; {error_text(after)}, largest error of a turn {after['largest_turn_error_deg']:.2f} degrees"
    return {
        "status": "done" if is_trusted else "uncertain",
        "verdict": verdict,
        "is_trusted": is_trusted,
        "uncertain_images": uncertain,
        "num_images": len(sequence),
        "num_keyframes": len(found.keyframes),
        "kept": METHODS[found.kept],
        "consistency": consistency,
        "consistency_initial": 1 - found.start_misfit,
        **after,
        **cli.named_initial(before),
    }


def error_text(errors: cli.Numbers) -> str:
    """Returns the errors of poses as a text."""
    return f"ATE {errors['ate_m']:.3f} m, map points {errors['point_distance_m']:.3f} m"


def draw(run: cli.Run, sequence: DepthSequence, found: deepmapping.Registered) -> None:
    """Draws map.png: the search, DeepMapping, the reference; and loss.png."""
    panels = []
    for name, T in (("start", found.start), ("fit", found.fit), ("reference", sequence.T_world_camera)):
        if T is not None:
            errors = metrics.depth_errors(sequence, T) if name in METHODS else None
            title = METHODS.get(name, name) + " (kept)" * (found.kept == name)
            panels.append((title + (f"\n{error_text(errors)}" if errors else ""), T))
    viz.save_figure(viz.from_above_figure(panels, sequence.points, sequence.mask), run / "map.png", dpi=110)
    cli.draw_loss(run, "m")
