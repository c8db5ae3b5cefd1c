"""Registers 2-D laser scans into one map by optimising two small networks on these scans alone (DeepMapping).

    dpmjax map2d                              the built-in world
    dpmjax map2d scans.tar -o out             a folder or .tar of .pcd + gt_pose.mat
    dpmjax map2d robot.log.gz                 a CARMEN log, as recorded or thinned
    dpmjax map2d drive.bag --topic /scan      LaserScan of a bag of ROS 1 or 2 (extra ros)
    dpmjax map2d scans.npz --seconds 60       arrays (n, b, 2)
    dpmjax map2d --jump 8 --init global       large steps: no first guess is needed
    dpmjax map2d --resume                     continue the latest run

Results go to results/map2d/<time>/ (latest links to the newest): metrics.json, trajectories as TUM, KITTI and
npy, and pictures: map.png, occupancy.png, loss.png. Without --init the start is the odometry, where there is one, else
incremental point-to-line ICP. There are four candidates: the start and DeepMapping, each with and without refinement.
The one whose map fits the beams best is kept, chosen without ground truth; metrics.json and map.png name it. Of a whole
recording, scans half a metre or 20 degrees apart are registered, and all others follow the odometry between them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from tqdm import tqdm
from tyro.conf import Positional, arg

from dpmjax import cli, deepmapping, geometry, io, registration2d, simulation
from dpmjax.cli import map2d_results as results
from dpmjax.sequences import FloatArray, ScanSequence

# Computes numbers, by name, of the poses of all scans.
Measure = Callable[[FloatArray], dict[str, float]]

NAME = "map2d"
# Scans of a recording in metres that lie this far apart are registered.
_MIN_DISTANCE_M, _MIN_TURN_RAD = 0.5, 0.35


@dataclass(frozen=True, kw_only=True)
class Config(cli.ScanOptions, cli.RunOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"seconds"})

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """Scans: a folder or .tar of .pcd, a CARMEN log, a bag of ROS, .npy or .npz. Without it: the built-in world."""
    topic: Annotated[str | None, arg(aliases=["-t"], metavar="NAME")] = None
    """Which scans of a bag, where it holds several topics of them."""
    preset: Literal["fast", "paper"] = "fast"
    """fast: minutes on two cores; paper: architecture, losses and sampling of the paper."""
    init: Annotated[str, arg(metavar="auto|odometry|icp-plane|icp-point|global|zero|FILE")] = "auto"
    """Where the poses start; auto: odometry if there is any, else icp-plane; if the map from odometry cannot be
    trusted, icp-plane is tried, too; global: exhaustive search of scan pairs, needs no guess; FILE: poses (TUM, KITTI,
    or x y theta)."""
    ordered: bool = True
    """Scans lie in the order of time; --no-ordered makes no use of it, and needs --init global."""
    refine: bool = True
    """Also align all scans together, point to line, from the start and from the fit."""
    steps: Annotated[int | None, arg(metavar="N")] = None
    """Stop after N steps, rounded up to whole calls of the compiled program; without it, the preset decides."""
    seconds: Annotated[float | None, arg(metavar="S")] = None
    """Stop the fit after S seconds of run time, compile time not counted."""
    relations: Annotated[Path | None, arg(metavar="FILE")] = None
    """Hand-checked relations of a log, to measure the result by."""
    corrected: Annotated[Path | None, arg(metavar="LOG")] = None
    """A log of the same drive with corrected poses, to measure the result by at scans of the same time."""
    world: Literal[0, 1, 2, "grove", "crowd"] = 0
    """Which built-in world, where no DATA is given: three with walls; grove: trees, bushes and rocks, no straight wall;
    crowd: an office in which people walk about."""
    range_noise_px: Annotated[float, arg(metavar="PX")] = 0.0
    """Standard deviation of the range noise in the built-in world."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, steps=1, n_scans=1, jump=1, range_noise_px=0)
        if self.seconds is not None and not self.seconds > 0.0:
            raise ValueError(f"--seconds: expected a positive time, got {self.seconds}")
        if not self.ordered and self.init != "global" and not self.resume:
            raise ValueError(f"--no-ordered: only --init global needs no order, got --init {self.init}")
        if self.topic is not None and self.data is None and not self.resume:
            raise ValueError("--topic chooses scans of a bag: give it too, DATA")
        if self.data is not None and (self.world != 0 or self.range_noise_px != 0):
            raise ValueError("--world and --range-noise-px choose simulated scans; leave them out beside DATA")


