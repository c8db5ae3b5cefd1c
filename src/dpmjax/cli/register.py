"""Registers two 3-D lidar scans without a first guess (DeepPointMap): the motion and the probability that it is right.

    dpmjax register a.pcd b.pcd                   where points of a lie in the frame of b
    dpmjax register 000000.bin 000010.bin -o out  KITTI's files
    dpmjax register a.npy b.ply --no-refine       without the final point-to-plane alignment

Scans are .pcd .ply .las .laz .bin .npy or .npz, in metres, each in the frame of its lidar. Results go to
results/register/<time>/ (latest links to the newest): T_target_source.txt (4 x 4, maps points of A to the frame of B),
metrics.json, aligned.ply (A in the frame of B, and B, in two colours) and registration.png (from above).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, deeppointmap, io, viz, weights
from dpmjax.sequences import InputError

if TYPE_CHECKING:
    from dpmjax.types import Registration

NAME = "register"
# Least calibrated probability of a certain motion.
SURE = 0.9
SOURCE_COLOR, TARGET_COLOR = (58, 134, 192), (240, 168, 64)


@dataclass(frozen=True, kw_only=True)
class Config(cli.ModelOptions, cli.OutputOptions):
    """Options of the run."""

    source: Annotated[Positional[Path], arg(metavar="A")]
    """Scan whose points are moved."""
    target: Annotated[Positional[Path], arg(metavar="B")]
    """Scan in whose frame they end."""
    columns: Annotated[int | None, arg(metavar="N")] = None
    """Numbers a point has in .bin files (4: KITTI, 5: nuScenes); without it, the values decide."""
    refine: bool = True
    """End with a fine point-to-plane alignment."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, columns=3)


def main(config: Config) -> None:
    """Registers two scans and writes the results."""
    started = time.perf_counter()
    paths = (config.source, config.target)
    source, target = (io.read_lidar_file(path, bin_columns=config.columns) for path in paths)
    scans = zip(paths, (source, target), strict=True)
    notes = [note for path, points in scans for note in io.scan_notes(path, points, bin_columns=config.columns)]
    model = weights.load_model(config.weights)
    folder = cli.open_run_folder(config, NAME)
    with cli.recording(folder):
        noted = cli.report_notes(notes)
        print("registration ...", flush=True)
        clock = time.perf_counter()
        found = deeppointmap.register(model, source, target, refine=config.refine)
        T = np.asarray(found.T_target_source, np.float64)
        metrics = {
            "source": config.source.name,
            "target": config.target.name,
            "weights": config.weights,
            **noted,
            **motion_numbers(T),
            **confidence_numbers(found, model.config.calibration is not None),
            "register_s": time.perf_counter() - clock,
        }
        write_motion(folder, T, source, target)
        metrics["wall_s"] = time.perf_counter() - started
        cli.write_metrics(folder, metrics)
        motions = {"before registration": np.eye(4), f"registered, confidence {metrics['confidence']:.2f}": T}
        files = names_of(config.source, config.target)
        pair = viz.RegisteredPair(f"{files[0]} in the frame of {files[1]}", source, target, motions, files)
        figure = viz.registered_pairs_figure([pair])
        viz.save_figure(figure, folder / "registration.png")
        print(motion_text(T, metrics), f"results in {folder.path}", sep="\n")
        if metrics["status"] == "failed":
            outcome = "no motion was found, the identity was written"
            advice = "give scans with walls and other things at 20 places or more, 1 to 60 m from the lidar"
            raise InputError(f"{config.source}, {config.target}", outcome, advice)


def names_of(source: Path, target: Path) -> tuple[str, str]:
    """Returns the names of both files, with their folders where the files have the same name."""
    num_parts = 1 if source.name != target.name else 2
    return str(Path(*source.parts[-num_parts:])), str(Path(*target.parts[-num_parts:]))


def confidence_numbers(found: Registration, is_calibrated: bool) -> dict[str, Any]:
    """Returns the status of a registration, its confidence, and the evidence for it."""
    names = () if found.verification is None else ("visible_share", "matched_share", "contradicted_share")
    shares = {name: float(getattr(found.verification, name)) for name in names}
    confidence, num_inliers = float(found.confidence), int(found.num_inliers)
    has_motion = num_inliers > 0 or bool(shares.get("matched_share"))
    status = "uncertain" if is_calibrated and confidence < SURE else "done"
    return {
        "status": status if has_motion else "failed",
        "confidence": confidence,
        "num_inliers": num_inliers,
        **shares,
        "is_calibrated": is_calibrated,
    }


def motion_numbers(T_target_source: np.ndarray) -> dict[str, Any]:
    """Returns the motion as a matrix, a distance and an angle."""
    from scipy.spatial.transform import Rotation

    angle = Rotation.from_matrix(T_target_source[:3, :3]).magnitude()
    return {
        "T_target_source": T_target_source,
        "translation_m": float(np.linalg.norm(T_target_source[:3, 3])),
        "rotation_deg": float(np.degrees(angle)),
    }


def write_motion(folder: cli.RunFolder, T_target_source: np.ndarray, source: np.ndarray, target: np.ndarray) -> None:
    """Writes T_target_source.txt and aligned.ply."""
    rows = (" ".join(f"{value:.9f}" for value in row) for row in T_target_source)
    io.write_atomically(folder / "T_target_source.txt", "\n".join(rows) + "\n")
    moved = source @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    colors = np.repeat(np.array([SOURCE_COLOR, TARGET_COLOR], np.uint8), [len(source), len(target)], axis=0)
    io.write_ply(folder / "aligned.ply", np.concatenate([moved, target]).astype(np.float32), colors=colors)


def motion_text(T_target_source: np.ndarray, metrics: dict[str, Any]) -> str:
    """Returns the last lines on the console."""
    rows = "\n".join("  " + " ".join(f"{value:12.6f}" for value in row) for row in T_target_source)
    if metrics["is_calibrated"]:
        sure = "" if metrics["confidence"] >= SURE else ": NOT SURE, look at registration.png"
        confidence = f"probability that it is right within 2 m and 5 degrees: {metrics['confidence']:.2f}{sure}"
    else:
        confidence = f"score of the matches (these weights are not calibrated): {metrics['confidence']:.2f}"
    return (
        f"T_target_source, which maps points of {metrics['source']} to the frame of {metrics['target']}:\n{rows}\n"
        f"{metrics['translation_m']:.3f} m, {metrics['rotation_deg']:.2f} degrees\n"
        f"{confidence}"
    )
