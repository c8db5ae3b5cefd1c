"""Counts sure but wrong answers on made scans: reliefs, shells, sizes, turns, tunnels, passages, silence and clocks.

    python -m experiments.made_cases --draws 20                       20 draws of each kind
    python -m experiments.made_cases --kinds relief scale --draws 200
    python -m experiments.made_cases --resume --draws 200             go on, with more draws
    python -m experiments.made_cases --kinds fused fused-cut --data DRIVE ...

The file rows.csv has a row for each kind and draw, table.md a summary. A drive along a relief of 3 to 20 cm is right
below an ATE of 0.05 m, a pair within 2 m and 5 degrees, a planar map where no scan is 0.5 m off.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation
from tyro.conf import arg

from dpmjax import cli, deepmapping, deeppointmap, io, metrics, sequences, simulation, slam, weights
from dpmjax.geometry import rigid, se2
from tests.io.bag_files import BagWriter

NUM_SCANS, STEP_M, NOISE_M, SURE, RIGHT_ATE_M, RIGHT_PASSAGE_M = 25, 0.12, 0.006, 0.9, 0.05, 0.5
FUSED = ("fused", "fused-cut")
PX_M, CROP_M, ANGLES = 0.05, 35.0, np.linspace(-np.pi / 2, np.pi / 2, 181)
# The map is that of the alignment: a fit compiles for each number of scans, and the trust is the same.
NO_FIT = slam.RegistrationHooks(engine=lambda _rows: partial(deepmapping.fit, stop=lambda: True))
COLUMNS = ("sure_and_wrong", "right_and_sure", "is_sure", "is_right", "error_m", "seconds")


@dataclass(frozen=True, kw_only=True)
class MadeOptions(cli.RunOptions, cli.ModelOptions):
    """Options of the made cases."""

    may_change: ClassVar[frozenset[str]] = frozenset({"draws", "kinds"})

    kinds: tuple[str, ...] = (
        "relief", "shell", "scale", "turn", "tunnel", "passage", "wheels", "silence", "clock", "late",
    )  # fmt: skip
    """Kinds of cases."""
    draws: Annotated[int, cli.Bound(1)] = 5
    """Draws of each kind."""
    data: Annotated[tuple[Path, ...], arg(metavar="DRIVE ...")] = ()
    """Drives with poses, for scans in crops of a fused map: --kinds fused fused-cut (a view of 70 degrees)."""

    def __post_init__(self) -> None:
        """Checks bounds and names."""
        super().__post_init__()
        cli.check_names("--kinds", self.kinds, (*KINDS, *FUSED))
        if not self.data and set(self.kinds) & set(FUSED):
            raise ValueError("--kinds: fused and fused-cut need --data")


def main(options: MadeOptions, run: cli.Run) -> cli.Row:
    """Runs the missing cases, and writes the table."""
    run.open()
    model = weights.load_model(options.weights)

    def work(kind: str, draw: int) -> cli.Row:
        begun, rng = time.process_time(), np.random.default_rng([options.seed, draw, *kind.encode()])
        if kind in FUSED:
            answer = register_pair(model, draw_view(rng, options.data, is_cut=kind == FUSED[1]))
        else:
            answer = KINDS[kind](model, rng)
        sure = {"sure_and_wrong": answer.is_sure and not answer.is_right, "right_and_sure": all(answer[1:])}
        return {**answer._asdict(), **sure, "seconds": time.process_time() - begun}

    cases = [{"kind": kind, "draw": draw} for draw in range(options.draws) for kind in options.kinds]
    rows = cli.fill_table(run, cases, work)
    return cli.write_summary(run, cli.summarize(rows, ("kind",), COLUMNS))


def scan_gallery(x: float, relief_m: float, *, seed: int = 0) -> np.ndarray:
    """Simulates 32 beams between two walls 6 m apart, with pilasters of a relief at uneven steps on both.

    Args:
        x: place of the lidar along the walls.
        relief_m: depth of the pilasters; 0 for bare walls.
        seed: of the places of the pilasters.

    Returns:
        (n, 3) points in the frame of the lidar.
    """
    angles = np.linspace(-np.pi, np.pi, 375, endpoint=False), np.deg2rad(np.linspace(-25, 25, 32))
    azimuth, elevation = np.meshgrid(*angles)
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    starts, width = np.cumsum(np.random.default_rng(seed).uniform(0.4, 1.8, (2, 20)), axis=1) - 15, 0.4
    ranges = np.where(rays[:, 2] < 0, -1.5 / np.minimum(rays[:, 2], -1e-9), np.inf)
    for side, sign in zip(starts, (-1, 1), strict=True):
        ahead = np.maximum(sign * rays[:, 1], 1e-9)
        ranges, front = np.minimum(ranges, 3.0 / ahead), (3.0 - relief_m) / ahead
        for start in side - x:
            # The front of a pilaster, and the side of it that faces the lidar.
            is_front = (front * rays[:, 0] > start) & (front * rays[:, 0] < start + width)
            edge = start if start > 0 else start + width
            beside = np.where(edge * rays[:, 0] > 0, edge / rays[:, 0], np.inf)
            is_beside = (beside * ahead > 3.0 - relief_m) & (beside * ahead < 3.0)
            ranges = np.minimum(ranges, np.where(is_front, front, np.where(is_beside, beside, np.inf)))
    ranges += np.random.default_rng([seed, round(1000 * x)]).normal(0, NOISE_M, len(ranges))
    return (rays * ranges[:, None])[ranges < 30]


class Answer(NamedTuple):
    """Error of an answer, None where no answer is right, and whether it is right and sure."""

    error_m: float | None
    is_right: bool
    is_sure: bool


def map_gallery(model: deeppointmap.Model, rng: np.random.Generator) -> Answer:
    """Maps a drive along a gallery; it is sure where few scans were guessed."""
    relief_m, seed, poses = rng.uniform(0.03, 0.2), int(rng.integers(1 << 30)), np.tile(np.eye(4), (NUM_SCANS, 1, 1))
    poses[:, 0, 3] = STEP_M * np.arange(NUM_SCANS)
    scans = [scan_gallery(pose[0, 3], relief_m, seed=seed) for pose in poses]
    result = slam.run_slam(model, scans)
    error_m = float(metrics.trajectory_errors(result.T_world_scan, poses)["ate_m"])
    return Answer(error_m, error_m < RIGHT_ATE_M, result.assessment.is_trusted)


def draw_passage(rng: np.random.Generator) -> tuple[np.ndarray, sequences.FloatArray, sequences.FloatArray]:
    """Draws a planar drive from a room through a passage to another room.

    Args:
        rng: source of all sizes: a passage 1 to 3 m wide and 12 to 30 m long, steps of 0.25 to 0.9 m.

    Returns:
        Ranges (n, 181) of beams from -90 to 90 degrees, poses (n, 3), and steps (n - 1, 3) by wheels.
    """
    width, length, rooms, step = rng.uniform(1, 3), rng.uniform(12, 30), rng.uniform(4, 8, 4), rng.uniform(0.25, 0.9)
    grid, middle = np.ones((200, 1000), bool), 100
    spans = ((1.0, rooms[0], rooms[2]), (1.0 + rooms[0], length, width), (1.0 + rooms[0] + length, rooms[1], rooms[3]))
    for begin, long, wide in spans:
        half = round(max(wide, width) / 2 / PX_M)
        grid[middle - half : middle + half, round(begin / PX_M) : round((begin + long) / PX_M)] = False
    for begin in (1.0 + rng.uniform(0, 0.3) * rooms[0], 1.0 + rooms[0] + length + rng.uniform(0.6, 0.8) * rooms[1]):
        box = round(begin / PX_M), middle + round(width / 2 / PX_M) + 4
        grid[box[1] : box[1] + 12, box[0] : box[0] + 16] = True
    x = np.arange(1.0 + rooms[0] / 2, 1.0 + rooms[0] + length + rooms[1] / 2, step)
    y = middle * PX_M + 0.1 * width * np.sin(x / rng.uniform(2, 5))
    poses = np.column_stack([x, y, np.arctan2(np.gradient(y), np.gradient(x)) + rng.normal(0, 0.02, len(x))])
    origins = np.repeat(poses[:, :2], len(ANGLES), axis=0) / PX_M
    ranges = PX_M * simulation.cast_rays(grid, origins, (poses[:, 2:] + ANGLES).ravel()).reshape(len(poses), -1)
    ranges += rng.normal(0, 0.01, ranges.shape)
    steps = se2.relative(poses[:-1], poses[1:]) + rng.normal(size=(len(x) - 1, 3)) * [0.03 * step, 0.03 * step, 0.01]
    return ranges, poses, steps


def map_passage(rng: np.random.Generator, *, odometry: str) -> Answer:
    """Maps a drive of `draw_passage`; right within half a metre.

    Args:
        rng: source of the drive.
        odometry: "none", "wheels", or "silent" for wheels that repeat their pose for 5 to 40 scans. "clock" and "late"
            are recorded with wheels (`record_passage`).

    Returns:
        The answer, with the worst error of a position after the best rigid alignment.
    """
    ranges, poses, steps = draw_passage(rng)
    if odometry == "silent":
        count = int(rng.integers(5, min(40, len(steps) // 2)))
        begin = int(rng.integers(1, len(steps) - count))
        steps[begin : begin + count] = 0.0
    points = (ranges[..., None] * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)).astype(np.float32)
    wheels = None if odometry == "none" else se2.chain(steps)
    drive = sequences.ScanSequence("passage", points, np.ones(points.shape[:2], bool), "m", poses, wheels)
    if odometry in ("clock", "late"):
        with tempfile.TemporaryDirectory() as folder:
            recorded = io.read_sequence(record_passage(rng, Path(folder), ranges, se2.chain(steps), fault=odometry))
        drive = replace(recorded, reference_poses=poses)
    config, key = slam.RegistrationConfig(min_distance=0.1), jax.random.key(0)
    found = slam.register_scans(drive, config, key=key, odometry=drive.odometry_poses, hooks=NO_FIT)
    worst_m = metrics.planar_errors(drive, found.poses)["worst_scan_m"]
    return Answer(worst_m, worst_m < RIGHT_PASSAGE_M, found.assessment.is_trusted)


def record_passage(
    rng: np.random.Generator, folder: Path, ranges: np.ndarray, odometry: sequences.FloatArray, *, fault: str
) -> Path:
    """Records a drive in a bag of ROS 1 or 2, or in a CARMEN log, with wrong stamps.

    Args:
        rng: source of the rate, 1 to 10 Hz, of the format and of the fault.
        folder: of the file.
        ranges: (n, 181).
        odometry: (n, 3).
        fault: "clock": stamps of the scans, the odometry or both step back by 1 to 20 s at a scan, in a log of both.
            "late": stamps of the odometry are 0.3 to 5 s late; a bag.

    Returns:
        The file.
    """
    period, kind, back = rng.uniform(0.1, 1.0), str(rng.choice(["bag", "db3", "log"])), np.zeros((2, len(ranges)))
    if fault == "clock":
        who = slice(None) if kind == "log" else ((0,), (1,), (0, 1))[rng.integers(3)]
        back[who, int(rng.integers(1, len(ranges))) :] = rng.uniform(1, 20)
    else:
        back[1], kind = -rng.uniform(0.3, 5.0), kind.replace("log", "bag")
    recorded = 1.6e9 + period * np.arange(len(ranges))
    stamps = recorded - back
    if kind == "log":
        path = folder / "drive.log"
        lines = zip(ranges, odometry, stamps[0], strict=True)
        path.write_text("".join(
            "ODOM {1} {2} {3} 0 0 0 {0} host {0}\nFLASER 181 {4} {1} {2} {3} {1} {2} {3} {0} host {0}\n".format(
                stamp, *pose, " ".join(map(str, row))
            )
            for row, pose, stamp in lines
        ))  # fmt: skip
        return path
    with BagWriter(folder / "drive", kind) as bag:
        whole = np.full((len(ranges), 360), np.inf)
        whole[:, 90:271] = ranges
        for row, pose, now, (scan, wheel) in zip(whole, odometry, recorded, stamps.T, strict=True):
            ns = [int(1e9 * time) for time in (now, scan, wheel)]
            bag.write_odometry(pose, ns[2], delay_ns=ns[0] - ns[2])
            bag.write_scan(row, ns[1], delay_ns=ns[0] - ns[1])
    return bag.path


class Pair(NamedTuple):
    """Two scans, and T_target_source; None where no motion is right."""

    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray | None


def register_pair(model: deeppointmap.Model, pair: Pair) -> Answer:
    """Registers a pair."""
    found = deeppointmap.register(model, pair.source, pair.target)
    is_sure, T_true = float(found.confidence) >= SURE, pair.T_target_source
    if T_true is None:
        return Answer(None, False, is_sure)
    recall = metrics.registration_recall(np.asarray(found.T_target_source, np.float64)[None], T_true[None])
    return Answer(float(recall.translation_errors_m[0]), bool(recall.is_right[0]), is_sure)


def draw_pair(rng: np.random.Generator, kind: str, most_apart: int) -> Pair:
    """Draws two scans of a simulated drive, the second one turned."""
    drive = simulation.simulate_drive(int(rng.integers(1 << 30)), kind=kind, length_m=160.0)
    first = int(rng.integers(len(drive)))
    second = int(np.clip(first + rng.integers(1, most_apart) * rng.choice([-1, 1]), 0, len(drive) - 1))
    T_turned = np.eye(4)
    T_turned[:3, :3] = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
    source, target = (drive.read_points(row).astype(np.float32) for row in (first, second))
    T = T_turned @ rigid.inverse(drive.T_world_lidar[second]) @ drive.T_world_lidar[first]
    return Pair(source, (target @ T_turned[:3, :3].T).astype(np.float32), T)


def with_shell(rng: np.random.Generator) -> Pair:
    """Draws a pair with 0.5 to 10 % of beams without an echo, at the largest range."""
    pair = draw_pair(rng, "suburb", 6)
    share, range_m, noise_m = rng.uniform(0.005, 0.1), rng.uniform(25, 50), rng.choice([0.0, 0.1])

    def shelled(points: np.ndarray) -> np.ndarray:
        near = points[np.linalg.norm(points, axis=1) < range_m - 0.5]
        rays = rng.normal(size=(int(share * len(near)), 3)) * [1, 1, 0.2]
        rays *= (range_m + noise_m * rng.normal(size=(len(rays), 1))) / np.linalg.norm(rays, axis=1, keepdims=True)
        return np.concatenate([near, rays]).astype(np.float32)

    return pair._replace(source=shelled(pair.source), target=shelled(pair.target))


def with_scale(rng: np.random.Generator) -> Pair:
    """Draws a pair whose source is enlarged by 0.9 to 1.1, not by less than 1 %: no motion of it is right."""
    pair = draw_pair(rng, "suburb", 6)
    scale = 1 + rng.uniform(0.01, 0.1) * rng.choice([-1, 1])
    return pair._replace(source=(scale * pair.source).astype(np.float32), T_target_source=None)


def draw_view(rng: np.random.Generator, drives: Sequence[Path], *, is_cut: bool) -> Pair:
    """Draws a scan of a recorded drive, and a crop of a fused map of the drive without this scan and its neighbours.

    Args:
        rng: source of the choices.
        drives: folders of drives with poses.
        is_cut: True keeps a view of 70 degrees of the scan.

    Returns:
        The pair; the target is the crop of 35 m, thinned to 10 cm, in a frame turned about the vertical.
    """
    drive = io.open_lidar_sequence(drives[rng.integers(len(drives))])
    if drive.T_world_lidar is None:
        raise ValueError(f"{drive.name}: has no poses; the kinds fused and fused-cut need them")
    T_world_lidar, row = drive.T_world_lidar, int(rng.integers(len(drive)))
    T_world_crop = T_world_lidar[row].copy()
    T_world_crop[:2, 3] += rng.uniform(-5, 5, 2)
    T_world_crop[:3, :3] = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
    order = np.argsort(np.linalg.norm(T_world_lidar[:, :3, 3] - T_world_crop[:3, 3], axis=1))[:40:2]
    rows = [other for other in order.tolist() if abs(other - row) > 2][:15]
    T_crop_lidar = rigid.inverse(T_world_crop) @ T_world_lidar
    fused = np.concatenate([rigid.transform_points(T_crop_lidar[other], drive[other]) for other in rows])
    fused = fused[np.linalg.norm(fused[:, :2], axis=1) < CROP_M]
    fused = fused[np.unique(np.floor(fused / 0.1), axis=0, return_index=True)[1]].astype(np.float32)
    scan = drive[row]
    if is_cut:
        off = np.arctan2(scan[:, 1], scan[:, 0]) - rng.uniform(-np.pi, np.pi)
        scan = scan[np.cos(off) > np.cos(np.radians(35))]
    return Pair(scan, fused, T_crop_lidar[row])


KINDS: dict[str, Callable[[deeppointmap.Model, np.random.Generator], Answer]] = {
    "relief": map_gallery,
    "shell": lambda model, rng: register_pair(model, with_shell(rng)),
    "scale": lambda model, rng: register_pair(model, with_scale(rng)),
    "turn": lambda model, rng: register_pair(model, draw_pair(rng, "corridor", 6)),
    "tunnel": lambda model, rng: register_pair(model, draw_pair(rng, "tunnel", 80)),
    "passage": lambda _, rng: map_passage(rng, odometry="none"),
    "wheels": lambda _, rng: map_passage(rng, odometry="wheels"),
    "silence": lambda _, rng: map_passage(rng, odometry="silent"),
    "clock": lambda _, rng: map_passage(rng, odometry="clock"),
    "late": lambda _, rng: map_passage(rng, odometry="late"),
}


if __name__ == "__main__":
    cli.run_experiment(main)
