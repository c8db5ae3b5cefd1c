"""Places that were seen before: pairs of scans far apart in time, matched without trust in the drifted poses.

A single pair of half-circle scans in a corridor fits in many wrong ways. Three things make a loop believable: the
target is a small map of several scans, neighbouring loops say the same (a wrong match has no company), and the robust
graph lets go of what still contradicts the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges, Floats, Indices, join_edges
from dpmjax.pose_graph.planar import GraphConfig, optimize_planar_graph
from dpmjax.registration.line_fitting import LineScans
from dpmjax.registration.pair_alignment import StepPrior
from dpmjax.registration.pairs import PairMatches, Schedule, length_scale, match_pairs, take_scans
from dpmjax.registration.visibility import compare_views
from dpmjax.types import ScanSet

_SEARCH = Schedule(gate=(1.2, 0.3), kernel=(0.6, 0.15), num_iterations=7, source_stride=5, target_stride=3)
_REFINE = Schedule(gate=(0.5, 0.15), kernel=(0.15, 0.03), num_iterations=10, target_stride=2)


# Candidates are matched so many at a time, all batches of one shape.
_BATCH = 512


@dataclass(frozen=True)
class LoopConfig:
    """Settings of the loop search.

    Attributes:
        num_rounds: searches, each from the poses that the one before has corrected.
        drift: how far a pose may have gone astray, as a share of the way since; sets where loops are looked for.
        max_radius: largest distance of a candidate, in length scales.
        min_way: way between the two scans of a loop, in length scales.
        max_candidates: at most so many pairs a round.
        submap_width: the target is a map of so many scans to either side.
        min_fitness: robust share of the beams that must find their partner.
        max_crossed: share of the points that may be crossed by a beam of the other scan.
        min_grip: share of the beams that must hold the pair in its softest direction.
        min_support: so many neighbouring loops must agree.
        agreement: within which they agree: translation in length scales, turn in radians.
        neighbourhood: scans within which loops are neighbours.
        sigma: accuracy of a fitted beam in length scales; gives edges their information.
        step_sigma: trust in a step of the start: translation in length scales, turn in radians.
        step_trust: so many loops must contradict a step before the trajectory is torn there.
    """

    num_rounds: int = 3
    drift: float = 0.05
    max_radius: float = 15.0
    min_way: float = 15.0
    max_candidates: int = 2000
    submap_width: int = 2
    min_fitness: float = 0.4
    max_crossed: float = 0.08
    min_grip: float = 0.03
    min_support: int = 2
    agreement: tuple[float, float] = (0.3, 0.08)
    neighbourhood: int = 6
    sigma: float = 0.2
    step_sigma: tuple[float, float] = (0.3, 0.15)
    step_trust: float = 30.0


def find_candidates(poses: Floats, config: LoopConfig, scale: float, seed: int = 0) -> tuple[Indices, Indices]:
    """Pairs of scans that may see the same place: later one (source) and earlier one (target)."""
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    tree = scipy.spatial.cKDTree(poses[:, :2])
    first, second = tree.query_pairs(
        min(config.max_radius * scale, 2 * scale + config.drift * way[-1]), output_type="ndarray"
    ).T
    apart = way[second] - way[first]
    distance = np.hypot(*(poses[second, :2] - poses[first, :2]).T)
    keep = (apart > config.min_way * scale) & (distance < 2 * scale + config.drift * apart) & (second - first > 5)
    source, target = second[keep], first[keep]
    if len(source) > config.max_candidates:
        # Nearer pairs are likelier to overlap; the rest is drawn so that far ones get their chance.
        rng = np.random.default_rng(seed)
        order = np.argsort(distance[keep] * rng.uniform(0.1, 1.0, len(source)))[: config.max_candidates]
        source, target = source[np.sort(order)], target[np.sort(order)]
    return source.astype(np.int64), target.astype(np.int64)


@jax.jit
def _merge_scans(lines: LineScans, rows: jax.Array, present: jax.Array, poses: jax.Array) -> LineScans:
    """Submaps of (p, w) scans each, poses (p, w, 3) T_target_scan."""
    c, s = jnp.cos(poses[..., 2]), jnp.sin(poses[..., 2])
    rotation = jnp.stack([jnp.stack([c, -s], -1), jnp.stack([s, c], -1)], -2)

    def turn(vectors: jax.Array) -> jax.Array:
        return jnp.einsum("pwij,pwbj->pwbi", rotation, vectors[rows], precision="highest")

    shift = poses[:, :, None, :2]
    flat = (rows.shape[0], -1)
    return LineScans(
        points=(turn(lines.points) + shift).reshape(*flat, 2),
        normals=turn(lines.normals).reshape(*flat, 2),
        centroids=(turn(lines.centroids) + shift).reshape(*flat, 2),
        mask=(lines.mask[rows] & present[..., None]).reshape(flat),
        noise=lines.noise[rows[:, 0]],
    )


def build_submaps(lines: LineScans, poses: Floats, centres: Indices, width: int) -> LineScans:
    """One small map around each centre scan, in that scan's frame: the scans up to `width` before and after it."""
    offsets = np.array(sorted(range(-width, width + 1), key=abs))
    rows = centres[:, None] + offsets
    present = (rows >= 0) & (rows < len(poses))
    rows = np.clip(rows, 0, len(poses) - 1)
    relative = se2.relative(poses[centres][:, None], poses[rows])
    return _merge_scans(lines, jnp.asarray(rows), jnp.asarray(present), jnp.asarray(relative, jnp.float32))


