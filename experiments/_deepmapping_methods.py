"""Tables of methods by sets of planar scans: baselines, parts of the pipeline, and their combinations.

A candidate is a set of poses under the name of its method. "DeepMapping" is the name for results of L-Net or M-Net.
A search, an ICP or a refinement has its own name.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from dpmjax import ScanSet, cli, registration2d
from dpmjax import deepmapping as dm
from dpmjax.io import ScanSequence
from dpmjax.registration2d import DEEPMAPPING, START_NAMES, PlanarScans
from experiments._baselines import multiway, optimize_directly, swarm_chain, swarm_poses
from experiments._plain_icp import chain_icp

Candidates = dict[str, np.ndarray]

# ATE below which the paper calls a run a success (section 4.1).
SUCCESS_PX = 20.0

_LBFGS_ITERATIONS = 150
# Process time of the fast preset from zero poses, seconds a scan (deepmapping_suite_zero.json), as of the swarms.
_FIT_CPU_S = 0.13


@dataclass(frozen=True)
class Task:
    """One set of scans to register.

    Attributes:
        sequence: the scans; methods do not look at its reference.
        planar: the same scans with a line at every beam.
        is_ordered: the scans lie in the order of time.
        steps: steps of the fit; None: the preset decides.
        seed: seed of everything random.
    """

    sequence: ScanSequence
    planar: PlanarScans
    is_ordered: bool = True
    steps: int | None = None
    seed: int = 0

    @property
    def scans(self) -> ScanSet:
        """Returns the scans without their names and reference."""
        return ScanSet(self.sequence.points, self.sequence.mask)

    @property
    def key(self) -> jax.Array:
        """Returns the key of everything random."""
        return jax.random.key(self.seed)


def make_task(sequence: ScanSequence, *, is_ordered: bool = True, steps: int | None = None, seed: int = 0) -> Task:
    """Prepares scans for the methods; where they are not ordered, they are shuffled first."""
    if not is_ordered:
        order = np.random.default_rng([seed, 77]).permutation(len(sequence))
        sequence = replace(sequence.take(order), odometry_poses=None)
    planar = registration2d.planar_scans(sequence.points, sequence.mask, is_ordered=is_ordered)
    return Task(sequence, planar, is_ordered, steps, seed)


def incremental(task: Task, metric: Literal["point", "plane"] = "plane") -> np.ndarray:
    """Returns poses by incremental ICP."""
    return registration2d.incremental_icp(task.planar, metric).poses


def _plain(task: Task, metric: Literal["point", "plane"]) -> np.ndarray:
    """Returns poses by the paper's incremental ICP: from the identity, without a search."""
    return chain_icp(task.scans, metric)


def search(task: Task) -> np.ndarray:
    """Returns poses by global registration, from nothing but the scans: no odometry, no first guess, no refinement."""
    return registration2d.register_globally(task.planar).poses


def refined(task: Task, poses: np.ndarray) -> np.ndarray:
    """Returns the poses after the alignment of all scans together."""
    return registration2d.refine(task.planar, poses).poses


def choose(task: Task, candidates: Mapping[str, np.ndarray]) -> tuple[str, dict[str, dict[str, float]]]:
    """Returns the name of the best candidate, chosen by the scans alone, and the errors and scores of all."""
    kept, scores = registration2d.choose_trajectory(task.planar, candidates)
    return kept, {
        name: cli.planar_errors(task.sequence, candidates[name]) | score._asdict() for name, score in scores.items()
    }


def _fit(task: Task, start: np.ndarray | None, config: dm.DeepMappingConfig | None = None) -> np.ndarray:
    """Returns poses by DeepMapping from a start, or from zero poses."""
    settings = config or dm.preset("fast")
    settings = settings if task.steps is None else dm.with_steps(settings, task.steps)
    ordered = task.is_ordered
    return registration2d.fit_in_order(task.scans, settings, key=task.key, start=start, is_ordered=ordered).poses


def _refined_icp(task: Task) -> Candidates:
    return {f"{START_NAMES['icp-plane']}, refined": refined(task, incremental(task))}


