from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.deepmapping.config import JOINT, REFINE, PhaseConfig
from dpmjax.deepmapping.objective import (
    Batch,
    chamfer_term,
    free_factors,
    occupancy_term,
    registration_loss,
    to_world,
)
from dpmjax.geometry import se2
from tests.tolerances import ACCUMULATED, ROUNDING

NUM_SCANS, NUM_POINTS = 6, 10
KEY = jax.random.key(0)


def make_batch(block: tuple[int, ...] = (0,) * NUM_SCANS, rows: tuple[int, ...] = tuple(range(NUM_SCANS))) -> Batch:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (NUM_SCANS, NUM_POINTS, 2)).astype(np.float32)
    mask = rng.uniform(size=(NUM_SCANS, NUM_POINTS)) < 0.8
    return Batch(jnp.asarray(points), jnp.asarray(mask), jnp.asarray(rows), jnp.asarray(block))


def some_poses() -> jax.Array:
    return jnp.asarray(np.random.default_rng(1).normal(scale=0.3, size=(NUM_SCANS, 3)), jnp.float32)


def some_logits(points: jax.Array) -> jax.Array:
    return jnp.sin(3.0 * points[:, 0]) - 2.0 * points[:, 1]


def slow_chamfer(a: np.ndarray, b: np.ndarray) -> float:
    apart = np.linalg.norm(a[:, None] - b, axis=-1)
    return apart.min(1).mean() + apart.min(0).mean()


def test_to_world_is_the_rigid_motion() -> None:
    batch, poses = make_batch(), some_poses()
    expected = se2.transform_points(np.asarray(poses, np.float64), np.asarray(batch.points, np.float64))
    np.testing.assert_allclose(to_world(poses, batch.points), expected, **ROUNDING)


@pytest.mark.parametrize(
    ("block", "rows"),
    [
        ((0, 0, 0, 0, 0, 0), (0, 1, 2, 3, 4, 5)),
        ((0, 0, 0, 1, 1, 1), (4, 5, 6, 7, 8, 9)),
        ((0, 0, 0, 1, 1, 1), (7, 8, 9, 0, 1, 2)),
    ],
)
def test_chamfer_is_the_mean_over_pairs_that_never_cross_a_block(block, rows) -> None:
    batch = make_batch(block, rows)
    world = to_world(some_poses(), batch.points)
    exact, mask = np.asarray(world, np.float64), np.asarray(batch.mask)
    offsets = (1, 3, 2)
    pairs = [
        (i, j)
        for i in range(NUM_SCANS)
        for j in range(NUM_SCANS)
        if block[i] == block[j] and rows[j] - rows[i] in offsets
    ]
    expected = np.mean([slow_chamfer(exact[i][mask[i]], exact[j][mask[j]]) for i, j in pairs])
    np.testing.assert_allclose(chamfer_term(world, batch, jnp.array(offsets)), expected, **ACCUMULATED)


def test_chamfer_of_no_pair_is_zero() -> None:
    batch = make_batch(block=tuple(range(NUM_SCANS)))
    assert float(chamfer_term(batch.points, batch, jnp.array([1, 2]))) == 0.0


def test_occupancy_is_the_binary_cross_entropy_of_valid_beams() -> None:
    batch, poses = make_batch(), some_poses()
    factors = jnp.asarray(np.random.default_rng(2).uniform(size=(NUM_SCANS, NUM_POINTS, 4)), jnp.float32)
    world = to_world(poses, batch.points)
    hits, sensors, mask = np.asarray(world, np.float64), np.asarray(poses, np.float64)[:, :2], np.asarray(batch.mask)
    occupied, free = [], []
    for scan in range(NUM_SCANS):
        for beam in np.flatnonzero(mask[scan]):
            occupied.append(hits[scan, beam])
            free += [sensors[scan] + f * (hits[scan, beam] - sensors[scan]) for f in np.asarray(factors)[scan, beam]]

    def probability(points: list[np.ndarray]) -> np.ndarray:
        x, y = np.array(points).T
        return 1.0 / (1.0 + np.exp(-(np.sin(3.0 * x) - 2.0 * y)))

    expected = -np.log(probability(occupied)).mean() - np.log(1.0 - probability(free)).mean()
    found = occupancy_term(poses[:, :2], world, batch, some_logits, factors)
    np.testing.assert_allclose(found, expected, **ACCUMULATED)


