"""Results of a map of planar scans: errors against references of several kinds, console lines, pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dpmjax import deepmapping, metrics, registration2d, viz
from dpmjax.cli.run import Run
from dpmjax.sequences import FloatArray, ScanSequence

if TYPE_CHECKING:
    from dpmjax.types import ScanSet

# Largest number of printed spans of uncertain scans.
_NUM_SPANS = 8
# Least number of common scans of a recording and its corrected log.
_MIN_COMMON = 10


def ate_of(sequence: ScanSequence, unit: float) -> Callable[[FloatArray], float]:
    """Returns a function to the ATE of poses whose lengths are multiples of `unit`; NaN without a reference."""
    reference = sequence.reference_poses
    if reference is None:
        return lambda _: math.nan
    return lambda poses: float(metrics.absolute_trajectory_error(unit * poses[:, :2], reference[:, :2]))


def before_and_after(sequence: ScanSequence, start: FloatArray, poses: FloatArray) -> dict[str, Any]:
    """Returns errors of the kept and of the initial poses; `success` is None without a reference."""
    reference, unit = sequence.reference_poses, sequence.unit
    if reference is None:
        return {"success": None}
    after, before = metrics.planar_errors(sequence, poses), metrics.planar_errors(sequence, start)
    # The paper's threshold is 20 pixels, 2 % of its world. The threshold of a real place is 2 % of the span of its
    # trajectory.
    threshold = 20.0 if unit == "px" else 0.02 * float(np.linalg.norm(np.ptp(reference[:, :2], axis=0)))
    return {
        **after,
        **named_initial(before),
        f"success_threshold_{unit}": threshold,
        "success": after[f"ate_{unit}"] < threshold,
    }


def named_initial(numbers: Mapping[str, float]) -> dict[str, float]:
    """Returns errors under their names for the initial poses, such as ate_initial_m for ate_m; counts are left out."""
    errors = {name: value for name, value in numbers.items() if not name.startswith("num_")}
    return {"_initial_".join(name.rsplit("_", 1)): value for name, value in errors.items()}


def trust_verdict(assessment: Mapping[str, Any]) -> str:
    """Returns whether the map can be trusted, why, the fault of the odometry, and the uncertain scans."""
    trust = "can be trusted" if assessment["is_trusted"] else "DO NOT TRUST this map"
    weakest, contradiction = assessment["weakest_connection"], assessment["contradiction"]
    # Near zero the difference of two shares has either sign.
    more = f"{max(contradiction, 0.0):.1%} more beams than between the best pairs"
    text = f"{trust}: the weakest connection scores {weakest:.2f} of 1; {more} end in the free space of another scan"
    if assessment["fault"] is not None:
        text += f"; {assessment['fault']}"
    if count := len(assessment["uncertain_scans"]):
        spans = spans_of(assessment["uncertain_scans"])
        shown = ", ".join(spans[:_NUM_SPANS]) + (" ..." if len(spans) > _NUM_SPANS else "")
        text += f"; uncertain where {count} scans are, which slide along a corridor or fit no other: {shown}"
    return text


def spans_of(rows: Sequence[int]) -> list[str]:
    """Returns increasing numbers as spans, such as 3-5 and 9."""
    parts = np.split(np.asarray(rows), np.flatnonzero(np.diff(rows) > 1) + 1)
    return [f"{part[0]}-{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts if len(part)]


def report(unit: str, numbers: Mapping[str, Any]) -> str:
    """Returns errors and scores of each candidate, which one was kept, and errors against further references."""
    candidates = numbers["candidates"]
    width = max(map(len, candidates))
    has_ate = all(f"ate_{unit}" in found for found in candidates.values())
    head = f"  {'ATE, ' + unit:>10}" if has_ate else ""
    lines = [f"  {'candidate':{width}}{head}  nats a beam  beams off a surface"]
    for name, found in candidates.items():
        mark, ate = "*" if name == numbers["kept"] else " ", f"  {found[f'ate_{unit}']:10.3g}" if has_ate else ""
        lines.append(f"{mark} {name:{width}}{ate}  {found['code_length']:11.3f}  {found['misfit']:19.1%}")
    why = "chosen without the reference" if has_ate else "no reference was given"
    lines.append(f"kept: {numbers['kept']} ({why}; docs/guides/scans_2d.md explains both scores)")
    return "\n".join(lines)


def scan_set_of(sequence: ScanSequence) -> ScanSet:
    """Returns the scans without their name, unit and poses."""
    import jax.numpy as jnp

    from dpmjax.types import ScanSet

    return ScanSet(jnp.asarray(sequence.points), jnp.asarray(sequence.mask))


def draw_map(
    run: Run, registered: ScanSequence, result: registration2d.RegisteredScans, numbers: Mapping[str, Any]
) -> viz.Limits:
    """Draws map.png: the start, DeepMapping if it was trained, the kept one, the reference; returns its limits."""
    scans, unit, reference = scan_set_of(registered), registered.unit, registered.reference_poses
    poses, anchor = {}, None
    titles = dict(zip(result.candidates, numbers["candidates"], strict=True))
    shown = dict.fromkeys((result.start, registration2d.DEEPMAPPING, result.kept))
    for name in [name for name in shown if name in result.candidates]:
        title, found, is_kept = titles[name], numbers["candidates"][titles[name]], name == result.kept
        ate, distance = found.get(f"ate_{unit}"), found.get(f"point_distance_{unit}")
        title = title[0].upper() + title[1:] + (" (kept)" if is_kept else "") + "\n"
        errors = {"ATE": ate, "points": distance}.items()
        title += "   ".join(f"{name} {viz.format_length(e, unit)}" for name, e in errors if e is not None)
        poses[title], anchor = result.candidates[name].poses, title if is_kept else anchor
    if reference is not None:
        poses["Reference\n"], anchor = reference, None
    figure = viz.registered_scans_figure(scans, poses, unit, anchor=anchor)
    viz.save_figure(figure, run / "map.png")
    return viz.Limits(*figure.axes[0].get_xlim(), *figure.axes[0].get_ylim())


def draw_occupancy(
    run: Run, registered: ScanSequence, result: registration2d.RegisteredScans, limits: viz.Limits
) -> None:
    """Draws occupancy.png: the occupancy that M-Net predicts, in the frame and within the limits of map.png."""
    picture = deepmapping.map_picture(result.fitted, registered.points, registered.mask)
    kept, reference = result.candidates[result.kept].poses, registered.reference_poses
    anchor, trajectory = kept if reference is None else reference, result.fitted.poses[:, :2]
    T_view_fit = np.asarray(metrics.align_rigid(trajectory, anchor[:, :2]))
    figure = viz.occupancy_figure(picture, trajectory, registered.unit, T_view_world=T_view_fit, limits=limits)
    viz.save_figure(figure, run / "occupancy.png")
