"""`dpmjax.train`: drives in, a model out; a continued training; input that cannot be trained on."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.deeppointmap import CurriculumStage, TrainingHooks, begin_training
from dpmjax.sequences import LidarSequence
from tests.deeppointmap import toy

TRAINING = replace(toy.TRAINING, curriculum=(CurriculumStage(2, 3),))


def num_steps(trained) -> int:
    return int(trained.progress.state.step)


@pytest.fixture(scope="module")
def whole():
    steps: list[int] = []
    hooks = TrainingHooks(on_report=lambda record, _: steps.append(record.step))
    return dpmjax.train([toy.drive()], TRAINING, hooks=hooks), steps


def test_three_steps_train_and_the_model_can_be_written_and_read(whole, tmp_path) -> None:
    trained, steps = whole
    assert steps == [1, 2, 3]
    assert (num_steps(trained), trained.stopped_by) == (3, 0)
    start = begin_training(TRAINING).state.params
    moved = jax.tree.map(lambda a, b: np.any(a != b), trained.model.params, start)
    assert any(jax.tree.leaves(moved))
    dpmjax.save_model(trained.model, tmp_path / "model.safetensors")
    toy.assert_trees_equal(dpmjax.load_model(tmp_path / "model.safetensors").params, trained.model.params)


def test_a_training_that_stops_and_continues_equals_an_unbroken_one(whole) -> None:
    calls = iter([0, 7])
    first = dpmjax.train([toy.drive()], TRAINING, hooks=TrainingHooks(stop=lambda: next(calls)))
    assert (num_steps(first), first.stopped_by) == (1, 7)
    second = dpmjax.train([toy.drive()], TRAINING, start=first.progress)
    toy.assert_trees_equal(second.progress, whole[0].progress)


def test_prepared_scans_and_drives_train_the_same_model(whole) -> None:
    toy.assert_trees_equal(dpmjax.train(toy.store(), TRAINING).model.params, whole[0].model.params)


@pytest.mark.slow
def test_training_runs_with_64_bits_and_keeps_parameters_float32(float64) -> None:
    trained = dpmjax.train([toy.drive()], TRAINING)
    params, start = (
        jax.tree.leaves(state.params) for state in (trained.progress.state, begin_training(TRAINING).state)
    )
    assert num_steps(trained) == 3
    assert all(leaf.dtype == np.float32 and np.isfinite(leaf).all() for leaf in params)
    assert any(np.any(a != b) for a, b in zip(params, start, strict=True))


@pytest.mark.parametrize(("scores", "best"), [((0.2, 0.9, 0.4), 2), ((0.2, 0.9, 0.9), 3)])
def test_the_best_model_is_the_last_one_of_the_best_score(scores, best: int) -> None:
    left, seen = iter(scores), []

    def evaluate(model):
        seen.append(model)
        return next(left)

    trained = dpmjax.train([toy.drive()], TRAINING, hooks=TrainingHooks(evaluate=evaluate, evaluate_every=1))
    assert int(trained.progress.best_step) == best
    toy.assert_trees_equal(trained.model.params, seen[best - 1].params)


@pytest.mark.slow
def test_a_training_that_is_told_to_finish_ends_early() -> None:
    config = replace(TRAINING, curriculum=(CurriculumStage(2, 60),))
    hooks = TrainingHooks(steps_left=lambda step: 4 if step == 5 else 0)
    trained = dpmjax.train(toy.store(), config, hooks=hooks)
    assert num_steps(trained) == int(trained.progress.state.end) == 9


@pytest.mark.slow
def test_an_estimate_of_the_end_may_change_at_each_step_but_not_beyond_the_curriculum() -> None:
    config = replace(TRAINING, curriculum=(CurriculumStage(2, 6),))
    rates: list[float] = []
    hooks = TrainingHooks(
        steps_left=lambda step: [3, 9, 9, 9, 9, 1][step],
        on_report=lambda record, _: rates.append(float(record.report.learning_rate)),
    )
    trained = dpmjax.train(toy.store(), config, hooks=hooks)
    assert num_steps(trained) == 6
    assert np.all(np.diff(rates) < 0)


@pytest.mark.slow
def test_a_training_from_a_model_begins_with_its_parameters() -> None:
    model = dpmjax.init_model(jax.random.key(5), toy.MODEL)
    trained = dpmjax.train(toy.store(), TRAINING, start=model, hooks=TrainingHooks(stop=lambda: 1))
    assert num_steps(trained) == 0
    toy.assert_trees_equal(trained.model.params, model.params)
    other = replace(toy.MODEL, decoder=replace(toy.MODEL.decoder, model_channels=16))
    with pytest.raises(ValueError, match="^start: "):
        dpmjax.train(toy.store(), TRAINING, start=dpmjax.init_model(jax.random.key(0), other))


def spoiled(index: int) -> np.ndarray:
    raise ValueError("cut off")


@pytest.mark.parametrize(
    ("drives", "message"),
    [
        ([], "^drives: expected at least one, got none$"),
        ([replace(toy.drive(), T_world_lidar=None)], "^drives: toy 0: no poses"),
        ([toy.drive(), replace(toy.drive(1), read_scan=spoiled)], "^drives: toy 1: all 24 scans are bad; .*cut off$"),
        ([toy.drive(step_m=50.0)], "^drives: toy 0: 24 scans, no two of them 0.25 to 20.0 m apart"),
        ([LidarSequence("empty", (), spoiled, np.zeros((0, 4, 4)))], "^drives: empty: 0 scans"),
    ],
)
def test_drives_that_cannot_be_trained_on_are_refused_in_one_line(drives, message: str) -> None:
    with pytest.raises(ValueError, match=message) as refused:
        dpmjax.train(drives, TRAINING)
    assert "\n" not in str(refused.value)
