"""DeepMapping of scans of any sensor: `fit_deepmapping`, and the choice between the fit and its initial poses.

The type of the scans chooses the sensor: a ScanSet is planar, DepthScans are depth images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple, cast

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.checks import Beams, require_type, runs_on_host
from dpmjax.deepmapping.config import DeepMappingConfig, preset
from dpmjax.deepmapping.engine import Fit, Progress, Report, fit
from dpmjax.deepmapping.problem import MappingData, Params, Problem, bind_map, make_optimizer, phases_of
from dpmjax.deepmapping.sensors import DEPTH, PLANAR, as_scan_set, positions_of, scale_start
from dpmjax.geometry import se2
from dpmjax.geometry.sampling import typical_range
from dpmjax.progress import progress_bar
from dpmjax.reading import read_path
from dpmjax.scan.depth.compare import projective_consistency
from dpmjax.scan.depth.record import DepthScans, as_depth_scans
from dpmjax.scan.depth.track import PlacedImages, initialize_depth
from dpmjax.sequences import DepthSequence
from dpmjax.types import ScanSet, with_short_repr

# A given unit of length is between the first of these shares and the second of the typical range.
_UNIT_SHARES = 0.1, 10.0
# Number of samples on a beam that mark cells as explored.
_SAMPLES = 64


@with_short_repr
class Fitted(NamedTuple):
    """Result of `fit_deepmapping`.

    Attributes:
        poses: float64, unit of the points: (n, 3) x, y, heading of planar scans, else (n, 4, 4) T_world_scan.
        params: parameters of L-Net and M-Net.
        report: report of the last call of the step.
        unit: unit of length of the parameters, in the unit of the points.
        config: settings of the fit.
        num_steps: number of steps, with those before a resumed run; with 0, the networks are untrained.
    """

    poses: NDArray[np.float64]
    params: Params
    report: Report | None
    unit: float
    config: DeepMappingConfig
    num_steps: int

    @property
    def T_world_scan(self) -> NDArray[np.float64]:
        """Poses as matrices (n, 3, 3) or (n, 4, 4); the frame of a depth image is that of the camera."""
        return self.poses if self.poses.ndim == 3 else se2.to_matrix(self.poses)


@with_short_repr
class Registered(NamedTuple):
    """Result of `register_depth`.

    Attributes:
        T_world_scan: (n, 4, 4) float64, unit of the points: the poses of the smaller misfit.
        kept: source of the poses, the fit or the initial poses ("start").
        misfit: 1 less the `projective_consistency` of the keyframes at the poses of the fit, 0 or more.
        start_misfit: the same at the initial poses.
        start: (n, 4, 4) initial poses.
        fit: (n, 4, 4) poses of the fit; images that are no keyframes follow the keyframe before them.
        keyframes: (k,) rows of the images that were fitted.
        fitted: DeepMapping of the keyframes.
        placed: the search of initial poses with its assessment; None where the poses were given.
    """

    T_world_scan: NDArray[np.float64]
    kept: Literal["fit", "start"]
    misfit: float
    start_misfit: float
    start: NDArray[np.float64]
    fit: NDArray[np.float64]
    keyframes: NDArray[np.int64]
    fitted: Fitted
    placed: PlacedImages | None = None


def mapping_data(
    scans: DepthScans | Beams, start: ArrayLike | None = None, *, unit: float | None = None
) -> tuple[MappingData, float]:
    """Checks scans and poses, and scales both to the unit of length of the fit.

    Args:
        scans: DepthScans, or planar scans as `as_scan_set` takes them.
        start: initial poses: (n, 3) x, y, heading or (n, 3, 3) matrices of planar scans, else (n, 4, 4)
            T_world_scan; None: cold start.
        unit: unit of length of the fit (`DeepMappingConfig.unit`); None: the typical range of the scans.

    Returns:
        Data of the problem, and the unit of length, in the unit of the scans.

    Raises:
        ValueError: the scans or the poses have a wrong shape or are not finite. Also if a scan has no valid beam, or
            if the unit is more than ten times smaller or larger than the typical range.
    """
    checked = scans if isinstance(scans, DepthScans) else as_scan_set(scans)
    reach = typical_range(checked.points, checked.mask)
    unit = reach if unit is None else unit
    if not _UNIT_SHARES[0] * reach <= unit <= _UNIT_SHARES[1] * reach:
        raise ValueError(
            f"unit: expected a length like the ranges of the scans, of which nine in ten are below {reach:.4g}, got "
            f"{unit:.4g}; dataclasses.replace(config, unit=None) takes the ranges as unit"
        )
    T_start = None if start is None else scale_start(start, checked, unit)
    points = jax.device_put(np.asarray(checked.points) / np.float32(unit))
    return MappingData(replace(checked, points=points), T_start), unit


def mapping_problem(config: DeepMappingConfig, data: MappingData) -> Problem:
    """Makes the optimisation problem of DeepMapping for scans.

    Args:
        config: settings of the fit.
        data: data of `mapping_data`.

    Returns:
        The problem; poses are as in `Fitted`, in units of the fit.
    """
    make = PLANAR if isinstance(data.scans, ScanSet) else DEPTH
    steps = config.steps_per_call
    return make(config, phases_of(config, data), optimizer=make_optimizer, steps_per_call=steps)


@runs_on_host("call deepmapping.solve there")
def fit_deepmapping(
    scans: DepthScans | Beams,
    config: DeepMappingConfig | None = None,
    *,
    key: jax.Array,
    start: ArrayLike | None = None,
    engine: Callable[..., Fit] | None = None,
    progress: bool = True,
) -> Fitted:
    """Registers scans by optimising L-Net and M-Net on them alone (DeepMapping eq. 6).

    Args:
        scans: planar scans (n, b, 2) in the sensor frames, any unit; all-zero or non-finite beams are left out. Or a
            ScanSet, a ScanSequence or its file, or DepthScans (section 4.2).
        config: settings; None: the fast preset of planar scans; `preset` has those of other sensors.
        key: key of the whole run.
        start: initial poses, as `mapping_data` takes them; None: cold start, of all poses at zero, or free poses at the
            output of the untrained L-Net.
        engine: training function, called as `engine(problem, data, key=key)`;
            `functools.partial(fit, on_report=..., stop=...)` reports each call of the step and can be stopped. None:
            `fit` with a bar.
        progress: False shows no bar.

    Returns:
        Fitted, poses in the unit of the points. The world is that of `start`, or arbitrary after a cold start.

    Raises:
        ValueError: as `mapping_data`.
    """
    config = config or DeepMappingConfig()
    require_type("config", config, DeepMappingConfig, "DeepMappingConfig or preset")
    data, unit = mapping_data(scans, start, unit=config.unit)
    problem = mapping_problem(config, data)
    with progress_bar("DeepMapping", is_shown=progress and engine is None) as bar:

        def show(report: Progress) -> None:
            bar.update(report.share - bar.n)

        done = (engine or partial(fit, on_report=show))(problem, data, key=key)
    poses = np.array(done.poses, np.float64)
    positions_of(poses)[...] *= unit
    return Fitted(poses, done.state.params, done.report, unit, config, int(done.state.step))


@runs_on_host("call deepmapping.solve there")
def register_depth(
    images: DepthScans | DepthSequence | ArrayLike | Path,
    config: DeepMappingConfig | None = None,
    *,
    key: jax.Array,
    start: ArrayLike | PlacedImages | None = None,
    engine: Callable[..., Fit] | None = None,
    progress: bool = True,
) -> Registered:
    """Registers depth images by a search of initial poses and DeepMapping (section 4.2), and keeps the better poses.

    DeepMapping adjusts the keyframes of the search. If you give the poses, it adjusts all images.

    Initial poses and fit are compared by `projective_consistency`, without ground truth.

    Args:
        images: (n, h, w, 3) points in the camera frames (x right, y down, z forward), DepthScans, or a
            DepthSequence or its folder. Lengths are in metres. With a start they may be in any unit.
        config: settings of the fit, and `motion` of the search; None: `preset("fast", "depth")`.
        key: key of the search and of the fit.
        start: (n, 4, 4) initial T_world_camera, or the result of `initialize_depth`, which is called for None.
        engine: engine of the fit, as in `fit_deepmapping`.
        progress: False shows no bar.

    Returns:
        Registered, in the world of the start.

    Raises:
        ValueError: as `as_depth_scans`, or `start` has a wrong shape or is not finite.
    """
    config = config or preset("fast", "depth")
    images = cast(DepthScans | DepthSequence | ArrayLike, read_path(images, "io.read_pose_folder"))
    if isinstance(images, DepthSequence):
        images = as_depth_scans(images.points, images.mask)
    scans = images if isinstance(images, DepthScans) else as_depth_scans(images)
    placed = start if isinstance(start, PlacedImages) else None
    if start is None:
        placed = initialize_depth(scans, config.motion, key=key)
    given = np.asarray(start if placed is None else placed.T_world_camera, np.float64)
    keyframes = np.arange(len(scans.mask)) if placed is None else placed.keyframes
    chosen = scans if len(keyframes) == len(scans.mask) else scans.take(keyframes)
    # Search and fit share the key, so that a fit from found poses equals a fit from the same poses, given as `start`.
    T_start = given[keyframes] if given.shape == (len(scans.mask), 4, 4) else given
    fitted = fit_deepmapping(chosen, config, key=key, start=T_start, engine=engine, progress=progress)
    poses = {"fit": fitted.T_world_scan, "start": T_start}
    misfits = {name: 1.0 - float(projective_consistency(chosen, T)) for name, T in poses.items()}
    # Images at poses that are not finite contradict nothing.
    is_better = bool(np.isfinite(poses["fit"]).all()) and misfits["fit"] < misfits["start"]
    kept: Literal["fit", "start"] = "fit" if fitted.num_steps > 0 and is_better else "start"
    row = np.searchsorted(keyframes, np.arange(len(given)), side="right") - 1
    T_fit = poses["fit"][row] @ np.linalg.inv(T_start)[row] @ given
    T_fit[keyframes] = poses["fit"]
    T_world_scan = given if kept == "start" else T_fit
    return Registered(T_world_scan, kept, misfits["fit"], misfits["start"], given, T_fit, keyframes, fitted, placed)


class MapPicture(NamedTuple):
    """A raster of the world; row 0 has the smallest y.

    Attributes:
        probability: (h, w) occupancy probability.
        explored: (h, w) True where a beam has passed or ended.
        extent: x_min, x_max, y_min, y_max in the unit of the points.
    """

    probability: NDArray[np.float32]
    explored: NDArray[np.bool_]
    extent: tuple[float, float, float, float]


def map_picture(
    fitted: Fitted, points: NDArray[np.floating], mask: NDArray[np.bool_], *, num_cells: int = 500
) -> MapPicture:
    """Evaluates M-Net on a raster over all hits, with the explored cells.

    Args:
        fitted: the fit.
        points: (n, b, 2) scans of the fit in the sensor frames, unit of the poses.
        mask: (n, b) False for invalid beams.
        num_cells: number of cells along the longer side.

    Returns:
        MapPicture in the frame of `fitted.poses`.
    """
    from scipy.ndimage import binary_closing

    poses = fitted.poses
    world = se2.transform_points(poses, points)
    hits = world[mask]
    low, high = hits.min(axis=0), hits.max(axis=0)
    margin = 0.03 * float((high - low).max())
    low, high = low - margin, high + margin
    cell = float((high - low).max()) / num_cells
    width, height = (np.ceil((high - low) / cell)).astype(int)
    explored = np.zeros((height, width), bool)
    sensors = np.broadcast_to(poses[:, None, :2], world.shape)[mask]
    for share in np.linspace(0.0, 1.0, _SAMPLES):
        column, row = ((sensors + share * (hits - sensors) - low) / cell).astype(int).T
        explored[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] = True
    x, y = low[0] + cell * (np.arange(width) + 0.5), low[1] + cell * (np.arange(height) + 0.5)
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) / fitted.unit
    occupied = jax.jit(lambda params, points: jax.nn.sigmoid(bind_map(params, fitted.config)(points)))
    probability = np.asarray(occupied(fitted.params, centres.astype(np.float32))).reshape(height, width)
    extent = (float(low[0]), float(low[0] + cell * width), float(low[1]), float(low[1] + cell * height))
    # Cells between two neighbouring beams are explored, too.
    return MapPicture(probability, binary_closing(explored, iterations=2) | explored, extent)