@pytest.mark.parametrize("config", [JOINT, replace(REFINE, num_free=19)])
def test_free_factors_lie_between_sensor_and_hit(config: PhaseConfig) -> None:
    factors = np.asarray(free_factors(make_batch(), config, jnp.float32(0.5), key=KEY))
    assert factors.shape == (NUM_SCANS, NUM_POINTS, 19 + (config.surface_distance is not None))
    assert (factors >= 0.0).all()
    assert (factors < 1.0).all()
    assert len(np.unique(factors[0, 0])) == factors.shape[-1]


def test_shared_factors_are_the_same_for_all_beams_and_scans() -> None:
    shared = np.asarray(free_factors(make_batch(), JOINT, jnp.float32(0.0), key=KEY))
    np.testing.assert_array_equal(shared, np.broadcast_to(shared[:1, :1], shared.shape))
    own = np.asarray(free_factors(make_batch(), replace(JOINT, is_free_factor_shared=False), jnp.float32(0.0), key=KEY))
    assert len(np.unique(own)) > 0.99 * own.size


@pytest.mark.parametrize("progress", [0.0, 0.5, 1.0])
def test_surface_samples_stand_just_in_front_of_the_hit(progress: float) -> None:
    batch = make_batch()._replace(points=jnp.broadcast_to(jnp.array([0.8, -0.6]), (NUM_SCANS, NUM_POINTS, 2)))
    factors = free_factors(batch, REFINE, jnp.float32(progress), key=KEY)
    first, last = REFINE.surface_distance
    distance = 1.0 - np.asarray(factors)[..., -1][np.asarray(batch.mask)]
    wanted = first ** (1 - progress) * last**progress
    assert distance.min() >= 0.499 * wanted
    assert distance.max() <= 1.501 * wanted


def test_surface_samples_of_near_hits_stay_away_from_the_sensor() -> None:
    batch = make_batch()._replace(points=jnp.full((NUM_SCANS, NUM_POINTS, 2), 1e-3))
    factors = np.asarray(free_factors(batch, REFINE, jnp.float32(0.0), key=KEY))[..., -1][np.asarray(batch.mask)]
    np.testing.assert_allclose(factors, 0.3, **ROUNDING)


@pytest.mark.parametrize("gamma", [0.0, 0.1, 1.0])
def test_loss_is_the_weighted_sum_of_its_terms(gamma: float) -> None:
    config = replace(JOINT, occupancy_weight=gamma)
    loss, terms = registration_loss(some_poses(), make_batch(), some_logits, config, jnp.float32(0.0), key=KEY)
    expected = gamma * float(terms.occupancy) + (1.0 - gamma) * float(terms.chamfer)
    np.testing.assert_allclose(loss, expected, **ROUNDING)
    assert (float(terms.occupancy) > 0.0) == (gamma > 0.0)


def test_gradient_is_finite_with_masked_beams_and_coincident_points() -> None:
    batch = make_batch()
    points = batch.points.at[1].set(batch.points[0]).at[2, :5].set(0.0)
    batch = batch._replace(points=points, mask=batch.mask.at[3].set(False))

    def loss(poses: jax.Array, slope: jax.Array) -> jax.Array:
        return registration_loss(
            poses, batch, lambda p: slope * some_logits(p), replace(REFINE, num_free=2), jnp.float32(0.3), key=KEY
        )[0]

    gradients = jax.jit(jax.grad(loss, argnums=(0, 1)))(jnp.zeros((NUM_SCANS, 3)), jnp.float32(1.0))
    assert all(np.isfinite(g).all() for g in gradients)
    # A scan without a beam pulls nobody and is pulled by nobody.
    np.testing.assert_array_equal(gradients[0][3], 0.0)


def test_masked_beams_never_matter() -> None:
    batch = make_batch()
    moved = batch._replace(points=jnp.where(batch.mask[..., None], batch.points, 100.0))
    for config in (replace(REFINE, num_free=3), JOINT):
        one, other = (
            registration_loss(some_poses(), b, some_logits, config, jnp.float32(0.2), key=KEY)[0]
            for b in (batch, moved)
        )
        assert float(one) == float(other)


def test_without_occupancy_the_map_gets_no_gradient() -> None:
    def loss(slope: jax.Array) -> jax.Array:
        config = replace(REFINE, occupancy_weight=0.0)
        return registration_loss(
            some_poses(), make_batch(), lambda p: slope * some_logits(p), config, jnp.float32(0.0), key=KEY
        )[0]

    assert float(jax.grad(loss)(jnp.float32(1.0))) == 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"occupancy_weight": 1.5}, "occupancy_weight"),
        ({"num_offsets": 9}, "num_offsets"),
        ({"num_steps": 0}, "num_steps"),
    ],
)
def test_phase_settings_are_checked(change, message) -> None:
    with pytest.raises(ValueError, match=message):
        replace(REFINE, **change)
