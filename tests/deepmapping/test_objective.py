from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.deepmapping.config import JOINT, REFINE, DeepMappingConfig, PhaseConfig
from dpmjax.deepmapping.objective import WorldBatch, chamfer_term, free_factors, occupancy_term
from dpmjax.deepmapping.problem import MapFrame, Params, mapping_loss
from dpmjax.nets.mapping import OccupancyConfig, init_map_net
from tests.tolerances import ACCUMULATED, ROUNDING

NUM_SCANS, NUM_POINTS = 6, 10
KEY = jax.random.key(0)


def make_world(block_length: int = NUM_SCANS) -> WorldBatch:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (NUM_SCANS, NUM_POINTS, 2)).astype(np.float32)
    mask = rng.uniform(size=(NUM_SCANS, NUM_POINTS)) < 0.8
    sensors = rng.normal(scale=0.3, size=(NUM_SCANS, 2)).astype(np.float32)
    is_scan = np.ones(NUM_SCANS, bool)
    return WorldBatch(*map(jnp.asarray, (points, sensors, mask, is_scan)), block_length, jnp.asarray(0.2))


def some_logits(points: jax.Array) -> jax.Array:
    return jnp.sin(3.0 * points[:, 0]) - 2.0 * points[:, 1]


def slow_chamfer(a: np.ndarray, b: np.ndarray) -> float:
    apart = np.linalg.norm(a[:, None] - b, axis=-1)
    return apart.min(1).mean() + apart.min(0).mean()


@pytest.mark.parametrize("block_length", [6, 3, 2])
def test_chamfer_is_the_mean_over_pairs_that_never_cross_a_block(block_length: int) -> None:
    world = make_world(block_length)
    block = np.arange(NUM_SCANS) // block_length
    exact, mask = np.asarray(world.points, np.float64), np.asarray(world.mask)
    offsets = (1, 3, 2)
    pairs = [(i, j) for i in range(NUM_SCANS) for j in range(NUM_SCANS) if block[i] == block[j] and j - i in offsets]
    expected = np.mean([slow_chamfer(exact[i][mask[i]], exact[j][mask[j]]) for i, j in pairs])
    np.testing.assert_allclose(chamfer_term(world, jnp.array(offsets)), expected, **ACCUMULATED)


def test_chamfer_of_no_pair_is_zero() -> None:
    assert float(chamfer_term(make_world(block_length=1), jnp.array([1, 2]))) == 0.0


@pytest.mark.parametrize("has_equal_scans", [False, True])
def test_occupancy_is_the_binary_cross_entropy_of_valid_beams(has_equal_scans: bool) -> None:
    world = make_world()
    factors = jnp.asarray(np.random.default_rng(2).uniform(size=(NUM_SCANS, NUM_POINTS, 4)), jnp.float32)
    hits, sensors, mask = (np.asarray(x, np.float64) for x in (world.points, world.sensors, world.mask))
    occupied, free = [[] for _ in mask], [[] for _ in mask]
    for scan in range(NUM_SCANS):
        for beam in np.flatnonzero(mask[scan]):
            occupied[scan].append(hits[scan, beam])
            shares = np.asarray(factors)[scan, beam]
            free[scan] += [sensors[scan] + share * (hits[scan, beam] - sensors[scan]) for share in shares]

    def probability(points: list[np.ndarray] | np.ndarray) -> np.ndarray:
        x, y = np.array(points).T
        return 1.0 / (1.0 + np.exp(-(np.sin(3.0 * x) - 2.0 * y)))

    if has_equal_scans:
        # Eq. 4: the mean of each scan, then the mean over K scans.
        scans = zip(occupied, free, strict=True)
        expected = np.mean([-np.log(probability(o)).mean() - np.log(1.0 - probability(f)).mean() for o, f in scans])
    else:
        hit, passed = (probability(np.concatenate(points)) for points in (occupied, free))
        expected = -np.log(hit).mean() - np.log(1.0 - passed).mean()
    found = occupancy_term(world, some_logits, factors, has_equal_scans=has_equal_scans)
    np.testing.assert_allclose(found, expected, **ACCUMULATED)


def factors_of(world: WorldBatch, config: PhaseConfig, progress: float) -> np.ndarray:
    return np.asarray(free_factors(world._replace(progress=jnp.float32(progress)), config, key=KEY))


@pytest.mark.parametrize("config", [JOINT, replace(REFINE, num_free=19)])
def test_free_factors_lie_between_sensor_and_hit(config: PhaseConfig) -> None:
    factors = factors_of(make_world(), config, 0.5)
    assert factors.shape == (NUM_SCANS, NUM_POINTS, 19 + (config.surface_distance is not None))
    assert (factors >= 0.0).all()
    assert (factors < 1.0).all()
    assert len(np.unique(factors[0, 0])) == factors.shape[-1]