def _guesses(predicted: Floats, scale: float) -> Floats:
    """Scans that overlap well are near each other, whatever the drift says; only the heading is trusted a little."""
    shifts = 1.5 * scale * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    turns = np.radians([0.0, -12.0, 12.0])
    fan = [
        np.stack([x + 0 * predicted[:, 0], y + 0 * predicted[:, 1], predicted[:, 2] + t], -1)
        for t in turns
        for x, y in shifts
    ]
    return np.stack([*fan, predicted], axis=1)


def count_support(edges: Edges, poses: Floats, config: LoopConfig, scale: float) -> Indices:
    """How many neighbouring loops say the same as each loop, through the steps of the trajectory between them."""
    near = np.abs(edges.source[:, None] - edges.source) <= config.neighbourhood
    near &= np.abs(edges.target[:, None] - edges.target) <= config.neighbourhood
    near &= (edges.source[:, None] != edges.source) | (edges.target[:, None] != edges.target)
    one, other = np.nonzero(near)
    step_target = se2.relative(poses[edges.target[one]], poses[edges.target[other]])
    step_source = se2.relative(poses[edges.source[other]], poses[edges.source[one]])
    through = se2.compose(se2.compose(step_target, edges.poses[other]), step_source)
    error = se2.relative(edges.poses[one], through)
    agrees = np.hypot(error[:, 0], error[:, 1]) < config.agreement[0] * scale
    agrees &= np.abs(error[:, 2]) < config.agreement[1]
    return np.bincount(one[agrees], minlength=len(edges.source))


def _match_batch(
    lines: LineScans, poses: Floats, source: Indices, target: Indices, way: Floats, config: LoopConfig, scale: float
) -> tuple[PairMatches, Floats]:
    """Matches of one batch of candidates, and the share of points that contradict each."""
    maps, scans = build_submaps(lines, poses, target, config.submap_width), take_scans(lines, source)
    predicted = se2.relative(poses[target], poses[source])
    # The prediction is believed as far as the drift allows: it decides along a corridor, where scans cannot.
    sigma = 0.3 * scale + 0.5 * config.drift * (way[source] - way[target])
    belief = np.stack([sigma, sigma, np.full_like(sigma, np.inf)], axis=-1) ** -2.0
    rough = match_pairs(
        scans, maps, _guesses(predicted, scale), _SEARCH, StepPrior(predicted, (0.1 * scale) ** 2 * belief), scale=scale
    )
    prior = StepPrior(predicted, (3.0 * float(lines.noise[0])) ** 2 * belief)
    fine = match_pairs(scans, maps, rough.poses[:, None], _REFINE, prior, scale=scale)
    centres = take_scans(lines, target)
    views = compare_views(
        ScanSet(scans.points, scans.mask),
        ScanSet(centres.points, centres.mask),
        jnp.asarray(fine.poses, jnp.float32),
        jnp.asarray(max(0.1 * scale, 3.0 * float(lines.noise[0])), jnp.float32),
    )
    crossed = np.asarray(views.num_crossed, np.float64) / np.maximum(np.asarray(views.num_seen, np.float64), 20.0)
    return fine, crossed


