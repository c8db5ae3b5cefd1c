"""Registers 2-D laser scans into one map by optimising two small networks on these scans alone (DeepMapping).

    dpmjax map2d                              the built-in world
    dpmjax map2d scans.tar -o out             a folder or .tar of .pcd + gt_pose.mat
    dpmjax map2d robot.log.gz                 a CARMEN log, as recorded or thinned
    dpmjax map2d scans.npz --seconds 60       arrays (n, b, 2)
    dpmjax map2d --jump 8 --init global       large steps: no first guess is needed
    dpmjax map2d --resume                     continue the latest run

Results go to results/map2d/<time>/ (latest links to the newest): metrics.json, trajectories as TUM, KITTI and
npy, and pictures: map.png, occupancy.png, loss.png. Without --init the start is the odometry, where there is one, else
incremental point-to-line ICP. Of the start, DeepMapping and both after refinement, the candidate is kept whose map
describes the beams best, judged without ground truth; metrics.json and map.png name it. Of a whole recording, scans
half a metre or 20 degrees apart are registered, and all others follow the odometry between them.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import deepmapping, io, registration, simulation, viz
from dpmjax import metrics as trajectory_metrics
from dpmjax.cli.command import StopFlag, check_least, run_command
from dpmjax.cli.machine import peak_rss_gb
from dpmjax.cli.recorded_fit import FitRun, draw_loss, run_fit
from dpmjax.cli.run_folder import RunFolder, RunOptions, open_run_folder, recording, write_metrics
from experiments import _deepmapping_methods as shared
from experiments._deepmapping_methods import Candidates, Floats, Task
from experiments._recordings import Recording, choose_scans, corrected_numbers, relation_numbers

if TYPE_CHECKING:
    from dpmjax.deepmapping import DeepMappingConfig
    from dpmjax.sequences import ScanSequence

NAME = "map2d"
LOGGER = logging.getLogger("dpmjax.deepmapping_2d")
UNITS = ("m", "deg")


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"seconds"})
    old_names: ClassVar[Mapping[str, str]] = {"--polish": "--refine", "--no-polish": "--no-refine"}

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """Scans: a folder or .tar of .pcd, a CARMEN log, .npy or .npz. Without it: the built-in world."""
    preset: Literal["fast", "paper"] = "fast"
    """fast: minutes on two cores; paper: architecture, losses and sampling of the paper."""
    init: Annotated[str, arg(metavar="auto|odometry|icp-plane|icp-point|global|zero|FILE")] = "auto"
    """Where the poses start; auto: odometry where there is one, else icp-plane, which is tried, too, where the map from
    odometry cannot be trusted; global: an exhaustive search of scan pairs, needs no guess; FILE is a trajectory."""
    ordered: bool = True
    """Scans lie in the order of time; --no-ordered makes no use of it, and needs --init global."""
    refine: bool = True
    """Also align all scans together, point to line, from the start and from the fit (--polish is the same)."""
    steps: Annotated[int | None, arg(metavar="N")] = None
    """Stop after N steps; without it, the preset decides."""
    seconds: Annotated[float | None, arg(metavar="S")] = None
    """Stop the fit after S seconds of run time, compile time not counted."""
    start: Annotated[int, arg(metavar="N")] = 0
    """First scan to use."""
    relations: Annotated[Path | None, arg(metavar="FILE")] = None
    """Hand-checked relations of a log, to measure the result by."""
    corrected: Annotated[Path | None, arg(metavar="LOG")] = None
    """A log of the same drive with corrected poses, to measure the result by at scans of the same time."""
    n_scans: Annotated[int | None, arg(aliases=["-n"], metavar="N")] = None
    """Use N scans; without it, all."""
    jump: Annotated[int, arg(aliases=["-j"], metavar="N")] = 1
    """Use every Nth scan."""
    world: Literal[0, 1, 2, "grove", "crowd"] = 0
    """Which built-in world, where no DATA is given: three with walls; grove: trees, bushes and rocks, no straight wall;
    crowd: an office in which people walk about."""
    range_noise_px: Annotated[float, arg(metavar="PX")] = 0.0
    """Standard deviation of the range noise in the built-in world."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_least(self, steps=1, n_scans=1, jump=1, start=0, range_noise_px=0)
        if self.seconds is not None and not self.seconds > 0.0:
            raise ValueError(f"--seconds: expected a positive time, got {self.seconds}")
        if not self.ordered and self.init != "global":
            raise ValueError(f"--no-ordered: only --init global needs no order, got --init {self.init}")


