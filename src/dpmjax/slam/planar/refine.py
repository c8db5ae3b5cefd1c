"""Refinement of a trajectory: loop closure at steps that fit badly, then the joint alignment of all scans.

If there is range noise, the scans are then adjusted to common lines (`lines.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dpmjax.checks import as_beams, runs_on_host
from dpmjax.geometry import se2
from dpmjax.scan.planar.align import FINE, match_pairs
from dpmjax.scan.planar.compare import pair_scores
from dpmjax.scan.planar.motion_prior import StepPrior
from dpmjax.scan.planar.record import Floats, PlanarScans, planar_scans
from dpmjax.scan.planar.slide import matched_steps, settle_steps, slid_steps
from dpmjax.slam.planar.assess import choose_trajectory, map_code_length
from dpmjax.slam.planar.joint import align_all, restore_open, restore_slid, restore_torn
from dpmjax.slam.planar.lines import adjust_to_lines
from dpmjax.slam.planar.loops import correct_by_loops
from dpmjax.slam.planar.recordings import distinct_rows, interpolate
from dpmjax.slam.planar.track import incremental_icp
from dpmjax.types import ScanSet, with_short_repr

# No loops are searched if all steps of the initial poses have a fitness above the first value and a weakest eigenvalue,
# as a share of the beams, above the second one.
_MIN_FITNESS, _MIN_EIGENVALUE = 0.35, 0.005
# Slid steps are put back where the code length of the map falls by more than this share.
_LEAST_GAIN = 0.005
# Shares of a refinement that are usually done after the steps, the loops and the joint alignment.
_STEPS_SHARE, _LOOPS_SHARE, _ALIGNED_SHARE = 0.1, 0.4, 0.9


@with_short_repr
class Refined(NamedTuple):
    """Result of `refine`.

    Attributes:
        poses: (n, 3) x, y, heading.
    """

    poses: Floats

    @property
    def T_world_scan(self) -> Floats:
        """Poses as matrices (n, 3, 3)."""
        return se2.to_matrix(self.poses)


@runs_on_host("call icp there")
def refine(
    scans: PlanarScans | ScanSet | ArrayLike,
    poses: ArrayLike,
    *,
    prior: StepPrior | None = None,
    on_progress: Callable[[float], None] = lambda _share: None,
) -> Refined:
    """Refines a trajectory by loop closure, joint alignment of all scans, and adjustment to common lines.

    Loops are searched only if steps of the initial poses fit badly. The search starts from a chain of re-aligned steps.
    The initial poses are also aligned without loops, and the better map is kept. For scans without an order, only
    neighbours in space are aligned, and no loops are searched. The adjustment to lines needs range noise.

    Args:
        scans: (n, b, 2) beam end points in the sensor frames, any unit, in the order of time; all-zero or non-finite
            beams are left out. Or a ScanSet. Or PlanarScans: scans without an order are
            `planar_scans(scans, is_ordered=False)`.
        poses: initial poses, (n, 3) x, y, heading or (n, 3, 3) matrices, in the unit of the scans.
        prior: prior of the steps of ordered scans; None: the steps of the initial poses, with the usual deviations.
        on_progress: called with the finished share of the refinement.

    Returns:
        Refined; the first pose is the initial one, unless loops are kept.

    Raises:
        ValueError: the scans or the poses have a wrong shape or are not finite.
    """
    scans = scans if isinstance(scans, PlanarScans) else planar_scans(as_beams("scans", scans))
    start = se2.as_poses("poses", poses, len(scans))
    candidates = {"start": start}
    fitting_steps = np.asarray(se2.relative(start[:-1], start[1:]))
    prior = (prior or StepPrior.of_poses(start, scans.typical_range)) if scans.is_ordered else None
    if prior is not None and not _is_sound(scans, start):
        rows = distinct_rows(scans)
        if len(rows) < len(scans):
            some = replace(scans.take(rows), is_ordered=True)
            fitting = refine(some, start[rows], prior=prior.through(rows), on_progress=on_progress)
            whole = interpolate(len(scans), rows, fitting.poses)
            return Refined(_put_back(scans, fitting_steps, whole, prior))
        # Steps re-aligned from the initial ones; the calibrated prior decides along unconstrained directions alone.
        steps = incremental_icp(scans, odometry=start, prior=prior.loosened(scans.typical_range)).steps
        on_progress(_STEPS_SHARE)
        settled, slides = settle_steps(scans, steps, prior)
        edges = matched_steps(settled, slides)
        candidates["loops"] = correct_by_loops(scans, se2.chain(settled.poses), edges).poses
        fitting_steps = _better_steps(scans, fitting_steps, settled.poses)
    aligned: dict[str, Floats] = {}
    for name, candidate in candidates.items():
        on_progress(_LOOPS_SHARE + (_ALIGNED_SHARE - _LOOPS_SHARE) * len(aligned) / len(candidates))
        aligned[name] = _align(scans, candidate, fitting_steps, prior)
    on_progress(_ALIGNED_SHARE)
    kept = "start" if len(aligned) == 1 else choose_trajectory(scans, aligned, prior=prior)[0]
    best = aligned[kept]
    # Scans are adjusted to common lines above this range noise, in typical ranges.
    if scans.noise > 1.5e-4 * scans.typical_range:
        adjusted = adjust_to_lines(scans, best)
        best = adjusted if prior is None else restore_open(scans, best, adjusted, prior)
        best = best if prior is None else _put_back(scans, fitting_steps, best, prior)
    return Refined(best)


def _align(scans: PlanarScans, poses: Floats, steps: Floats, prior: StepPrior | None) -> Floats:
    """Aligns all scans, restores torn steps and aligns again, as long as the code length does not grow."""
    best = align_all(scans, poses, prior)
    if prior is None:
        return best
    # Largest number of repetitions of the alignment after torn steps are restored.
    for _ in range(2):
        restored = restore_torn(scans, steps, best, prior)
        if restored is None:
            break
        again = align_all(scans, restored, prior)
        if map_code_length(scans, again) > map_code_length(scans, best):
            break
        best = again
    return best


def _put_back(scans: PlanarScans, steps: Floats, poses: Floats, prior: StepPrior) -> Floats:
    """Restores torn steps, unless the code length of the map grows."""
    restored = restore_torn(scans, steps, poses, prior)
    if restored is None or map_code_length(scans, restored) > map_code_length(scans, poses):
        return poses
    return restored


def put_back_slid(scans: PlanarScans, poses: Floats) -> Floats | None:
    """Moves steps back that have slid along passages, for scans without odometry.

    Args:
        scans: n scans in time order.
        poses: (n, 3) T_world_scan.

    Returns:
        (n, 3) poses; None if no step has slid, or if the map does not become clearly better.
    """
    slides = slid_steps(scans, poses)
    if not slides.is_torn.any():
        return None
    restored = restore_slid(scans, poses, slides)
    is_better = map_code_length(scans, restored) < (1.0 - _LEAST_GAIN) * map_code_length(scans, poses)
    return restored if is_better else None


def _better_steps(scans: PlanarScans, steps: Floats, others: Floats) -> Floats:
    """Returns, for each of n - 1 steps, the one of two relative poses with the higher score."""
    later = np.arange(1, len(steps) + 1)
    scores = [pair_scores(scans, later, later - 1, found) for found in (steps, others)]
    return np.where((scores[1] > scores[0])[:, None], others, steps)


def _is_sound(scans: PlanarScans, poses: Floats) -> bool:
    """Returns True if all steps fit and are constrained in every direction, so that their chain has little drift."""
    guesses = se2.relative(poses[:-1], poses[1:])[:, None]
    steps = match_pairs(scans.take(slice(1, None)), scans.take(slice(len(poses) - 1)), guesses, FINE)
    share = steps.weakest_eigenvalue() / scans.num_on_line[1:]
    return bool((steps.fitness > _MIN_FITNESS).all() and (share > _MIN_EIGENVALUE).all())
