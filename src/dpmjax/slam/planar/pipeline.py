"""Registration of planar scans by one call: initial poses, DeepMapping, refinement, and the choice among the results.

`register_scans` joins the functions of this folder with DeepMapping; no other file of `slam` imports `deepmapping`. A
candidate is a trajectory under the name of the method that produced it: "DeepMapping" is the result of L-Net or M-Net.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, NamedTuple, get_args

import jax
import numpy as np
from numpy.typing import ArrayLike

from dpmjax.checks import Beams, as_key, require_one_of, require_positive, require_type, runs_on_host
from dpmjax.deepmapping.config import DeepMappingConfig
from dpmjax.deepmapping.engine import Fit, Progress, fit
from dpmjax.deepmapping.mapping import Fitted, fit_deepmapping
from dpmjax.deepmapping.sensors import as_scan_set
from dpmjax.geometry import se2
from dpmjax.scan.planar.motion_prior import StepPrior
from dpmjax.scan.planar.record import Booleans, Floats, Indices, PlanarScans, planar_scans
from dpmjax.slam.planar.assess import Assessment, Score, assess_trajectory, choose_trajectory
from dpmjax.slam.planar.global_registration import nearest_tour, register_globally
from dpmjax.slam.planar.odometry import Odometry, calibrate_odometry
from dpmjax.slam.planar.recordings import Recording, choose_scans, find_silent_steps, interpolate, take_scans
from dpmjax.slam.planar.refine import put_back_slid, refine
from dpmjax.slam.planar.track import incremental_icp, scan_odometry
from dpmjax.types import ScanSet, with_short_repr

StartName = Literal["auto", "odometry", "icp-plane", "icp-point", "global", "zero"]
"""Name of the initial poses; "auto": see `register_scans`."""

DEEPMAPPING = "DeepMapping"
GIVEN_POSES = "given poses"
START_NAMES: dict[str, str] = {
    "icp-plane": "incremental ICP, point to line",
    "icp-point": "incremental ICP, point to point",
    "global": "global registration",
    "odometry": "odometry",
    "zero": "zero poses",
}
"""Name of the candidate of each kind of initial poses."""

STARTS_FROM_SCANS = ("icp-plane", "icp-point", "global")
"""Starts that use the scans alone."""

Engine = Callable[..., Fit]
"""Training function, as `fit_deepmapping(engine=...)` takes it."""
EngineOf = Callable[[Indices], Engine]
"""Makes the engine of the scans of these rows, in this order."""

# Up to this many scans without odometry are all registered.
_MAX_WHOLE = 256

# Trajectories whose scans differ by less, in typical ranges and radians, have one refinement: it starts its search of
# matching beams with three times this distance.
_SAME_PLACE = 0.02


@dataclass(frozen=True)
class RegistrationConfig:
    """Settings of `register_scans`.

    Attributes:
        is_ordered: True if the scans are in time order.
        refine: True refines the initial poses and the fit, and keeps the best map.
        fit: settings of DeepMapping; presets are `dpmjax.deepmapping.preset`.
        min_distance: least distance of two registered scans of a recording, in the unit of the scans. Nearer scans are
            registered only after a turn by `min_turn`. The remaining scans follow the motion between registered ones.
            None: all are registered.
        min_turn: least turn between two registered scans nearer than `min_distance`, radians.

    Raises:
        ValueError: a limit is not positive.
    """

    is_ordered: bool = True
    refine: bool = True
    fit: DeepMappingConfig = field(default_factory=DeepMappingConfig)
    min_distance: float | None = None
    min_turn: float = 0.35

    def __post_init__(self) -> None:
        require_positive("min_distance", 1.0 if self.min_distance is None else self.min_distance)
        require_positive("min_turn", self.min_turn)


class RegistrationHooks(NamedTuple):
    """Functions that `register_scans` calls.

    Attributes:
        on_progress: called with the name of a stage and its finished share. The calls come at the beginning of a stage,
            after each call of the step of the fit, and after the parts of a refinement.
        stop: called before each optional stage and before each call of the step of the fit. If it returns True, the fit
            ends, and the best of the candidates so far is kept.
        engine: called with the rows of the scans that are fitted, in the order of the fit; returns the `engine` of
            `fit_deepmapping`, which must report progress and handle stops. None: `deepmapping.fit`.
    """

    on_progress: Callable[[str, float], None] = lambda _stage, _share: None
    stop: Callable[[], bool] = lambda: False
    engine: EngineOf | None = None


class Candidate(NamedTuple):
    """A trajectory that was compared.

    Attributes:
        poses: (k, 3) T_world_scan of the registered scans.
        score: score of the map, by the scans alone.
    """

    poses: Floats
    score: Score


@with_short_repr
class RegisteredScans(NamedTuple):
    """Result of `register_scans`.

    Attributes:
        poses: (n, 3) T_world_scan of all scans, x, y, heading, in the unit of the scans.
        kept: name of the candidate with these poses.
        start: name of the candidate at which the fit started.
        candidates: all candidates by name; with DeepMapping if it has done a step.
        assessment: assessment of the kept candidate; `uncertain_scans` are rows of all scans.
        fitted: DeepMapping of the registered scans; untrained if the fit was stopped before its first step.
        recording: all scans, and the rows of those that were registered.
    """

    poses: Floats
    kept: str
    start: str
    candidates: dict[str, Candidate]
    assessment: Assessment
    fitted: Fitted
    recording: Recording

    @property
    def T_world_scan(self) -> Floats:
        """Poses as matrices (n, 3, 3)."""
        return se2.to_matrix(self.poses)


@jax.enable_x64(False)  # float32, also where JAX has 64 bits
@runs_on_host("call icp, or deepmapping.solve, there")
def register_scans(
    scans: Beams,
    config: RegistrationConfig | None = None,
    *,
    key: jax.Array,
    start: StartName | ArrayLike = "auto",
    odometry: ArrayLike | None = None,
    hooks: RegistrationHooks | None = None,
) -> RegisteredScans:
    """Registers planar scans from initial poses by DeepMapping and refinement, and keeps the best map.

    The map is chosen and assessed by the scans alone. With the start "auto", the scans are registered without odometry,
    too, if the map from odometry cannot be trusted.

    Args:
        scans: (n, b, 2) beam end points in the sensor frames, any unit; all-zero or non-finite beams are left out. Or a
            ScanSet, a ScanSequence or its file; pass their odometry separately. An ordered scan without any beam gets a
            pose between its neighbours.
        config: settings.
        key: of the fit.
        start: initial poses, (n, 3) x, y, heading or (n, 3, 3) matrices, or a name. The name "odometry" is the given
            odometry, "zero" sets all poses to zero, and "icp-plane" and "icp-point" are incremental ICP. The name
            "global" is an exhaustive search of scan pairs, which needs no order. The name "auto" is the odometry if
            there is one. Without odometry it is "icp-plane" for ordered scans, and "global" for scans without an order.
        odometry: (n, 3) or (n, 3, 3) raw odometry of ordered scans.
        hooks: functions that are called: progress, a request to stop, the engine of the fit.

    Returns:
        RegisteredScans.

    Raises:
        ValueError: the scans, the start or the odometry have a wrong shape or are not finite, a scan has no valid
            beam, or all scans are equal. Also if there is no odometry to start from, or if the start needs an order
            that the scans do not have.
    """
    config, hooks, key = config or RegistrationConfig(), hooks or RegistrationHooks(), as_key("key", key)
    require_type("config", config, RegistrationConfig, "RegistrationConfig")
    all_scans = as_scan_set(scans, may_be_blind=config.is_ordered)
    count = len(all_scans.points)
    odometry_poses = None if odometry is None else se2.as_poses("odometry", odometry, count)
    kind, given = _checked_start(start, odometry_poses, count, config)
    is_silent = None if odometry_poses is None else find_silent_steps(all_scans, odometry_poses)
    recording = _choose_scans(all_scans, odometry_poses, is_silent, kind, config, hooks)
    lines = planar_scans(take_scans(all_scans, recording.chosen), is_ordered=config.is_ordered)
    evidence = None
    # Initial poses from the scans alone, or zero, are no evidence.
    if given is not None and len(lines) > 1 and config.is_ordered:
        hooks.on_progress("calibration of the odometry", 0.0)
        measured = given if odometry_poses is None else odometry_poses
        is_unknown = None if is_silent is None else np.logical_or.reduceat(is_silent, recording.chosen[:-1])
        evidence = calibrate_odometry(lines, measured[recording.chosen], is_silent=is_unknown)
    run = _Run(lines, recording, evidence, config, hooks)
    start_name, poses = _start_poses(run, kind, given)
    fitted = _fit(run, None if start_name == START_NAMES["zero"] else poses, key=key)
    found = {start_name: poses}
    if fitted.num_steps > 0:
        found[DEEPMAPPING] = fitted.poses
    if config.refine and not hooks.stop():
        found |= _refined_candidates(run, found)
    hooks.on_progress("choice and assessment", 0.0)
    kept, scores, assessment = _choose_mended(run, found)
    is_doubtful = evidence is not None and not evidence.is_mirrored and not assessment.is_trusted
    if is_doubtful and isinstance(start, str) and start == "auto" and config.refine and not hooks.stop():
        report = partial(hooks.on_progress, "the map from odometry cannot be trusted: registration without it")
        report(0.0)
        name, poses = START_NAMES["icp-plane"], incremental_icp(lines).poses
        found |= {name: poses, f"{name}, refined": refine(lines, poses, on_progress=report).poses}
        kept, scores, assessment = _choose(run, found)
    if recording.motion is not None:
        hooks.on_progress("poses between the registered scans", 0.0)
    poses, lost = recording.aligned(found[kept])
    candidates = {name: Candidate(found[name], score) for name, score in scores.items()}
    uncertain = np.union1d(recording.chosen[list(assessment.uncertain_scans)], lost).astype(int).tolist()
    is_trusted = assessment.is_trusted and not len(lost)
    assessment = assessment._replace(uncertain_scans=tuple(uncertain), is_trusted=is_trusted)
    return RegisteredScans(poses, kept, start_name, candidates, assessment, fitted, recording)


class _Run(NamedTuple):
    """A registration after the choice of the scans, the input of its stages.

    Attributes:
        lines: the registered scans.
        recording: all scans.
        evidence: calibrated odometry or given poses; None for initial poses from the scans alone.
        config: settings.
        hooks: functions that are called.
    """

    lines: PlanarScans
    recording: Recording
    evidence: Odometry | None
    config: RegistrationConfig
    hooks: RegistrationHooks

    @property
    def prior(self) -> StepPrior | None:
        """Prior of the steps by the evidence."""
        return None if self.evidence is None else self.evidence.prior


def _choose(run: _Run, candidates: dict[str, Floats]) -> tuple[str, dict[str, Score], Assessment]:
    """Returns the name of the best candidate, the scores of all, and the assessment of the best."""
    fault = None if run.evidence is None else run.evidence.fault
    kept, scores = choose_trajectory(run.lines, candidates, prior=run.prior)
    # Units are corrected; in a mirrored log either the scans or the odometry may be wrong.
    fatal = fault if run.evidence is not None and run.evidence.is_mirrored else None
    assessment = assess_trajectory(run.lines, candidates[kept], prior=run.prior, fault=fatal)
    return kept, scores, assessment._replace(fault=fault)


def _choose_mended(run: _Run, candidates: dict[str, Floats]) -> tuple[str, dict[str, Score], Assessment]:
    """Chooses as `_choose`; without odometry, the best one with its slid steps put back is kept, if it is better."""
    kept, scores, assessment = _choose(run, candidates)
    is_mended = run.evidence is None and run.config.is_ordered and run.config.refine and len(run.lines) > 2
    restored = put_back_slid(run.lines, candidates[kept]) if is_mended and not run.hooks.stop() else None
    if restored is None:
        return kept, scores, assessment
    kept = f"{kept}, slid steps put back"
    candidates[kept] = restored
    _, own, assessment = _choose(run, {kept: restored})
    return kept, scores | own, assessment


def _checked_start(
    start: StartName | ArrayLike, odometry: Floats | None, count: int, config: RegistrationConfig
) -> tuple[str, Floats | None]:
    """Returns the name of the initial poses with "auto" resolved, and the given poses or odometry."""
    if not config.is_ordered and odometry is not None:
        raise ValueError("odometry: expected None, because the scans are not ordered")
    if not isinstance(start, str):
        return GIVEN_POSES, se2.as_poses("start", start, count)
    require_one_of("start", start, get_args(StartName))
    if start == "auto":
        by_order = "icp-plane" if odometry is None else "odometry"
        start = by_order if config.is_ordered else "global"
    if start == "odometry" and odometry is None:
        raise ValueError("start: expected a start without odometry, because there is none, got 'odometry'")
    if start != "global" and not config.is_ordered:
        raise ValueError(f"start: expected 'global' or poses, because the scans are not ordered, got {start!r}")
    return start, odometry if start == "odometry" else None


def _choose_scans(
    scans: ScanSet,
    odometry: Floats | None,
    is_silent: Booleans | None,
    start: str,
    config: RegistrationConfig,
    hooks: RegistrationHooks,
) -> Recording:
    """Chooses the registered scans by the odometry, or by scan odometry for initial poses from the scans alone."""
    motion = None if start in STARTS_FROM_SCANS else odometry
    if not config.is_ordered:
        return Recording(scans, np.arange(len(scans.points)), None, np.arange(len(scans.points)))
    if config.min_distance is None:
        return choose_scans(scans, None, 1.0, 1.0)
    if motion is None and len(scans.points) > _MAX_WHOLE:
        hooks.on_progress("odometry from the scans", 0.0)
        seen = np.flatnonzero(np.asarray(scans.mask).any(axis=1))
        motion = interpolate(len(scans.points), seen, scan_odometry(planar_scans(take_scans(scans, seen))))
    return choose_scans(scans, motion, config.min_distance, config.min_turn, is_silent)


def _start_poses(run: _Run, start: str, given: Floats | None) -> tuple[str, Floats]:
    """Returns the name and the values of the initial poses of the registered scans."""
    if start == GIVEN_POSES and given is not None:
        return GIVEN_POSES, given[run.recording.chosen]
    name = START_NAMES[start]
    run.hooks.on_progress(f"start: {name}", 0.0)
    match start:
        case "global":
            return name, register_globally(run.lines)
        case "icp-plane" | "icp-point":
            return name, incremental_icp(run.lines, "plane" if start == "icp-plane" else "point").poses
    # Zero poses, and one scan alone, have no odometry.
    return name, np.zeros((len(run.lines), 3)) if run.evidence is None else run.evidence.poses


def fit_in_order(
    scans: ScanSet,
    config: DeepMappingConfig,
    *,
    key: jax.Array,
    start: Floats | None,
    is_ordered: bool,
    engine_of: EngineOf = lambda _order: fit,
) -> Fitted:
    """Fits scans by DeepMapping in an order with near neighbours: time order, or a tour of the initial poses.

    Args:
        scans: the scans.
        config: settings of the fit.
        key: of the fit.
        start: (n, 3) initial x, y, heading; None: cold start, in the given order.
        is_ordered: True if the scans are in time order.
        engine_of: called with the order (rows of the scans); returns the `engine` of `fit_deepmapping`.

    Returns:
        The fit, its poses in the order of the scans.

    Raises:
        ValueError: as `fit_deepmapping`.
    """
    order = np.arange(len(scans.points)) if is_ordered or start is None else nearest_tour(start)
    first_poses = None if start is None else start[order]
    fitted = fit_deepmapping(take_scans(scans, order), config, key=key, start=first_poses, engine=engine_of(order))
    return fitted._replace(poses=fitted.poses[np.argsort(order)])


def _fit(run: _Run, start: Floats | None, *, key: jax.Array) -> Fitted:
    """Fits the registered scans by the engine of the hooks, or by one that reports to them."""
    hooks, config, chosen = run.hooks, run.config, run.recording.chosen
    hooks.on_progress(DEEPMAPPING, 0.0)

    def report(progress: Progress) -> None:
        hooks.on_progress(DEEPMAPPING, progress.share)

    def engine_of(order: Indices) -> Engine:
        if hooks.engine is not None:
            return hooks.engine(chosen[order])
        return partial(fit, on_report=report, stop=hooks.stop)

    scans = take_scans(run.recording.scans, chosen)
    return fit_in_order(scans, config.fit, key=key, start=start, is_ordered=config.is_ordered, engine_of=engine_of)


def _are_near(lines: PlanarScans, poses: Floats, others: Floats) -> bool:
    """Returns True where each scan lies at the same place in both trajectories, relative to the first scan."""
    apart = se2.relative(poses[0], poses) - se2.relative(others[0], others)
    return bool(se2.is_within(apart, _SAME_PLACE * lines.typical_range, _SAME_PLACE).all())


def _refined_candidates(run: _Run, candidates: dict[str, Floats]) -> dict[str, Floats]:
    """Returns the refined initial poses and fits, without fits whose map is worse than that of the initial poses.

    From good initial poses the fit gives the sharper map. The initial poses keep the motion that odometry has measured.
    A fit that lies where the refined initial poses lie is not refined: the result would be the same.
    """
    (start, start_poses), *fits = candidates.items()
    found: dict[str, Floats] = {}

    def add_refined(name: str, poses: Floats) -> None:
        report = partial(run.hooks.on_progress, f"{name}, refined")
        report(0.0)
        found[f"{name}, refined"] = refine(run.lines, poses, prior=run.prior, on_progress=report).poses

    if start != START_NAMES["zero"]:
        add_refined(start, start_poses)
    for name, poses in fits:
        if any(_are_near(run.lines, poses, refined) for refined in found.values()):
            continue  # its refinement would end at the same map
        scores = choose_trajectory(run.lines, {name: poses, **found}, prior=run.prior)[1]
        nats = [score.code_length for score in scores.values()]
        # A fit is not refined if its map has a code length above this multiple of that of the refined initial poses.
        if nats[0] <= 1.15 * nats[-1]:
            add_refined(name, poses)
    return found
