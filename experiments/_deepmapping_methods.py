"""The methods that the suite and the limits compare: each from scans to poses, none of them sees the truth."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dpmjax.registration import Assessment, PlanarScans
    from dpmjax.sequences import ScanSequence
    from dpmjax.types import ScanSet

Floats = NDArray[np.float64]

SUCCESS_PX = 20.0
"""ATE below which the paper calls a run a success (section 4.1)."""

NOT_RUN = {
    "go-icp": "its packages on PyPI search the turns of 3-D clouds, which may turn a flat scan over; py-goicp does not "
    "build with today's setuptools, py-simple-go-icp-interface took 20 s for one pair of flat scans and gave up",
}
"""Baselines of the paper that have no column, and why."""

EXTRAS = {"pso": "evosax", "multiway": "open3d"}
"""Methods that need a package of the extra `baselines`."""


@dataclass(frozen=True)
class Problem:
    """What a method is given.

    Attributes:
        sequence: the scans; methods do not look at its reference.
        planar: the same with lines.
        is_ordered: the scans lie in the order of time.
        steps: of Adam, for what optimises.
        seed: of everything random.
    """

    sequence: ScanSequence
    planar: PlanarScans
    is_ordered: bool
    steps: int
    seed: int

    @property
    def scans(self) -> ScanSet:
        """The scans without their names and truth."""
        from dpmjax.types import ScanSet

        return ScanSet(self.sequence.points, self.sequence.mask)


def split_by_extras(methods: tuple[str, ...]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Methods that can run here; and why the others cannot."""
    missing = {
        name: f"needs {EXTRAS[name]}: pip install dpmjax[baselines]"
        for name in methods
        if name in EXTRAS and importlib.util.find_spec(EXTRAS[name]) is None
    }
    return tuple(name for name in methods if name not in missing), missing


def make_problem(sequence: ScanSequence, *, is_ordered: bool, steps: int, seed: int) -> Problem:
    """The scans as methods want them; without an order they are shuffled."""
    from dpmjax.registration import planar_scans

    if not is_ordered:
        order = np.random.default_rng([seed, 77]).permutation(len(sequence))
        sequence = replace(sequence.take(order), odometry_poses=None)
    planar = planar_scans(sequence.points, sequence.mask, is_ordered=is_ordered)
    return Problem(sequence, planar, is_ordered, steps, seed)


def icp_point(problem: Problem) -> Floats:
    """Incremental ICP, point to point."""
    return _incremental(problem, "point")


def icp_plane(problem: Problem) -> Floats:
    """Incremental ICP, point to line."""
    return _incremental(problem, "plane")


def multiview(problem: Problem) -> Floats:
    """Incremental ICP, loops, and all scans aligned together."""
    from dpmjax.registration import refine

    return refine(problem.planar, icp_plane(problem)).poses


def multiway(problem: Problem) -> Floats:
    """Open3D's multiway registration."""
    from experiments.baselines.multiway import multiway

    return multiway(problem.scans)


def pso(problem: Problem) -> Floats:
    """Each scan onto the one before by particle swarms."""
    import jax

    from experiments.baselines.swarm import swarm_chain

    return swarm_chain(problem.scans, key=jax.random.key(problem.seed))


def direct_adam(problem: Problem) -> Floats:
    """The same loss without L-Net, poses from zero, by Adam."""
    from dpmjax.deepmapping import preset

    config = preset("fast")
    return _fit(problem, None, replace(config, cold_phases=config.warm_phases))


