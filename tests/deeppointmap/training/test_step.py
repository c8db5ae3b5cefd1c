"""The step of training: its changes, its invariants, the number of its compilations, and several devices."""

import functools
from dataclasses import replace

import jax
import numpy as np
import pytest

from dpmjax import deeppointmap as dpm
from dpmjax.deeppointmap.model import predict_offsets
from dpmjax.deeppointmap.training.curriculum import Layout, layout_capacity
from dpmjax.deeppointmap.training.sampling import RegistrationSample
from dpmjax.deeppointmap.training.step import WEIGHT_DECAY, TrainingState, _learning_rate, batch_loss
from tests.deeppointmap import toy
from tests.processes import run_python
from tests.tolerances import ACCUMULATED


@pytest.fixture(scope="module")
def maker() -> dpm.SampleMaker:
    return dpm.SampleMaker(toy.store(), toy.TRAINING, seed=0)


@pytest.fixture(scope="module")
def step():
    return dpm.make_step(toy.TRAINING)


@pytest.fixture(scope="module")
def start() -> TrainingState:
    return dpm.init_training(jax.random.key(0), toy.TRAINING)


def capacity_of(step: int, seed: int) -> Layout:
    return layout_capacity(toy.TRAINING.layout_at(step, seed=seed), toy.TRAINING.sampling)


@pytest.mark.slow
def test_loss_falls_on_one_batch_and_all_parts_but_the_overlap_head_learn(maker, step, start) -> None:
    batch, state, losses = maker(0), start, []
    for _ in range(15):
        state, report = step(state, batch)
        losses.append(float(report.loss))
    assert losses[-1] < losses[0] - 0.2
    assert report.terms.num_positives > 0
    moved = jax.tree.map(lambda a, b: bool(np.any(a != b)), start.params, state.params)
    parts = {"encoder": moved["encoder"], **moved["decoder"]}
    del parts["overlap_head"]  # by weight decay alone
    assert all(any(jax.tree.leaves(part)) for part in parts.values())


@pytest.mark.slow
def test_without_the_offset_head_it_does_not_learn_and_a_pair_is_registered_by_positions(maker, start) -> None:
    decoder = replace(toy.MODEL.decoder, predicts_offsets=False)
    config = replace(toy.TRAINING, model=replace(toy.MODEL, decoder=decoder))
    after, report = dpm.make_step(config)(start, maker(0))
    assert report.terms.offset == 0
    head = (state.params["decoder"]["offset_head"] for state in (start, after))
    kept = 1 - float(report.learning_rate) * WEIGHT_DECAY  # AdamW's decay, no gradient
    for before, now in zip(*map(jax.tree.leaves, head), strict=True):
        np.testing.assert_allclose(now, kept * before, atol=1e-7)
    model = dpm.Model(start.params, config.model)
    features = np.ones((5, 1, config.model.decoder.model_channels), np.float32)
    rows = np.zeros((5, 3), np.int32)
    assert not np.any(predict_offsets(model, features, features[:, 0], None, rows))
    assert predict_offsets(model, features, features[:, 0], None, rows).shape == (5, 3, 3)


def test_parts_of_the_training_can_be_left_out() -> None:
    config = dpm.training_preset("small")
    assert dpm.without(config, "curriculum").curriculum == (dpm.CurriculumStage(16, config.num_steps),)
    assert dpm.without(config, "coarse-loss").objective.coarse_weight == 0
    bare = dpm.without(config, "occlusion").augment
    assert (bare.sector_probability, bare.box_probability, bare.max_drop_ratio) == (0, 0, 0.5)
    paper = dpm.training_preset("paper")
    assert paper.model.decoder.predicts_offsets
    assert not dpm.without(paper, "offset-head").model.decoder.predicts_offsets


