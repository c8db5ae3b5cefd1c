"""Registers depth images by DeepMapping, many short trajectories at low overlap (DeepMapping section 4.2, figure 9).

    python -m experiments.deepmapping_rgbd                        105 walks through simulated apartments
    python -m experiments.deepmapping_rgbd --walks hard --limit 60
    python -m experiments.deepmapping_rgbd --limit 7 -o out
    python -m experiments.deepmapping_rgbd Home_001_1             walks through a scene of the Active Vision Dataset
    python -m experiments.deepmapping_rgbd rgbd_folder            depth PNG + pose files + intrinsics, in SE(3)
    python -m experiments.deepmapping_rgbd --resume -o out

The simulated apartments follow the dataset's protocol: places 300 mm apart, views every 30 degrees, 8 or 16 views. With
--walks hard, each walk has 16 views of an apartment of its own: moves and turns at once with jitter, depth noise and
missing pixels. Walks on which no motion at all has an ATE below 450 mm are left out. No setting was chosen on them.

Each trajectory is written to rows/ as soon as all methods have done it. The file metrics.json has the share of walks
with an ATE below 450 mm, and of right walks. The paper's threshold is 450 mm; no motion at all meets it on most of its
walks. Right is an ATE below a tenth of the spread of the cameras, turns between neighbours within 2 degrees, and points
within 100 mm. The files map_K.png have some trajectories from above.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, io, simulation, viz
from dpmjax import deepmapping as dm
from dpmjax import registration_rgbd as rgbd

EXPERIMENT = "deepmapping_rgbd"
METHODS = ("zero", "placed", "deepmapping", "deepmapping-cold", "direct", "icp", "multiway")
_ICP_POINTS = 800
_SUCCESS_MM = 450.0
# What is right: ATE as a share of the spread, turns, distance of points.
_RIGHT_SHARE, _RIGHT_DEG, _RIGHT_MM = 0.1, 2.0, 100.0
# Settings were chosen on apartments below 15; each hard walk has an apartment of its own.
_NUM_APARTMENTS, _FIRST_HELD_OUT = 15, 1000
_HARD_VIEWS, _FOLDER_VIEWS = 16, 8
# Trajectories that are drawn from above.
_NUM_PICTURES = 4


@dataclass(frozen=True, kw_only=True)
class Config(cli.RunOptions):
    """Options of the comparison."""

    may_change: ClassVar[frozenset[str]] = frozenset({"limit"})

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """A scene of the Active Vision Dataset, or a folder of NAME.depth.png; without it, simulated apartments."""
    walks: Literal["paper", "hard"] = "paper"
    """Which simulated walks."""
    limit: Annotated[int, arg(metavar="N")] = 105
    """Trajectories."""
    methods: tuple[str, ...] = ("zero", "placed", "deepmapping", "deepmapping-cold", "direct")
    """What to compare; also icp and multiway (Open3D, extra `baselines`)."""
    window_step: Annotated[int, arg(metavar="N")] = _FOLDER_VIEWS // 2
    """Windows of 8 images of a folder begin so many images apart."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, limit=1, window_step=1)
        cli.check_names("--methods", self.methods, METHODS)


def main(config: Config) -> list[cli.Row]:
    """Runs the missing cases, then writes the table and the pictures."""
    if "multiway" in config.methods:
        cli.require_importable("open3d", "--methods multiway")
    settings = dm.preset("fast", "depth", motion="planar" if read_trajectory(config, 0).is_planar else "full")

    def work(run: cli.TableRun, trajectory: int) -> cli.Row:
        return run_one(trajectory, run.folder, config, settings)

    cases = [{"trajectory": index} for index in range(num_trajectories(config))]
    return cli.run_table(config, EXPERIMENT, cases, work, lambda rows: report(rows, config.methods))


