"""One table of all kernels: jit and vmap give the numbers of the call, padding changes nothing, gradients are right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpmjax
from dpmjax import deepmapping, deeppointmap, geometry, losses
from dpmjax.geometry import rigid
from tests.deeppointmap import toy

Arrays = dict[str, Any]
NUM, EXTRA = 24, 3
# Float32 sums and solutions of small systems; a loop that ends at a millionth of the cloud.
CLOSE: Arrays = {"rtol": 1e-3, "atol": 2e-4}


@dataclass(frozen=True)
class Kernel:
    """A kernel and the arguments of its tests.

    Attributes:
        call: of arrays by name.
        make: example arrays of a random generator.
        by: the arrays that it has a derivative by; empty for choices of indices.
        padding: numbers in the rows that are not there, by array; empty where nothing is masked.
        is_exact: False where the derivative is not compared with differences (a network, or a long fit).
    """

    call: Callable[..., Any]
    make: Callable[[np.random.Generator], Arrays]
    by: tuple[str, ...] = ()
    padding: Arrays = field(default_factory=dict)
    is_exact: bool = True


def points(*names: str, dim: int = 3) -> Callable[[np.random.Generator], Arrays]:
    return lambda rng: {name: rng.normal(size=(NUM, dim)).astype(np.float32) for name in names}


def with_masks(*names: str, dim: int = 3, **masks: str) -> Callable[[np.random.Generator], Arrays]:
    """Points, and masks that are True everywhere."""
    return lambda rng: points(*names, dim=dim)(rng) | {mask: np.ones(NUM, bool) for mask in masks.values()}


def masked(*names: str, **masks: str) -> Arrays:
    return dict.fromkeys(names, np.nan) | dict.fromkeys(masks.values(), False)


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
    """Descriptors, of which some queries and some keys do not count."""
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


@pytest.fixture(autouse=True, scope="module")
def _made_outside_of_programs() -> None:
    """What is made once must hold no tracers of the program that asks for it first."""
    model()
    toy_1d()


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


BOTH = {"source_mask": "source_mask", "target_mask": "target_mask"}
CLOUDS = masked("a", "b", "at_a", "at_b", is_a="is_a", is_b="is_b")
KERNELS = {
    "weighted_svd": Kernel(
        dpmjax.weighted_svd, weighted, ("source", "target", "weights"), masked("source", "target") | {"weights": 0.0}
    ),
    "align_rigid": Kernel(
        dpmjax.align_rigid,
        with_masks("estimated", "reference", mask="mask"),
        ("estimated", "reference"),
        masked("estimated", "reference", mask="mask"),
    ),
    "absolute_trajectory_error": Kernel(
        dpmjax.absolute_trajectory_error,
        with_masks("estimated", "reference", dim=2, mask="mask"),
        ("estimated", "reference"),
        masked("estimated", "reference", mask="mask"),
    ),
    "relative_pose_error": Kernel(dpmjax.relative_pose_error, trajectories, ("estimated", "reference")),
    "point_distance": Kernel(
        distance_of_beams, mapped_points, ("points", "T_estimated"), masked("points", mask="mask")
    ),
    "k_nearest": Kernel(
        lambda queries, points, mask: dpmjax.k_nearest(queries, points, 3, mask),
        with_masks("queries", "points", mask="mask"),
        ("queries", "points"),
        masked("points", mask="mask"),
    ),
    "radius_search": Kernel(
        lambda queries, points, mask: dpmjax.radius_search(queries, points, 0.8, 3, mask),
        with_masks("queries", "points", mask="mask"),
        ("queries", "points"),
        masked("points", mask="mask"),
    ),
    "farthest_point_sample": Kernel(
        lambda points, mask: dpmjax.farthest_point_sample(points, 6, mask),
        with_masks("points", mask="mask"),
        padding=masked("points", mask="mask"),
    ),
    "voxel_sample": Kernel(
        lambda points, mask: dpmjax.voxel_sample(points, 0.7, mask),
        with_masks("points", mask="mask"),
        padding=masked("points", mask="mask"),
    ),
    "estimate_normals": Kernel(
        lambda points, mask: dpmjax.estimate_normals(points, 5, mask),
        with_masks("points", mask="mask"),
        padding=masked("points", mask="mask"),
    ),
    "sample_free_space": Kernel(dpmjax.sample_free_space, beams, ("origin", "points", "factors")),
    "build_pyramid": Kernel(
        lambda points, mask: geometry.build_pyramid(points, mask, toy.MODEL.pyramid).levels[1:],
        scan,
        padding=masked("points", mask="mask"),
    ),
    "find_consensus": Kernel(
        geometry.find_consensus,
        with_masks("source", "target", mask="mask"),
        padding=masked("source", "target", mask="mask"),
    ),
    "info_nce": Kernel(
        contrast_of,
        contrast,
        ("queries", "keys"),
        {"positives": 0} | masked("queries", "keys", query="is_query", key="is_key"),
    ),
    "chamfer_distance": Kernel(
        dpmjax.chamfer_distance,
        with_masks("a", "b", mask_a="mask_a", mask_b="mask_b"),
        ("a", "b"),
        masked("a", "b", mask_a="mask_a", mask_b="mask_b"),
    ),
    "occupancy_loss": Kernel(
        dpmjax.occupancy_loss, samples, ("logits", "labels"), masked("logits", "labels") | {"weights": 0.0}
    ),
    "offset_loss": Kernel(
        losses.offset_loss,
        with_masks("predicted", "true", mask="mask"),
        padding=masked("predicted", "true", mask="mask"),
        by=("predicted",),
        is_exact=False,  # the covariance is held constant
    ),
    "icp to points": Kernel(
        partial(dpmjax.icp, metric="point"),
        moved_clouds(2),
        ("source", "target"),
        masked("source", "target", **BOTH),
        is_exact=False,  # a test of its own
    ),
    "icp to planes": Kernel(
        partial(dpmjax.icp, metric="plane"),
        moved_clouds(3),
        ("source",),
        masked("source", "target", **BOTH),
        is_exact=False,
    ),
    "encode_pyramid": Kernel(encode, scan, ("points",), masked("points", mask="mask"), is_exact=False),
    "correlate": Kernel(correlate, descriptors, ("a", "b"), CLOUDS, is_exact=False),
    "match_hypotheses": Kernel(match, descriptors, ("a", "b", "at_a", "at_b"), CLOUDS),
    "step": Kernel(step_toy, seeds, ("x",), is_exact=False),
    "solve": Kernel(lambda seed, x: solve_toy(seed), seeds),
}
# These compile for seconds.
SLOW = ("encode_pyramid", "find_consensus", "icp to planes", "icp to points", "match_hypotheses", "solve")


def each(kernels: dict[str, Kernel]) -> pytest.MarkDecorator:
    """Runs a test for each of some kernels."""
    marks = {name: (pytest.mark.slow,) if name in SLOW else () for name in kernels}
    rows = [pytest.param(kernel, id=name, marks=marks[name]) for name, kernel in kernels.items()]
    return pytest.mark.parametrize("kernel", rows)


WITH_MASKS = {name: kernel for name, kernel in KERNELS.items() if kernel.padding}
WITH_GRADIENT = {name: kernel for name, kernel in KERNELS.items() if kernel.by}


def example(kernel: Kernel, seed: int = 0, dtype: Any = None) -> Arrays:
    arrays = kernel.make(np.random.default_rng(seed))
    return {name: jnp.asarray(value, dtype if value.dtype.kind == "f" else None) for name, value in arrays.items()}


def padded(kernel: Kernel, arrays: Arrays) -> Arrays:
    def pad(value: Any, filler: Any) -> Any:
        return jnp.concatenate([value, jnp.full((EXTRA, *value.shape[1:]), filler, value.dtype)])

    return {
        name: pad(value, kernel.padding[name]) if name in kernel.padding else value for name, value in arrays.items()
    }


def assert_close(found: Any, expected: Any) -> None:
    """The same leaves; rows of padding are left out."""
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        np.testing.assert_allclose(x[tuple(map(slice, y.shape))], y, **CLOSE)


@each(KERNELS)
def test_jit_and_vmap_are_the_call(kernel: Kernel, assert_compiles_nothing) -> None:
    examples = [example(kernel, seed) for seed in (0, 1)]
    compiled = jax.jit(lambda arrays: kernel.call(**arrays))
    expected = [kernel.call(**arrays) for arrays in examples]
    assert_close(compiled(examples[0]), expected[0])
    with assert_compiles_nothing():
        second = compiled(examples[1])
    assert_close(second, expected[1])
    together = jax.jit(jax.vmap(lambda arrays: kernel.call(**arrays)))(jax.tree.map(lambda *x: jnp.stack(x), *examples))
    for row in (0, 1):
        assert_close(jax.tree.map(lambda leaf, row=row: leaf[row], together), expected[row])


@each(WITH_MASKS)
def test_padding_changes_nothing(kernel: Kernel) -> None:
    arrays = example(kernel)
    assert_close(jax.jit(lambda arrays: kernel.call(**arrays))(padded(kernel, arrays)), kernel.call(**arrays))


@pytest.mark.parametrize("name", ["weighted_svd", "estimate_normals", "info_nce", "icp to planes"])
def test_half_precision_is_computed_in_float32(name: str) -> None:
    kernel = KERNELS[name]
    half = example(kernel, dtype=jnp.bfloat16)
    rounded = {name: jnp.asarray(value, example(kernel)[name].dtype) for name, value in half.items()}
    assert_close(kernel.call(**half), kernel.call(**rounded))


def total(kernel: Kernel, arrays: Arrays) -> Any:
    """A weighted sum of all numbers that a kernel returns."""
    leaves = map(jnp.asarray, jax.tree.leaves(kernel.call(**arrays)))
    leaves = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    leaves = [jnp.where(jnp.isfinite(leaf), leaf, 0.0).ravel() for leaf in leaves]
    return sum(jnp.sum(jnp.cos(jnp.arange(leaf.size)) * leaf) for leaf in leaves)


@each(WITH_GRADIENT)
def test_gradients_are_finite_next_to_padding(kernel: Kernel) -> None:
    arrays = padded(kernel, example(kernel))
    gradients = jax.jit(jax.grad(lambda moving: total(kernel, arrays | moving)))({by: arrays[by] for by in kernel.by})
    for name, gradient in gradients.items():
        assert np.isfinite(gradient).all(), name
        assert np.any(np.asarray(gradient) != 0), name
        if name in kernel.padding:
            np.testing.assert_array_equal(gradient[-EXTRA:], 0)


@each({name: kernel for name, kernel in WITH_GRADIENT.items() if kernel.is_exact})
def test_gradients_are_those_of_differences(kernel: Kernel, float64) -> None:
    arrays = example(kernel, dtype=np.float64)
    here = {by: arrays[by] for by in kernel.by}
    rng, width = np.random.default_rng(2), 1e-4
    along = {name: jnp.asarray(rng.normal(size=value.shape)) for name, value in here.items()}
    function = jax.jit(lambda moving: total(kernel, arrays | moving))
    _, slope = jax.jvp(function, (here,), (along,))
    ends = [function(jax.tree.map(lambda x, d, t=t: x + t * d, here, along)) for t in (width, -width)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * width), rtol=2e-3, atol=2e-3)


def test_degenerate_trajectories_have_an_error_and_a_gradient() -> None:
    line, every = jnp.linspace(0.0, 4.0, 5)[:, None] * jnp.asarray([1.0, 2.0, -1.0]), jnp.ones(5, bool)
    error = jax.jit(jax.value_and_grad(dpmjax.absolute_trajectory_error))
    for path, mask in ((line, every), (jnp.ones((5, 3)), every), (line, jnp.arange(5) == 2), (line, ~every)):
        value, gradient = error(path, path + 3.0, mask)
        assert float(value) == pytest.approx(0.0, abs=1e-5)
        assert np.isfinite(gradient).all()


@pytest.mark.slow
@pytest.mark.parametrize(("metric", "dim"), [("point", 2), ("plane", 3)])
def test_gradient_of_icp_is_that_of_its_solution(metric: str, dim: int, float64) -> None:
    arrays = {name: jnp.asarray(x, float) for name, x in moved_clouds(dim)(np.random.default_rng(3)).items()}
    source, target = arrays["source"], arrays["target"]

    def solution(source: Any) -> Any:
        T = None
        for _ in range(25):  # each call goes on from the last one, beyond its millionth of the cloud
            T = dpmjax.icp(source, target, metric, T).T_target_source
        return T

    along, width = jnp.asarray(np.random.default_rng(4).normal(size=source.shape)), 1e-5
    T = solution(source)
    _, slope = jax.jvp(lambda source: dpmjax.icp(source, target, metric, T).T_target_source, (source,), (along,))
    ends = [solution(source + step * along) for step in (width, -width)]
    difference = (ends[0] - ends[1]) / (2 * width)
    assert np.abs(difference).max() > 1e-2
    np.testing.assert_allclose(slope, difference, rtol=1e-3, atol=1e-4)
