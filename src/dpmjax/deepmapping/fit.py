"""Training as registration: `init` a state, `step` it through a phase, go to the next; `fit_deepmapping` does it all.

The state is one pytree of arrays, so that a run can be written to disk after any call and go on exactly.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike, NDArray

from dpmjax.deepmapping.config import DeepMappingConfig, PhaseConfig
from dpmjax.deepmapping.objective import Batch, MapLogits, Terms, registration_loss, to_world
from dpmjax.deepmapping.stepping import MapFrame, Params, bind_map, level_weights, make_optimizer, steps_per_call
from dpmjax.geometry import se2
from dpmjax.nets.localization import LocalizationNet
from dpmjax.nets.occupancy import init_map_net
from dpmjax.types import ScanSet

# Scans that are drawn together where a set is too large for one step.
_BLOCK = 32


@flax.struct.dataclass
class State:
    """Everything that a fit needs to go on.

    Attributes:
        params: networks and poses.
        optimizer: Adam's moments.
        start_poses: (n, 3) poses that L-Net's outputs are relative to.
        frame: of the map.
        phase: index of the phase.
        phase_step: steps done in it.
        step: steps done in all.
    """

    params: Params
    optimizer: Any
    start_poses: Float[Array, "n 3"]
    frame: MapFrame
    phase: Int[Array, ""]
    phase_step: Int[Array, ""]
    step: Int[Array, ""]


class Report(NamedTuple):
    """What one call of `step` says.

    Attributes:
        loss: mean over the steps of the call.
        terms: its parts before weighting, likewise.
        poses: (n, 3) poses after the call, in reaches and radians.
    """

    loss: Float[Array, ""]
    terms: Terms
    poses: Float[Array, "n 3"]


class Fitted(NamedTuple):
    """Result of `fit_deepmapping`.

    Attributes:
        T_world_scan: (n, 3, 3) float64.
        poses: the same as (n, 3) x, y, heading.
        params: of L-Net and M-Net.
        report: of the last step.
        state: to continue or to draw the map from.
        reach: the length that the state counts in, unit of the points.
        config: settings of the fit.
    """

    T_world_scan: NDArray[np.float64]
    poses: NDArray[np.float64]
    params: Params
    report: Report
    state: State
    reach: float
    config: DeepMappingConfig


def as_scan_set(scans: ScanSet | ArrayLike) -> ScanSet:
    """Scans from an array (n, b, 2); beams with coordinates that are not finite, or both zero, measured nothing.

    Raises:
        ValueError: the shape is not (n, b, 2), there are fewer than two scans, a scan has no valid beam, or what the
            mask of a ScanSet calls valid is not finite.
    """
    if not isinstance(scans, ScanSet):
        points = np.asarray(scans, np.float32)
        if points.ndim != 3 or points.shape[-1] != 2:
            raise ValueError(f"scans: expected shape (n, b, 2), got {points.shape}")
        mask = np.isfinite(points).all(-1) & (np.abs(points).sum(-1) > 0)
        scans = ScanSet(points=jnp.asarray(np.where(mask[..., None], points, 0.0)), mask=jnp.asarray(mask))
    if scans.points.shape[0] < 2:
        raise ValueError(f"scans: expected at least 2, got {scans.points.shape[0]}")
    empty = np.flatnonzero(~np.asarray(scans.mask).any(-1))
    if len(empty):
        raise ValueError(f"scans: scan {empty[0]} has no valid beam; leave it out ({len(empty)} such scans)")
    mask = jnp.asarray(scans.mask, bool)
    clean = jnp.where(mask[..., None], jnp.asarray(scans.points, jnp.float32), 0.0)
    if not bool(jnp.isfinite(clean).all()):
        raise ValueError("scans: expected finite coordinates where the mask is True")
    return ScanSet(points=clean, mask=mask)


def measure_reach(scans: ScanSet) -> float:
    """The unit of length of the fit: the range that nine beams in ten stay below, median over the scans."""
    ranges = np.linalg.norm(np.asarray(scans.points), axis=-1)
    return float(np.median([np.percentile(r[m], 90) for r, m in zip(ranges, np.asarray(scans.mask), strict=True)]))


def _choose_frame(scans: ScanSet, poses: Float[Array, "n 3"], config: DeepMappingConfig) -> MapFrame:
    """The square that the scans cover at these poses, with a margin."""
    if config.occupancy.kind == "mlp":
        return MapFrame(centre=jnp.zeros(2), half_side=jnp.ones(()))
    world = to_world(poses, scans.points)
    low = jnp.min(jnp.where(scans.mask[..., None], world, jnp.inf), axis=(0, 1))
    high = jnp.max(jnp.where(scans.mask[..., None], world, -jnp.inf), axis=(0, 1))
    return MapFrame(centre=0.5 * (low + high), half_side=0.5 * config.map_margin * jnp.max(high - low))


def init(
    key: jax.Array, scans: ScanSet, config: DeepMappingConfig, *, start_poses: Float[Array, "n 3"] | None = None
) -> State:
    """A fresh state.

    Args:
        key: for the weights of both networks.
        scans: in reaches.
        config: settings; a start from given poses runs `config.warm_phases`.
        start_poses: (n, 3) in reaches and radians; None: cold start from zero.

    Returns:
        The state at the start of the first phase.
    """
    net_key, map_key = jax.random.split(key)
    net = LocalizationNet(config.localization)
    num_scans = scans.mask.shape[0]
    poses = jnp.zeros((num_scans, 3)) if start_poses is None else jnp.asarray(start_poses, jnp.float32)
    phase = config.phases(is_warm=start_poses is not None)[0]
    params = Params(
        localization=net.init(net_key, scans.points[0], scans.mask[0]),
        poses=poses,
        occupancy=init_map_net(config.occupancy, key=map_key),
    )
    zero = jnp.zeros((), jnp.int32)
    frame = _choose_frame(scans, poses, config)
    return State(params, make_optimizer(phase).init(params), poses, frame, zero, zero, zero)


# `fit_deepmapping` has an argument of the name `init`, as `icp` has: the start of a registration.
_init_state = init


def next_phase(state: State, scans: ScanSet, config: DeepMappingConfig, *, is_warm: bool) -> State:
    """The state at the start of the next phase: free poses take over where L-Net is, in a map frame around them."""
    phases = config.phases(is_warm=is_warm)
    poses = current_poses(state, scans, config, phases[int(state.phase)])
    params = replace(state.params, poses=poses)
    optimizer = make_optimizer(phases[int(state.phase) + 1]).init(params)
    frame = _choose_frame(scans, poses, config)
    zero = jnp.zeros((), jnp.int32)
    return State(params, optimizer, state.start_poses, frame, state.phase + 1, zero, state.step)


def _network_poses(params: Params, start: Float[Array, "m 3"], batch: Batch, config: DeepMappingConfig) -> Array:
    net = LocalizationNet(config.localization)
    outputs = jax.vmap(net.apply, in_axes=(None, 0, 0))(params.localization, batch.points, batch.mask)
    return se2.compose(start, outputs)


def current_poses(state: State, scans: ScanSet, config: DeepMappingConfig, phase: PhaseConfig) -> Float[Array, "n 3"]:
    """Poses of all scans as the state has them; L-Net sees the same number of beams as in training."""
    if phase.poses == "free":
        return state.params.poses
    beams = _choose_beams(scans.mask.shape[1], phase, jnp.zeros((), jnp.int32))
    rows = jnp.arange(scans.mask.shape[0])
    batch = Batch(scans.points[:, beams], scans.mask[:, beams], rows, jnp.zeros_like(rows))
    return _network_poses(state.params, state.start_poses, batch, config)


def _choose_beams(num_beams: int, phase: PhaseConfig, offset: Int[Array, ""]) -> Int[Array, " c"]:
    stride = max(1, -(-num_beams // phase.beams_per_step))
    return offset % stride + stride * jnp.arange(num_beams // stride)


def _draw_batch(scans: ScanSet, phase: PhaseConfig, step: Int[Array, ""], *, key: jax.Array) -> Batch:
    """All scans where they are few enough, else blocks of neighbours in time; beams from a random first one on."""
    beam_key, scan_key = jax.random.split(key)
    num_scans, num_beams = scans.mask.shape
    beams = _choose_beams(num_beams, phase, jax.random.randint(beam_key, (), 0, num_beams))
    if num_scans <= phase.scans_per_step:
        rows, block = jnp.arange(num_scans), jnp.zeros(num_scans, jnp.int32)
    elif phase.is_free_factor_shared:
        # The published order: batches follow each other in time, none is mixed.
        # The last one reaches back, so that it is as long as the others and no scan is left out.
        first = step % -(-num_scans // phase.scans_per_step) * phase.scans_per_step
        first = jnp.minimum(first, num_scans - phase.scans_per_step)
        rows, block = first + jnp.arange(phase.scans_per_step), jnp.zeros(phase.scans_per_step, jnp.int32)
    else:
        num_blocks = phase.scans_per_step // _BLOCK
        first = jax.random.randint(scan_key, (num_blocks, 1), 0, num_scans - _BLOCK + 1)
        rows, block = (first + jnp.arange(_BLOCK)).reshape(-1), jnp.repeat(jnp.arange(num_blocks), _BLOCK)
    return Batch(scans.points[rows][:, beams], scans.mask[rows][:, beams], rows, block)


def map_logits(state: State, config: DeepMappingConfig) -> MapLogits:
    """M-Net of a state with all its levels on, as a function of points in the world, in reaches."""
    return bind_map(state.params.occupancy, config.occupancy, state.frame, jnp.ones(config.occupancy.num_levels))


def make_step(scans: ScanSet, config: DeepMappingConfig, phase: PhaseConfig) -> Callable[..., tuple[State, Report]]:
    """The compiled step of one phase: `state, report = step(state, key=key)` does `steps_per_call` steps.

    Args:
        scans: all scans, in reaches.
        config: settings of the fit.
        phase: the phase that the state is in.

    Returns:
        The function. The key is that of the whole run: step k uses `fold_in(key, k)`, so that a resumed run equals an
        unbroken one.
    """
    optimizer = make_optimizer(phase)
    length = steps_per_call(config, phase)

    def loss_of(params: Params, state: State, key: jax.Array) -> tuple[Float[Array, ""], Terms]:
        batch_key, loss_key = jax.random.split(key)
        batch = _draw_batch(scans, phase, state.phase_step, key=batch_key)
        progress = state.phase_step / phase.num_steps
        if phase.poses == "network":
            poses = _network_poses(params, state.start_poses[batch.rows], batch, config)
        else:
            poses = params.poses[batch.rows]
        logits = bind_map(params.occupancy, config.occupancy, state.frame, level_weights(phase, config, progress))
        loss, terms = registration_loss(poses, batch, logits, phase, progress, key=loss_key)
        if phase.map_decay > 0.0:
            squares = sum(jnp.sum(x**2) for x in jax.tree.leaves(params.occupancy))
            loss += phase.map_decay * squares / batch.mask.size
        return loss, terms

    def one_step(state: State, key: jax.Array) -> tuple[State, tuple[Array, Terms]]:
        (loss, terms), gradient = jax.value_and_grad(loss_of, has_aux=True)(
            state.params, state, jax.random.fold_in(key, state.step)
        )
        updates, optimizer_state = optimizer.update(gradient, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        state = replace(
            state, params=params, optimizer=optimizer_state, phase_step=state.phase_step + 1, step=state.step + 1
        )
        return state, (loss, terms)

    @jax.jit
    def step(state: State, *, key: jax.Array) -> tuple[State, Report]:
        state, (losses, terms) = jax.lax.scan(lambda s, _: one_step(s, key), state, None, length=length)
        poses = current_poses(state, scans, config, phase)
        return state, Report(losses.mean(), jax.tree.map(jnp.mean, terms), poses)

    return step


def run_phases(
    scans: ScanSet, config: DeepMappingConfig, state: State, *, key: jax.Array, is_warm: bool
) -> Iterator[tuple[PhaseConfig, State, Report]]:
    """Steps a state through all phases that are left, and hands out every report.

    Args:
        scans: in reaches.
        config: settings.
        state: from `init`, or from where an earlier run stopped.
        key: of the run.
        is_warm: the run began from given poses.

    Yields:
        The phase, the state and the report after each call of the step.
    """
    phases = config.phases(is_warm=is_warm)
    while True:
        phase = phases[int(state.phase)]
        step = make_step(scans, config, phase)
        while int(state.phase_step) < phase.num_steps:
            state, report = step(state, key=key)
            yield phase, state, report
        if int(state.phase) + 1 == len(phases):
            return
        state = next_phase(state, scans, config, is_warm=is_warm)


def fit_deepmapping(
    scans: ScanSet | ArrayLike,
    config: DeepMappingConfig | None = None,
    *,
    key: jax.Array,
    init: NDArray[np.float64] | None = None,
) -> Fitted:
    """Registers planar scans by optimising L-Net and M-Net on them alone (DeepMapping eq. 6).

    Args:
        scans: (n, b, 2) in the sensor frames, any unit; all-zero or non-finite beams are left out. Or a ScanSet.
        config: settings; None: `preset("fast")`.
        key: of the whole run.
        init: (n, 3) x, y, heading or (n, 3, 3) matrices to start from; None: cold start from zero.

    Returns:
        Fitted, poses in the unit of the points. The world is that of `init`, or arbitrary after a cold start.

    Raises:
        ValueError: the scans or the poses have a wrong shape or are not finite, or a scan has no valid beam.
    """
    config = config or DeepMappingConfig()
    scans = as_scan_set(scans)
    reach = measure_reach(scans)
    scaled = replace(scans, points=scans.points / reach)
    unit = np.array([reach, reach, 1.0])
    start = None if init is None else _as_planar(init, scans.mask.shape[0]) / unit
    state = _init_state(key, scaled, config, start_poses=start)
    # One at a time: a list of all states would hold every map that there ever was.
    ((_, state, report),) = deque(run_phases(scaled, config, state, key=key, is_warm=start is not None), maxlen=1)
    poses = np.asarray(report.poses, np.float64) * unit
    return Fitted(se2.to_matrix(poses), poses, state.params, report, state, reach, config)


def _as_planar(poses: NDArray[np.float64], num_scans: int) -> NDArray[np.float64]:
    poses = np.asarray(poses, np.float64)
    if not np.isfinite(poses).all():
        raise ValueError("init: expected finite poses")
    if poses.shape == (num_scans, 3, 3):
        return np.stack([poses[:, 0, 2], poses[:, 1, 2], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])], axis=-1)
    if poses.shape != (num_scans, 3):
        raise ValueError(f"init: expected shape ({num_scans}, 3) or ({num_scans}, 3, 3), got {poses.shape}")
    return poses