def test_shared_factors_are_the_same_for_all_beams_and_scans() -> None:
    shared = factors_of(make_world(), JOINT, 0.0)
    np.testing.assert_array_equal(shared, np.broadcast_to(shared[:1, :1], shared.shape))
    own = factors_of(make_world(), replace(JOINT, is_as_published=False), 0.0)
    assert len(np.unique(own)) > 0.99 * own.size


@pytest.mark.parametrize("progress", [0.0, 0.5, 1.0])
def test_surface_samples_stand_just_in_front_of_the_hit(progress: float) -> None:
    world = make_world()
    # All beams are one unit long.
    world = world._replace(points=world.sensors[:, None] + jnp.broadcast_to(jnp.array([0.8, -0.6]), world.points.shape))
    factors = factors_of(world, REFINE, progress)
    first, last = REFINE.surface_distance
    distance = 1.0 - factors[..., -1][np.asarray(world.mask)]
    wanted = first ** (1 - progress) * last**progress
    assert distance.min() >= 0.498 * wanted
    assert distance.max() <= 1.502 * wanted


def test_surface_samples_of_near_hits_stay_away_from_the_sensor() -> None:
    world = make_world()
    world = world._replace(points=world.sensors[:, None] + jnp.full(world.points.shape, 1e-3))
    np.testing.assert_allclose(factors_of(world, REFINE, 0.0)[..., -1][np.asarray(world.mask)], 0.3, **ROUNDING)


MLP = DeepMappingConfig(occupancy=OccupancyConfig(kind="mlp", features=(8,)))


def loss_of(world: WorldBatch, phase: PhaseConfig, occupancy, config: DeepMappingConfig = MLP, pair=0.25):
    params = Params(None, jnp.zeros((1, 3)), occupancy, jnp.zeros((1, 3)), MapFrame(jnp.zeros(2), jnp.ones(())))
    return mapping_loss(config, phase, params, world, jnp.asarray(pair), key=KEY)


@pytest.mark.slow
@pytest.mark.parametrize("gamma", [0.0, 0.1, 1.0])
def test_loss_is_convex_in_its_terms_and_an_untrained_grid_is_undecided(gamma: float) -> None:
    config = DeepMappingConfig(occupancy=OccupancyConfig(kind="grid", resolutions=(4,)))
    phase = replace(JOINT, occupancy_weight=gamma)
    loss, terms = loss_of(make_world(), phase, init_map_net(config.occupancy, key=KEY), config)
    # Probability one half everywhere: log 2 nats for the hits, log 2 for the free samples.
    occupancy = 2.0 * np.log(2.0)
    np.testing.assert_allclose(loss, gamma * occupancy + (1.0 - gamma) * 0.25, **ROUNDING)
    np.testing.assert_allclose(terms.occupancy, occupancy * (gamma > 0.0), **ROUNDING)
    assert float(terms.chamfer) == 0.25


def test_gradient_is_finite_with_masked_beams_and_coincident_points() -> None:
    world = make_world()
    points = world.points.at[1].set(world.points[0]).at[2, :5].set(0.0)
    world = world._replace(points=points, mask=world.mask.at[3].set(False))
    phase, occupancy = replace(REFINE, num_free=2), init_map_net(MLP.occupancy, key=KEY)

    def loss(points: jax.Array, occupancy) -> jax.Array:
        moved = world._replace(points=points)
        chamfer = chamfer_term(moved, jnp.array([1, 2]))
        return loss_of(moved, phase, occupancy, pair=chamfer)[0]

    gradients = jax.jit(jax.grad(loss, argnums=(0, 1)))(world.points, occupancy)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    # A scan without a beam pulls nobody and is pulled by nobody.
    np.testing.assert_array_equal(gradients[0][3], 0.0)


def test_masked_beams_never_matter() -> None:
    world = make_world()
    moved = world._replace(points=jnp.where(world.mask[..., None], world.points, 100.0))
    occupancy = init_map_net(MLP.occupancy, key=KEY)
    for phase in (replace(REFINE, num_free=3), JOINT):
        one, other = (loss_of(w, phase, occupancy, pair=chamfer_term(w, jnp.array([1, 2])))[0] for w in (world, moved))
        assert float(one) == float(other)


def test_map_decay_is_the_mean_square_of_the_nodes() -> None:
    config = DeepMappingConfig(occupancy=OccupancyConfig(kind="grid", resolutions=(4,)))
    nodes = jax.tree.map(lambda leaf: leaf + 2.0, init_map_net(config.occupancy, key=KEY))
    loss, terms = loss_of(make_world(), replace(JOINT, occupancy_weight=0.4), nodes, config)
    # 5 x 5 nodes of 2 each, over the beams of the step, with the weight 0.001.
    expected = 0.4 * terms.occupancy + 0.6 * 0.25 + 1e-3 * 25 * 4.0 / (NUM_SCANS * NUM_POINTS)
    np.testing.assert_allclose(loss, expected, **ROUNDING)
