from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.geometry import pyramid as pyramid_host
from dpmjax.geometry.pyramid import (
    PyramidConfig,
    PyramidStage,
    build_pyramid,
    build_pyramid_on_host,
    farthest_points_on_host,
)
from dpmjax.types import PointPyramid
from tests.tolerances import ACCUMULATED, ROUNDING

CONFIG = PyramidConfig(
    stages=(
        PyramidStage(64, (0.3, 0.6), 8),
        PyramidStage(24, (0.6, 1.2, 0.9), 8),
        PyramidStage(6, (1.2, 2.4), 4),
    ),
    num_interpolations=2,
)
DATA = Path(os.environ.get("DPMJAX_DATA", Path(__file__).parents[3] / "shared" / "data"))


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


CASES = pytest.mark.parametrize(
    "case",
    ["random", "farthest first", "masked", "duplicates", "all in one place", "too few", "two", "one", "none"],
)


@CASES
def test_both_builders_agree(case: str) -> None:
    ours, host = both(*masked_case(case))
    for left, right in zip(jax.tree.leaves(ours), jax.tree.leaves(host), strict=True):
        assert left.dtype == right.dtype
        assert left.shape == right.shape
        if left.dtype.kind == "f":
            np.testing.assert_allclose(left, right, **ACCUMULATED)
        else:
            np.testing.assert_array_equal(left, right)


def neighbours_in_numpy(
    queries: np.ndarray, points: np.ndarray, mask: np.ndarray, k: int, radius: float
) -> list[list[int]]:
    distances = np.linalg.norm(queries[:, None].astype(np.float64) - points, axis=-1)
    distances[:, ~mask] = np.inf
    rows = []
    for distance in distances:
        near = [int(i) for i in np.argsort(distance, kind="stable")[:k] if distance[i] <= radius]
        near = near or [int(np.argmin(distance))]
        rows.append(near + [near[0]] * (k - len(near)))
    return rows


@pytest.mark.parametrize("builder", [build_pyramid, build_pyramid_on_host])
def test_levels_are_those_of_numpy(builder) -> None:
    points, mask = cloud(3), np.random.default_rng(3).random(300) < 0.8
    pyramid = jax.device_get(builder(points, mask, CONFIG))
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
            searched = level if block else before
            expected = neighbours_in_numpy(
                level.positions, searched.positions, searched.mask, stage.num_neighbours, radius
            )
            np.testing.assert_array_equal(level.neighbours[block], expected)


@pytest.mark.parametrize("builder", [build_pyramid, build_pyramid_on_host])
def test_interpolation_is_linear_in_inverse_squared_distance(builder) -> None:
    pyramid = jax.device_get(builder(cloud(4), None, CONFIG))
    for step, interpolation in enumerate(pyramid.interpolation):
        fine, coarse = pyramid.levels[-2 - step], pyramid.levels[-1 - step]
        distances = np.linalg.norm(fine.positions[:, None].astype(np.float64) - coarse.positions, axis=-1)
        np.testing.assert_array_equal(interpolation.indices, np.argsort(distances, axis=1)[:, :3])
        inverse = 1 / (np.sort(distances, axis=1)[:, :3] ** 2 + 1e-8)
        np.testing.assert_allclose(interpolation.weights, inverse / inverse.sum(axis=1, keepdims=True), **ROUNDING)


def test_padded_equals_unpadded() -> None:
    points = cloud(5)
    padded = np.concatenate([points, np.full((84, 3), np.nan, np.float32)])
    small = jax.device_get(build_pyramid(points, None, CONFIG))
    large = jax.device_get(build_pyramid(padded, np.arange(384) < 300, CONFIG))
    jax.tree.map(np.testing.assert_array_equal, small.levels[1:], large.levels[1:])
    jax.tree.map(np.testing.assert_array_equal, small.interpolation, large.interpolation)


def test_masked_points_are_nobodys_neighbours() -> None:
    points, mask = masked_case("masked")
    first = jax.device_get(build_pyramid(points, mask, CONFIG)).levels[1]
    assert mask[first.neighbours[0]].all()
    assert mask[first.sample_indices].all()
    assert np.isfinite(first.positions).all()


def test_vmap_equals_a_loop() -> None:
    clouds = jnp.stack([cloud(seed) for seed in range(3)])
    masks = jnp.stack([jnp.arange(300) < n for n in (300, 100, 5)])
    batched = jax.vmap(lambda p, m: build_pyramid(p, m, CONFIG))(clouds, masks)
    for i in range(3):
        one = jax.device_get(build_pyramid(clouds[i], masks[i], CONFIG))
        many = jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], batched)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **ROUNDING), one, many)


