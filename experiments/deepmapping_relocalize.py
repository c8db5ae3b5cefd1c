"""Draws how well L-Net re-localises unseen scans, at every free pixel of a world (DeepMapping figure 7).

    python -m experiments.deepmapping_2d --world 1 --init zero -o run
    python -m experiments.deepmapping_relocalize run

RUN is a folder of deepmapping_2d on a built-in world. Written beside its results: relocalization.png and
relocalization.json, for L-Net as the fit left it (only where one L-Net has learned all scans from zero poses: not with
windows, nor after a warm start) and for L-Net trained on the poses that the run found.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional, arg

from experiments import deepmapping_2d
from experiments._command import run_command
from experiments._machine import environment
from experiments._result_files import write_json
from experiments._run_folder import CHECKPOINTS, find_run, load_config

if TYPE_CHECKING:
    from dpmjax.deepmapping import Fitted
    from dpmjax.sequences import ScanSequence

EXPERIMENT = "deepmapping_relocalize"
# A fit counts as a success below this error (section 4.1); so does a re-localisation.
_RIGHT_PX = 20.0
_BINS_PX = (0.0, 10.0, 20.0, 50.0, 100.0, 1500.0)


@dataclass(frozen=True)
class Config:
    """Options of the picture."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of a run of deepmapping_2d on a built-in world."""
    stride_px: Annotated[int, arg(metavar="PX")] = 6
    """A scan is taken at the centre of every square of so many pixels that is free."""
    heading: Literal["nearest", "east"] = "nearest"
    """Orientation of these scans: that of the nearest scan of the fit, or along x everywhere."""
    steps: Annotated[int, arg(metavar="N")] = 5000
    """Training steps of L-Net on the poses of the run."""
    seed: int = 0
    """Seed of the training."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        for name in ("stride_px", "steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')}: expected at least 1, got {getattr(self, name)}")


def main(config: Config) -> dict[str, Any]:
    """Loads the run, re-localises scans everywhere with both L-Nets, draws, writes."""
    import jax

    from dpmjax.deepmapping import LocalizationTrainingConfig, relocalize, train_localization
    from dpmjax.deepmapping.relocalization import has_windows
    from dpmjax.simulation import make_world, scan_world
    from dpmjax.types import ScanSet

    options = load_config(find_run(deepmapping_2d.EXPERIMENT, config.run), deepmapping_2d.Config)
    if options.data is not None:
        raise ValueError(f"{config.run} is a run on {options.data}: the map of its world is needed; use a built-in one")
    sequence = deepmapping_2d.read_scans(options)
    fitted = load_fit(config.run, options, sequence)
    grid = make_world(options.world).is_obstacle
    truth = free_poses(grid, sequence, config)
    points, mask = scan_world(grid, truth, num_beams=sequence.points.shape[1])
    nets: dict[str, Fitted] = {}
    if not has_windows(fitted) and not np.any(np.asarray(fitted.params.start)):
        nets["L-Net as fitted"] = fitted
    begun = time.perf_counter()
    scans = ScanSet(sequence.points, sequence.mask)
    training = LocalizationTrainingConfig(num_steps=config.steps)
    nets["L-Net trained"] = train_localization(fitted, scans, training, key=jax.random.key(config.seed))
    jax.block_until_ready(nets["L-Net trained"].params)
    training_s = time.perf_counter() - begun
    errors = {
        name: errors_at(relocalize(net, ScanSet(points, mask)).pose, truth, fitted, sequence)
        for name, net in nets.items()
    }
    results = {name: summarise(far, turns, truth, sequence) for name, (far, turns) in errors.items()}
    draw(config, sequence, grid.shape, truth, {name: far for name, (far, _) in errors.items()}, results)
    report = {
        "world": sequence.name,
        "num_scans": len(sequence),
        "num_poses": len(truth),
        "heading": config.heading,
        "nets": results,
        "training_s": training_s,
        "seed": config.seed,
        **environment(),
    }
    write_json(config.run / "relocalization.json", report)
    tell(report)
    print(f"results in {config.run}")
    return report


def draw(
    config: Config,
    sequence: ScanSequence,
    shape: tuple[int, ...],
    truth: NDArray[np.float64],
    errors: dict[str, NDArray[np.float64]],
    results: dict[str, dict[str, Any]],
) -> None:
    """relocalization.png: a map of the errors a net."""
    from dpmjax import viz

    panels = []
    for name, far in errors.items():
        image = np.full(shape, np.nan)[:: config.stride_px, :: config.stride_px]
        image[tuple((truth[:, 1::-1] // config.stride_px).astype(int).T)] = far
        share = 100 * results[name]["share_below_20_px"]
        median = f"median {results[name]['median_px']:.0f} px"
        panels.append(viz.ErrorMap(name, f"{median}; {share:.0f} % of the free space below 20 px", image))
    side = config.stride_px * np.array(panels[0].error.shape)
    assert sequence.reference_poses is not None
    extent = (0.0, side[1], 0.0, side[0])
    figure = viz.error_maps_figure(panels, extent, sequence.reference_poses[:, :2], "px", worst=200.0)
    viz.save_figure(figure, config.run / "relocalization.png")


def load_fit(run: Path, options: deepmapping_2d.Config, sequence: ScanSequence) -> Fitted:
    """The fit of a run folder; its poses are those that the run kept.

    Args:
        run: the folder.
        options: of the run.
        sequence: its scans.

    Returns:
        The fit.

    Raises:
        ValueError: the folder holds no checkpoint or no trajectory.
    """
    import jax

    from dpmjax.checkpoints import Checkpoints
    from dpmjax.deepmapping import Fitted
    from dpmjax.deepmapping.fit import init
    from dpmjax.deepmapping.planar import planar_data, planar_problem
    from dpmjax.types import ScanSet

    trajectory = run / "trajectory.npy"
    if not trajectory.is_file():
        raise ValueError(f"{run} holds no trajectory.npy: let the run end, or resume it")
    settings = deepmapping_2d.fit_settings(options, sequence)
    poses = np.load(trajectory)
    data, unit = planar_data(ScanSet(sequence.points, sequence.mask), None if options.init == "zero" else poses)
    like = init(planar_problem(settings, data), data, key=jax.random.key(0))
    state = Checkpoints((run / CHECKPOINTS).resolve()).restore_latest(like, fallback=None)
    if state is None:
        raise ValueError(f"{run} holds no checkpoint that can be read")
    return Fitted(poses, state.params, None, unit, settings)


def free_poses(grid: NDArray[np.bool_], sequence: ScanSequence, config: Config) -> NDArray[np.float64]:
    """(m, 3) poses at the centres of the free squares."""
    from scipy.spatial import KDTree

    half = config.stride_px // 2
    rows, columns = np.nonzero(~grid[half :: config.stride_px, half :: config.stride_px])
    places = np.column_stack([columns, rows]) * config.stride_px + half + 0.5
    if config.heading == "east":
        return np.column_stack([places, np.zeros(len(places))])
    _, nearest = KDTree(sequence.reference_poses[:, :2]).query(places)
    return np.column_stack([places, sequence.reference_poses[nearest, 2]])


def errors_at(
    poses: NDArray[np.float64], truth: NDArray[np.float64], fitted: Fitted, sequence: ScanSequence
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distance (px) and angle (degrees) to the truth, in the frame that lays the run's trajectory onto the truth."""
    from dpmjax.geometry import se2
    from dpmjax.metrics import align_rigid

    T = align_rigid(fitted.poses[:, :2], sequence.reference_poses[:, :2])
    moved = poses[:, :2] @ T[:2, :2].T + T[:2, 2]
    turn = se2.wrap_angle(poses[:, 2] + np.arctan2(T[1, 0], T[0, 0]) - truth[:, 2])
    return np.linalg.norm(moved - truth[:, :2], axis=1), np.degrees(np.abs(turn))