def main(config: Config) -> dict[str, Any]:
    """Registers planar scans and writes the results; returns the content of `metrics.json`."""
    started = time.perf_counter()
    sequence = read_scans(config)
    start = starting_poses(config, sequence)
    measure = measures_of(config, sequence)
    folder = cli.open_run_folder(config, NAME)
    with cli.recording(folder), cli.StopFlag() as stop:
        print(f"{sequence.name}: {len(sequence)} scans of {sequence.points.shape[1]} beams")
        notes = cli.report_notes(sequence.notes)
        seconds = math.inf if config.seconds is None else config.seconds
        recorder = cli.FitRecorder(folder, sequence.unit, stop=lambda run_s: stop.is_requested or run_s >= seconds)
        result = register_sequence(sequence, start, config, recorder, stop)
        metrics = {
            **map_numbers(sequence, result, config, measure),
            **notes,
            **recorder.numbers,
            "status": "uncertain" if stop.status == "done" and not result.assessment.is_trusted else stop.status,
        }
        # Numbers first, so that they are written even if a picture fails.
        cli.write_poses(folder.path, result.poses, times=sequence.times, unit=sequence.unit)
        cli.write_metrics(folder, metrics | {"wall_s": time.perf_counter() - started}, seed=config.seed)
        registered = sequence.take(result.recording.chosen)
        limits = results.draw_map(folder, registered, result, metrics)
        if recorder.has_map:
            results.draw_occupancy(folder, registered, result, limits)
        cli.draw_loss(folder, sequence.unit)
        metrics["wall_s"] = time.perf_counter() - started
        cli.write_metrics(folder, metrics, seed=config.seed)
        cli.tell(f"{results.report(sequence.unit, metrics)}\nresults in {folder.path}")
    return metrics


def register_sequence(
    sequence: ScanSequence, start: str | FloatArray, config: Config, recorder: cli.FitRecorder, stop: cli.StopFlag
) -> registration2d.RegisteredScans:
    """Registers the scans, with the recorder as engine of the fit, and prints each stage and a bar of all."""
    import jax

    bar = tqdm(total=1.0, bar_format="{desc} {percentage:3.0f}%|{bar}| [{elapsed}]", desc="registration")

    def show(stage: str, share: float) -> None:
        if share == 0.0:
            bar.write(f"{stage} ...")

    def engine(rows: np.ndarray) -> Callable[..., deepmapping.Fit]:
        if len(rows) < len(sequence):
            bar.write(f"{len(rows)} of the scans are registered, chosen by their motion")
        fitted = sequence.take(rows)
        unit = fit_settings(config, sequence).unit or geometry.typical_range(fitted.points, fitted.mask)
        return partial(recorder, measure=results.ate_of(fitted, unit))

    def advance(share: float) -> None:
        bar.update(share - bar.n)

    hooks = registration2d.RegistrationHooks(show, lambda: stop.is_requested, engine, advance)
    with bar:
        return registration2d.register_scans(
            results.scan_set_of(sequence),
            registration_settings(config, sequence),
            key=jax.random.key(config.seed),
            start=start,
            odometry=sequence.odometry_poses if config.ordered else None,
            hooks=hooks,
        )


def map_numbers(
    sequence: ScanSequence, result: registration2d.RegisteredScans, config: Config, measure: Measure
) -> dict[str, Any]:
    """Returns the numbers of a registration under the names of `metrics.json`; given poses are named by their file."""
    registered = sequence.take(result.recording.chosen)
    start, kept = (result.candidates[name].poses for name in (result.start, result.kept))

    def title(name: str) -> str:
        return name.replace(registration2d.GIVEN_POSES, f"poses of {Path(config.init).name}")

    return {
        "num_scans": len(sequence),
        "num_registered": len(registered),
        **results.before_and_after(registered, start, kept),
        **cli.named_initial(measure(result.recording.between(start))),
        **measure(result.poses),
        "start": title(result.start),
        "kept": title(result.kept),
        "candidates": {
            title(name): results.planar_errors(registered, candidate.poses) | candidate.score._asdict()
            for name, candidate in result.candidates.items()
        },
        "assessment": result.assessment._asdict(),
    }


def measures_of(config: Config, sequence: ScanSequence) -> Measure:
    """Reads further references of the scans.

    Args:
        config: options of the run.
        sequence: all scans.

    Returns:
        A function of the poses of all scans; it returns the numbers by name.

    Raises:
        ValueError: a file does not belong to the scans.
    """
    relations = None if config.relations is None else io.read_relations(config.relations)
    corrected = None if config.corrected is None else io.read_sequence(config.corrected)
    if relations is None and corrected is None:
        return lambda _poses: {}
    times = sequence.times
    if times is None:
        raise ValueError(f"{sequence.name}: its scans have no times, which relations and a corrected log need")

    def measure(poses: FloatArray) -> dict[str, float]:
        by_relations = {} if relations is None else results.relation_numbers(times, poses, relations)
        return by_relations | ({} if corrected is None else results.corrected_numbers(times, poses, corrected))

    # Files of another drive are refused before any long work.
    measure(np.zeros((len(sequence), 3)))
    return measure


