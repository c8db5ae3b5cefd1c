"""Calibration of odometry: its scale, noise and faults, estimated from steps that the scans alone constrain.

Most steps of a log are clear: two scans share walls in two directions, and the score has one mode. The odometry is
calibrated with these steps, and the same standard deviations hold for steps that the scans leave unconstrained. If the
beams are in reversed order, or the y axis points to the right, the turns of the scans have the opposite sign.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from dpmjax.geometry import se2
from dpmjax.scan.planar.align import COARSE, FINE, match_pairs
from dpmjax.scan.planar.motion_prior import StepPrior
from dpmjax.scan.planar.record import Booleans, Floats, Indices, PlanarScans
from dpmjax.scan.planar.slide import slide_steps
from dpmjax.slam.planar.track import match_near

# Score above which a step is clear.
_CLEAR_SCORE = 0.45
# Least number of clear steps for a calibration, and for the detection of a fault.
_LEAST_STEPS = 5
# Least translation (typical ranges) and turn (radians) from which a scale or a sign is estimated.
_LEAST_MOVE, _LEAST_TURN = 0.02, 0.08
# Floors of the standard deviations of a step: typical ranges, radians; and per unit of length moved or turned.
_FLOOR, _LENGTH_FLOOR, _TURN_FLOOR = (0.002, 0.005), 0.02, 0.02
# A step agrees with the scans within these: share of the longer move, typical ranges; of the larger turn, radians.
_MOVE_AGREEMENT, _TURN_AGREEMENT = (0.3, 0.01), (0.3, 0.03)
# Shares of the clear steps that must agree under a fault, and may agree without it.
_FAULT_SHARE, _SOUND_SHARE = 0.7, 0.4
# A scale is used within these limits, if it differs from 1 by more than this number of its standard errors.
_SCALES, _CLEAR_SCALE = (0.7, 1.4), 4.0


def _turned(poses: Floats, angle: float) -> Floats:
    return np.column_stack([poses[:, :2], se2.wrap_angle(poses[:, 2] + angle)])


def _turned_in_degrees(poses: Floats) -> Floats:
    return np.column_stack([poses[:, :2], se2.wrap_angle(np.radians(poses[:, 2]))])


MIRRORED = (
    "the scans are mirrored against the odometry: the beams are in reversed order, or one y axis points to the right"
)
# The first of equal ones counts.
_FAULTS: dict[str, Callable[[Floats], Floats]] = {
    MIRRORED: lambda poses: poses * [1.0, -1.0, -1.0],
    "the sensor looks backwards: the odometry moves against the scans": lambda poses: _turned(poses, np.pi),
    "the sensor looks to the left of the odometry's heading": lambda poses: _turned(poses, np.pi / 2),
    "the sensor looks to the right of the odometry's heading": lambda poses: _turned(poses, -np.pi / 2),
    "the headings of the odometry are degrees, not radians": _turned_in_degrees,
    "the odometry is in millimetres": lambda poses: poses * [1e-3, 1e-3, 1.0],
    "the odometry is in centimetres": lambda poses: poses * [1e-2, 1e-2, 1.0],
}


class ClearSteps(NamedTuple):
    """Steps between neighbours in time that the scans alone constrain.

    Attributes:
        rows: (m,) numbers of the steps; step i leads from scan i to scan i + 1.
        steps: (m, 3) T_scan_next.
    """

    rows: Indices
    steps: Floats


class Odometry(NamedTuple):
    """Calibrated odometry, or a calibrated given trajectory.

    Attributes:
        poses: (n, 3) T_world_scan, corrected for a fault of its axes or units.
        prior: the steps at the scale of the scans, with their standard deviations.
        fault: sentence on a wrong axis or unit; None without a fault.
    """

    poses: Floats
    prior: StepPrior
    fault: str | None = None

    @property
    def is_mirrored(self) -> bool:
        """True if the scans are mirrored against the odometry; either of them may be wrong."""
        return self.fault == MIRRORED


def calibrate_odometry(scans: PlanarScans, poses: Floats, *, is_silent: Booleans | None = None) -> Odometry:
    """Estimates scale, noise and faults of odometry from the steps that the scans alone constrain.

    Args:
        scans: n scans in time order, two at least.
        poses: (n, 3) raw x, y, heading.
        is_silent: (n - 1,) steps that the odometry does not measure; the usual motion is expected there.

    Returns:
        Odometry; with the usual deviations if few steps are clear.
    """
    unit, clear = scans.typical_range, match_clear_steps(scans, poses)
    fault = _find_fault(clear, poses, unit)
    corrected = poses if fault is None else _FAULTS[fault](poses)
    usual = StepPrior.of_poses(corrected, unit)
    prior = usual if len(clear.rows) < _LEAST_STEPS else _calibrate(clear, usual.steps, unit)
    if is_silent is None or not is_silent.any():
        return Odometry(corrected, prior, fault)
    prior = prior.without(is_silent, unit)
    return Odometry(se2.chain(prior.steps), prior, fault)


def match_clear_steps(scans: PlanarScans, odometry: Floats) -> ClearSteps:
    """Aligns each scan with the previous one, from zero motion and from the odometry under each possible fault.

    Args:
        scans: n scans in time order.
        odometry: (n, 3) raw poses.

    Returns:
        ClearSteps: steps with a high score and one mode.
    """
    source, target = scans.take(slice(1, None)), scans.take(slice(len(scans) - 1))
    ways = [odometry, *(change(odometry) for change in _FAULTS.values())]
    told = np.stack([se2.relative(poses[:-1], poses[1:]) for poses in ways], axis=1)
    # Longer steps of the odometry are not used as guesses, typical ranges.
    is_within = np.hypot(told[..., 0], told[..., 1]) < 2.0 * scans.typical_range
    rough = match_pairs(source, target, np.where(is_within[..., None], told, 0.0), COARSE).poses
    guesses = np.stack([match_near(source, target, "plane").poses, rough], axis=1)
    steps = match_pairs(source, target, guesses, FINE).poses
    slides = slide_steps(scans, steps)
    is_clear = (slides.scores > _CLEAR_SCORE) & ~slides.is_torn & ~slides.is_open
    return ClearSteps(np.flatnonzero(is_clear), steps[is_clear])


def _find_fault(clear: ClearSteps, odometry: Floats, unit: float) -> str | None:
    """Returns the fault under which the odometry agrees with the clear steps; None where it agrees without a fault."""
    share, num_told = _agreement(clear, odometry, unit)
    if num_told < _LEAST_STEPS or share > _SOUND_SHARE:
        return None
    shares = {fault: _agreement(clear, change(odometry), unit)[0] for fault, change in _FAULTS.items()}
    best = max(shares, key=lambda fault: shares[fault])
    return best if shares[best] > _FAULT_SHARE else None


def _agreement(clear: ClearSteps, odometry: Floats, unit: float) -> tuple[float, int]:
    """Returns the share of the clear steps that the odometry agrees with, and the number of these steps.

    Steps with a turn are used; if they are too few, steps with a translation.
    """
    expected = se2.relative(odometry[clear.rows], odometry[clear.rows + 1])
    moves = np.maximum(*(np.hypot(x[:, 0], x[:, 1]) for x in (expected, clear.steps)))
    turns = np.maximum(*(np.abs(x[:, 2]) for x in (expected, clear.steps)))
    limits = _MOVE_AGREEMENT[0] * moves + _MOVE_AGREEMENT[1] * unit, _TURN_AGREEMENT[0] * turns + _TURN_AGREEMENT[1]
    agrees = se2.is_within(clear.steps - expected, *limits)
    tells = turns > _LEAST_TURN
    if tells.sum() < _LEAST_STEPS:
        tells = moves > _LEAST_MOVE * unit
    return float(agrees[tells].mean()) if tells.any() else 1.0, int(tells.sum())


def _calibrate(clear: ClearSteps, expected: Floats, unit: float) -> StepPrior:
    """Estimates the scale of the odometry and its standard deviations from the clear steps."""
    told = expected[clear.rows]
    lengths, measured = np.hypot(told[:, 0], told[:, 1]), np.hypot(clear.steps[:, 0], clear.steps[:, 1])
    is_move, is_turn = lengths > _LEAST_MOVE * unit, np.abs(told[:, 2]) > _LEAST_TURN
    scale = _robust_scale(measured[is_move] / lengths[is_move])
    turn_scale = _robust_scale(clear.steps[is_turn, 2] / told[is_turn, 2])
    steps = expected * [scale, scale, turn_scale]
    off = np.abs(clear.steps - steps[clear.rows])
    off[:, 2] = np.abs(se2.wrap_angle(off[:, 2]))
    floors = np.array(_FLOOR) * [unit, 1.0]
    length, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    # Wheel slip causes errors in proportion to the distance; a turn moves a sensor that is mounted off the axis.
    size = np.hypot(length, _LEAST_MOVE * unit)
    share = max(_LENGTH_FLOOR, _spread((off[:, :2] / size[clear.rows][:, None]).ravel()))
    turn_share = max(_TURN_FLOOR, _spread(off[is_turn, 2] / turn[clear.rows][is_turn]))
    turn_noise = max(floors[1], _spread(off[~is_turn, 2]))
    moved, turned = np.hypot(floors[0], share * size), np.hypot(turn_noise, turn_share * turn)
    return StepPrior(steps, np.stack([moved, moved, turned], axis=1))


def _robust_scale(ratios: Floats) -> float:
    """Returns the median of ratios where it differs clearly from 1, else 1."""
    if len(ratios) < _LEAST_STEPS:
        return 1.0
    scale = float(np.median(ratios))
    error = _spread(np.abs(ratios - scale)) / len(ratios) ** 0.5
    is_clear = abs(scale - 1.0) > _CLEAR_SCALE * error
    return scale if is_clear and _SCALES[0] < scale < _SCALES[1] else 1.0


def _spread(off: Floats) -> float:
    """Returns the standard deviation of a normal distribution with the same median of absolute values."""
    return 1.4826 * float(np.median(off)) if len(off) >= _LEAST_STEPS else 0.0
