"""Registers 2-D laser scans into one map by optimising two small networks on these scans alone (DeepMapping).

    dpmjax map2d                              the built-in world
    dpmjax map2d scans.tar -o out             a folder or .tar of .pcd + gt_pose.mat
    dpmjax map2d robot.log.gz                 a CARMEN log, as recorded or thinned
    dpmjax map2d drive.bag --topic /scan      LaserScan of a bag of ROS 1 or 2 (extra ros)
    dpmjax map2d scans.npz --seconds 60       arrays (n, b, 2)
    dpmjax map2d --jump 8 --init global       large steps: no first guess is needed
    dpmjax map2d --resume                     continue the latest run

Results go to results/map2d/<time>/ (latest links to the newest): metrics.json, trajectories as TUM, KITTI and
npy, and pictures: map.png, occupancy.png, loss.png.

Without --init, the start is the odometry. If there is none, it is incremental point-to-line ICP. There are four
candidates: the start and DeepMapping, each with and without refinement. The candidate whose map fits the beams best is
kept, without ground truth. The files metrics.json and map.png name it. In a whole recording, only scans half a metre or
20 degrees apart are registered. The scans between them follow the odometry.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, deepmapping, geometry, io, metrics, simulation, slam, viz
from dpmjax.progress import progress_bar
from dpmjax.sequences import FloatArray, ScanSequence

if TYPE_CHECKING:
    from dpmjax.types import ScanSet

# Scans of a recording in metres that lie this far apart are registered.
MIN_DISTANCE_M, MIN_TURN_RAD = 0.5, 0.35
# Largest number of printed spans of uncertain scans.
NUM_SPANS = 8


@dataclass(frozen=True, kw_only=True)
class Map2dOptions(cli.ScanOptions, cli.RunOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"seconds"})

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """Scans: a folder or .tar of .pcd, a CARMEN log, a bag of ROS, .npy or .npz. Default: the built-in world."""
    topic: Annotated[str | None, arg(aliases=["-t"], metavar="NAME")] = None
    """Topic of the scans, if a bag holds several."""
    preset: Literal["fast", "paper"] = "fast"
    """fast: minutes on two cores; paper: architecture, losses and sampling of the paper."""
    init: Annotated[str, arg(metavar="auto|odometry|icp-plane|icp-point|global|zero|FILE")] = "auto"
    """Initial poses. auto: odometry if there is any, else icp-plane, also if the map from odometry cannot be trusted.
    global: exhaustive search of scan pairs, without a first guess. FILE: poses (TUM, KITTI, or x y theta)."""
    ordered: bool = True
    """Scans are in time order. --no-ordered ignores the order, and needs --init global."""
    refine: bool = True
    """Also align all scans together, point to line, from the start and from the fit."""
    steps: Annotated[int | None, arg(metavar="N"), cli.Bound(1)] = None
    """Stop after N steps, rounded up to whole calls of the compiled program. Without it, the preset decides."""
    seconds: Annotated[float | None, arg(metavar="S"), cli.Bound(0, is_allowed=False)] = None
    """Stop the fit after S seconds of run time, without compile time."""
    world: Literal[0, 1, 2, "grove"] = 0
    """Built-in world without DATA: numbered ones have walls, grove has trees and rocks."""
    range_noise_px: Annotated[float, arg(metavar="PX"), cli.Bound(0)] = 0.0
    """Standard deviation of the range noise in the built-in world."""

    def __post_init__(self) -> None:
        """Checks bounds, and options that do not go together."""
        super().__post_init__()
        if not self.ordered and self.init != "global" and not self.resume:
            raise ValueError(f"--no-ordered: only --init global needs no order, got --init {self.init}")
        if self.topic is not None and self.data is None and not self.resume:
            raise ValueError("--topic chooses scans of a bag: give it too, DATA")
        if self.data is not None and (self.world != 0 or self.range_noise_px != 0):
            raise ValueError("--world and --range-noise-px choose simulated scans; leave them out beside DATA")


def main(options: Map2dOptions, run: cli.Run) -> cli.Numbers:
    """Registers planar scans and writes the results."""
    sequence = read_scans(options)
    start = starting_poses(options, sequence)
    run.open(sequence.notes)
    run.say(f"{sequence.name}: {len(sequence)} scans of {sequence.points.shape[1]} beams")
    recorder = cli.FitRecorder(run, sequence.unit, max_s=math.inf if options.seconds is None else options.seconds)
    result = register_sequence(sequence, start, options, recorder, run)
    numbers = {**map_numbers(sequence, result, options), **recorder.numbers}
    if sequence.odometry_poses is not None and options.ordered:
        T_odometry = geometry.se2.to_matrix(sequence.odometry_poses)
        numbers |= cli.odometry_numbers(run, T_odometry, result.T_world_scan, sequence)
    start_poses = result.recording.between(result.candidates[result.start].poses)
    for name, poses in (("trajectory", result.poses), ("start", start_poses)):
        cli.write_poses(run.path, poses, name, times=sequence.times, unit=sequence.unit)
    run.write_numbers(numbers)  # also where a picture fails
    if sequence.unit == "m":
        io.write_grid_map(run / "map", result.poses, sequence.points, sequence.mask)
    registered = sequence.take(result.recording.chosen)
    limits = draw_map(run, registered, result, numbers)
    if recorder.has_map:
        draw_occupancy(run, registered, result, limits)
    cli.draw_loss(run, sequence.unit)
    shown = (f"ate_{sequence.unit}", "code_length", "misfit")
    candidates = [
        {"candidate": name, **{column: found.get(column) for column in shown}}
        for name, found in numbers["candidates"].items()
    ]
    run.say(f"{cli.format_table(candidates)}\nkept: {numbers['kept']} (docs/guides/scans_2d.md explains the scores)")
    return numbers


def register_sequence(
    sequence: ScanSequence, start: str | FloatArray, options: Map2dOptions, recorder: cli.FitRecorder, run: cli.Run
) -> slam.RegisteredScans:
    """Registers the scans with the recorder as engine of the fit, and prints each stage and its bar."""
    import jax

    fit = fit_settings(options, sequence)
    config = slam.RegistrationConfig(
        is_ordered=options.ordered,
        refine=options.refine,
        fit=fit,
        min_distance=MIN_DISTANCE_M if sequence.unit == "m" else None,
        min_turn=MIN_TURN_RAD,
    )

    bar = progress_bar("registration", is_shown=True)

    def show(stage: str, share: float) -> None:
        if share == 0.0:
            bar.write(f"{stage} ...")
            bar.reset()
        bar.update(share - bar.n)

    def engine(rows: np.ndarray) -> Callable[..., deepmapping.Fit]:
        if len(rows) < len(sequence):
            bar.write(f"{len(rows)} of the scans are registered, chosen by their motion")
        fitted = sequence.take(rows)
        unit = fit.unit or geometry.typical_range(fitted.points, fitted.mask)
        return partial(recorder, measure=ate_of(fitted, unit))

    hooks = slam.RegistrationHooks(show, lambda: run.is_stopped, engine)
    with bar:
        return slam.register_scans(
            scan_set_of(sequence),
            config,
            key=jax.random.key(options.seed),
            start=start,
            odometry=sequence.odometry_poses if options.ordered else None,
            hooks=hooks,
        )


def map_numbers(sequence: ScanSequence, result: slam.RegisteredScans, options: Map2dOptions) -> cli.Numbers:
    """Returns the numbers of a registration under the names of `metrics.json`; given poses are named by their file."""
    registered, unit = sequence.take(result.recording.chosen), sequence.unit
    numbers: cli.Numbers = {
        "status": "done" if result.assessment.is_trusted else "uncertain",
        "verdict": trust_verdict(result.assessment._asdict()),
        "num_scans": len(sequence),
        "num_registered": len(registered),
        "success": None,
    }
    candidates = {
        name: metrics.planar_errors(registered, candidate.poses) | candidate.score._asdict()
        for name, candidate in result.candidates.items()
    }
    if registered.reference_poses is not None:
        before, after = (
            metrics.planar_errors(registered, result.candidates[name].poses) for name in (result.start, result.kept)
        )
        # The paper's threshold is 20 pixels, 2 % of its world. The threshold of a real place is 2 % of the span of its
        # trajectory.
        span = float(np.linalg.norm(np.ptp(registered.reference_poses[:, :2], axis=0)))
        threshold = 20.0 if unit == "px" else 0.02 * span
        numbers |= {**after, **named_initial(before), f"success_threshold_{unit}": threshold}
        numbers["success"] = after[f"ate_{unit}"] < threshold

    def title(name: str) -> str:
        return name.replace(slam.GIVEN_POSES, f"poses of {Path(options.init).name}")

    return {
        **numbers,
        "start": title(result.start),
        "kept": title(result.kept),
        "candidates": {title(name): found for name, found in candidates.items()},
        "assessment": result.assessment._asdict(),
    }


def read_scans(options: Map2dOptions) -> ScanSequence:
    """Returns the chosen scans of DATA or of the built-in world."""
    chosen = options.selection
    if options.data is None:
        num, noise_px = chosen.stop or 256, options.range_noise_px
        return simulation.simulate_sequence(
            options.world, num, range_noise_px=noise_px, seed=options.seed, with_odometry=True
        ).take(chosen)
    sequence = io.read_sequence(options.data, selection=chosen, topic=options.topic)
    if not slam.find_originals(scan_set_of(sequence)).any():
        raise ValueError(f"{options.data}: all scans are equal beam by beam; give scans of a robot that moves")
    return sequence


def starting_poses(options: Map2dOptions, sequence: ScanSequence) -> str | FloatArray:
    """Returns the name of the initial poses, or the poses of the file of `--init` for all scans."""
    init, words = options.init, ("auto", *slam.START_NAMES)
    if init == "odometry" and sequence.odometry_poses is None:
        reason = "has no odometry of its own (its odometry column repeats the corrected pose, or is missing)"
        raise ValueError(f"{sequence.name}: {reason}; use --init icp-plane")
    if init not in words and not Path(init).exists():
        raise ValueError(f"--init {init}: no such file, and none of {', '.join(words)}")
    return init if init in words else io.read_planar_poses(init, len(sequence), sequence.unit)


def fit_settings(options: Map2dOptions, sequence: ScanSequence) -> deepmapping.DeepMappingConfig:
    """Returns the preset, with the given number of steps; the unit of the paper is that of its worlds in pixels."""
    settings = deepmapping.preset(options.preset, is_organised=sequence.is_organised)
    if sequence.unit == "m":
        settings = replace(settings, unit=None)
    return settings if options.steps is None else deepmapping.with_steps(settings, options.steps)


def ate_of(sequence: ScanSequence, unit: float) -> Callable[[FloatArray], float]:
    """Returns a function that computes the ATE of poses with lengths in `unit`; NaN without a reference."""
    reference = sequence.reference_poses
    if reference is None:
        return lambda _: math.nan
    return lambda poses: float(metrics.absolute_trajectory_error(unit * poses[:, :2], reference[:, :2]))


def named_initial(numbers: Mapping[str, float]) -> dict[str, float]:
    """Renames errors for the initial poses, such as ate_m to ate_initial_m, and leaves out counts."""
    errors = {name: value for name, value in numbers.items() if not name.startswith("num_")}
    return {"_initial_".join(name.rsplit("_", 1)): value for name, value in errors.items()}


def trust_verdict(assessment: Mapping[str, Any]) -> str:
    """Returns the verdict on trust with its reason, the fault of the odometry, and the uncertain scans."""
    # Near zero the difference of two shares has either sign.
    contradiction, weakest = max(assessment["contradiction"], 0.0), assessment["weakest_connection"]
    text = f"{cli.trust_words(assessment['is_trusted'])}: the weakest connection scores {weakest:.2f} of 1; "
    text += f"{contradiction:.1%} more beams than between the best pairs end in the free space of another scan"
    if assessment["fault"] is not None:
        text += f"; {assessment['fault']}"
    if count := len(assessment["uncertain_scans"]):
        spans = spans_of(assessment["uncertain_scans"])
        shown = ", ".join(spans[:NUM_SPANS]) + (" ..." if len(spans) > NUM_SPANS else "")
        text += f"; uncertain where {count} scans are, which slide along a corridor or fit no other: {shown}"
    return text


def spans_of(rows: Sequence[int]) -> list[str]:
    """Returns increasing numbers as spans, such as 3-5 and 9."""
    parts = np.split(np.asarray(rows), np.flatnonzero(np.diff(rows) > 1) + 1)
    return [f"{part[0]}-{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts if len(part)]


def scan_set_of(sequence: ScanSequence) -> ScanSet:
    """Returns the scans without their name, unit and poses."""
    import jax.numpy as jnp

    from dpmjax.types import ScanSet

    return ScanSet(jnp.asarray(sequence.points), jnp.asarray(sequence.mask))


def draw_map(
    run: cli.Run, registered: ScanSequence, result: slam.RegisteredScans, numbers: Mapping[str, Any]
) -> viz.Limits:
    """Draws map.png: the start, DeepMapping if it was trained, the kept map, the reference. Returns its limits."""
    unit, reference = registered.unit, registered.reference_poses
    poses, anchor = {}, None
    for name, (title, found) in zip(result.candidates, numbers["candidates"].items(), strict=True):
        if name not in (result.start, slam.DEEPMAPPING, result.kept):
            continue
        title = title[0].upper() + title[1:] + (" (kept)" if name == result.kept else "") + "\n"
        errors = {"ATE": found.get(f"ate_{unit}"), "points": found.get(f"point_distance_{unit}")}.items()
        title += "   ".join(f"{label} {viz.format_length(e, unit)}" for label, e in errors if e is not None)
        poses[title], anchor = result.candidates[name].poses, title if name == result.kept else anchor
    if reference is not None:
        poses["Reference\n"], anchor = reference, None
    figure = viz.registered_scans_figure(scan_set_of(registered), poses, unit, anchor=anchor)
    viz.save_figure(figure, run / "map.png")
    return viz.Limits(*figure.axes[0].get_xlim(), *figure.axes[0].get_ylim())


def draw_occupancy(run: cli.Run, registered: ScanSequence, result: slam.RegisteredScans, limits: viz.Limits) -> None:
    """Draws occupancy.png: the occupancy that M-Net predicts, in the frame and within the limits of map.png."""
    picture = deepmapping.map_picture(result.fitted, registered.points, registered.mask)
    kept, reference = result.candidates[result.kept].poses, registered.reference_poses
    anchor, trajectory = kept if reference is None else reference, result.fitted.poses[:, :2]
    T_view_fit = np.asarray(metrics.align_rigid(trajectory, anchor[:, :2]))
    figure = viz.occupancy_figure(picture, trajectory, registered.unit, T_view_world=T_view_fit, limits=limits)
    viz.save_figure(figure, run / "occupancy.png")