@pytest.mark.slow
def test_a_step_compiles_once_for_each_capacity(maker, start, assert_compiles_nothing) -> None:
    step, other = dpm.make_step(toy.TRAINING), dpm.SampleMaker(toy.store(), toy.TRAINING, seed=1)
    state = start
    capacities = [[capacity_of(number, seed) for number in range(5)] for seed in (0, 1)]
    for number, capacity in enumerate(capacities[0]):
        if capacity not in capacities[1]:
            continue
        state, _ = step(state, maker(number))
        following = other(capacities[1].index(capacity))
        with assert_compiles_nothing():
            state, _ = step(state, following)


@pytest.mark.slow
def test_places_without_a_group_change_nothing(maker, start) -> None:
    batch = maker(0)
    pairs = batch.groups
    # Masked entries reach no gradient either: this is a law of each term (test_objective).
    loss = jax.jit(lambda params, batch: batch_loss(params, batch, toy.TRAINING)[0])
    masked = replace(batch, groups=replace(pairs, mask=np.array([[True, False, True]])))
    kept = jax.tree.map(lambda leaf: leaf[:, [0, 2]], pairs)
    expected = loss(start.params, replace(batch, groups=kept))
    np.testing.assert_allclose(loss(start.params, masked), expected, **ACCUMULATED)


@pytest.mark.slow
def test_a_map_without_the_rows_that_thinning_removes_has_the_same_loss(maker, start, monkeypatch) -> None:
    """The compact map has one row for each descriptor."""
    batch = maker(next(number for number in range(3, 20) if capacity_of(number, 0).num_target > 1))
    masks = [side.mask for side in (batch.groups.source, batch.groups.target)]
    most = max(int(mask.sum(axis=(-1, -2)).max()) for mask in masks)
    assert most < max(mask[0, 0].size for mask in masks)
    whole = jax.jit(lambda params, batch: batch_loss(params, batch, toy.TRAINING))(start.params, batch)
    monkeypatch.setattr("dpmjax.deeppointmap.training.step.MAX_DESCRIPTORS", most)
    compact = jax.jit(lambda params, batch: batch_loss(params, batch, toy.TRAINING))(start.params, batch)
    jax.tree.map(functools.partial(np.testing.assert_allclose, **ACCUMULATED), whole, compact)


@pytest.mark.slow
def test_a_batch_of_empty_scans_has_no_loss_and_a_finite_gradient(maker, step, start) -> None:
    batch: RegistrationSample = maker(0)
    empty = replace(batch.scans.pyramids, num_points=np.zeros_like(batch.scans.pyramids.num_points))
    state, report = step(start, replace(batch, scans=replace(batch.scans, pyramids=empty)))
    assert report.loss == 0
    assert np.isfinite(report.gradient_norm)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.params))


def test_a_sample_depends_on_seed_and_step_alone(maker) -> None:
    fresh = dpm.SampleMaker(toy.store(), toy.TRAINING, seed=0)
    toy.assert_trees_equal(fresh(4), maker(4))
    assert np.any(fresh(4).scans.T_augmented_lidar[:, 0] != fresh(3).scans.T_augmented_lidar[:, 0])