def _direct_lbfgs(task: Task) -> np.ndarray:
    """Returns poses by DeepMapping's loss without L-Net, from zero poses by L-BFGS."""
    num_iterations = _LBFGS_ITERATIONS if task.steps is None else max(1, task.steps // 4)
    return optimize_directly(task.scans, dm.preset("fast"), num_iterations=num_iterations, key=task.key)


def _lnet_from_icp(task: Task) -> Candidates:
    """Returns incremental ICP, and DeepMapping from it by the phases of a cold start, L-Net's among them."""
    start, config = incremental(task), dm.preset("fast")
    fitted = _fit(task, start, replace(config, warm_phases=config.cold_phases))
    return {START_NAMES["icp-plane"]: start, DEEPMAPPING: fitted}


def _swarm_poses(task: Task) -> np.ndarray:
    """Returns poses by swarms over all poses, in the time of the fast preset or of a part of its steps."""
    config = dm.preset("fast")
    share = 1.0 if task.steps is None else task.steps / sum(phase.num_steps for phase in config.cold_phases)
    return swarm_poses(task.scans, config, cpu_s=_FIT_CPU_S * share * len(task.sequence), key=task.key)


def _direct(task: Task, *, has_windows: bool) -> np.ndarray:
    """Returns poses by DeepMapping's loss without L-Net, by Adam; windows, or the whole set in each phase.

    They start at the output of the untrained L-Nets, as in supplement B.
    """
    config = dm.as_direct(dm.preset("fast"))
    if not has_windows:
        phases = tuple(replace(phase, scans_per_window=None) for phase in config.cold_phases)
        config = replace(config, cold_phases=phases)
    return _fit(task, None, config)


def _global_deepmapping(task: Task) -> Candidates:
    """Returns global registration and DeepMapping from it: no refinement."""
    start = search(task)
    return {START_NAMES["global"]: start, DEEPMAPPING: _fit(task, start)}


def _refined_deepmapping(task: Task) -> Candidates:
    """Returns refined ICP or refined global registration, DeepMapping from it, and that refined."""
    name, start = _best_start(task)
    fitted = _fit(task, start)
    return {name: start, DEEPMAPPING: fitted, f"{DEEPMAPPING}, refined": refined(task, fitted)}


def _all_candidates(task: Task) -> Candidates:
    """Returns ICP (of ordered scans), global registration and DeepMapping from it, and each of them refined."""
    found = {START_NAMES["icp-plane"]: incremental(task)} if task.is_ordered else {}
    found |= _global_deepmapping(task)
    return found | {f"{name}, refined": refined(task, x) for name, x in found.items()}


def _best_start(task: Task) -> tuple[str, np.ndarray]:
    """Returns refined ICP if trusted; else of it and refined global registration the more strongly connected one."""

    def assessed(name: str, poses: np.ndarray) -> tuple[registration2d.Assessment, str, np.ndarray]:
        return registration2d.assess_trajectory(task.planar, poses), f"{name}, refined", poses

    starts = []
    if task.is_ordered:
        starts.append(assessed(START_NAMES["icp-plane"], refined(task, incremental(task))))
    if not starts or not starts[0][0].is_trusted:
        starts.append(assessed(START_NAMES["global"], refined(task, search(task))))
    # Between two different maps the sharper one may be wrong, so `choose` does not decide here.
    return max(starts, key=lambda start: start[0].weakest_connection)[1:]


class Method(NamedTuple):
    """A column of the comparison.

    Attributes:
        title: name in tables.
        run: makes its candidates; poses alone are one candidate under `title`.
        package: package of the extra `baselines`, which it needs.
    """

    title: str
    run: Callable[[Task], Candidates | np.ndarray]
    package: str | None = None


METHODS: dict[str, Method] = {
    "icp-point-plain": Method("plain chain of ICP, point to point", partial(_plain, metric="point")),
    "icp-plane-plain": Method("plain chain of ICP, point to line", partial(_plain, metric="plane")),
    "icp-point": Method(START_NAMES["icp-point"], partial(incremental, metric="point")),
    "icp-plane": Method(START_NAMES["icp-plane"], incremental),
    "icp-refined": Method("incremental ICP, refined", _refined_icp),
    "multiway": Method("multiway registration of Open3D", lambda task: multiway(task.scans), "open3d"),
    "swarm-poses": Method("particle swarms over all poses, in the time of L-Net", _swarm_poses, "evosax"),
    "particle-swarm": Method(
        "particle swarms, each scan onto the one before", lambda task: swarm_chain(task.scans, key=task.key), "evosax"
    ),
    "lnet-zero": Method("L-Net and M-Net from zero", lambda task: {DEEPMAPPING: _fit(task, None)}),
    "lnet-icp": Method("L-Net and M-Net from incremental ICP", _lnet_from_icp),
    "search": Method(START_NAMES["global"], search),
    "search-refined": Method("global registration, refined", lambda task: refined(task, search(task))),
    "direct-adam": Method("direct optimisation from L-Net's start, Adam", partial(_direct, has_windows=False)),
    "direct-windows": Method(
        "direct optimisation from L-Net's start in windows, Adam", partial(_direct, has_windows=True)
    ),
    "direct-lbfgs": Method("direct optimisation from zero, L-BFGS", _direct_lbfgs, "jaxopt"),
    "global-deepmapping": Method("global registration, then DeepMapping", _global_deepmapping),
    "all": Method("ICP, global registration, DeepMapping from it, and each refined", _all_candidates),
    "refined-deepmapping": Method("ICP or global registration, then DeepMapping, refined", _refined_deepmapping),
}


# Baselines of the paper that have no column, and why.
NOT_RUN = {
    "go-icp": "its packages on PyPI search the turns of 3-D clouds, which may turn a flat scan over; py-goicp does not "
    "build with today's setuptools, py-simple-go-icp-interface took 20 s for one pair of flat scans and gave up",
}
# A candidate whose ATE is larger than the least by no more than this is as good.
_AS_GOOD_PX = 0.1


@dataclass(frozen=True, kw_only=True)
class TableOptions(cli.RunOptions):
    """Options of a comparison of methods."""

    methods: tuple[str, ...] = tuple(METHODS)
    """Columns; of all of them, those whose package cannot be imported are left out and named."""
    steps: int | None = None
    """Steps of the fit; without it, the preset decides."""

    def __post_init__(self) -> None:
        """Checks names and ranges."""
        cli.check_names("--methods", self.methods, METHODS)
        cli.check_least(self, steps=2)


def run_method(name: str, task: Task) -> cli.Row:
    """Returns one row: errors, time and assessment of the kept candidate, and the numbers of every candidate."""
    method = METHODS[name]
    begun, begun_cpu = time.perf_counter(), time.process_time()
    found = method.run(task)
    candidates = found if isinstance(found, dict) else {method.title: found}
    # The choice belongs to a method that has several candidates, and to its time.
    chosen = choose(task, candidates) if len(candidates) > 1 else None
    seconds, cpu_seconds = time.perf_counter() - begun, time.process_time() - begun_cpu
    kept, measured = chosen or choose(task, candidates)
    return {
        **cli.planar_errors(task.sequence, candidates[kept]),
        "success": measured[kept]["ate_px"] < SUCCESS_PX,
        "seconds": seconds,
        "cpu_s": cpu_seconds,
        "kept": kept,
        "candidates": measured,
        **registration2d.assess_trajectory(task.planar, candidates[kept])._asdict(),
    }


def success_of_trusted(rows: list[cli.Row]) -> cli.Row:
    """Returns how many maps were trusted, and the share of these that are right."""
    trusted = [row["success"] for row in rows if row["is_trusted"]]
    return {"num_trusted": len(trusted), "success_of_trusted": float(np.mean(trusted)) if trusted else None}


def best_kept(rows: list[cli.Row]) -> cli.Row:
    """Returns how many rows have several candidates, and of how many the best one was kept, or one nearly as good."""
    regrets = [
        row["ate_px"] - min(numbers["ate_px"] for numbers in row["candidates"].values())
        for row in rows
        if len(row["candidates"]) > 1
    ]
    return {"num_choices": len(regrets), "num_best_kept": sum(regret <= _AS_GOOD_PX for regret in regrets)}


def run_methods(
    config: TableOptions,
    experiment: str,
    cells: list[cli.Row],
    prepare: Callable[[cli.Row], tuple[Task, cli.Row]],
    report: Callable[[list[cli.Row], dict[str, str]], cli.Summary],
) -> list[cli.Row]:
    """Runs every method on every cell; what an earlier run has done is read from its files.

    Args:
        config: options.
        experiment: name of the experiment.
        cells: what identifies each set of scans.
        prepare: makes the task of a cell, and what its rows carry besides the results.
        report: summarises the rows, and names the methods that were not run, with the reasons.

    Returns:
        All rows.

    Raises:
        ValueError: the package of a chosen method cannot be imported.
    """
    packages = {name: package for name in config.methods if (package := METHODS[name].package) is not None}
    unusable = {name: reason for name, package in packages.items() if (reason := cli.why_not_importable(package))}
    if unusable and set(config.methods) != set(METHODS):
        name, reason = next(iter(unusable.items()))
        raise ValueError(f"--methods {name}: {reason}")
    not_run = NOT_RUN | unusable
    # The scans are made once for all methods, and not at all where all rows exist.
    prepared = lru_cache(maxsize=1)(lambda *cell: prepare(dict(cell)))

    def work(_: cli.TableRun, method: str, **cell: Any) -> cli.Row:
        task, extra = prepared(*cell.items())
        return run_method(method, task) | extra

    cases = [{"method": method, **cell} for cell in cells for method in config.methods if method not in not_run]
    rows = cli.run_table(config, experiment, cases, work, lambda rows: report(rows, not_run))
    print(*(f"{name}: not run ({reason})" for name, reason in not_run.items()), sep="\n")
    return rows
