"""Registers depth images by DeepMapping, many short walks at low overlap (DeepMapping section 4.2, figure 9).

    python -m experiments.deepmapping_rgbd                        105 walks through simulated apartments
    python -m experiments.deepmapping_rgbd --walks hard --limit 60
    python -m experiments.deepmapping_rgbd Home_001_1             walks through a scene of the Active Vision Dataset
    python -m experiments.deepmapping_rgbd rgbd_folder            depth PNG + pose files + intrinsics, in SE(3)
    python -m experiments.deepmapping_rgbd --resume -o out

The simulated apartments follow the dataset's protocol: places 300 mm apart, views every 30 degrees, 8 or 16 views. With
--walks hard, each walk has 16 views of an apartment of its own: moves and turns at once with jitter, depth noise and
missing pixels. Walks on which no motion at all has an ATE below 0.45 m are left out. No setting was chosen on them.

The file rows.csv has a row for each walk and method, table.md a summary. `success` is an ATE below the paper's 0.45 m,
which no motion at all meets on most of its walks. `right` is an ATE below a tenth of the spread of the cameras, turns
between neighbours within 2 degrees, and points within 0.1 m.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import jax
import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, io, metrics, simulation
from dpmjax import deepmapping as dm
from dpmjax.scan import DepthScans, as_depth_scans, initialize_depth
from experiments._baselines import multiway_images

SUCCESS_M = 0.45
RIGHT_SHARE, RIGHT_DEG, RIGHT_M = 0.1, 2.0, 0.1
# Settings were chosen on apartments below 15; each hard walk has an apartment of its own.
NUM_APARTMENTS, FIRST_HARD = 15, 1000
# Images of a folder that are registered together, and their distance from the next window.
WINDOW, WINDOW_STEP = 8, 4
ICP_POINTS = 800

Scans = DepthScans
Register = Callable[[Scans, dm.DeepMappingConfig, jax.Array], np.ndarray]


@dataclass(frozen=True, kw_only=True)
class RgbdOptions(cli.RunOptions):
    """Options of the comparison."""

    may_change: ClassVar[frozenset[str]] = frozenset({"limit", "methods"})

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """A scene of the Active Vision Dataset, or a folder of NAME.depth.png; without it, simulated apartments."""
    walks: Literal["paper", "hard"] = "paper"
    """Which simulated walks."""
    limit: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 105
    """Number of walks."""
    methods: tuple[str, ...] = ("zero", "placed", "deepmapping", "deepmapping-cold", "direct")
    """Methods to compare; also icp and multiway (Open3D, extra `baselines`)."""

    def __post_init__(self) -> None:
        """Checks bounds and names."""
        super().__post_init__()
        cli.check_names("--methods", self.methods, METHODS)


def main(options: RgbdOptions, run: cli.Run) -> cli.Row:
    """Computes the missing rows, and writes the table."""
    if "multiway" in options.methods:
        cli.require_importable("open3d", "--methods multiway")
    read = lru_cache(maxsize=1)(partial(read_walk, options))
    settings = dm.preset("fast", "depth", motion="planar" if read(0).is_planar else "full")
    run.open()

    def work(walk: int, method: str) -> cli.Row:
        sequence, begun = read(walk), time.perf_counter()
        scans = as_depth_scans(sequence.points, sequence.mask)
        T = METHODS[method](scans, settings, jax.random.key(options.seed))
        seconds = time.perf_counter() - begun
        return {"sequence": sequence.name, "views": len(sequence), **errors_of(T, sequence), "seconds": seconds}

    cases = [{"walk": walk, "method": name} for walk in range(num_walks(options)) for name in options.methods]
    rows = cli.fill_table(run, cases, work)
    columns = ("success", "right", "ate_m", "point_distance_m", "seconds")
    return cli.write_summary(run, cli.summarize(rows, ("method",), columns))


def num_walks(options: RgbdOptions) -> int:
    """Returns the number of walks; of a folder of images at most that of its windows."""
    if options.data is None or io.is_active_vision(options.data):
        return options.limit
    return min(options.limit, max(1, (len(io.read_pose_folder(options.data)) - WINDOW) // WINDOW_STEP + 1))


def read_walk(options: RgbdOptions, walk: int) -> io.DepthSequence:
    """Returns the images of a walk: 8 and 16 views in turn, 16 of a hard walk, a window of a folder."""
    views, seed = 8 if walk % 2 == 0 else 16, 1000 * options.seed + walk
    if options.data is None and options.walks == "hard":
        return simulation.simulate_depth_sequence(FIRST_HARD + seed, 16, seed=seed, config=simulation.HARD_WALK)
    if options.data is None:
        return simulation.simulate_depth_sequence(seed % NUM_APARTMENTS, views, seed=seed)
    if io.is_active_vision(options.data):
        return io.read_active_vision(options.data, views, seed=seed)
    sequence = io.read_pose_folder(options.data)
    if sequence.T_world_camera is None:
        raise ValueError(f"{options.data}: has no pose files, so nothing to compare to")
    begin = walk * WINDOW_STEP
    return sequence.take(slice(begin, begin + WINDOW))


def errors_of(T: np.ndarray, sequence: io.DepthSequence) -> cli.Row:
    """Returns the errors of (n, 4, 4) T_world_camera in metres and degrees, and whether they are small enough."""
    errors = metrics.depth_errors(sequence, T)
    spread_m = float(np.sqrt(np.var(sequence.T_world_camera[:, :3, 3], axis=0).sum()))
    is_right = errors["ate_m"] < RIGHT_SHARE * spread_m and errors["largest_turn_error_deg"] < RIGHT_DEG
    is_right = is_right and errors["point_distance_m"] < RIGHT_M
    return {"spread_m": spread_m, **errors, "success": errors["ate_m"] < SUCCESS_M, "right": is_right}


def chain_icp(scans: Scans, settings: dm.DeepMappingConfig, key: jax.Array) -> np.ndarray:
    """Returns poses by point-to-plane ICP of each image onto the one before, from the same pose."""
    from dpmjax.scan import icp

    rng = np.random.default_rng(jax.random.key_data(key)[-1].item())
    # One size for all clouds, so that ICP compiles once.
    images = zip(np.asarray(scans.points), np.asarray(scans.mask), strict=True)
    clouds = [points[mask][rng.choice(int(mask.sum()), ICP_POINTS)] for points, mask in images]
    T = [np.eye(4)]
    for before, after in itertools.pairwise(clouds):
        T.append(T[-1] @ np.asarray(icp(after, before, metric="plane").T_target_source, np.float64))
    return np.stack(T)


# Each returns (n, 4, 4) T_world_camera. "zero": all cameras at one place. "placed": the search for first poses.
# "deepmapping": from "placed", of the two the one of the larger projective consistency. "deepmapping-cold": L-Net from
# zero. "direct": its losses without L-Net, from L-Net's first forward pass, as in the paper.
METHODS: dict[str, Register] = {
    "zero": lambda scans, settings, key: np.tile(np.eye(4), (len(scans.points), 1, 1)),
    "placed": lambda scans, settings, key: initialize_depth(scans, settings.motion, key=key).T_world_camera,
    "deepmapping": lambda scans, settings, key: dm.register_depth(scans, settings, key=key).T_world_scan,
    "deepmapping-cold": lambda scans, settings, key: dm.fit_deepmapping(scans, settings, key=key).T_world_scan,
    "direct": lambda scans, settings, key: dm.fit_deepmapping(scans, dm.as_direct(settings), key=key).T_world_scan,
    "icp": chain_icp,
    "multiway": lambda scans, settings, key: multiway_images(scans.points, scans.mask),
}

if __name__ == "__main__":
    cli.run_experiment(main)
