"""Methods that register planar scans: baselines, parts of the pipeline, and their combinations.

A candidate is a set of poses under the name of its method. "DeepMapping" is the name for results of L-Net or M-Net.
A search, an ICP or a refinement has its own name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import jax
import numpy as np

from dpmjax import ScanSet, scan, slam
from dpmjax import deepmapping as dm
from dpmjax.io import ScanSequence
from dpmjax.scan import PlanarScans
from dpmjax.slam import DEEPMAPPING, START_NAMES
from experiments._baselines import chain_icp, multiway, optimize_directly, swarm_poses

Candidates = dict[str, np.ndarray]

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
    planar = scan.planar_scans(sequence.points, sequence.mask, is_ordered=is_ordered)
    return Task(sequence, planar, is_ordered, steps, seed)


def align_incrementally(task: Task, metric: Literal["point", "plane"] = "plane") -> np.ndarray:
    """Returns poses by incremental ICP."""
    return slam.incremental_icp(task.planar, metric).poses


def search(task: Task) -> np.ndarray:
    """Returns poses by global registration, from nothing but the scans: no odometry, no first guess, no refinement."""
    return slam.register_globally(task.planar)


def refine(task: Task, poses: np.ndarray) -> np.ndarray:
    """Returns the poses after the alignment of all scans together."""
    return slam.refine(task.planar, poses).poses


def fit(task: Task, start: np.ndarray | None, config: dm.DeepMappingConfig | None = None) -> np.ndarray:
    """Returns poses by DeepMapping from a start, or from zero poses."""
    settings = config or dm.preset("fast")
    settings = settings if task.steps is None else dm.with_steps(settings, task.steps)
    ordered = task.is_ordered
    return slam.fit_in_order(task.scans, settings, key=task.key, start=start, is_ordered=ordered).poses


def optimize_by_lbfgs(task: Task) -> np.ndarray:
    """Returns poses by DeepMapping's loss without L-Net, from zero poses by L-BFGS."""
    num_iterations = 150 if task.steps is None else max(1, task.steps // 4)
    return optimize_directly(task.scans, dm.preset("fast"), num_iterations=num_iterations, key=task.key)


def optimize_by_adam(task: Task, *, has_windows: bool) -> np.ndarray:
    """Returns poses by DeepMapping's loss without L-Net, by Adam; windows, or the whole set in each phase.

    They start at the output of the untrained L-Nets, as in supplement B.
    """
    config = dm.as_direct(dm.preset("fast"))
    if not has_windows:
        phases = tuple(replace(phase, scans_per_window=None) for phase in config.cold_phases)
        config = replace(config, cold_phases=phases)
    return fit(task, None, config)


def find_by_swarms(task: Task) -> np.ndarray:
    """Returns poses by swarms over all poses, in the time of the fast preset or of a part of its steps."""
    config = dm.preset("fast")
    share = 1.0 if task.steps is None else task.steps / sum(phase.num_steps for phase in config.cold_phases)
    return swarm_poses(task.scans, config, cpu_s=_FIT_CPU_S * share * len(task.sequence), key=task.key)


def fit_from_icp(task: Task) -> Candidates:
    """Returns incremental ICP, and DeepMapping from it by the phases of a cold start, L-Net's among them."""
    start, config = align_incrementally(task), dm.preset("fast")
    fitted = fit(task, start, replace(config, warm_phases=config.cold_phases))
    return {START_NAMES["icp-plane"]: start, DEEPMAPPING: fitted}


def fit_from_search(task: Task) -> Candidates:
    """Returns global registration and DeepMapping from it: no refinement."""
    start = search(task)
    return {START_NAMES["global"]: start, DEEPMAPPING: fit(task, start)}


def fit_from_refined(task: Task) -> Candidates:
    """Returns refined ICP or refined global registration, DeepMapping from it, and that refined.

    ICP is taken if it can be trusted, else of both the one of the stronger weakest connection. Between two different
    maps the sharper one may be wrong, so the code length does not decide here.
    """
    starts: list[tuple[slam.Assessment, str, np.ndarray]] = []
    for name, find in (("icp-plane", align_incrementally), ("global", search)):
        if (name == "global" or task.is_ordered) and not (starts and starts[0][0].is_trusted):
            poses = refine(task, find(task))
            assessment = slam.assess_trajectory(task.planar, poses)
            starts.append((assessment, f"{START_NAMES[name]}, refined", poses))
    _, name, start = max(starts, key=lambda one: one[0].weakest_connection)
    fitted = fit(task, start)
    return {name: start, DEEPMAPPING: fitted, f"{DEEPMAPPING}, refined": refine(task, fitted)}


def find_all_candidates(task: Task) -> Candidates:
    """Returns ICP (of ordered scans), global registration and DeepMapping from it, and each of them refined."""
    found = {START_NAMES["icp-plane"]: align_incrementally(task)} if task.is_ordered else {}
    found |= fit_from_search(task)
    return found | {f"{name}, refined": refine(task, poses) for name, poses in found.items()}


METHODS: dict[str, Callable[[Task], Candidates | np.ndarray]] = {
    # The paper's ICP: a chain of steps, each from the identity, without a search.
    "icp-point-plain": lambda task: chain_icp(task.scans, "point"),
    "icp-plane-plain": lambda task: chain_icp(task.scans, "plane"),
    "icp-point": lambda task: align_incrementally(task, "point"),
    "icp-plane": align_incrementally,
    "icp-refined": lambda task: refine(task, align_incrementally(task)),
    "multiway": lambda task: multiway(task.scans),
    "swarm-poses": find_by_swarms,
    "lnet-zero": lambda task: {DEEPMAPPING: fit(task, None)},
    "lnet-icp": fit_from_icp,
    "search": search,
    "search-refined": lambda task: refine(task, search(task)),
    "direct-adam": lambda task: optimize_by_adam(task, has_windows=False),
    "direct-windows": lambda task: optimize_by_adam(task, has_windows=True),
    "direct-lbfgs": optimize_by_lbfgs,
    "global-deepmapping": fit_from_search,
    "all": find_all_candidates,
    "refined-deepmapping": fit_from_refined,
}
# Packages of the extra `baselines` that a method needs.
PACKAGES = {"multiway": "open3d", "swarm-poses": "evosax", "direct-lbfgs": "jaxopt"}