@pytest.mark.parametrize("case", ["random", "two", "none"])
def test_gradient_is_finite(case: str) -> None:
    points, mask = masked_case(case)

    def loss(points: jax.Array) -> jax.Array:
        pyramid = build_pyramid(points, mask, CONFIG)
        floats = [leaf for leaf in jax.tree.leaves(pyramid) if leaf.dtype == jnp.float32]
        return sum(jnp.sum(leaf**2) for leaf in floats)

    assert np.isfinite(jax.grad(loss)(jnp.asarray(points))).all()


@pytest.mark.parametrize("num_samples", [1, 50, 299, 300])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_buckets_choose_what_the_kernel_chooses(num_samples: int, seed: int) -> None:
    points = farthest_first(cloud(seed))
    chosen = pyramid_host._sample_by_buckets(points, num_samples)
    expected = farthest_points_on_host(points[:, ::-1] if num_samples == 1 else points, np.ones(300, bool), num_samples)
    if chosen is not None:
        np.testing.assert_array_equal(chosen, expected)
    assert (chosen is None) == (num_samples == 1)


def test_without_the_bucket_package_the_result_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    points = farthest_first(cloud(6))
    expected = build_pyramid_on_host(points, None, CONFIG)
    monkeypatch.setitem(__import__("sys").modules, "fpsample", None)
    assert pyramid_host._sample_by_buckets(points, 10) is None
    jax.tree.map(np.testing.assert_array_equal, build_pyramid_on_host(points, None, CONFIG), expected)


@pytest.mark.skipif(not (DATA / "lidar_3d").is_dir(), reason="real scans: set DPMJAX_DATA to their folder")
@pytest.mark.parametrize("sequence", ["kitti_07", "mulran_kaist03", "hilti_room"])
def test_both_builders_agree_on_real_scans(sequence: str) -> None:
    path = sorted((DATA / "lidar_3d" / sequence / "velodyne").glob("*.bin"))[0]
    points = np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]
    points = farthest_first(points[np.linspace(0, len(points) - 1, 2048).astype(int)] / np.float32(60))
    config = dataclasses.replace(
        CONFIG, stages=(PyramidStage(512, (0.05, 0.1), 16), PyramidStage(128, (0.2, 0.4), 16), CONFIG.stages[2])
    )
    ours, host = both(points, None, config)
    for level, other in zip(ours.levels[1:], host.levels[1:], strict=True):
        np.testing.assert_array_equal(level.sample_indices, other.sample_indices)
    for before, level, other in zip(ours.levels, ours.levels[1:], host.levels[1:], strict=False):
        for block in range(len(level.neighbours)):
            searched = (level if block else before).positions.astype(np.float64)
            distances = [
                np.linalg.norm(searched[rows] - level.positions[:, None], axis=-1)
                for rows in (level.neighbours[block], other.neighbours[block])
            ]
            # Equally near ones may come in the other order.
            np.testing.assert_allclose(*distances, **ROUNDING)
            assert np.mean(level.neighbours[block] == other.neighbours[block]) > 0.99


def test_second_call_compiles_nothing(assert_compiles_nothing) -> None:
    build_pyramid(cloud(7), None, CONFIG)
    build_pyramid_on_host(cloud(7), None, CONFIG)
    with assert_compiles_nothing():
        build_pyramid(cloud(8), None, CONFIG)
        build_pyramid_on_host(cloud(8), np.arange(300) < 200, CONFIG)


def test_wrong_arguments_are_named(as_user) -> None:
    with pytest.raises(ValueError, match="^points: expected shape"):
        build_pyramid(np.ones((4, 2), np.float32), None, CONFIG)
    with pytest.raises(ValueError, match="^points: expected at least one"):
        build_pyramid(np.ones((0, 3), np.float32), None, CONFIG)
    for bad in (np.ones((4, 2), np.float32), np.ones((0, 3), np.float32)):
        with pytest.raises(ValueError, match="^points: expected shape"):
            build_pyramid_on_host(bad, None, CONFIG)
    with pytest.raises(ValueError, match="^mask: expected bool"):
        build_pyramid_on_host(cloud(0), np.ones(3, bool), CONFIG)
    with pytest.raises(ValueError, match="^num_threads: expected at least 1"):
        build_pyramid_on_host(cloud(0), None, CONFIG, num_threads=0)
    with pytest.raises(ValueError, match="^stages: expected no stage"):
        PyramidConfig(stages=CONFIG.stages[::-1])
    with pytest.raises(ValueError, match="^num_interpolations: expected"):
        PyramidConfig(num_interpolations=5)
