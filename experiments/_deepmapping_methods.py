"""What the commands of DeepMapping share: starts, methods to compare, and the numbers of every candidate.

A candidate is a set of poses under the name of what produced it. "DeepMapping" names what L-Net or M-Net produced;
a search, an ICP or a refinement is called that.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from dpmjax import deepmapping, metrics, registration
from experiments._command import StopFlag
from experiments._run_folder import RunFolder, do_row, recording

if TYPE_CHECKING:
    from dpmjax.deepmapping import DeepMappingConfig
    from dpmjax.registration import PlanarScans
    from dpmjax.sequences import ScanSequence
    from dpmjax.types import ScanSet

Floats = NDArray[np.float64]
Candidates = dict[str, Floats]

SUCCESS_PX = 20.0
"""ATE below which the paper calls a run a success (section 4.1)."""

DEEPMAPPING = "DeepMapping"
START_NAMES = {
    "icp-plane": "incremental ICP, point to line",
    "icp-point": "incremental ICP, point to point",
    "global": "global registration",
    "odometry": "odometry",
    "zero": "zero poses",
}
"""Starts of a fit: the word on the command line, and the name of the candidate."""

NOT_RUN = {
    "go-icp": "its packages on PyPI search the turns of 3-D clouds, which may turn a flat scan over; py-goicp does not "
    "build with today's setuptools, py-simple-go-icp-interface took 20 s for one pair of flat scans and gave up",
}
"""Baselines of the paper that have no column, and why."""


@dataclass(frozen=True)
class Task:
    """One set of scans to register.

    Attributes:
        sequence: the scans; methods do not look at its reference.
        planar: the same scans with a line at every beam.
        is_ordered: the scans lie in the order of time.
        steps: steps of an optimiser.
        seed: seed of everything random.
    """

    sequence: ScanSequence
    planar: PlanarScans
    is_ordered: bool = True
    steps: int = 600
    seed: int = 0

    @property
    def scans(self) -> ScanSet:
        """The scans without their names and reference."""
        from dpmjax.types import ScanSet

        return ScanSet(self.sequence.points, self.sequence.mask)


def make_task(sequence: ScanSequence, *, is_ordered: bool = True, steps: int = 600, seed: int = 0) -> Task:
    """Prepares scans for the methods; where they are not ordered, they are shuffled first."""
    if not is_ordered:
        order = np.random.default_rng([seed, 77]).permutation(len(sequence))
        sequence = replace(sequence.take(order), odometry_poses=None)
    planar = registration.planar_scans(sequence.points, sequence.mask, is_ordered=is_ordered)
    return Task(sequence, planar, is_ordered, steps, seed)


def incremental(task: Task, metric: Literal["point", "plane"] = "plane") -> Floats:
    """Poses by incremental ICP."""
    return registration.incremental_icp(task.planar, metric).poses


def search(task: Task) -> Floats:
    """Poses by global registration: an exhaustive search of scan pairs, without a first guess."""
    return registration.register_globally(task.planar).poses


def refined(task: Task, poses: Floats, *, is_ordered: bool) -> Floats:
    """Poses after the alignment of all scans together."""
    return registration.refine(task.planar.replace(is_ordered=is_ordered), poses).poses


def choose(task: Task, candidates: Mapping[str, Floats]) -> tuple[str, dict[str, dict[str, float]]]:
    """The name of the best candidate, judged by the scans alone, and the scores of all."""
    kept, scores = registration.choose_trajectory(task.planar, candidates)
    return kept, {name: score._asdict() for name, score in scores.items()}


def assess(task: Task, poses: Floats) -> dict[str, Any]:
    """Whether the poses can be trusted, from the scans alone, by the names of the result files."""
    return registration.assess_trajectory(task.planar, poses)._asdict()


def errors(sequence: ScanSequence, poses: Floats) -> dict[str, float]:
    """ATE and point distance in the unit of the scans; nothing where there is no reference."""
    from dpmjax.geometry import se2

    reference = sequence.reference_poses
    if reference is None:
        return {}
    distance = metrics.point_distance(sequence.points, sequence.mask, se2.to_matrix(poses), se2.to_matrix(reference))
    return {
        f"ate_{sequence.unit}": metrics.absolute_trajectory_error(poses[:, :2], reference[:, :2]),
        f"point_distance_{sequence.unit}": distance,
    }


def in_fitting_order(task: Task, start: Floats) -> NDArray[np.intp]:
    """An order in which neighbours are near each other, for DeepMapping's losses: of time, or a tour of the start."""
    return np.arange(len(start)) if task.is_ordered else registration.nearest_tour(start)


