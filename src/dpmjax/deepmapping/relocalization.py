"""Re-localisation of new scans in the map of a fit: L-Net proposes poses, M-Net scores them (DeepMapping figure 7).

L-Net is trained on the headings of the trajectory only. So each scan is turned in steps over the full circle, and L-Net
proposes a pose for each turn. A search around these poses minimises the cost of the scan in the map of M-Net. A high
cost means that the place is not in the map.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from dpmjax.checks import require_count, require_value, runs_on_host
from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig
from dpmjax.deepmapping.engine import solve
from dpmjax.deepmapping.map_rendering import MapRaster, make_raster, nearest_nodes, render_scans
from dpmjax.deepmapping.mapping import Fitted
from dpmjax.deepmapping.problem import MapFrame, Problem
from dpmjax.deepmapping.sensors import as_scan_set, choose_beams, localize_scans
from dpmjax.geometry import se2
from dpmjax.nets.mapping import LocalizationNet
from dpmjax.types import ScanSet, with_short_repr

# Step of the coarsest grid of poses, along x and y in units of the fit, and in radians; each level halves it.
_FIRST_STEP, _NUM_LEVELS = 0.08, 5
# Number of hypotheses that are kept after the first level, and largest number of beams that are compared.
_NUM_KEPT, _NUM_BEAMS = 6, 64
# Number of headings of each scan for L-Net, evenly spaced.
_NUM_TURNS = 24
# Positions on a beam at which the map must be free, as shares of the length.
_FREE_SHARES = (0.3, 0.6, 0.85)
# Largest cost of one hit or one free sample, nats, for robustness to people and noise.
_MAX_NATS = 3.0
# Offsets of a grid of poses in steps of the grid, the centre first, so that it is chosen among equal costs.
_OFFSETS = np.array(sorted(product(range(-2, 3), repeat=3), key=np.linalg.norm))


class MapFields(NamedTuple):
    """Costs of hits and of free samples at the nodes of a raster over the frame of the map, one raster for each level.

    Attributes:
        hit: nats of a hit.
        free: nats of a free sample.
        frame: frame of the map.
    """

    hit: Float[Array, "l r r"]
    free: Float[Array, "l r r"]
    frame: MapFrame


def map_fields(raster: MapRaster) -> MapFields:
    """Computes the costs of hits and of free samples, blurred for each level by the step of its grid.

    Args:
        raster: raster of the map.

    Returns:
        MapFields.
    """
    logits = np.asarray(raster.logits)
    # A hit on a surface lies between a free and an occupied node, so the least radius is one node.
    radii = np.maximum(0.5 * _FIRST_STEP * 0.5 ** np.arange(_NUM_LEVELS) / float(raster.spacing), 1.0)
    sizes = 2 ** (1 + np.floor(np.log2(radii + 1.0)).astype(int)) - 1
    highest = jnp.stack([maximum_filter(logits, size, mode="wrap") for size in sizes])
    lowest = jnp.stack([minimum_filter(logits, size, mode="wrap") for size in sizes])
    hit, free = jax.nn.softplus(-highest), jax.nn.softplus(lowest)
    return MapFields(jnp.minimum(hit, _MAX_NATS), jnp.minimum(free, _MAX_NATS), raster.frame)


def _nats(
    scan: ScanSet, pose: Float[Array, " 3"], hit: Float[Array, "r r"], free: Float[Array, "r r"], frame: MapFrame
) -> Array:
    """Computes the mean cost of a beam of one scan at one pose."""
    shares = jnp.asarray((1.0, *_FREE_SHARES))[:, None, None]
    world = se2.transform_points(pose, (shares * scan.points).reshape(-1, 2)).reshape(len(shares), -1, 2)
    row, inside = nearest_nodes(frame, world)
    unknown = jnp.log(2.0)
    of_hit = jnp.where(inside[0], hit.reshape(-1)[row[0]], unknown)
    of_free = jnp.where(inside[1:], free.reshape(-1)[row[1:]], unknown).mean(0)
    weight = jnp.where(scan.mask, jnp.sum(jnp.where(scan.mask[:, None], scan.points, 1.0) ** 2, axis=-1) ** 0.25, 0.0)
    return jnp.sum(weight * (of_hit + of_free)) / jnp.maximum(weight.sum(), 1e-9)


@jax.jit
def search_map(
    scans: ScanSet, proposals: Float[Array, "m p 3"], fields: MapFields
) -> tuple[Float[Array, "m 3"], Float[Array, " m"]]:
    """Searches the poses of scans around proposals, coarse to fine.

    Args:
        scans: (m, b, 2) in units of the fit.
        proposals: initial poses.
        fields: costs of hits and free samples in the map.

    Returns:
        x, y, heading of each scan, in units of the fit and radians. The mean cost of a beam in nats: cost of the hit
        plus mean cost of the free samples; log 4 where the map is unknown. Beams are weighted by the root of the
        range, because near beams end on some surface everywhere.
    """
    stride = -(-scans.mask.shape[1] // _NUM_BEAMS)
    thinned = ScanSet(scans.points[:, ::stride], scans.mask[:, ::stride])
    poses = jax.lax.map(lambda one: _search_one(one[0], one[1], fields), (thinned, proposals), batch_size=8)
    cost = partial(_nats, hit=fields.hit[-1], free=fields.free[-1], frame=fields.frame)
    return poses, jax.lax.map(lambda one: cost(*one), (scans, poses), batch_size=64)


def _search_one(scan: ScanSet, proposals: Float[Array, "p 3"], fields: MapFields) -> Float[Array, " 3"]:
    poses = proposals
    for level in range(_NUM_LEVELS):
        around = poses[:, None] + _FIRST_STEP * 0.5**level * _OFFSETS
        cost = partial(_nats, scan, hit=fields.hit[level], free=fields.free[level], frame=fields.frame)
        nats = jax.vmap(jax.vmap(cost))(around)
        # The best pose around each hypothesis, and the best of these hypotheses.
        poses = jnp.take_along_axis(around, nats.argmin(axis=1)[:, None, None], axis=1)[:, 0]
        poses = poses[jnp.argsort(nats.min(axis=1))[:_NUM_KEPT]]
    return poses[0]


@with_short_repr
class Relocalized(NamedTuple):
    """Poses of scans in the world of a fit.

    Attributes:
        pose: (3,) or (m, 3) x, y, heading in (-pi, pi], unit of the points.
        nats: () or (m,) mean cost of a beam at this pose: 0 where M-Net explains it fully, log 4 where the map is
            unknown.
        is_known: () or (m,) False where the cost is too high: the place is not in the map, or the pose is wrong.
    """

    pose: NDArray[np.float64]
    nats: NDArray[np.float64]
    is_known: NDArray[np.bool_]

    @property
    def T_world_scan(self) -> NDArray[np.float64]:
        """Poses as matrices (3, 3), or (m, 3, 3) for m scans."""
        return se2.to_matrix(self.pose)


@runs_on_host("call it outside, and pass its result in")
def relocalize(fitted: Fitted, scan: ScanSet | ArrayLike, *, max_nats: float = 0.4) -> Relocalized:
    """Estimates poses of new scans, and detects scans outside of the map (DeepMapping section 4.1, figure 7).

    The heading is arbitrary. L-Net proposes a pose for each of several turns of the scan; a search around the proposals
    finds the pose of the least cost in the map of M-Net. In the phases with free poses of the fast preset L-Net is not
    trained; `train_localization` trains it on the final poses.

    Args:
        fitted: result of `fit_deepmapping` from zero poses with one L-Net for all scans, or of `train_localization`,
            with a trained M-Net.
        scan: (b, 2) one scan, or (m, b, 2), in the sensor frame; unit and order of the beams as in the fit. Beams with
            coordinates that are not finite, or both zero, are invalid.
        max_nats: largest mean cost of a known scan.

    Returns:
        Relocalized, in the world frame of the fit.

    Raises:
        ValueError: the shape is another one, a scan has no valid beam, the fit has several L-Nets, L-Net's outputs
            correct given start poses, or `max_nats` is not positive.
    """
    require_value(max_nats > 0.0, "max_nats", "a positive number", max_nats)
    if has_windows(fitted):
        raise ValueError("fitted: each of its L-Nets knows one window of the walk; call train_localization first")
    if np.any(np.asarray(fitted.params.start) != 0.0) or not has_localization(fitted):
        raise ValueError(
            "fitted: its L-Net corrects given start poses, which a new scan has not; call train_localization first"
        )
    is_one = not isinstance(scan, ScanSet) and np.ndim(scan) == 2
    scans = as_scan_set(np.asarray(scan)[None] if is_one else scan, min_scans=1)
    scaled = ScanSet(scans.points / fitted.unit, scans.mask)
    proposals = propose_poses(fitted.params.localization, scaled, num_turns=_NUM_TURNS, fit_config=fitted.config)
    found = search_map(scaled, proposals, map_fields(make_raster(fitted)))
    poses, nats = (np.array(values, np.float64) for values in found)
    poses[:, :2] *= fitted.unit
    poses[:, 2] = se2.wrap_angle(poses[:, 2])
    result = Relocalized(poses, nats, nats <= max_nats)
    return Relocalized(*(values[0] for values in result)) if is_one else result


@partial(jax.jit, static_argnames=("num_turns", "fit_config"))
def propose_poses(
    params: Any, scans: ScanSet, *, num_turns: int, fit_config: DeepMappingConfig
) -> Float[Array, "m t 3"]:
    """Computes L-Net's poses of scans, one for each turn of the scan.

    Args:
        params: weights of L-Net.
        scans: (m, b, 2) in units of the fit.
        num_turns: number of evenly spaced turns; the first is zero.
        fit_config: settings of the fit.

    Returns:
        x, y, heading of the scans before the turn, in units of the fit and radians.
    """
    beams = choose_beams(scans.mask.shape[1], fit_config.cold_phases[0])
    turns = 2.0 * jnp.pi * jnp.arange(num_turns) / num_turns

    def propose(scan: ScanSet) -> Float[Array, "t 3"]:
        points, mask = (jnp.stack([values[beams]] * num_turns) for values in (scan.points, scan.mask))
        found = localize_scans(params, turn_scans(points, turns), mask, fit_config)
        return found - turns[:, None] * jnp.array([0.0, 0.0, 1.0])

    return jnp.asarray(jax.lax.map(propose, scans, batch_size=32))


# Learning rate of Adam at the start; a cosine schedule reduces it to a hundredth.
_LEARNING_RATE = 2e-3
# Largest random heading of a scan; `relocalize` tries all turns, so L-Net needs only a range of headings.
_MAX_TURN_DEG = 20.0
# Number of scans of a step, drawn with replacement. Number of scans rendered from the map at random free positions;
# half of each step are rendered scans, so that L-Net learns observed places off the trajectory.
_SCANS_PER_STEP, _NUM_RENDERED = 64, 4096
# Largest share of masked beams of a scan.
_LARGEST_DROP = 0.2


def has_windows(fitted: Fitted) -> bool:
    """Returns True where the fit has an L-Net for each of several windows instead of one for all scans.

    Args:
        fitted: result of `fit_deepmapping` or of `train_localization`.

    Returns:
        True if a leading axis of L-Net's weights is that of the windows.
    """
    return has_localization(fitted) and fitted.params.localization["params"]["Dense_0"]["bias"].ndim > 1


def has_localization(fitted: Fitted) -> bool:
    """Returns True where the fit has an L-Net; one of free poses from given poses has none.

    Args:
        fitted: result of `fit_deepmapping` or of `train_localization`.

    Returns:
        True if there are weights.
    """
    return bool(fitted.params.localization)


def train_localization(fitted: Fitted, scans: ScanSet | ArrayLike, *, num_steps: int = 5000, key: jax.Array) -> Fitted:
    """Trains L-Net on the poses of the fit, for `relocalize` in the same world frame.

    The labels are the poses of the fit, not ground truth. Scans are turned and partly masked. Half of them are rendered
    from the map of M-Net at positions off the trajectory.

    Args:
        fitted: any fit, also from given poses.
        scans: (n, b, 2) the scans of the fit.
        num_steps: number of steps of Adam.
        key: key of the batches.

    Returns:
        The fit with another L-Net and with zero start poses; poses and map are the same.

    Raises:
        ValueError: the number of scans is not that of the fit, or there is no step.
    """
    require_count("num_steps", num_steps)
    scans = as_scan_set(scans)
    num, num_given = len(fitted.poses), len(scans.points)
    require_value(num_given == num, "scans", f"the {num} scans of the fit", num_given)
    poses = jnp.asarray(fitted.poses / [fitted.unit, fitted.unit, 1.0], jnp.float32)
    measured = replace(scans, points=scans.points / fitted.unit)
    render_key, train_key, net_key = jax.random.split(key, 3)
    rendered, places = render_scans(make_raster(fitted), measured, _NUM_RENDERED, key=render_key)
    begin: Any = fitted.params.localization
    if has_windows(fitted):
        begin = jax.tree.map(lambda weights: weights[0], begin)
    elif not has_localization(fitted):
        begin = jax.jit(LocalizationNet(fitted.config.localization).init)(net_key, measured.points[0], measured.mask[0])
    shares = [np.full(len(some), 1.0 / len(some)) for some in (poses, places) if len(some)]
    both, labels = jax.tree.map(lambda *parts: jnp.concatenate(parts), (measured, poses), (rendered, places))
    phase = replace(fitted.config.cold_phases[0], num_steps=num_steps, num_epochs=0)
    problem = Problem(fitted.config, (phase,), _init, _optimizer, _loss, fitted.config.steps_per_call)
    state, _ = solve(problem, TrainingScans(begin, both, labels, jnp.asarray(np.concatenate(shares))), key=train_key)
    params = replace(fitted.params, localization=state.params, start=jnp.zeros_like(fitted.params.start))
    return fitted._replace(params=params)


class TrainingScans(NamedTuple):
    """Data of the problem of `train_localization`, in units of the fit.

    Attributes:
        begin: weights of L-Net before the first step.
        scans: scans of the fit, and rendered ones.
        poses: labels.
        weights: frequency with which each scan is drawn.
    """

    begin: Any
    scans: ScanSet
    poses: Float[Array, "n 3"]
    weights: Float[Array, " n"]


def _init(config: DeepMappingConfig, key: jax.Array, data: TrainingScans) -> Any:
    return data.begin


def _optimizer(config: DeepMappingConfig, phase: PhaseConfig) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(_LEARNING_RATE, phase.num_steps, 0.01))


def _loss(
    config: DeepMappingConfig, phase: PhaseConfig, params: Any, data: TrainingScans, step: Array, key: jax.Array
) -> tuple[Float[Array, ""], None]:
    """Computes the mean error of L-Net's poses for scans that are drawn, turned and partly masked."""
    row_key, first_key, turn_key, share_key, drop_key = jax.random.split(key, 5)
    num_scans, num_beams = data.scans.mask.shape
    rows = jax.random.choice(row_key, num_scans, (_SCANS_PER_STEP,), p=data.weights)
    beams = choose_beams(num_beams, phase, jax.random.randint(first_key, (), 0, num_beams))
    points, mask, poses = data.scans.points[rows][:, beams], data.scans.mask[rows][:, beams], data.poses[rows]
    limit = np.deg2rad(_MAX_TURN_DEG)
    turn = jax.random.uniform(turn_key, rows.shape, minval=-limit, maxval=limit) - poses[:, 2]
    hidden = jax.random.uniform(drop_key, mask.shape) < _LARGEST_DROP * jax.random.uniform(share_key, (len(rows), 1))
    # At least one beam of a scan remains.
    seen = jnp.where((mask & ~hidden).any(-1, keepdims=True), mask & ~hidden, mask)
    error = localize_scans(params, turn_scans(points, turn), seen, config) - poses
    return jnp.mean(jnp.abs(error[:, :2]).sum(-1) + jnp.abs(se2.wrap_angle(error[:, 2] - turn))), None


def turn_scans(points: Float[Array, "m b 2"], turns: Float[Array, " m"]) -> Float[Array, "m b 2"]:
    """Simulates scans of sensors whose headings are larger by `turns`, by turning all points back.

    Args:
        points: points in the sensor frames.
        turns: radians.

    Returns:
        Points in the frames of the turned sensors.
    """
    return se2.transform_points(jnp.zeros((len(turns), 3)).at[:, 2].set(-turns), points)