def num_trajectories(config: Config) -> int:
    """Returns the requested number, and of a folder of images at most the number of windows."""
    if config.data is None or io.is_active_vision(config.data):
        return config.limit
    count = len(io.read_pose_folder(config.data))
    return min(config.limit, max(1, (count - _FOLDER_VIEWS) // config.window_step + 1))


def read_trajectory(config: Config, index: int) -> io.DepthSequence:
    """Returns one trajectory; of a folder of images a window."""
    views, seed = 8 if index % 2 == 0 else 16, 1000 * config.seed + index
    if config.data is None:
        if config.walks == "hard":
            apartment, walk = _FIRST_HELD_OUT + seed, simulation.HARD_WALK
            return simulation.simulate_depth_sequence(apartment, _HARD_VIEWS, seed=seed, config=walk)
        return simulation.simulate_depth_sequence(seed % _NUM_APARTMENTS, views, seed=seed)
    if io.is_active_vision(config.data):
        return io.read_active_vision(config.data, views, seed=seed)
    sequence = io.read_pose_folder(config.data)
    if sequence.T_world_camera is None:
        raise ValueError(f"{config.data}: has no pose files, so nothing to compare to")
    begin = index * config.window_step
    window = sequence.take(slice(begin, begin + _FOLDER_VIEWS))
    return replace(window, name=f"{sequence.name}, images {begin} to {begin + len(window) - 1}")


def run_method(
    name: str, sequence: io.DepthSequence, settings: dm.DeepMappingConfig, found: Mapping[str, np.ndarray], *, seed: int
) -> np.ndarray:
    """Returns (n, 4, 4) T_world_camera by one method.

    Args:
        name: one of `METHODS`. "zero": all cameras at one place. "placed": the search for first poses. "deepmapping":
            from "placed", of the two the one of the larger projective consistency. "deepmapping-cold": L-Net from zero.
            "direct": its losses without L-Net, from L-Net's first forward pass, as in the paper. "icp": each image onto
            the one before. "multiway": Open3D's multiway registration.
        sequence: depth images.
        settings: settings of DeepMapping.
        found: results of other methods for this sequence: a start that is there is not computed again.
        seed: seed of everything random.

    Returns:
        The poses.
    """
    import jax

    from experiments._baselines import multiway_images

    scans, key = rgbd.as_depth_scans(sequence.points, sequence.mask), jax.random.key(seed)

    def fit_cold(config: dm.DeepMappingConfig) -> np.ndarray:
        return dm.fit_deepmapping(scans, config, key=key).T_world_scan

    methods = {
        "zero": lambda: np.tile(np.eye(4), (len(sequence), 1, 1)),
        "placed": lambda: rgbd.initialize_depth(scans, rgbd.depth_search(settings.motion), key=key),
        "deepmapping": lambda: dm.register_depth(scans, settings, key=key, start=found.get("placed")).T_world_scan,
        "deepmapping-cold": lambda: fit_cold(settings),
        "direct": lambda: fit_cold(dm.as_direct(settings)),
        "icp": lambda: chain_icp(sequence, seed=seed),
        "multiway": lambda: multiway_images(sequence.points, sequence.mask),
    }
    return methods[name]()


def chain_icp(sequence: io.DepthSequence, *, seed: int) -> np.ndarray:
    """Returns poses by point-to-plane ICP of each image onto the one before, from the same pose."""
    from dpmjax.registration2d import icp

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


def spread_of(sequence: io.DepthSequence) -> float:
    """Returns the root mean square distance of the cameras from their mean, mm: the ATE of not moving at all."""
    positions = sequence.T_world_camera[:, :3, 3]
    return 1e3 * float(np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1))))


def errors_of(T: np.ndarray, sequence: io.DepthSequence) -> dict[str, float]:
    """Returns ATE (mm), mean point distance (mm) and the largest error of a turn between neighbours (degrees)."""
    errors = cli.depth_errors(sequence, T)
    return {name.replace("_m", "_mm"): 1e3 * value if name.endswith("_m") else value for name, value in errors.items()}


def run_one(trajectory: int, folder: cli.RunFolder, config: Config, settings: dm.DeepMappingConfig) -> cli.Row:
    """Runs all methods on one trajectory; a fit from the result of another method is timed without that method.

    The first `run_s` of each number of images contains its compilation.

    Args:
        trajectory: its number.
        folder: folder of the run; gets the pictures.
        config: options.
        settings: settings of DeepMapping.

    Returns:
        The remaining entries of the row.
    """
    sequence = read_trajectory(config, trajectory)
    found: dict[str, np.ndarray] = {}
    row: cli.Row = {"name": sequence.name, "views": len(sequence), "spread_mm": spread_of(sequence)}
    for name in config.methods:
        begun = time.perf_counter()
        found[name] = run_method(name, sequence, settings, found, seed=config.seed)
        row[name] = {**errors_of(found[name], sequence), "run_s": time.perf_counter() - begun}
    if trajectory < _NUM_PICTURES:
        panels = [(f"{name}, ATE {row[name]['ate_mm']:.0f} mm", T) for name, T in found.items() if name != "zero"]
        panels.append(("reference", sequence.T_world_camera))
        figure = viz.from_above_figure(panels, sequence.points, sequence.mask)
        viz.save_figure(figure, folder / f"map_{trajectory}.png", dpi=110)
    return row


def summarise(rows: list[cli.Row], methods: tuple[str, ...]) -> cli.Row:
    """Returns success rates and medians by method."""
    table: dict[str, dict[str, float]] = {}
    spread_mm = np.array([row["spread_mm"] for row in rows])
    for name in methods:
        values = {key: np.array([row[name][key] for row in rows]) for key in rows[0][name]}
        is_right = (values["ate_mm"] < _RIGHT_SHARE * spread_mm) & (values["point_distance_mm"] < _RIGHT_MM)
        is_right &= values["largest_turn_error_deg"] < _RIGHT_DEG
        medians = {f"median_{key}": float(np.median(values[key])) for key in ("ate_mm", "point_distance_mm", "run_s")}
        success = float((values["ate_mm"] < _SUCCESS_MM).mean())
        table[name] = {"success": success, "right": float(is_right.mean()), **medians}
    return {"num_trajectories": len(rows), "methods": table}


def report(rows: list[cli.Row], methods: tuple[str, ...]) -> cli.Summary:
    """Returns the shares and medians of each method."""
    numbers = summarise(rows, methods)
    right = f"below {_RIGHT_SHARE:.0%} of the spread, turns {_RIGHT_DEG:g} degrees, points {_RIGHT_MM:g} mm"
    text = f"{len(rows)} trajectories; success: ATE below 450 mm (the paper's); right: ATE {right}"
    columns = list(numbers["methods"][methods[0]])
    lines = [[name, *(row[column] for column in columns)] for name, row in numbers["methods"].items()]
    return cli.Summary(numbers, f"{text}\n\n{cli.markdown(('method', *columns), lines)}")


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