def read_scans(config: Config) -> ScanSequence:
    """Returns the chosen scans of DATA or of the built-in world."""
    chosen = config.selection
    if config.data is not None:
        sequence = io.read_sequence(config.data, selection=chosen, topic=config.topic)
        if not registration2d.find_originals(results.scan_set_of(sequence)).any():
            raise ValueError(f"{config.data}: all scans are equal beam by beam; give scans of a robot that moves")
        return sequence
    sequence = simulation.simulate_sequence(
        config.world, chosen.stop or 256, range_noise_px=config.range_noise_px, seed=config.seed, with_odometry=True
    )
    return sequence.take(chosen)


def starting_poses(config: Config, sequence: ScanSequence) -> Any:
    """Returns the name of the initial poses, or the poses of the file that `--init` names, for all scans."""
    init = config.init
    if init == "odometry" and sequence.odometry_poses is None:
        raise ValueError(
            f"{sequence.name}: has no odometry of its own (its odometry column repeats the corrected pose, or is "
            "missing); use --init icp-plane"
        )
    words = ("auto", *registration2d.START_NAMES)
    if init in words:
        return init
    if not Path(init).exists():
        raise ValueError(f"--init {init}: no such file, and none of {', '.join(words)}")
    return io.read_planar_poses(init, len(sequence), sequence.unit)


def registration_settings(config: Config, sequence: ScanSequence) -> registration2d.RegistrationConfig:
    """Returns the settings of the registration; scans in metres are chosen by their motion."""
    return registration2d.RegistrationConfig(
        is_ordered=config.ordered,
        refine=config.refine,
        fit=fit_settings(config, sequence),
        min_distance=_MIN_DISTANCE_M if sequence.unit == "m" else None,
        min_turn=_MIN_TURN_RAD,
    )


def fit_settings(config: Config, sequence: ScanSequence) -> deepmapping.DeepMappingConfig:
    """Returns the preset, with the given number of steps; the unit of the paper is that of its worlds in pixels."""
    settings = deepmapping.preset(config.preset, is_organised=sequence.is_organised)
    if sequence.unit == "m":
        settings = replace(settings, unit=None)
    return settings if config.steps is None else deepmapping.with_steps(settings, config.steps)


class Map2dRun(NamedTuple):
    """A finished run.

    Attributes:
        sequence: the scans.
        fitted: the fit, with the poses of the map.
        world: the built-in world; None where the scans were read from files.
    """

    sequence: ScanSequence
    fitted: deepmapping.Fitted
    world: int | str | None


def read_map2d_run(path: Path) -> Map2dRun:
    """Reads a run of all scans in their order.

    Args:
        path: the folder.

    Returns:
        Map2dRun.

    Raises:
        ValueError: the folder holds no options, no trajectory or no checkpoint that can be read; or its fit has other
            scans than the sequence, or another order of them.
    """
    import jax

    from dpmjax.checkpoints import Checkpoints

    config, trajectory = cli.load_config(cli.find_run(NAME, path), Config), path / "trajectory.npy"
    if not trajectory.is_file():
        raise ValueError(f"{path} holds no trajectory.npy: let the run end, or resume it")
    if not config.ordered:
        raise ValueError(
            f"{path} is a run with --no-ordered, whose fit has another order of the scans; use an ordered one"
        )
    sequence = read_scans(config)
    if sequence.unit == "m":
        raise ValueError(f"{path} is a run on {sequence.name}, in metres: give a run on a built-in world (--world)")
    settings = fit_settings(config, sequence)
    data, unit = deepmapping.mapping_data(
        results.scan_set_of(sequence),
        None if config.init == "zero" else np.load(trajectory),
        unit=settings.unit,
    )
    problem = deepmapping.mapping_problem(settings, data)
    like = deepmapping.init(problem, data, key=jax.random.key(0))
    state = Checkpoints((path / cli.CHECKPOINTS).resolve()).restore_latest(like, fallback=None)
    if state is None:
        raise ValueError(f"{path} holds no checkpoint that can be read")
    poses = np.asarray(problem.poses(settings, problem.phases[int(state.phase)], state.params, data), np.float64)
    fitted = deepmapping.Fitted(poses * [unit, unit, 1.0], state.params, None, unit, settings, int(state.step))
    return Map2dRun(sequence, fitted, config.world if config.data is None else None)
