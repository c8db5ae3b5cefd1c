"""The second stage: pairs and labels by true distances, a frozen network, exact resumption, and a head that learns."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.deeppointmap import OverlapConfig, draw_overlap_pairs, train_overlap, why_no_overlap
from dpmjax.deeppointmap.training import overlap_stage
from dpmjax.deeppointmap.training.overlap_stage import (
    OverlapHooks,
    PairFeatures,
    hard_pairs,
    head_logits,
    init_overlap,
    with_head,
)
from dpmjax.deeppointmap.training.sampling import ScanTable
from tests.deeppointmap import toy

NEW = replace(toy.TRAINING, stages=("overlap",), overlap=OverlapConfig(num_epochs=1, batch_pairs=8))
POOL = replace(NEW, overlap=OverlapConfig(num_epochs=3, batch_pairs=8, pool_pairs=16))


def table(positions: np.ndarray, scene: np.ndarray | None = None) -> ScanTable:
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :2, 3] = positions
    return ScanTable(poses, np.zeros(len(poses), int) if scene is None else scene)


def laps(num: int = 100) -> ScanTable:
    """Two laps of a circle of 160 m."""
    angles = np.linspace(0, 4 * np.pi, num, endpoint=False)
    return table(160 / (2 * np.pi) * np.stack([np.cos(angles), np.sin(angles)], axis=1))


@pytest.fixture(scope="module")
def model() -> dpmjax.Model:
    untrained = replace(toy.MODEL, trained=("registration",))
    return dpmjax.init_model(jax.random.key(0), untrained)


def test_pairs_have_the_published_shares_by_true_distance() -> None:
    positions = np.random.default_rng(0).uniform(0, 150, (300, 2))
    some = table(positions, np.arange(300) % 2)
    pairs = draw_overlap_pairs(some, 400, np.random.default_rng(1))
    assert np.all(pairs[:, 0] != pairs[:, 1])
    distances = np.array([some.distances_from(a)[b] for a, b in pairs.tolist()])
    shares = [np.mean(distances < 20), np.mean((distances >= 20) & (distances < 40)), np.mean(distances >= 40)]
    np.testing.assert_allclose(shares, [0.5, 0.25, 0.25])
    assert np.isinf(distances).any()


def test_missing_distances_are_replaced_by_other_pairs_without_overlap() -> None:
    two_rooms = table(np.zeros((8, 2)), np.arange(8) // 4)
    pairs = draw_overlap_pairs(two_rooms, 16, np.random.default_rng(0))
    is_one_room = two_rooms.scene[pairs[:, 0]] == two_rooms.scene[pairs[:, 1]]
    assert (is_one_room.sum(), len(pairs)) == (8, 16)


@pytest.mark.parametrize(
    ("scans", "reason"),
    [
        (table(np.zeros((5, 2))), "all scans are less than 20 m apart"),
        (table(30 * np.arange(10.0).reshape(5, 2)), "no two scans are less than 20 m apart"),
        (laps(), None),
    ],
)
def test_scans_that_teach_no_overlap_are_named(scans: ScanTable, reason: str | None) -> None:
    found = why_no_overlap(scans)
    assert found == reason if reason is None else reason in found


def test_hard_pairs_are_second_visits_and_places_that_look_alike() -> None:
    scans, vectors = laps(), np.random.default_rng(0).normal(size=(100, 4))
    vectors[10] = vectors[40]
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    pairs = hard_pairs(scans, vectors, 40, np.random.default_rng(0))
    distances = np.array([scans.distances_from(a)[b] for a, b in pairs.tolist()])
    assert (distances < 20).tolist() == [True] * 20 + [False] * 20
    assert np.all(np.abs(np.diff(pairs[:20], axis=1)) > 25)  # another lap, not a neighbour
    all_alike = hard_pairs(scans, vectors, 400, np.random.default_rng(0))
    assert (10, 40) in set(map(tuple, all_alike.tolist()))


def test_a_head_learns_to_tell_pairs_apart(model) -> None:
    rng = np.random.default_rng(0)
    is_overlap = np.arange(64) % 2 == 0
    features = rng.normal(is_overlap[:, None, None, None], 0.5, (64, 2, 8, 12)).astype(np.float16)
    pairs = PairFeatures(features, np.ones((64, 2, 8), bool), is_overlap)
    state, losses = init_overlap(model), []
    for _ in range(60):
        state, loss, _ = overlap_stage._step(state, model, pairs, 1e-2, 0.0)
        losses.append(float(loss))
    assert losses[-1] < 0.1 * losses[0]
    trained = with_head(model, state.head, is_trained=True)
    assert np.mean((np.asarray(head_logits(trained, pairs)) > 0) == is_overlap) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("config", [NEW, POOL], ids=["new pairs", "pool"])
def test_only_the_head_changes_and_a_stopped_stage_goes_on_exactly(model, config) -> None:
    store, records = toy.store(), []
    whole, last = train_overlap(store, model, config, hooks=OverlapHooks(lambda record, _: records.append(record)))
    assert [record.step for record in records] == list(range(1, config.overlap.num_steps(24) + 1))
    assert records[0].learning_rate == pytest.approx(0.1 * config.learning_rate)
    assert whole.config.trained == ("registration", "overlap")
    for part in ("encoder", "decoder"):
        for name, value in model.params[part].items():
            if name != "overlap_head":
                toy.assert_trees_equal(whole.params[part][name], value)
    moved = jax.tree.map(lambda a, b: np.any(a != b), last.head, init_overlap(model).head)
    assert any(jax.tree.leaves(moved))
    calls = iter([0, 0, 1])
    first, state = train_overlap(store, model, config, hooks=OverlapHooks(stop=lambda: next(calls)))
    assert (int(state.step), first.config.trained) == (2, ("registration",))
    toy.assert_trees_equal(train_overlap(store, model, config, start=state)[1], last)


@pytest.mark.slow
def test_training_does_both_stages_and_says_so() -> None:
    config = replace(POOL, stages=("registration", "overlap"))
    both = dpmjax.train(toy.store(), config)
    assert both.model.config.trained == ("registration", "overlap")
    first = dpmjax.train(toy.store(), replace(config, stages=("registration",)))
    assert (first.model.config.trained, first.overlap) == (("registration",), None)
    head_alone = dpmjax.train(toy.store(), replace(config, stages=("overlap",)), start=first.model)
    toy.assert_trees_equal(head_alone.model.params, both.model.params)
    assert head_alone.model.config == both.model.config


def test_drives_that_teach_no_overlap_are_refused() -> None:
    config = replace(toy.TRAINING, stages=("registration", "overlap"))
    with pytest.raises(ValueError, match="^drives: all scans are less than 20 m apart.*leave the stage overlap out$"):
        dpmjax.train(toy.store(toy.drive(num_scans=4)), config)
