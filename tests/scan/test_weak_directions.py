"""The covariance of an alignment against the scatter of alignments with other noise."""

from __future__ import annotations

import numpy as np

from dpmjax.scan.lidar.pairs import Pairs
from dpmjax.scan.lidar.slide import (
    CUBE_M,
    SCATTER_FACTOR,
    UNKNOWN,
    plane_information,
    scattered_information,
    sigma_along,
)

IDENTITY = np.eye(4)


def pairs_of(points: np.ndarray, residuals: np.ndarray, normals: np.ndarray) -> Pairs:
    ones = np.ones(len(points))
    return Pairs(ones > 0, points, residuals, normals, ones, ones)


def walls(rng: np.random.Generator, num: int = 1500) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of the walls and the floor of a hall, 60 by 40 by 8 m."""
    axis = rng.integers(0, 3, num)
    points = rng.uniform(-1, 1, (num, 3)) * [30.0, 20.0, 4.0]
    side = np.where(axis == 2, -1.0, rng.choice([-1.0, 1.0], num))
    points[np.arange(num), axis] = side * np.array([30.0, 20.0, 4.0])[axis]
    return points, np.eye(3)[axis]


def test_sigma_covers_alignments_whose_cubes_disagree() -> None:
    rng = np.random.default_rng(0)
    points, normals = walls(rng)
    cubes = np.unique(np.floor(points / CUBE_M), axis=0, return_inverse=True)[1].ravel()
    jacobian = np.concatenate([normals, np.cross(points, normals)], axis=1)
    errors, variances, before = [], [], []
    for _ in range(300):
        residuals = rng.normal(0, 0.05, cubes.max() + 1)[cubes] + rng.normal(0, 0.01, len(points))
        step = np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
        pairs = pairs_of(points, residuals - jacobian @ step, normals)
        before.append(np.linalg.inv(plane_information(pairs, IDENTITY))[0, 0])
        variances.append(sigma_along(scattered_information(pairs, IDENTITY), np.array([1.0, 0, 0])) ** 2 - before[-1])
        errors.append(step[0])
    assert np.sqrt(np.mean(before)) < np.std(errors)
    # The fitted motion absorbs a share of the scatter of the cubes, so that it is a few percent too small.
    np.testing.assert_allclose(np.sqrt(np.mean(variances)), SCATTER_FACTOR * np.std(errors), rtol=0.2)


def test_one_cube_alone_is_as_uncertain_as_its_planes() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(0, CUBE_M, (200, 3))
    normals = np.tile([1.0, 0, 0], (200, 1))
    jacobian = np.concatenate([normals, np.cross(points, normals)], axis=1)
    noise = rng.uniform(-0.02, 0.02, 200)
    pairs = pairs_of(points, noise - jacobian @ np.linalg.lstsq(jacobian, noise, rcond=None)[0], normals)
    by_planes, scattered = plane_information(pairs, IDENTITY), scattered_information(pairs, IDENTITY)
    sigmas = [sigma_along(information, np.array([1.0, 0, 0])) for information in (scattered, by_planes)]
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=1e-4)


def test_few_pairs_have_no_more_information_than_they_have() -> None:
    """Independent pairs on three walls: the sigma is that of their noise, until pairs are discounted as correlated."""
    rng = np.random.default_rng(2)
    for num in (30, 150):
        points, normals = rng.normal(0, 10.0, (num, 3)), np.eye(3)[np.arange(num) % 3]
        pairs = pairs_of(points, np.full(num, 0.05) * rng.choice([-1, 1], num), normals)
        jacobian = np.concatenate([normals, np.cross(points, normals)], axis=1) / 0.05
        np.testing.assert_allclose(
            plane_information(pairs, IDENTITY), jacobian.T @ jacobian + UNKNOWN, rtol=1e-6, atol=1
        )


def test_few_planes_constrain_nothing() -> None:
    pairs = pairs_of(np.ones((5, 3)), np.zeros(5), np.eye(3)[[0, 1, 2, 0, 1]])
    np.testing.assert_allclose(plane_information(pairs, IDENTITY), UNKNOWN)
    np.testing.assert_allclose(scattered_information(pairs, IDENTITY), UNKNOWN)