def direct_lbfgs(problem: Problem) -> Floats:
    """The same loss without L-Net, poses from zero, by L-BFGS."""
    import jax

    from dpmjax.deepmapping import preset
    from experiments.baselines.direct import optimize_directly

    key = jax.random.key(problem.seed)
    return optimize_directly(problem.scans, preset("fast"), num_iterations=max(1, problem.steps // 4), key=key)


def cold(problem: Problem) -> Floats:
    """DeepMapping from the global search of scan pairs: no ICP, no polish; the better map of search and fit."""
    from dpmjax.registration import choose_trajectory

    start = _global(problem)
    candidates = {"start": start, "fit": _fit_in_order(problem, start)}
    return candidates[choose_trajectory(problem.planar, candidates)[0]]


def warm(problem: Problem) -> Floats:
    """DeepMapping from ICP, or from the global search where that holds better; the sharpest result is kept."""
    from dpmjax.registration import choose_trajectory, refine

    best = _best_start(problem)
    fitted = _fit_in_order(problem, best)
    polished = refine(problem.planar.replace(is_ordered=False), fitted).poses
    candidates = {"start": best, "fit": fitted, "polished fit": polished}
    return candidates[choose_trajectory(problem.planar, candidates)[0]]


def _best_start(problem: Problem) -> Floats:
    """ICP if it can be trusted; else the one of ICP and search whose weakest connection is the stronger."""
    from dpmjax.registration import assess_trajectory, refine

    starts: list[tuple[Assessment, Floats]] = []

    def add(poses: Floats) -> None:
        starts.append((assess_trajectory(problem.planar, poses), poses))

    if problem.is_ordered:
        add(refine(problem.planar, icp_plane(problem)).poses)
    if not starts or not starts[0][0].is_trusted:
        add(refine(problem.planar.replace(is_ordered=False), _global(problem)).poses)
    # Other than between fits of one map, the sharper of two maps may be the wrong one.
    return max(starts, key=lambda start: start[0].weakest_connection)[1]


METHODS: dict[str, Callable[[Problem], Floats]] = {
    "icp-point": icp_point,
    "icp-plane": icp_plane,
    "multiview": multiview,
    "multiway": multiway,
    "pso": pso,
    "direct-adam": direct_adam,
    "direct-lbfgs": direct_lbfgs,
    "deepmapping-cold": cold,
    "deepmapping-warm": warm,
}


def run_method(name: str, problem: Problem) -> dict[str, Any]:
    """Errors, time and confidence of one method on one problem."""
    from dpmjax.geometry import se2
    from dpmjax.metrics import absolute_trajectory_error, point_distance
    from dpmjax.registration import assess_trajectory

    sequence = problem.sequence
    reference = sequence.reference_poses
    assert reference is not None
    begun, begun_cpu = time.perf_counter(), time.process_time()
    poses = METHODS[name](problem)
    seconds, cpu_seconds = time.perf_counter() - begun, time.process_time() - begun_cpu
    ate = absolute_trajectory_error(poses[:, :2], reference[:, :2])
    distance = point_distance(sequence.points, sequence.mask, se2.to_matrix(poses), se2.to_matrix(reference))
    assessment = assess_trajectory(problem.planar, poses)
    return {
        "ate_px": ate,
        "point_distance_px": distance,
        "success": ate < SUCCESS_PX,
        "seconds": seconds,
        "cpu_s": cpu_seconds,
        **assessment._asdict(),
    }


def _incremental(problem: Problem, metric: Literal["point", "plane"]) -> Floats:
    from dpmjax.registration import IncrementalConfig, incremental_icp

    return incremental_icp(problem.planar, IncrementalConfig(metric=metric)).poses


def _global(problem: Problem) -> Floats:
    from dpmjax.registration import register_globally

    return register_globally(problem.planar).poses


def _fit(problem: Problem, start: Floats | None, config: Any) -> Floats:
    import jax

    from dpmjax.deepmapping import fit_deepmapping, with_steps

    settings = with_steps(config, problem.steps)
    return fit_deepmapping(problem.scans, settings, key=jax.random.key(problem.seed), init=start).poses


def _fit_in_order(problem: Problem, start: Floats) -> Floats:
    """The fit of scans in an order in which neighbours are near each other: that of time, or a tour of the start."""
    from dpmjax.deepmapping import preset
    from dpmjax.registration import nearest_tour

    if problem.is_ordered:
        return _fit(problem, start, preset("fast"))
    tour = nearest_tour(start)
    ordered = replace(problem, sequence=problem.sequence.take(tour))
    poses = np.empty_like(start)
    poses[tour] = _fit(ordered, start[tour], preset("fast"))
    return poses