def _fit(task: Task, start: Floats | None, config: DeepMappingConfig | None = None) -> Floats:
    """DeepMapping from a start, or from zero poses."""
    import jax

    settings = deepmapping.with_steps(config or deepmapping.preset("fast"), task.steps)
    order = np.arange(len(task.sequence)) if start is None else in_fitting_order(task, start)
    scans = replace(task, sequence=task.sequence.take(order)).scans
    fitted = deepmapping.fit_deepmapping(
        scans, settings, key=jax.random.key(task.seed), init=None if start is None else start[order]
    )
    return fitted.poses[np.argsort(order)]


def _direct_adam(task: Task) -> Floats:
    """DeepMapping's loss without L-Net: poses from zero by Adam."""
    return _fit(task, None, deepmapping.as_direct(deepmapping.preset("fast")))


def _direct_lbfgs(task: Task) -> Floats:
    """DeepMapping's loss without L-Net: poses from zero by L-BFGS."""
    import jax

    from experiments.baselines.direct import optimize_directly

    key = jax.random.key(task.seed)
    return optimize_directly(task.scans, deepmapping.preset("fast"), num_iterations=max(1, task.steps // 4), key=key)


def _multiway(task: Task) -> Floats:
    from experiments.baselines.multiway import multiway

    return multiway(task.scans)


def _swarm(task: Task) -> Floats:
    import jax

    from experiments.baselines.swarm import swarm_chain

    return swarm_chain(task.scans, key=jax.random.key(task.seed))


def _global_deepmapping(task: Task) -> Candidates:
    """DeepMapping from global registration: no ICP, no refinement."""
    start = search(task)
    return {START_NAMES["global"]: start, DEEPMAPPING: _fit(task, start)}


def _refined_deepmapping(task: Task) -> Candidates:
    """DeepMapping from the better of refined ICP and refined global registration, then refined."""
    name, start = _best_start(task)
    fitted = _fit(task, start)
    return {name: start, DEEPMAPPING: fitted, f"{DEEPMAPPING}, refined": refined(task, fitted, is_ordered=False)}


def _best_start(task: Task) -> tuple[str, Floats]:
    """Refined ICP if it can be trusted; else of it and refined global registration the more strongly connected one."""
    starts: list[tuple[dict[str, Any], str, Floats]] = []

    def add(name: str, poses: Floats) -> None:
        starts.append((assess(task, poses), f"{name}, refined", poses))

    if task.is_ordered:
        add(START_NAMES["icp-plane"], refined(task, incremental(task), is_ordered=True))
    if not starts or not starts[0][0]["is_trusted"]:
        add(START_NAMES["global"], refined(task, search(task), is_ordered=False))
    # Between two different maps the sharper one may be wrong, so `choose` does not decide here.
    return max(starts, key=lambda start: start[0]["weakest_connection"])[1:]


class Method(NamedTuple):
    """A column of the comparison.

    Attributes:
        title: what it is.
        run: makes its candidates; poses alone are one candidate under `title`.
        package: of the extra `baselines`, which it needs.
    """

    title: str
    run: Callable[[Task], Candidates | Floats]
    package: str | None = None


METHODS: dict[str, Method] = {
    "icp-point": Method(START_NAMES["icp-point"], partial(incremental, metric="point")),
    "icp-plane": Method(START_NAMES["icp-plane"], incremental),
    "icp-refined": Method("incremental ICP, refined", lambda task: refined(task, incremental(task), is_ordered=True)),
    "multiway": Method("multiway registration of Open3D", _multiway, "open3d"),
    "particle-swarm": Method("particle swarms, each scan onto the one before", _swarm, "evosax"),
    "direct-adam": Method("direct optimisation from zero, Adam", _direct_adam),
    "direct-lbfgs": Method("direct optimisation from zero, L-BFGS", _direct_lbfgs),
    "global-deepmapping": Method("global registration, then DeepMapping", _global_deepmapping),
    "refined-deepmapping": Method("ICP or global registration, then DeepMapping, refined", _refined_deepmapping),
}


def check_methods(methods: Sequence[str]) -> None:
    """Raises a ValueError where a method does not exist, or none is named."""
    unknown = [name for name in methods if name not in METHODS]
    if unknown or not methods:
        raise ValueError(f"--methods: expected some of {', '.join(METHODS)}, got {', '.join(unknown) or 'none'}")


def split_by_extras(methods: Sequence[str]) -> tuple[tuple[str, ...], dict[str, str]]:
    """The methods that can run here, and why the others cannot."""
    missing = {
        name: f"needs {package}: pip install dpmjax[baselines]"
        for name in methods
        if (package := METHODS[name].package) is not None and importlib.util.find_spec(package) is None
    }
    return tuple(name for name in methods if name not in missing), missing


def run_method(name: str, task: Task) -> dict[str, Any]:
    """One row: the errors, the time and the assessment of what was kept, and the numbers of every candidate."""
    method = METHODS[name]
    begun, begun_cpu = time.perf_counter(), time.process_time()
    found = method.run(task)
    candidates = found if isinstance(found, dict) else {method.title: found}
    # The choice belongs to a method that has several candidates, and to its time.
    kept, scores = choose(task, candidates) if len(candidates) > 1 else (method.title, {})
    seconds, cpu_seconds = time.perf_counter() - begun, time.process_time() - begun_cpu
    scores = scores or choose(task, candidates)[1]
    measured = {label: errors(task.sequence, poses) | scores[label] for label, poses in candidates.items()}
    return {
        **errors(task.sequence, candidates[kept]),
        "success": measured[kept]["ate_px"] < SUCCESS_PX,
        "seconds": seconds,
        "cpu_s": cpu_seconds,
        "kept": kept,
        "candidates": measured,
        **assess(task, candidates[kept]),
    }


def run_cells(
    folder: RunFolder,
    cells: Sequence[dict[str, Any]],
    methods: Sequence[str],
    prepare: Callable[[dict[str, Any]], tuple[Task, dict[str, Any]]],
    write: Callable[[list[dict[str, Any]]], None],
    *,
    seed: int,
) -> list[dict[str, Any]]:
    """Runs every method on every cell; what an earlier run has done is read from its files.

    Args:
        folder: of the run.
        cells: what identifies each set of scans.
        methods: names.
        prepare: makes the task of a cell, and what its rows carry besides the results.
        write: writes the results so far, after each cell.
        seed: of the run.

    Returns:
        All rows.
    """

    def work(method: str, prepared: Callable[[], tuple[Task, dict[str, Any]]]) -> dict[str, Any]:
        task, extra = prepared()
        return run_method(method, task) | extra

    rows: list[dict[str, Any]] = []
    with recording(folder), StopFlag() as stop:
        for cell in tqdm(cells, unit=" sets"):
            # The scans are made once for all methods, and not at all where all rows exist.
            prepared = cache(partial(prepare, cell))
            for method in methods:
                if stop.is_requested:
                    return rows
                rows.append(do_row(folder, {"method": method, **cell}, partial(work, method, prepared), seed=seed))
            write(rows)
    return rows