def summarise(
    errors: NDArray[np.float64], turns: NDArray[np.float64], truth: NDArray[np.float64], sequence: ScanSequence
) -> dict[str, Any]:
    """Medians, overall and by the distance from the trajectory."""
    from scipy.spatial import KDTree

    distance, _ = KDTree(sequence.reference_poses[:, :2]).query(truth[:, :2])
    bins = []
    for low, high in itertools.pairwise(_BINS_PX):
        inside = (distance >= low) & (distance < high)
        if inside.any():
            row = {"from_px": low, "to_px": high, "num_poses": int(inside.sum())}
            row |= {"median_px": float(np.median(errors[inside])), "median_deg": float(np.median(turns[inside]))}
            bins.append({**row, "share_below_20_px": float((errors[inside] < _RIGHT_PX).mean())})
    return {
        "median_px": float(np.median(errors)),
        "median_deg": float(np.median(turns)),
        "share_below_20_px": float((errors < _RIGHT_PX).mean()),
        "by_distance_from_trajectory": bins,
    }


def tell(report: dict[str, Any]) -> None:
    """The medians by distance as a table."""
    for name, result in report["nets"].items():
        print(f"{name}: median {result['median_px']:.1f} px, {100 * result['share_below_20_px']:.0f} % below 20 px")
        for row in result["by_distance_from_trajectory"]:
            print(
                f"  {row['from_px']:5.0f} to {row['to_px']:5.0f} px from the trajectory: median {row['median_px']:6.1f}"
                f" px, {row['median_deg']:5.1f} degrees, {100 * row['share_below_20_px']:3.0f} % below 20 px"
            )


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, experiment=EXPERIMENT, description=__doc__))
