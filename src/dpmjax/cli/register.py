"""Registers two 3-D lidar scans without a first guess (DeepPointMap): the motion and the probability that it is right.

    dpmjax register a.pcd b.pcd                   the points of a in the frame of b
    dpmjax register 000000.bin 000010.bin -o out  KITTI's files
    dpmjax register a.npy b.ply --no-refine       without the final point-to-plane alignment

Scans are .pcd .ply .las .laz .bin .npy .npz, or x y z as text (.xyz .csv .txt), in metres, each in the frame of its
lidar. Results go to results/register/<time>/ (latest links to the newest): T_target_source.txt (4 x 4, maps points of A
to the frame of B), metrics.json, aligned.ply (A in the frame of B, and B, in two colours) and registration.png (from
above).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, deeppointmap, io, metrics, viz, weights

if TYPE_CHECKING:
    from dpmjax.types import Registration

# Least calibrated probability of a certain motion.
SURE = 0.9
SOURCE_COLOR, TARGET_COLOR = (58, 134, 192), (240, 168, 64)


@dataclass(frozen=True, kw_only=True)
class RegisterOptions(cli.ModelOptions, cli.OutputOptions):
    """Options of the run."""

    source: Annotated[Positional[Path], arg(metavar="A")]
    """Scan whose points are moved."""
    target: Annotated[Positional[Path], arg(metavar="B")]
    """Scan that gives the frame of the result."""
    columns: Annotated[int | None, arg(metavar="N"), cli.Bound(3)] = None
    """Number of values of each point in .bin files (4: KITTI, 5: nuScenes). Without it, the values decide."""
    refine: bool = True
    """End with a fine point-to-plane alignment."""


def main(options: RegisterOptions, run: cli.Run) -> cli.Numbers:
    """Registers two scans and writes the results."""
    paths = (options.source, options.target)
    source, target = clouds = [io.read_lidar_file(path, bin_columns=options.columns) for path in paths]
    scans = zip(paths, clouds, strict=True)
    notes = [note for path, points in scans for note in io.scan_notes(path, points, bin_columns=options.columns)]
    model = weights.load_model(options.weights)
    run.open(notes)
    print("registration ...", flush=True)
    found = deeppointmap.register(model, source, target, refine=options.refine)
    T = np.asarray(found.T_target_source, np.float64)
    np.savetxt(run / "T_target_source.txt", T, "%.9f")
    points = np.concatenate([source @ T[:3, :3].T + T[:3, 3], target])
    colors = np.repeat(np.array([SOURCE_COLOR, TARGET_COLOR], np.uint8), [len(source), len(target)], axis=0)
    io.write_ply(run / "aligned.ply", points, colors=colors)
    # Files of the same name are shown with their folders.
    num_parts = 1 if options.source.name != options.target.name else 2
    files = (str(Path(*options.source.parts[-num_parts:])), str(Path(*options.target.parts[-num_parts:])))
    numbers = {
        "source": files[0],
        "target": files[1],
        "weights": options.weights,
        "T_target_source": T,
        "translation_m": np.linalg.norm(T[:3, 3]),
        "rotation_deg": np.degrees(metrics.rotation_angle(T[None, :3, :3]))[0],
        **verdict_numbers(found, model.config.calibration is not None),
    }
    run.write_numbers(numbers)  # also where a picture fails
    motions = {"before registration": np.eye(4), f"registered, confidence {float(found.confidence):.2f}": T}
    pair = viz.RegisteredPair(f"{files[0]} in the frame of {files[1]}", source, target, motions, files)
    viz.save_figure(viz.registered_pairs_figure([pair]), run / "registration.png")
    print(f"T_target_source, which maps points of {files[0]} to the frame of {files[1]}:")
    print("\n".join("  " + " ".join(f"{value:12.6f}" for value in row) for row in T))
    return numbers


def verdict_numbers(found: Registration, is_calibrated: bool) -> cli.Numbers:
    """Returns status and verdict of a registration, its confidence, and the evidence for it."""
    names = () if found.verification is None else ("visible_share", "matched_share", "contradicted_share")
    shares = {name: float(getattr(found.verification, name)) for name in names}
    confidence, num_inliers = float(found.confidence), int(found.num_inliers)
    size = None if found.relative_size is None else float(found.relative_size)
    status, verdict = "done", f"score of the matches {confidence:.2f} (these weights are not calibrated)"
    if is_calibrated:
        verdict = f"right within 2 m and 5 degrees with probability {confidence:.2f}"
    if is_calibrated and confidence < SURE:
        status, verdict = "uncertain", f"{verdict}: NOT SURE, look at registration.png"
    if size not in (None, 1.0):
        verdict += f"; the surfaces fit if the source is {size:.3f} times as large as the target: are both in metres?"
    if num_inliers == 0 and not shares.get("matched_share"):
        status, verdict = "failed", "no motion was found, the identity was written: give scans with walls and other "
        verdict += "things at 20 places or more, 1 to 60 m from the lidar"
    numbers = {"confidence": confidence, "num_inliers": num_inliers, "relative_size": size}
    return {"status": status, "verdict": verdict, **numbers, **shares, "is_calibrated": is_calibrated}
