"""The polish: every scan against its neighbours in time and in space, all poses in one sparse robust Gauss-Newton.

Where there is range noise the scans are then aligned to walls that they make together (walls.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges, Floats, Indices, join_edges
from dpmjax.pose_graph.planar import solve_poses
from dpmjax.registration.incremental import incremental_icp
from dpmjax.registration.line_adjustment import WallConfig, align_to_walls
from dpmjax.registration.line_fitting import LineScans
from dpmjax.registration.loop_closure import LoopConfig, close_loops, step_edges
from dpmjax.registration.pair_alignment import PairSystem, linearise_pair
from dpmjax.registration.pairs import (
    FINE,
    PairMatches,
    Schedule,
    length_scale,
    match_pairs,
    no_prior,
    scales,
    take_scans,
    thin_beams,
)

# Distances of one round are kept below this by leaving out beams of the sources: about two seconds on two cores.
_ROUND_DISTANCES = 1.5e9


@dataclass(frozen=True)
class PolishConfig:
    """Settings of the polish. Lengths are in length scales of the scans.

    Attributes:
        schedule: how gates and kernels shrink over the rounds.
        temporal: offsets of the neighbours in time.
        num_spatial: at most so many neighbours in space, each from another visit.
        radius: within which neighbours in space are looked for.
        max_turn: largest difference of heading of two neighbours in space, radians.
        refresh: neighbours are chosen anew every so many rounds.
        step_sigma: trust in the steps of the start, where scans leave a direction open: length scales, radians.
        loops: settings of the loop search; None: never.
        firm_fitness: the start is sound, and no loops are searched, if all its steps fit better than this ...
        firm_grip: ... and this share of the beams holds each in its softest direction.
        walls: settings of the last step, the alignment to common walls ...
        min_noise: ... which is done from this range noise on, in length scales.
        is_ordered: neighbours in the array are neighbours in time; else only neighbours in space count, the steps of
            the start mean nothing, and no loops are searched.
    """

    schedule: Schedule = field(default_factory=lambda: Schedule(gate=(0.6, 0.1), kernel=(0.4, 0.01), num_iterations=14))
    temporal: tuple[int, ...] = (1, 2, 3)
    num_spatial: int = 8
    radius: float = 4.0
    max_turn: float = 2.0
    refresh: int = 4
    step_sigma: tuple[float, float] = (0.3, 0.15)
    loops: LoopConfig | None = field(default_factory=LoopConfig)
    firm_fitness: float = 0.35
    firm_grip: float = 0.005
    walls: WallConfig = field(default_factory=WallConfig)
    min_noise: float = 1e-3
    is_ordered: bool = True


class Polished(NamedTuple):
    """Result of `polish`.

    Attributes:
        poses: (n, 3) x, y, heading.
        num_loops: loops that were found and kept; 0 where none was needed.
        num_pairs: pairs of scans in the last round.
        rmse: robust root mean square of the distances to the lines, unit of the points.
    """

    poses: Floats
    num_loops: int
    num_pairs: int
    rmse: float


def choose_pairs(poses: Floats, config: PolishConfig, scale: float) -> tuple[Indices, Indices]:
    """Pairs (source, target) of neighbours in time and in space; of each visit of a place the nearest scan."""
    num_scans = len(poses)
    temporal = config.temporal if config.is_ordered else ()
    source = [np.arange(k, num_scans) for k in temporal]
    target = [np.arange(num_scans - k) for k in temporal]
    tree = scipy.spatial.cKDTree(poses[:, :2])
    # Of each visit of a place one scan is enough; without an order every scan is a visit.
    apart, visit = (max(temporal, default=0) + 2, 2) if config.is_ordered else (0, 0)
    count = min(num_scans, 6 * config.num_spatial + 2 * apart)
    nearest = tree.query(poses[:, :2], k=count, distance_upper_bound=config.radius * scale)
    distances, rows = np.atleast_2d(nearest[0]), np.atleast_2d(nearest[1])
    for scan in range(num_scans if config.num_spatial else 0):
        near = rows[scan][np.isfinite(distances[scan])]
        near = near[(np.abs(near - scan) > apart)]
        near = near[np.abs(se2.wrap_angle(poses[near, 2] - poses[scan, 2])) < config.max_turn]
        chosen: list[int] = []
        for other in near:
            if all(abs(other - c) > visit for c in chosen):
                chosen.append(int(other))
            if len(chosen) == config.num_spatial:
                break
        source.append(np.full(len(chosen), scan))
        target.append(np.array(chosen, np.int64))
    return np.concatenate(source).astype(np.int64), np.concatenate(target).astype(np.int64)


@partial(jax.jit, static_argnames="source_stride")
def _linearise_pairs(
    lines: LineScans,
    source: jax.Array,
    target: jax.Array,
    poses: jax.Array,
    gate: jax.Array,
    kernel: jax.Array,
    *,
    source_stride: int,
) -> PairSystem:
    thinned = thin_beams(lines, source_stride)

    def linearise(pair: tuple[jax.Array, jax.Array, jax.Array]) -> PairSystem:
        i, j, pose = pair
        one, other = jax.tree.map(lambda x: x[i], thinned), jax.tree.map(lambda x: x[j], lines)
        return linearise_pair(one, other, pose, gate, kernel, metric="plane")

    return jax.lax.map(linearise, (source, target, poses), batch_size=16)


def _linearise(
    lines: LineScans, source: Indices, target: Indices, poses: Floats, gate: jax.Array, kernel: jax.Array
) -> tuple[Edges, PairSystem]:
    """Systems of all pairs at these poses; their number is rounded up so that few shapes are compiled."""
    relative = se2.relative(poses[target], poses[source])
    num_beams = lines.mask.shape[1]
    stride = max(1, int(np.ceil(len(source) * num_beams**2 / _ROUND_DISTANCES)))
    filled = np.resize(np.arange(len(source)), 1024 * -(-len(source) // 1024))
    system = _linearise_pairs(
        lines,
        jnp.asarray(source[filled]),
        jnp.asarray(target[filled]),
        jnp.asarray(relative[filled], jnp.float32),
        gate,
        kernel,
        source_stride=stride,
    )
    system = jax.tree.map(lambda x: np.asarray(x, np.float64)[: len(source)], system)
    return Edges(source, target, relative, np.asarray(system.information)), system


def align_all(lines: LineScans, poses: Floats, config: PolishConfig, *, scale: float) -> Polished:
    """Multi-view point-to-line alignment of all scans from nearby poses.

    Args:
        lines: n scans with lines.
        poses: (n, 3) start.
        config: settings.
        scale: `length_scale` of the scans.

    Returns:
        Polished; the first pose is that of the start.
    """
    noise = float(lines.noise[0])
    gates, kernels = scales(config.schedule, scale, 1.25 * noise)
    steps = step_edges(poses, None, LoopConfig(step_sigma=config.step_sigma), scale)
    # In units of one beam's information, as the systems of the pairs are.
    trust = max(noise, 0.005 * scale) ** 2 if config.is_ordered else 1e-9
    steps = steps._replace(information=steps.information * trust)
    source, target, system = np.zeros(0, np.int64), np.zeros(0, np.int64), None
    for round_number, (gate, kernel) in enumerate(zip(gates, kernels, strict=True)):
        if round_number % config.refresh == 0:
            source, target = choose_pairs(poses, config, scale)
        edges, system = _linearise(lines, source, target, poses, gate, kernel)
        here = se2.relative(poses[steps.target], poses[steps.source])
        pull = np.einsum("eij,ej->ei", steps.information, se2.relative(steps.poses, here))
        gradient = np.concatenate([np.asarray(system.gradient), pull])
        poses = se2.compose(
            poses, solve_poses(len(poses), join_edges(edges, steps._replace(measurements=here)), gradient)
        )
    rmse = float(np.sqrt(np.sum(system.squares) / max(float(np.sum(system.weight)), 1e-9))) if system else 0.0
    return Polished(poses, 0, len(source), rmse)


def match_steps(lines: LineScans, poses: Floats, *, scale: float) -> PairMatches:
    """Steps of a trajectory, each matched again from where it is."""
    num_scans = len(poses)
    guesses = se2.relative(poses[:-1], poses[1:])[:, None]
    source, target = take_scans(lines, np.arange(1, num_scans)), take_scans(lines, np.arange(num_scans - 1))
    return match_pairs(source, target, guesses, FINE, no_prior(num_scans - 1), scale=scale)


def is_sound(lines: LineScans, steps: PairMatches, config: PolishConfig) -> bool:
    """Whether all steps fit and are held in every direction, so that a chain of them cannot have gone far astray."""
    num_beams = np.maximum(np.asarray(lines.mask.sum(1))[1:], 1)
    grip = np.linalg.eigvalsh(steps.information[:, :2, :2])[:, 0] / num_beams
    return bool((steps.fitness > config.firm_fitness).all() and (grip > config.firm_grip).all())


def polish(lines: LineScans, poses: Floats, config: PolishConfig | None = None) -> Polished:
    """Closes loops where the start leaves doubt, then aligns all scans together, and to walls if there is noise.

    Args:
        lines: n scans with lines (`fit_lines`), in time order.
        poses: (n, 3) start, x, y, heading.
        config: settings.

    Returns:
        Polished.
    """
    config = config or PolishConfig()
    scale = length_scale(lines)
    num_loops = 0
    if config.is_ordered and config.loops is not None:
        poses, num_loops = _close_loops_in_doubt(lines, poses, config, config.loops, scale)
    polished = align_all(lines, poses, config, scale=scale)
    if float(lines.noise[0]) > config.min_noise * scale:
        polished = polished._replace(poses=align_to_walls(lines, polished.poses, config.walls))
    return polished._replace(num_loops=num_loops)


def _close_loops_in_doubt(
    lines: LineScans, poses: Floats, config: PolishConfig, loops: LoopConfig, scale: float
) -> tuple[Floats, int]:
    """Poses with loops closed, and how many; the poses as they are, if all their steps are sound."""
    steps = match_steps(lines, poses, scale=scale)
    if is_sound(lines, steps, config):
        return poses, 0
    # The steps again, with those of the start as guess and as belief, where the scans leave a direction open.
    chained, steps = incremental_icp(lines, odometry=poses)
    edges = step_edges(chained, steps, loops, scale)
    closed, _, weight = close_loops(lines, chained, edges, loops)
    return closed, int((weight > 0.25).sum())


def surface_misfit(lines: LineScans, poses: Floats, config: PolishConfig | None = None) -> float:
    """How badly neighbouring scans agree at these poses, without knowing the truth.

    Args:
        lines: n scans with lines.
        poses: (n, 3) x, y, heading.
        config: settings; its last kernel tells how fine the comparison is.

    Returns:
        The share of beams, 0 to 1, that do not find their surface in the scans nearby; fractions for near misses.
    """
    config = config or PolishConfig()
    scale = length_scale(lines)
    gates, kernels = scales(config.schedule, scale, 1.25 * float(lines.noise[0]))
    source, target = choose_pairs(poses, config, scale)
    _, system = _linearise(lines, source, target, poses, gates[-1], kernels[-1])
    num_beams = np.asarray(lines.mask.sum(1), np.float64)
    return 1.0 - float(np.sum(system.weight) / np.maximum(num_beams[source].sum(), 1.0))
