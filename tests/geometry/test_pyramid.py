import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.geometry import pyramid as pyramid_host
from dpmjax.geometry.pyramid import PyramidConfig, PyramidStage, build_pyramid, build_pyramid_on_host
from dpmjax.types import PointPyramid
from tests.tolerances import ACCUMULATED, ROUNDING

STAGES = PyramidStage(64, (0.3, 0.6), 8), PyramidStage(24, (0.6, 1.2, 0.9), 8), PyramidStage(6, (1.2, 2.4), 4)
CONFIG = PyramidConfig(STAGES, num_interpolations=2)


def cloud(seed: int, n: int = 300) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 3)).astype(np.float32)


def farthest_first(points: np.ndarray) -> np.ndarray:
    points = points.copy()
    row = int(np.argmax(np.sum(points.astype(np.float64) ** 2, axis=1)))
    points[[0, row]] = points[[row, 0]]
    return points


def both(points: np.ndarray, mask: np.ndarray | None, config: PyramidConfig = CONFIG) -> tuple[PointPyramid, ...]:
    return jax.device_get(build_pyramid(points, mask, config)), build_pyramid_on_host(points, mask, config)


def masked_case(name: str) -> tuple[np.ndarray, np.ndarray]:
    points, rng = cloud(1), np.random.default_rng(2)
    if name == "random":
        return points, np.ones(300, bool)
    if name == "farthest first":
        return farthest_first(points), np.ones(300, bool)
    if name == "masked":
        mask = rng.random(300) < 0.6
        return np.where(mask[:, None], points, np.nan).astype(np.float32), mask
    if name == "duplicates":
        return np.concatenate([points[:40]] * 7 + [points[:20]]), np.ones(300, bool)
    if name == "all in one place":
        return np.ones((300, 3), np.float32), np.ones(300, bool)
    return points, np.arange(300) < {"too few": 30, "two": 2, "one": 1, "none": 0}[name]


@pytest.mark.parametrize(
    "case", ["random", "farthest first", "masked", "duplicates", "all in one place", "too few", "two", "one", "none"]
)
def test_both_builders_agree(case: str) -> None:
    ours, host = both(*masked_case(case))
    for left, right in zip(jax.tree.leaves(ours), jax.tree.leaves(host), strict=True):
        assert left.dtype == right.dtype
        assert left.shape == right.shape
        if left.dtype.kind == "f":
            np.testing.assert_allclose(left, right, **ACCUMULATED)
        else:
            np.testing.assert_array_equal(left, right)


def neighbours_in_numpy(queries, points, mask, k: int, radius: float) -> list[list[int]]:
    distances = np.linalg.norm(queries[:, None].astype(np.float64) - points, axis=-1)
    distances[:, ~mask] = np.inf
    rows = []
    for distance in distances:
        near = [int(i) for i in np.argsort(distance, kind="stable")[:k] if distance[i] <= radius]
        near = near or [int(np.argmin(distance))]
        rows.append(near + [near[0]] * (k - len(near)))
    return rows


def test_levels_are_those_of_numpy() -> None:
    points, mask = cloud(3), np.random.default_rng(3).random(300) < 0.8
    pyramid = build_pyramid_on_host(points, mask, CONFIG)
    assert len(pyramid.levels) == len(CONFIG.stages) + 1
    for before, level, stage in zip(pyramid.levels, pyramid.levels[1:], CONFIG.stages, strict=False):
        np.testing.assert_array_equal(level.positions, before.positions[level.sample_indices])
        assert level.mask.all()
        # Each the farthest from all before it, on this level as on the first.
        for count in range(1, stage.num_points):
            distances = np.linalg.norm(before.positions[:, None] - level.positions[:count], axis=-1).min(axis=1)
            farthest = np.where(before.mask, distances, -1).max()
            np.testing.assert_allclose(distances[level.sample_indices[count]], farthest, **ROUNDING)
        for block, radius in enumerate(stage.radii):
            near = level if block else before
            expected = neighbours_in_numpy(level.positions, near.positions, near.mask, stage.num_neighbours, radius)
            np.testing.assert_array_equal(level.neighbours[block], expected)


def test_interpolation_is_linear_in_inverse_squared_distance() -> None:
    pyramid = build_pyramid_on_host(cloud(4), None, CONFIG)
    for step, interpolation in enumerate(pyramid.interpolation):
        fine, coarse = pyramid.levels[-2 - step], pyramid.levels[-1 - step]
        distances = np.linalg.norm(fine.positions[:, None].astype(np.float64) - coarse.positions, axis=-1)
        np.testing.assert_array_equal(interpolation.indices, np.argsort(distances, axis=1)[:, :3])
        inverse = 1 / (np.sort(distances, axis=1)[:, :3] ** 2 + 1e-8)
        np.testing.assert_allclose(interpolation.weights, inverse / inverse.sum(axis=1, keepdims=True), **ROUNDING)


@pytest.mark.parametrize("case", ["random", "two", "none"])
def test_gradient_is_finite(case: str) -> None:
    points, mask = masked_case(case)

    def loss(points: jax.Array) -> jax.Array:
        pyramid = build_pyramid(points, mask, CONFIG)
        floats = [leaf for leaf in jax.tree.leaves(pyramid) if leaf.dtype == jnp.float32]
        return sum(jnp.sum(leaf**2) for leaf in floats)

    assert np.isfinite(jax.grad(loss)(jnp.asarray(points))).all()


def test_without_buckets_the_result_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    points = farthest_first(cloud(6))
    expected = build_pyramid_on_host(points, None, CONFIG)
    monkeypatch.setattr(pyramid_host, "_sample_by_buckets", lambda *_: None)
    jax.tree.map(np.testing.assert_array_equal, build_pyramid_on_host(points, None, CONFIG), expected)