def main(config: Config) -> dict[str, Any]:
    """Reads, starts, fits, refines, keeps the best candidate, writes; returns the content of `metrics.json`."""
    started = time.perf_counter()
    by_scans = config.init in shared.STARTS_FROM_SCANS
    log = choose_scans(read_scans(config), is_ordered=config.ordered, by_scans=by_scans)
    sequence = log.registered
    planar = registration.planar_scans(sequence.points, sequence.mask, is_ordered=config.ordered)
    task = Task(sequence, planar, is_ordered=config.ordered, seed=config.seed)
    start_name, start = starting_poses(config, task, log)
    measure = measures_of(config, log)
    measured_before = measure(log.between(start), "_initial")
    settings = fit_settings(config, sequence)
    folder = open_run_folder(config, NAME)
    with recording(folder), StopFlag() as stop:
        print(f"{sequence.name}: {log.title}, from {start_name}")
        run = _fit(folder, task, settings, start, config, stop)
        candidates = {start_name: start, shared.DEEPMAPPING: run.fitted.poses}
        if config.refine and not stop.is_requested:
            candidates |= shared.refined_candidates(task, candidates, config.init)
        kept, compared = shared.choose(task, candidates)
        assessment = shared.assess(task, candidates[kept])
        has_other = config.init == "auto" and config.refine and sequence.odometry_poses is not None
        if has_other and not assessment["is_trusted"] and not stop.is_requested:
            print("The map from odometry cannot be trusted: the scans are registered without it, too ...", flush=True)
            candidates |= shared.refined_icp(task)
            kept, compared = shared.choose(task, candidates)
            assessment = shared.assess(task, candidates[kept])
        trajectory = log.aligned(candidates[kept])
        metrics = {
            "num_scans": len(log.whole),
            "num_registered": len(sequence),
            "steps": run.steps,
            **before_and_after(sequence, start, candidates[kept]),
            **measured_before,
            **measure(trajectory, ""),
            "start": start_name,
            "kept": kept,
            "candidates": compared,
            "assessment": assessment,
            "fit_s": run.run_s,
            "compile_s": run.compile_s,
            "peak_rss_gb": peak_rss_gb(),
            "is_interrupted": stop.is_requested,
        }
        # Numbers first: a picture that fails must not cost them.
        write_trajectories(folder, log.whole, trajectory)
        write_metrics(folder, metrics | {"wall_s": time.perf_counter() - started}, seed=config.seed)
        limits = draw_map(folder, task, candidates, metrics)
        draw_occupancy(folder, sequence, run, candidates[kept], limits)
        draw_loss(folder, sequence.unit)
        metrics["wall_s"] = time.perf_counter() - started
        write_metrics(folder, metrics, seed=config.seed)
        summary = report(sequence.unit, metrics)
        LOGGER.info(summary)
        print(summary, f"results in {folder.path}", sep="\n")
    return metrics


def _fit(
    folder: RunFolder, task: Task, settings: DeepMappingConfig, start: Floats, config: Config, stop: StopFlag
) -> FitRun:
    """Fits the scans in an order in which neighbours are near each other."""
    order = shared.in_fitting_order(task, start)
    run = run_fit(
        folder,
        task.sequence.take(order),
        settings,
        start=None if config.init == "zero" else start[order],
        seed=config.seed,
        stop=lambda run_s: stop.is_requested or (config.seconds is not None and run_s >= config.seconds),
    )
    return run._replace(fitted=run.fitted._replace(poses=run.fitted.poses[np.argsort(order)]))