def find_loops(lines: LineScans, poses: Floats, config: LoopConfig, *, scale: float) -> Edges:
    """Loops between scans of one trajectory, each supported by its neighbours.

    Args:
        lines: n scans with lines.
        poses: (n, 3) T_world_scan, locally right, globally drifted.
        config: settings.
        scale: `length_scale` of the scans.

    Returns:
        Edges with information in the unit of the points; perhaps none.
    """
    source, target = find_candidates(poses, config, scale)
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    found = []
    for start in range(0, len(source), _BATCH):
        rows = np.resize(np.arange(start, min(start + _BATCH, len(source))), _BATCH)
        found.append(_match_batch(lines, poses, source[rows], target[rows], way, config, scale))
    if not found:
        return Edges(source, target, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    matches, crossed = (
        PairMatches(*(np.concatenate(x)[: len(source)] for x in zip(*[m for m, _ in found], strict=True))),
        np.concatenate([c for _, c in found])[: len(source)],
    )
    num_beams = np.maximum(np.asarray(lines.mask.sum(1))[source], 1)
    grip = np.linalg.eigvalsh(matches.information[:, :2, :2])[:, 0] / num_beams
    fits = (matches.fitness > config.min_fitness) & (crossed < config.max_crossed) & (grip > config.min_grip)
    information = matches.information[fits] / (config.sigma * scale) ** 2
    edges = Edges(source[fits], target[fits], matches.poses[fits], information)
    supported = count_support(edges, poses, config, scale) >= config.min_support
    return jax.tree.map(lambda x: x[supported], edges)


def close_loops(
    lines: LineScans, poses: Floats, steps: Edges, config: LoopConfig | None = None
) -> tuple[Floats, Edges, Floats]:
    """Corrects a drifted trajectory by the loops found in it.

    Args:
        lines: n scans with lines.
        poses: (n, 3) start.
        steps: edges between neighbours in time.
        config: settings.

    Returns:
        The corrected poses, the loops of the last round and their final weights (0: let go).
    """
    config = config or LoopConfig()
    scale = length_scale(lines)
    loops, weight = find_loops(lines, poses, config, scale=scale), np.zeros(0)
    for round_number in range(config.num_rounds):
        if round_number:
            loops = find_loops(lines, poses, config, scale=scale)
        if not len(loops.source):
            return poses, loops, weight
        trust = np.repeat([config.step_trust, 1.0], [len(steps.source), len(loops.source)])
        poses, weights = optimize_planar_graph(poses, join_edges(steps, loops), GraphConfig(), trust=trust)
        weight = weights[len(steps.source) :]
    return poses, loops, weight


def step_edges(poses: Floats, matches: PairMatches | None, config: LoopConfig, scale: float) -> Edges:
    """Edges between neighbours in time: from matched steps where there are any, else from the poses themselves."""
    sigma = np.array([scale, scale, 1.0]) * np.array(config.step_sigma)[[0, 0, 1]]
    floor = np.diag(1.0 / sigma**2)
    source = np.arange(1, len(poses))
    if matches is None:
        relative = se2.relative(poses[:-1], poses[1:])
        return Edges(source, source - 1, relative, np.broadcast_to(floor, (len(source), 3, 3)))
    information = matches.information / (config.sigma * scale) ** 2 + floor
    return Edges(source, source - 1, matches.poses, information)
