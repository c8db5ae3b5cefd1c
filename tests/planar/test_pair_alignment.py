from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.scan import PlanarScans
from dpmjax.scan.planar.align import FINE, PairPrior, linearise_pair, match_pairs
from dpmjax.scan.planar.record import Lines

GATE, KERNEL = 20.0, 4.0


def residuals(source: Lines, target: Lines, pose: np.ndarray, nearest: np.ndarray, metric: str) -> np.ndarray:
    """Slow float64 distances of fixed pairs, (b, k)."""
    points = se2.transform_points(pose[None], np.asarray(source.points, np.float64)[None])[0]
    if metric == "point":
        return points - np.asarray(target.points, np.float64)[nearest]
    normals, centroids = (np.asarray(x, np.float64)[nearest] for x in (target.normals, target.centroids))
    return ((points - centroids) * normals).sum(-1, keepdims=True)


@pytest.mark.parametrize("metric", ["point", "plane"])
def test_system_is_that_of_finite_differences(walk, walk_scans, metric: str) -> None:
    source, target = (walk_scans.lines(row) for row in (1, 0))
    pose = se2.relative(walk.reference_poses[0], walk.reference_poses[1]) + np.array([1.0, -0.7, 0.02])
    with jax.default_matmul_precision("highest"):
        system = linearise_pair(
            Lines(*map(jnp.asarray, source)),
            Lines(*map(jnp.asarray, target)),
            jnp.asarray(pose, jnp.float32),
            jnp.asarray([GATE, KERNEL]),
            metric=metric,
        )
    moved = se2.transform_points(pose[None], np.asarray(source.points, np.float64)[None])[0]
    apart = np.linalg.norm(moved[:, None] - np.asarray(target.points, np.float64), axis=-1)
    apart[:, ~np.asarray(target.mask)] = np.inf
    nearest = apart.argmin(-1)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turned = np.asarray(source.normals, np.float64) @ np.array([[c, s], [-s, c]])
    facing = (turned * np.asarray(target.normals)[nearest]).sum(-1) > 0.7
    counts = np.asarray(source.mask) & (apart.min(-1) < GATE) & facing
    here = residuals(source, target, pose, nearest, metric)
    step = 1e-6
    jacobian = np.stack(
        [
            (
                residuals(source, target, se2.compose(pose, delta), nearest, metric)
                - residuals(source, target, se2.compose(pose, -delta), nearest, metric)
            )
            / (2 * step)
            for delta in step * np.eye(3)
        ],
        axis=-1,
    )
    weight = counts * (KERNEL**2 / (KERNEL**2 + (here**2).sum(-1))) ** 2
    size = np.sqrt(np.einsum("b,bki,bki->i", weight, jacobian, jacobian))
    information = np.einsum("b,bki,bkj->ij", weight, jacobian, jacobian) / np.outer(size, size)
    gradient = np.einsum("b,bki,bk->i", weight, jacobian, here) / size
    np.testing.assert_allclose(np.asarray(system.information) / np.outer(size, size), information, atol=2e-3)
    np.testing.assert_allclose(np.asarray(system.gradient) / size, gradient, atol=2e-2)
    assert float(system.weight) == pytest.approx(weight.sum(), rel=2e-3)


def corridor(shift: float) -> PlanarScans:
    """Two parallel walls, seen from `shift` along them."""
    x = np.tile(np.linspace(-50, 50, 60), 2)
    y = np.repeat([-10.0, 10.0], 60)
    points = np.stack([x - shift, y], -1).astype(np.float32)[None]
    normals = np.stack([0 * x, -np.sign(y)], -1).astype(np.float32)[None]
    mask = np.ones((1, 120), bool)
    return PlanarScans(points, mask, normals, points, mask, noise=0.0, typical_range=133.0)


def test_prior_decides_along_a_corridor_and_the_walls_across_it() -> None:
    guess = np.array([[[0.0, 1.0, 0.02]]])

    def aligned(information: float) -> np.ndarray:
        prior = PairPrior(np.array([[7.0, 3.0, 0.1]]), np.full((1, 3), information))
        return match_pairs(corridor(7.0), corridor(0.0), guess, FINE, prior).poses[0]

    with_prior, without = aligned(1.0), aligned(0.0)
    np.testing.assert_allclose(with_prior, [7.0, 0.0, 0.0], atol=5e-2)
    np.testing.assert_allclose(without, [0.0, 0.0, 0.0], atol=5e-2)


def test_pairs_are_aligned_from_the_best_guess_pixels_away(walk, walk_scans) -> None:
    true = se2.relative(walk.reference_poses[:-1], walk.reference_poses[1:])
    near = true + np.random.default_rng(0).normal(size=true.shape) * [3.0, 3.0, 0.03]
    guesses = np.stack([true + np.array([80.0, 0.0, 2.0]), near, true - np.array([0.0, 90.0, 2.0])], axis=1)
    found = match_pairs(walk_scans.take(slice(1, None)), walk_scans.take(slice(len(true))), guesses, FINE)
    error = se2.relative(true, found.poses)
    assert np.median(np.hypot(error[:, 0], error[:, 1])) < 0.01
    assert (found.fitness > 0.3).all()


@pytest.mark.slow
def test_scans_without_a_beam_stay_at_their_guess(walk_scans) -> None:
    one = replace(walk_scans, is_on_line=np.zeros_like(walk_scans.mask)).take([0])
    guess = np.array([[[3.0, -2.0, 0.4]]])
    found = match_pairs(one, one, guess, FINE)
    np.testing.assert_allclose(found.poses, guess[0], atol=1e-6)
    assert found.fitness.tolist() == [0.0]
    assert found.weakest_eigenvalue().tolist() == [0.0]