def measures_of(config: Config, log: Recording) -> Callable[[Floats, str], dict[str, float]]:
    """Reads what the result is measured by, beside its own reference; returns the numbers of poses of all scans."""
    relations = None if config.relations is None else io.read_relations(config.relations)
    corrected = None if config.corrected is None else io.read_sequence(config.corrected)
    if relations is None and corrected is None:
        return lambda _poses, _suffix: {}
    times = log.times()

    def measure(poses: Floats, suffix: str) -> dict[str, float]:
        by_relations = {} if relations is None else relation_numbers(times, poses, relations, suffix)
        return by_relations | ({} if corrected is None else corrected_numbers(times, poses, corrected, suffix))

    return measure


def read_scans(config: Config) -> ScanSequence:
    """Returns the scans of DATA or of the built-in world, sub-range and stride applied."""
    stop = None if config.n_scans is None else config.start + config.n_scans * config.jump
    if config.data is not None:
        return io.read_sequence(config.data, start=config.start, stop=stop, stride=config.jump)
    sequence = simulation.simulate_sequence(
        config.world, stop or 256, range_noise_px=config.range_noise_px, seed=config.seed, with_odometry=True
    )
    return sequence.take(slice(config.start, stop, config.jump))


def starting_poses(config: Config, task: Task, log: Recording) -> tuple[str, Floats]:
    """Returns the name of the start and its (n, 3) poses; other words than those of `START_NAMES` name a file."""
    sequence, init = task.sequence, config.init
    if init == "auto":
        init = "icp-plane" if sequence.odometry_poses is None else "odometry"
    name = shared.START_NAMES.get(init, f"poses of {Path(init).name}")
    match init:
        case "zero":
            return name, np.zeros((len(sequence), 3))
        case "global":
            return name, shared.search(task)
        case "icp-plane" | "icp-point":
            return name, shared.incremental(task, "plane" if init == "icp-plane" else "point")
        case "odometry" if sequence.odometry_poses is None:
            raise ValueError(
                f"{sequence.name}: has no odometry of its own (its odometry column repeats the corrected pose, or is "
                "missing); use --init icp-plane"
            )
        case "odometry":
            return name, sequence.odometry_poses
        case _ if not Path(init).exists():
            raise ValueError(f"--init {init}: no such file, and none of auto, {', '.join(shared.START_NAMES)}")
    return name, io.read_planar_poses(init, len(log.whole), sequence.unit)[log.chosen]


def fit_settings(config: Config, sequence: ScanSequence) -> DeepMappingConfig:
    """Returns the preset, with the given number of steps."""
    settings = deepmapping.preset(config.preset, is_organised=sequence.is_organised)
    return settings if config.steps is None else deepmapping.with_steps(settings, config.steps)


def before_and_after(sequence: ScanSequence, start: Floats, poses: Floats) -> dict[str, Any]:
    """Returns errors of the kept poses and of the start; `success` is None where there is no reference."""
    reference, unit = sequence.reference_poses, sequence.unit
    if reference is None:
        return {"success": None}
    after, before = shared.errors(sequence, poses), shared.errors(sequence, start)
    # The paper's threshold is 20 pixels, 2 % of its world; of a real place, 2 % of what its trajectory spans.
    threshold = 20.0 if unit == "px" else 0.02 * float(np.linalg.norm(np.ptp(reference[:, :2], axis=0)))
    return {
        **after,
        **{name.replace(f"_{unit}", f"_initial_{unit}"): value for name, value in before.items()},
        f"success_threshold_{unit}": threshold,
        "success": after[f"ate_{unit}"] < threshold,
    }


def write_trajectories(folder: RunFolder, sequence: ScanSequence, poses: Floats) -> None:
    """Writes T_world_scan of every scan: trajectory.npy, trajectory_tum.txt, trajectory_kitti.txt."""
    io.write_poses_npy(folder / "trajectory.npy", poses)
    io.write_tum(folder / "trajectory_tum.txt", poses, times=sequence.times, unit=sequence.unit)
    io.write_kitti(folder / "trajectory_kitti.txt", poses)


