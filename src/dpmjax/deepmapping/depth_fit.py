"""DeepMapping of depth images: the loop of `fit`, with poses in space (section 4.2).

Poses are T_start @ motion: the start is kept as it is given, and what L-Net tells or what is optimised freely is a
motion after it. Lengths of the state are in reaches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike, NDArray

from dpmjax.deepmapping.depth_agreement import agreement_of_pairs
from dpmjax.deepmapping.depth_config import DepthMappingConfig, DepthPhaseConfig
from dpmjax.deepmapping.depth_scans import DepthScans, as_depth_scans, measure_depth_reach, motion_matrices
from dpmjax.deepmapping.objective import Batch, MapLogits, Terms, free_factors, occupancy_term, world_loss
from dpmjax.deepmapping.stepping import MapFrame, Params, bind_map, level_weights, make_optimizer, steps_per_call
from dpmjax.geometry import rigid
from dpmjax.nets.depth_localization import DepthLocalizationNet
from dpmjax.nets.occupancy import init_map_net

StepFunction = Callable[..., tuple["DepthState", "DepthReport"]]


@flax.struct.dataclass
class DepthState:
    """Everything that a fit needs to go on; as `fit.State`.

    Attributes:
        params: networks and free motions.
        optimizer: Adam's moments.
        T_start: poses that the motions come after.
        frame: of the map.
        phase: index of the phase.
        phase_step: steps done in it.
        step: steps done in all.
    """

    params: Params
    optimizer: Any
    T_start: Float[Array, "n 4 4"]
    frame: MapFrame
    phase: Int[Array, ""]
    phase_step: Int[Array, ""]
    step: Int[Array, ""]


class DepthReport(NamedTuple):
    """What one call of the step says: mean loss and terms, and T_world_camera after it, in reaches."""

    loss: Float[Array, ""]
    terms: Terms
    T_world_camera: Float[Array, "n 4 4"]


class DepthFitted(NamedTuple):
    """Result of `fit_depth`.

    Attributes:
        T_world_camera: (n, 4, 4) float64, unit of the points.
        state: to draw the map from.
        report: of the last call.
        reach: the length that the state counts in.
    """

    T_world_camera: NDArray[np.float64]
    state: DepthState
    report: DepthReport
    reach: float


def _compose(T_a_b: Float[Array, "n 4 4"], T_b_c: Float[Array, "n 4 4"]) -> Float[Array, "n 4 4"]:
    return jnp.einsum("nij,njk->nik", T_a_b, T_b_c, precision=jax.lax.Precision.HIGHEST)


def _choose_frame(scans: DepthScans, T: Float[Array, "n 4 4"], config: DepthMappingConfig) -> MapFrame:
    """The cube that the scans cover at these poses, with a margin."""
    count = scans.mask.shape[0]
    world = rigid.transform_points(T, scans.points.reshape(count, -1, 3)).reshape(-1, 3)
    valid = scans.mask.reshape(-1, 1)
    low = jnp.where(valid, world, jnp.inf).min(0)
    high = jnp.where(valid, world, -jnp.inf).max(0)
    return MapFrame((low + high) / 2, config.map_margin * jnp.max(high - low) / 2)


def init_depth(
    key: jax.Array, scans: DepthScans, config: DepthMappingConfig, *, T_start: Float[Array, "n 4 4"] | None = None
) -> DepthState:
    """A fresh state; `scans` in reaches. Without `T_start` it is a cold start with all cameras at one place."""
    net_key, map_key = jax.random.split(key)
    net = DepthLocalizationNet(config.localization, config.num_outputs)
    count = scans.mask.shape[0]
    start = jnp.tile(jnp.eye(4), (count, 1, 1)) if T_start is None else jnp.asarray(T_start, jnp.float32)
    phase = config.phases(is_warm=T_start is not None)[0]
    params = Params(
        localization=net.init(net_key, scans.points[0], scans.mask[0]),
        poses=jnp.zeros((count, config.num_outputs)),
        occupancy=init_map_net(config.occupancy, key=map_key, num_dimensions=3),
    )
    if phase.poses == "free" and T_start is None:
        # The paper's direct baseline starts where L-Net's first forward pass puts the cameras.
        params = replace(params, poses=_network_motions(params, scans, config))
    zero = jnp.zeros((), jnp.int32)
    frame = _choose_frame(scans, start, config)
    return DepthState(params, make_optimizer(phase).init(params), start, frame, zero, zero, zero)


def _network_motions(params: Params, scans: DepthScans, config: DepthMappingConfig) -> Float[Array, "n k"]:
    net = DepthLocalizationNet(config.localization, config.num_outputs)
    return jax.vmap(net.apply, in_axes=(None, 0, 0))(params.localization, scans.points, scans.mask)  # type: ignore[return-value]


def _poses(
    params: Params,
    T_start: Float[Array, "n 4 4"],
    scans: DepthScans,
    config: DepthMappingConfig,
    phase: DepthPhaseConfig,
) -> Float[Array, "n 4 4"]:
    motions = params.poses if phase.poses == "free" else _network_motions(params, scans, config)
    return _compose(T_start, motion_matrices(motions))


def next_depth_phase(state: DepthState, scans: DepthScans, config: DepthMappingConfig, *, is_warm: bool) -> DepthState:
    """The state at the start of the next phase: the poses reached are the new start, in a map frame around them."""
    phases = config.phases(is_warm=is_warm)
    T = _poses(state.params, state.T_start, scans, config, phases[int(state.phase)])
    params = replace(state.params, poses=jnp.zeros_like(state.params.poses))
    optimizer = make_optimizer(phases[int(state.phase) + 1]).init(params)
    zero = jnp.zeros((), jnp.int32)
    return DepthState(params, optimizer, T, _choose_frame(scans, T, config), state.phase + 1, zero, state.step)


def _draw_points(scans: DepthScans, count: int, *, key: jax.Array) -> Batch:
    """Other pixels from each image: equal ones would pull equal rays together."""
    num_scans, height, width = scans.mask.shape
    points, mask = scans.points.reshape(num_scans, -1, 3), scans.mask.reshape(num_scans, -1)
    if count < height * width:

        def choose(key: jax.Array) -> Array:
            return jax.random.randint(key, (count,), 0, height * width)

        pixels = jax.vmap(choose)(jax.random.split(key, num_scans))
        points = jnp.take_along_axis(points, pixels[..., None], axis=1)
        mask = jnp.take_along_axis(mask, pixels, axis=1)
    return Batch(points, mask, jnp.arange(num_scans), jnp.zeros(num_scans, jnp.int32))


def _draw_offsets(num_scans: int, phase: DepthPhaseConfig, *, key: jax.Array) -> Int[Array, " o"]:
    """1, so that neighbours always meet, and further ones at random."""
    furthest = min(phase.max_offset, num_scans - 1)
    count = min(phase.num_offsets, furthest) - 1
    drawn = jax.random.choice(key, jnp.arange(2, max(furthest, 2) + 1), (count,), replace=False)
    return jnp.concatenate([jnp.ones(1, drawn.dtype), drawn])


def _projected_loss(
    T: Float[Array, "n 4 4"],
    scans: DepthScans,
    batch: Batch,
    logits: MapLogits,
    phase: DepthPhaseConfig,
    progress: Float[Array, ""],
    *,
    key: jax.Array,
) -> tuple[Float[Array, ""], Terms]:
    """Eq. 6 with the agreement of projected images in the place of the Chamfer distance (as 1 - agreement)."""
    assert phase.projection_tolerance is not None
    free_key, offset_key = jax.random.split(key)
    first, last = np.log(phase.projection_tolerance)
    tolerance = jnp.exp(first + progress * (last - first))
    offsets = _draw_offsets(len(T), phase, key=offset_key)
    pairs = agreement_of_pairs(T, batch.points, batch.mask, scans.depth, scans.pinhole, offsets, tolerance)
    gamma = phase.occupancy_weight
    if gamma == 0.0:
        return 1.0 - pairs, Terms(jnp.zeros(()), 1.0 - pairs)
    factors = free_factors(batch, phase, progress, key=free_key)
    occupancy = occupancy_term(T[:, :3, 3], rigid.transform_points(T, batch.points), batch, logits, factors)
    return gamma * occupancy + (1.0 - gamma) * (1.0 - pairs), Terms(occupancy, 1.0 - pairs)


def make_depth_step(config: DepthMappingConfig, phase: DepthPhaseConfig) -> StepFunction:
    """The compiled step of one phase: `state, report = step(state, scans, key=key)` does `steps_per_call` steps.

    The scans are an argument, so that sets of one shape share one compilation. Step k uses `fold_in(key, k)`.
    """
    optimizer = make_optimizer(phase)
    length = steps_per_call(config, phase)

    def loss_of(params: Params, state: DepthState, scans: DepthScans, key: jax.Array) -> tuple[Float[Array, ""], Terms]:
        batch_key, loss_key = jax.random.split(key)
        batch = _draw_points(scans, phase.beams_per_step, key=batch_key)
        progress = state.phase_step / phase.num_steps
        T = _poses(params, state.T_start, scans, config, phase)
        weights = level_weights(phase, config, progress)
        logits = bind_map(params.occupancy, config.occupancy, state.frame, weights)
        if phase.projection_tolerance is None:
            world = rigid.transform_points(T, batch.points)
            loss, terms = world_loss(T[:, :3, 3], world, batch, logits, phase, progress, key=loss_key)
        else:
            loss, terms = _projected_loss(T, scans, batch, logits, phase, progress, key=loss_key)
        if phase.map_decay > 0.0:
            loss += phase.map_decay * sum(jnp.sum(x**2) for x in jax.tree.leaves(params.occupancy)) / batch.mask.size
        return loss, terms

    def one_step(state: DepthState, scans: DepthScans, key: jax.Array) -> tuple[DepthState, tuple[Array, Terms]]:
        (loss, terms), gradient = jax.value_and_grad(loss_of, has_aux=True)(
            state.params, state, scans, jax.random.fold_in(key, state.step)
        )
        updates, moments = optimizer.update(gradient, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        state = replace(state, params=params, optimizer=moments, phase_step=state.phase_step + 1, step=state.step + 1)
        return state, (loss, terms)

    @jax.jit
    def step(state: DepthState, scans: DepthScans, *, key: jax.Array) -> tuple[DepthState, DepthReport]:
        state, (losses, terms) = jax.lax.scan(lambda s, _: one_step(s, scans, key), state, None, length=length)
        T = _poses(state.params, state.T_start, scans, config, phase)
        return state, DepthReport(losses.mean(), jax.tree.map(jnp.mean, terms), T)

    return step


def fit_depth(
    scans: DepthScans | ArrayLike,
    config: DepthMappingConfig | None = None,
    *,
    key: jax.Array,
    init: ArrayLike | None = None,
    steps: dict[DepthPhaseConfig, StepFunction] | None = None,
) -> DepthFitted:
    """Registers depth images by optimising L-Net and M-Net on them alone (DeepMapping section 4.2).

    Args:
        scans: (n, h, w, 3) in the camera frames, any unit, or DepthScans with their mask.
        config: settings; None: `depth_preset("fast")`.
        key: of the whole run.
        init: (n, 4, 4) T_world_camera to start from; None: cold start.
        steps: compiled steps by phase, from an earlier fit of the same settings: many sets then compile once.

    Returns:
        DepthFitted, in the world of `init`, or an arbitrary one after a cold start.

    Raises:
        ValueError: as `as_depth_scans`, or `init` has a wrong shape or is not finite.
    """
    config = config or DepthMappingConfig()
    scans = scans if isinstance(scans, DepthScans) else as_depth_scans(scans)
    reach = measure_depth_reach(scans)
    scaled = replace(scans, points=scans.points / reach)
    T_start = None if init is None else _in_reaches(np.asarray(init, np.float64), scans.mask.shape[0], reach)
    is_warm = init is not None
    state = init_depth(key, scaled, config, T_start=T_start)
    phases = config.phases(is_warm=is_warm)
    compiled = {} if steps is None else steps
    while True:
        phase = phases[int(state.phase)]
        step = compiled.setdefault(phase, make_depth_step(config, phase))
        while int(state.phase_step) < phase.num_steps:
            state, report = step(state, scaled, key=key)
        if int(state.phase) + 1 == len(phases):
            break
        state = next_depth_phase(state, scaled, config, is_warm=is_warm)
    T = np.asarray(report.T_world_camera, np.float64)
    T[:, :3, 3] *= reach
    return DepthFitted(T, state, report, reach)


def _in_reaches(T: NDArray[np.float64], num_scans: int, reach: float) -> Float[Array, "n 4 4"]:
    if T.shape != (num_scans, 4, 4) or not np.isfinite(T).all():
        raise ValueError(f"init: expected finite numbers of shape ({num_scans}, 4, 4), got {T.shape}")
    scaled = T.copy()
    scaled[:, :3, 3] /= reach
    return jnp.asarray(scaled, jnp.float32)