def test_devices_share_the_anchors_of_an_epoch(maker) -> None:
    both = dpm.SampleMaker(toy.store(), toy.TRAINING, seed=0, numbers=(0, 1), num_in_step=2)
    toy.assert_trees_equal(jax.tree.map(lambda leaf: leaf[:1], both(0)), maker(0))
    num = len(toy.store().table)
    alone = [maker._anchor(step, 0) for step in range(num)]
    assert sorted(alone) == list(range(num))
    assert [both._anchor(step, number) for step in range(num // 2) for number in range(2)] == alone


def test_the_learning_rate_is_a_cosine_over_the_whole_training(start) -> None:
    config = replace(toy.TRAINING, curriculum=(dpm.CurriculumStage(2, 100),), warmup_steps=4)
    state = dpm.init_training(jax.random.key(0), config)
    found = [rate(state, step, config) for step in range(101)]
    cosine = 1e-5 + (1e-3 - 1e-5) * (1 + np.cos(np.pi * np.arange(101) / 100)) / 2
    np.testing.assert_allclose(found[4:], cosine[4:], rtol=1e-4)
    np.testing.assert_allclose(found[:4], cosine[:4] * np.arange(1, 5) / 4, rtol=1e-4)
    np.testing.assert_allclose([found[50], found[80]], [5.05e-4, 1.045e-4], rtol=1e-3)
    assert dpm.training_preset("paper").warmup_steps == 0


def test_a_training_that_finishes_early_passes_through_the_rest_of_the_cosine(start) -> None:
    config = replace(toy.TRAINING, curriculum=(dpm.CurriculumStage(2, 100),), warmup_steps=0)
    state = replace(dpm.init_training(jax.random.key(0), config), step=jax.numpy.asarray(40))
    early = dpm.finish(state, 10)
    assert (int(early.planned_at), int(early.end)) == (40, 50)
    np.testing.assert_allclose(rate(early, 40, config), rate(state, 40, config), rtol=1e-5)
    np.testing.assert_allclose(rate(early, 45, config), rate(state, 70, config), rtol=1e-4)
    np.testing.assert_allclose(rate(early, 50, config), 1e-5, rtol=1e-4)
    again = dpm.finish(replace(early, step=jax.numpy.asarray(45)), 30)
    np.testing.assert_allclose(rate(again, 60, config), rate(state, 85, config), rtol=1e-4)
    with pytest.raises(ValueError, match="^num_steps: expected at least 1, got 0"):
        dpm.finish(state, 0)


def rate(state: TrainingState, step: int, config: dpm.TrainingConfig) -> float:
    return float(_learning_rate(replace(state, step=jax.numpy.asarray(step)), config))


def test_uniform_parameters_are_those_of_pytorchs_linear_layers() -> None:
    params = dpm.init_training(jax.random.key(0), replace(toy.TRAINING, initialization="uniform")).params
    of_path = {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in jax.tree.leaves_with_path(params)}
    kernels = {path.removesuffix("['kernel']"): leaf for path, leaf in of_path.items() if path.endswith("['kernel']")}
    assert len(kernels) > 10
    scaled = []
    for path, kernel in kernels.items():
        bound = 1 / np.sqrt(kernel.shape[0])
        for leaf in (kernel, of_path[f"{path}['bias']"]):
            assert np.abs(leaf).max() <= bound
            assert np.any(leaf != 0)
            scaled.append((leaf / bound).ravel())
    drawn = np.concatenate(scaled)
    # Of the uniform distribution from -1 to 1, within four standard errors.
    assert abs(drawn.mean()) < 4 * np.sqrt(1 / 3 / len(drawn))
    assert abs(drawn.var() - 1 / 3) < 4 * np.sqrt(4 / 45 / len(drawn))
    norms = [leaf for path, leaf in of_path.items() if "norm" in path]
    assert norms
    assert all(np.all(leaf == leaf.flat[0]) for leaf in norms)


EIGHT_DEVICES = """
import jax, numpy as np
from dpmjax.deeppointmap import SampleMaker, init_training
from dpmjax.deeppointmap.training.processes import device_mesh, place
from dpmjax.deeppointmap.training.step import batch_loss
from tests.deeppointmap import toy
assert jax.device_count() == 8
maker = SampleMaker(toy.store(), toy.TRAINING, seed=0, numbers=range(8), num_in_step=8)
batch, params = maker(0), init_training(jax.random.key(0), toy.TRAINING).params
gradient = jax.jit(jax.grad(lambda params, batch: batch_loss(params, batch, toy.TRAINING)[0]))
alone = gradient(params, batch)
mesh = device_mesh()
spread = place(batch, mesh, is_batch=True)
mask = spread.groups.mask
assert len(mask.sharding.device_set) == 8 and mask.addressable_shards[0].data.shape[0] == 1
together = gradient(place(params, mesh), spread)
for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
"""


@pytest.mark.slow
def test_eight_devices_find_the_gradient_of_one() -> None:
    flags = "--xla_force_host_platform_device_count=8 --xla_backend_optimization_level=0"
    done = run_python("-c", EIGHT_DEVICES, variables={"XLA_FLAGS": flags})
    assert done.returncode == 0, done.stderr
