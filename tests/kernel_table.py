"""One table of all kernels: how each is called, on small arrays, and by which of them it has a derivative."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dpmjax
from dpmjax import deepmapping, deeppointmap, geometry, losses, pose_graph
from dpmjax.geometry import rigid, se2
from tests.deeppointmap import toy

Arrays = dict[str, Any]
NUM, EXTRA = 24, 3


@dataclass(frozen=True)
class Kernel:
    """A kernel and the arguments of its tests.

    Attributes:
        call: of arrays by name.
        make: example arrays of a random generator.
        by: the arrays that it has a derivative by; empty for choices of indices.
        padding: numbers in the rows that are not there, by array; empty where nothing is masked.
        points: the padded arrays whose rows count as not there wherever they hold no usable point.
        is_exact: False where the derivative is not compared with differences (a network, or a long fit).
        dtypes: types of floats in the result beside that of the arrays: networks compute in float32; None for the
            engine, where the problem decides.
    """

    call: Callable[..., Any]
    make: Callable[[np.random.Generator], Arrays]
    by: tuple[str, ...] = ()
    padding: Arrays = field(default_factory=dict)
    points: tuple[str, ...] = ()
    is_exact: bool = True
    dtypes: tuple[str, ...] | None = ()


def points(*names: str, dim: int = 3) -> Callable[[np.random.Generator], Arrays]:
    return lambda rng: {name: rng.normal(size=(NUM, dim)).astype(np.float32) for name in names}


def masked(*names: str, **masks: str) -> Arrays:
    return dict.fromkeys(names, np.nan) | dict.fromkeys(masks.values(), False)


def of_points(call, names: str, by="", *, padded="", masks="mask", dim=3, is_exact=True, has_places=True) -> Kernel:
    """A kernel of named points and masks, of which all points are padded or those that `padded` names."""
    rows, there = tuple((padded or names).split()), masks.split()

    def make(rng: np.random.Generator) -> Arrays:
        return points(*names.split(), dim=dim)(rng) | {mask: np.ones(NUM, bool) for mask in there}

    padding = dict.fromkeys(rows, np.nan) | dict.fromkeys(there, False)
    return Kernel(call, make, tuple(by.split()), padding, points=rows if has_places else (), is_exact=is_exact)


def moved_clouds(dim: int) -> Callable[[np.random.Generator], Arrays]:
    """The sides of a box, and the same a little turned, shifted and noisy."""

    def make(rng: np.random.Generator) -> Arrays:
        source = rng.uniform(-1.0, 1.0, (120, dim))
        side = rng.integers(0, dim, 120)
        source[np.arange(120), side] = np.sign(source[np.arange(120), side])
        source *= np.array([5.0, 3.0, 2.0])[:dim]
        step = np.full(3 if dim == 2 else 6, 0.03)
        T = np.asarray(rigid.exp(step), np.float64)
        target = source @ T[:dim, :dim].T + T[:dim, dim] + 0.01 * rng.normal(size=source.shape)
        arrays = {"source": source.astype(np.float32), "target": target.astype(np.float32)}
        return arrays | {"source_mask": np.ones(120, bool), "target_mask": np.ones(120, bool)}

    return make


def trajectories(rng: np.random.Generator) -> Arrays:
    poses = {name: np.asarray(rigid.exp(0.5 * rng.normal(size=(NUM, 6)))) for name in ("estimated", "reference")}
    return {name: T.astype(np.float32) for name, T in poses.items()}


def mapped_points(rng: np.random.Generator) -> Arrays:
    """Beams of all scans; the beams come first, so that they can be padded."""
    T = trajectories(rng)
    beams = rng.normal(size=(5, NUM, 3)).astype(np.float32)
    return {"points": beams, "mask": np.ones((5, NUM), bool)} | {f"T_{name}": poses for name, poses in T.items()}


def distance_of_beams(points: Any, mask: Any, **T: Any) -> Any:
    return dpmjax.point_distance(jnp.swapaxes(points, 0, 1), mask.T, **T)


def contrast(rng: np.random.Generator) -> Arrays:
    masks = {name: rng.uniform(size=NUM) < 0.8 for name in ("is_query", "is_key")}
    return points("queries", "keys")(rng) | {"positives": rng.permutation(NUM)} | masks


def contrast_of(queries: Any, keys: Any, positives: Any, is_query: Any, is_key: Any) -> Any:
    ignore = jnp.broadcast_to(~is_key, (len(queries), len(keys)))
    return dpmjax.info_nce(queries, keys, positives, ignore=ignore, mask=is_query)


def beams(rng: np.random.Generator) -> Arrays:
    return points("points")(rng) | {
        "origin": rng.normal(size=3).astype(np.float32),
        "factors": rng.uniform(size=(NUM, 4)).astype(np.float32),
    }


def samples(rng: np.random.Generator) -> Arrays:
    numbers = {name: rng.uniform(0.1, 0.9, NUM).astype(np.float32) for name in ("logits", "labels", "weights")}
    return numbers | {"logits": 4.0 * numbers["logits"] - 2.0}


def weighted(rng: np.random.Generator) -> Arrays:
    return points("source", "target")(rng) | {"weights": rng.uniform(0.1, 1.0, NUM).astype(np.float32)}


def scan(rng: np.random.Generator) -> Arrays:
    return {"points": rng.uniform(-0.5, 0.5, (64, 3)).astype(np.float32), "mask": np.ones(64, bool)}


def descriptors(rng: np.random.Generator) -> Arrays:
    arrays = {name: rng.normal(size=(16, 8)).astype(np.float32) for name in ("a", "b")}
    arrays |= {name: 9.0 * rng.normal(size=(16, 3)).astype(np.float32) for name in ("at_a", "at_b")}
    return arrays | {name: np.ones(16, bool) for name in ("is_a", "is_b")}


@cache
def model() -> dpmjax.Model:
    return dpmjax.init_model(jax.random.key(0), toy.MODEL)


@cache
def toy_1d() -> deepmapping.Problem:
    return deepmapping.toy_problem(deepmapping.ToyConfig("direct", num_steps=5))


def encode(points: Any, mask: Any) -> Any:
    return dpmjax.encode_pyramid(model(), geometry.build_pyramid(points, mask, toy.MODEL.pyramid))


def clouds_of(a: Any, b: Any, at_a: Any, at_b: Any, is_a: Any, is_b: Any) -> Any:
    return dpmjax.DescriptorCloud(at_a, a, is_a), dpmjax.DescriptorCloud(at_b, b, is_b)


def correlate(**arrays: Any) -> Any:
    return dpmjax.correlate(model(), *clouds_of(**arrays))


def match(**arrays: Any) -> Any:
    a, b = clouds_of(**arrays)
    left, right = (jnp.where(cloud.mask[:, None], cloud.features, 0.0) for cloud in (a, b))
    # Numbers of pairs that are not there may be anything.
    cosines = jnp.where(a.mask[:, None] & b.mask, jnp.tanh(left @ right.T / 9.0), jnp.nan)
    offsets = lambda rows, others: (jnp.zeros((*rows.shape, 3)),) * 2  # noqa: E731
    found = toy.best_match(a, b, cosines, offsets, config=deeppointmap.MatchConfig(num_rounds=1))
    return found.T_target_source, found.mean_score, found.num_inliers


def solve_toy(seed: Any) -> Any:
    state, report = deepmapping.solve(toy_1d(), None, key=jax.random.key(seed))
    return state.params.x, report.losses


def step_toy(seed: Any, x: Any) -> Any:
    state = deepmapping.init(toy_1d(), None, key=jax.random.key(seed))
    state = state.replace(params=state.params.replace(x=x))
    state, report = deepmapping.step(toy_1d(), state, None, phase=0)
    return state.params.x, report.losses


def seeds(rng: np.random.Generator) -> Arrays:
    return {"seed": rng.integers(0, 99, dtype=np.int32), "x": np.float32(rng.normal())}


def planar_graph(rng: np.random.Generator) -> Arrays:
    """A loop of six poses and one more edge across it, measured with noise."""
    poses = np.column_stack([np.cumsum(rng.uniform(0.5, 1.5, (6, 2)), axis=0), 0.3 * rng.normal(size=6)])
    source, target = np.array([1, 2, 3, 4, 5, 5, 3]), np.array([0, 1, 2, 3, 4, 0, 0])
    relative = np.asarray(se2.compose(se2.inverse(poses[target]), poses[source]))
    return {
        "poses": (poses + 0.05 * rng.normal(size=poses.shape)).astype(np.float32),
        "source": source,
        "target": target,
        "measured": (relative + 0.02 * rng.normal(size=relative.shape)).astype(np.float32),
        "information": (np.eye(3) * rng.uniform(0.5, 2.0, (7, 1, 1))).astype(np.float32),
        "edge_mask": np.ones(7, bool),
    }


def edges_of(source: Any, target: Any, measured: Any, information: Any) -> pose_graph.Edges:
    return pose_graph.Edges(source, target, measured, information)


EDGES = {"source": 0, "target": 0} | masked("measured", "information", edge_mask="edge_mask")
SCAN = masked("points", mask="mask")
PAIR = masked("source", "target", source_mask="source_mask", target_mask="target_mask")
CLOUDS = masked("a", "b", "at_a", "at_b", is_a="is_a", is_b="is_b")
KERNELS = {
    "weighted_svd": Kernel(
        dpmjax.weighted_svd,
        weighted,
        ("source", "target", "weights"),
        masked("source", "target") | {"weights": 0.0},
        points=("source", "target"),
    ),
    "align_rigid": of_points(dpmjax.align_rigid, "estimated reference", "estimated reference", has_places=False),
    "absolute_trajectory_error": of_points(
        dpmjax.absolute_trajectory_error, "estimated reference", "estimated reference", dim=2, has_places=False
    ),
    "relative_pose_error": Kernel(dpmjax.relative_pose_error, trajectories, ("estimated", "reference")),
    "point_distance": Kernel(distance_of_beams, mapped_points, ("points", "T_estimated"), SCAN, ("points",)),
    "k_nearest": of_points(
        lambda queries, points, mask: dpmjax.k_nearest(queries, points, 3, mask),
        "queries points",
        "queries points",
        padded="points",
    ),
    "radius_search": of_points(
        lambda queries, points, mask: dpmjax.radius_search(queries, points, 0.8, 3, mask),
        "queries points",
        "queries points",
        padded="points",
    ),
    "farthest_point_sample": of_points(lambda points, mask: dpmjax.farthest_point_sample(points, 6, mask), "points"),
    "voxel_sample": of_points(lambda points, mask: dpmjax.voxel_sample(points, 0.7, mask), "points"),
    "estimate_normals": of_points(lambda points, mask: dpmjax.estimate_normals(points, 5, mask), "points"),
    "sample_free_space": Kernel(dpmjax.sample_free_space, beams, ("origin", "points", "factors")),
    "geometry.build_pyramid": Kernel(
        lambda points, mask: geometry.build_pyramid(points, mask, toy.MODEL.pyramid).levels[1:],
        scan,
        padding=SCAN,
        points=("points",),
    ),
    "geometry.find_consensus": of_points(geometry.find_consensus, "source target"),
    "info_nce": Kernel(
        contrast_of,
        contrast,
        ("queries", "keys"),
        {"positives": 0} | masked("queries", "keys", query="is_query", key="is_key"),
    ),
    "chamfer_distance": of_points(dpmjax.chamfer_distance, "a b", "a b", masks="mask_a mask_b"),
    "occupancy_loss": Kernel(
        dpmjax.occupancy_loss, samples, ("logits", "labels"), masked("logits", "labels") | {"weights": 0.0}
    ),
    # The covariance is held constant.
    "losses.offset_loss": of_points(
        losses.offset_loss, "predicted true", "predicted", is_exact=False, has_places=False
    ),
    # Compared with differences by a test of its own.
    "icp": Kernel(
        partial(dpmjax.icp, metric="plane"), moved_clouds(3), ("source",), PAIR, ("source", "target"), is_exact=False
    ),
    "icp to points": Kernel(
        partial(dpmjax.icp, metric="point"),
        moved_clouds(2),
        ("source", "target"),
        PAIR,
        ("source", "target"),
        is_exact=False,
    ),
    "encode_pyramid": Kernel(encode, scan, ("points",), SCAN, ("points",), is_exact=False, dtypes=("float32",)),
    "correlate": Kernel(correlate, descriptors, ("a", "b"), CLOUDS, is_exact=False, dtypes=("float32",)),
    "match_hypotheses": Kernel(match, descriptors, ("a", "b", "at_a", "at_b"), CLOUDS, dtypes=("float32",)),
    "pose_graph.residuals": Kernel(
        lambda poses, edge_mask, **edges: pose_graph.residuals(poses, edges_of(**edges), edge_mask),
        planar_graph,
        ("poses", "measured"),
        EDGES,
    ),
    "pose_graph.solve_dense": Kernel(
        lambda poses, edge_mask, **edges: pose_graph.solve_dense(poses, edges_of(**edges), edge_mask=edge_mask).poses,
        planar_graph,
        ("measured",),
        EDGES,
    ),
    "deepmapping.step": Kernel(step_toy, seeds, ("x",), is_exact=False, dtypes=None),
    "deepmapping.solve": Kernel(lambda seed, x: solve_toy(seed), seeds, dtypes=None),
}


def example(kernel: Kernel, seed: int = 0, dtype: Any = None) -> Arrays:
    arrays = kernel.make(np.random.default_rng(seed))
    return {name: jnp.asarray(value, dtype if value.dtype.kind == "f" else None) for name, value in arrays.items()}


def padded(kernel: Kernel, arrays: Arrays, point: float | None = None, hidden: float = np.nan) -> Arrays:
    """Arrays with further rows: masked ones that hold `hidden`, or with a number for `point` unmasked ones of it."""

    def pad(name: str, value: Any) -> Any:
        filler = hidden if kernel.padding[name] is np.nan else kernel.padding[name]
        if point is not None:
            filler = point if name in kernel.points else 1
        return jnp.concatenate([value, jnp.full((EXTRA, *value.shape[1:]), filler, value.dtype)])

    return {name: pad(name, value) if name in kernel.padding else value for name, value in arrays.items()}


def total(kernel: Kernel, arrays: Arrays) -> Any:
    leaves = floats(kernel.call(**arrays))
    leaves = [jnp.where(jnp.isfinite(leaf), leaf, 0.0).ravel() for leaf in leaves]
    return sum(jnp.sum(jnp.cos(jnp.arange(leaf.size)) * leaf) for leaf in leaves)


def floats(tree: Any) -> list[Any]:
    """The leaves that are no counts, choices or masks."""
    leaves = map(jnp.asarray, jax.tree.leaves(tree))
    return [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
