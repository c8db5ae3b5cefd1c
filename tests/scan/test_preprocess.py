from __future__ import annotations

import warnings
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dpmjax.geometry.neighbours import HostTree
from dpmjax.scan import PreprocessConfig, preprocess_scan_on_host
from dpmjax.scan.lidar.preprocess import NUM_SPACED, OUTLIER_SIGMAS, TABLE_BITS, find_inliers, first_of_each_voxel
from tests.scan.surface_scenes import street

CONFIG = PreprocessConfig(max_range_m=30.0, num_outlier_neighbours=5, capacity=512)


def scan(seed: int, n: int = 1000, spread: float = 10.0) -> np.ndarray:
    return (spread * np.random.default_rng(seed).normal(size=(n, 3))).astype(np.float32)


def preprocessed_in_numpy(points: np.ndarray, config: PreprocessConfig) -> np.ndarray:
    ranges = np.linalg.norm(points.astype(np.float64), axis=1)
    kept, voxels = [], set()
    for point, distance in zip(points, ranges, strict=True):
        voxel = tuple(np.floor(point / np.float32(config.voxel_size_m)).astype(int))
        if config.min_range_m <= distance <= config.max_range_m and voxel not in voxels:
            kept.append(point)
            voxels.add(voxel)
    if len(kept) > config.capacity:
        kept = [kept[slot * len(kept) // config.capacity] for slot in range(config.capacity)]
    kept = np.array(kept)
    distances = np.sort(np.linalg.norm(kept[:, None].astype(np.float64) - kept, axis=-1), axis=1)
    spread = distances[:, 1 : config.num_outlier_neighbours + 1].mean(axis=1)
    kept = kept[spread <= spread.mean() + OUTLIER_SIGMAS * spread.std()]
    farthest = int(np.argmax(np.linalg.norm(kept, axis=1)))
    kept[[0, farthest]] = kept[[farthest, 0]]
    return kept


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("voxel_size", [0.3, 4.0])
def test_kept_points_are_those_of_numpy(seed: int, voxel_size: float) -> None:
    config = replace(CONFIG, voxel_size_m=voxel_size)
    cloud = preprocess_scan_on_host(scan(seed), None, config)
    expected = preprocessed_in_numpy(scan(seed), config)
    assert 100 < len(expected) < 512
    np.testing.assert_array_equal(cloud.mask, np.arange(512) < len(expected))
    np.testing.assert_array_equal(cloud.points[cloud.mask], expected)
    assert (cloud.points[~cloud.mask] == 0).all()


@pytest.mark.parametrize("case", ["masked", "not finite", "one", "none", "duplicates", "grid", "too near"])
def test_points_that_are_not_there_do_not_count(case: str) -> None:
    points, mask = scan(2), np.random.default_rng(3).random(1000) < 0.7
    if case == "not finite":
        points = np.where(mask[:, None], points, np.array([np.nan, np.inf, 1], np.float32))
    elif case in ("one", "none"):
        mask = np.arange(1000) < {"one": 1, "none": 0}[case]
        points[0] = [3, 4, 0]
    elif case == "duplicates":
        points = np.repeat(points[:100], 10, axis=0)
    elif case == "grid":
        points = np.stack(np.meshgrid(*[np.arange(1, 11, dtype=np.float32)] * 3), axis=-1).reshape(-1, 3)
    elif case == "too near":
        points = points / 1000
    with pytest.warns(UserWarning, match="in metres") if case == "too near" else nullcontext():
        host = preprocess_scan_on_host(points, mask, CONFIG)
    assert (host.points[~host.mask] == 0).all()
    if case in ("one", "none", "too near"):
        assert host.mask.sum() == (case == "one")
    else:
        np.testing.assert_array_equal(host.points[host.mask], preprocessed_in_numpy(points[mask], CONFIG))


@pytest.mark.parametrize("seed", range(3))
def test_outliers_of_a_large_scan_are_those_of_all_neighbours(seed: int) -> None:
    """Neighbours of few points are searched, so only points near the limit may differ from the full search."""
    lonely = np.random.default_rng(seed).uniform(-60, 60, (60, 3))
    points = np.concatenate([street(seed, 8000), lonely])
    assert len(points) > 4 * NUM_SPACED
    spread = cKDTree(points).query(points, 11)[0][:, 1:].mean(axis=1)
    limit = spread.mean() + OUTLIER_SIGMAS * spread.std()
    is_inlier = find_inliers(HostTree(points), 10)
    assert 20 < (~is_inlier).sum() < 200
    is_clear = np.abs(spread / limit - 1) > 0.03
    np.testing.assert_array_equal(is_inlier[is_clear], (spread <= limit)[is_clear])


# The bounding box of the second cloud has nearly 2^63 voxels.
@pytest.mark.parametrize("farthest", [20.0, 9e5])
def test_the_first_point_of_each_voxel_is_kept(farthest: float) -> None:
    points = np.random.default_rng(5).integers(-3, 3, (1000, 3)) + np.float32(0.25)
    points[[0, 700]] = farthest
    points[1] = -farthest
    seen: dict[tuple[float, ...], int] = {}
    for row, point in enumerate(np.floor(points)):
        seen.setdefault(tuple(point), row)
    np.testing.assert_array_equal(first_of_each_voxel(points, 1.0), sorted(seen.values()))


def test_first_points_are_found_where_many_voxels_share_a_slot_of_the_table() -> None:
    points = np.random.default_rng(0).uniform(-50, 50, (600_000, 3)).astype(np.float32)
    first = np.unique(np.floor(points), axis=0, return_index=True)[1]
    assert len(first) > 1 << TABLE_BITS
    np.testing.assert_array_equal(first_of_each_voxel(points, 1.0), np.sort(first))


def test_a_scan_in_millimetres_is_warned_of_once() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for seed in (2, 3):
            assert preprocess_scan_on_host(1000 * scan(seed), None, CONFIG).mask.sum() < 5
    assert [str(warning.message) for warning in caught] == [
        "hardly any point of the scan is 1 to 30 m from the lidar: is it in metres?"
    ]


def test_wrong_arguments_are_named(as_user) -> None:
    with pytest.raises(ValueError, match="^points: expected shape"):
        preprocess_scan_on_host(np.ones((5, 4), np.float32), None, CONFIG)
    with pytest.raises(ValueError, match="^mask: expected"):
        preprocess_scan_on_host(scan(0), np.ones(5, bool), CONFIG)


@pytest.mark.parametrize(
    ("name", "value"),
    [("min_range_m", 90.0), ("voxel_size_m", 1e-6), ("capacity", 0), ("capacity", 1 << 16)],
)
def test_settings_out_of_range_are_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        PreprocessConfig(**{name: value})