def draw_map(folder: RunFolder, task: Task, candidates: Candidates, metrics: Mapping[str, Any]) -> viz.Limits:
    """Draws map.png: the start, DeepMapping, the kept candidate, the reference; returns its limits."""
    scans, unit, kept = task.scans, task.sequence.unit, metrics["kept"]
    panels = []
    for name in dict.fromkeys((metrics["start"], shared.DEEPMAPPING, kept)):
        numbers = metrics["candidates"][name]
        ate, distance = numbers.get(f"ate_{unit}"), numbers.get(f"point_distance_{unit}")
        title = name[0].upper() + name[1:] + (" (kept)" if name == kept else "")
        panels.append(viz.Panel(title, scans, candidates[name], ate=ate, point_distance=distance))
    if task.sequence.reference_poses is None:
        panels = [replace(panel, is_reference=panel.title.endswith(" (kept)")) for panel in panels]
    else:
        panels.append(viz.Panel("Reference", scans, task.sequence.reference_poses, is_reference=True))
    figure = viz.registered_scans_figure(panels, unit)
    viz.save_figure(figure, folder / "map.png")
    return viz.Limits(*figure.axes[0].get_xlim(), *figure.axes[0].get_ylim())


def draw_occupancy(folder: RunFolder, sequence: ScanSequence, run: FitRun, kept: Floats, limits: viz.Limits) -> None:
    """Draws occupancy.png: what M-Net learned, in the frame and within the limits of map.png."""
    if not run.has_map:
        return
    picture = deepmapping.draw_map(run.fitted, sequence.points, sequence.mask)
    anchor = kept if sequence.reference_poses is None else sequence.reference_poses
    trajectory = run.fitted.poses[:, :2]
    T_view_fit = trajectory_metrics.align_rigid(trajectory, anchor[:, :2])
    figure = viz.occupancy_figure(picture, trajectory, sequence.unit, T_view_world=T_view_fit, limits=limits)
    viz.save_figure(figure, folder / "occupancy.png")


def report(unit: str, metrics: Mapping[str, Any]) -> str:
    """Returns the last lines on the console: errors and scores of each candidate, assessment of the kept one."""
    candidates, assessment = metrics["candidates"], metrics["assessment"]
    width = max(map(len, candidates))
    lines = [f"  {'candidate':{width}}  {'ATE, ' + unit:>10}  nats a beam  beams off a surface"]
    for name, numbers in candidates.items():
        mark, ate = "*" if name == metrics["kept"] else " ", numbers.get(f"ate_{unit}", math.nan)
        lines.append(f"{mark} {name:{width}}  {ate:10.3g}  {numbers['code_length']:11.3f}  {numbers['misfit']:19.1%}")
    trust = "can be trusted" if assessment["is_trusted"] else "DO NOT TRUST this map"
    weakest, contradiction = assessment["weakest_connection"], assessment["contradiction"]
    lines += [
        f"kept: {metrics['kept']} (chosen by the scans alone)",
        f"{trust}: weakest connection {weakest:.2f}, {contradiction:.1%} of the beams contradict beyond the usual",
    ]
    if "num_relations" in metrics:
        kinds = (f"{metrics[f'relations_initial_{kind}']:.3g} -> {metrics[f'relations_{kind}']:.3g}" for kind in UNITS)
        lines.append(f"mean error of {metrics['num_relations']} hand-checked relations: {' m, '.join(kinds)} degrees")
    if "num_corrected" in metrics:
        before, after = metrics["ate_corrected_initial_m"], metrics["ate_corrected_m"]
        lines.append(f"ATE at {metrics['num_corrected']} scans of the corrected log: {before:.3g} -> {after:.3g} m")
        errors = metrics["relations_corrected_m"], metrics["relations_corrected_deg"]
        lines.append("mean error from each of these scans to the next: {:.3g} m, {:.3g} degrees".format(*errors))
    return "\n".join(lines)


def run(args: Sequence[str] | None = None) -> int:
    """Runs the subcommand; returns the exit code."""
    return run_command(main, Config, name=NAME, description=__doc__, args=args)
