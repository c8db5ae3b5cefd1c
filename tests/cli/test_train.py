"""The command that trains: options, the background, and runs that are broken off."""

import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from dpmjax.cli import train_run
from dpmjax.cli.run import CHECKPOINTS, HISTORY
from dpmjax.cli.train import TrainOptions, training_settings
from dpmjax.cli.train_run import Records, Selection, run_training
from dpmjax.deeppointmap import (
    CurriculumStage,
    Evaluation,
    OverlapConfig,
    SampleMaker,
    StepRecord,
    TrainingHooks,
    TrainingReport,
    draw_evaluation_pairs,
    init_model,
    prepare_drive,
    training_preset,
)  # fmt: skip
from dpmjax.deeppointmap.training.loop import Speed
from dpmjax.deeppointmap.training.objective import ObjectiveTerms
from dpmjax.metrics.poses import registration_recall
from dpmjax.weights import load_model
from tests.data_sets import run_in
from tests.deeppointmap import toy

TRAINING = replace(toy.TRAINING, curriculum=(CurriculumStage(2, 4),))


class StopAfter:
    def __init__(self, num: int) -> None:
        self._left = num

    def __call__(self) -> int:
        self._left -= 1
        return int(self._left < 0)


BOTH = replace(TRAINING, stages=("registration", "overlap"), overlap=OverlapConfig(num_epochs=1, batch_pairs=6))
"""Four steps of each stage."""


def train_both(folder: Path, *, stop_after: int = 99):
    records = Records(run_in(folder), BOTH, Selection(None, "the last step"), seed=0)
    return run_training(records, toy.store(), BOTH, TrainingHooks(stop=StopAfter(stop_after)), seed=0)


def train(folder: Path, *, stop_after: int = 99, total_s: float = math.inf):
    pairs = draw_evaluation_pairs([toy.drive(seed=9)], 2, toy.MODEL)
    records = Records(run_in(folder), TRAINING, Selection(pairs, "a toy"), seed=0)
    hooks = TrainingHooks(evaluate_every=2, stop=StopAfter(stop_after))
    return run_training(records, toy.store(), TRAINING, hooks, seed=0, total_s=total_s)


def num_steps(trained) -> int:
    return int(trained.progress.state.step)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return train(folder), folder


def assert_same_run(parts, folder: Path, whole) -> None:
    """Checks that parameters and history are equal bit for bit, except the seconds."""
    toy.assert_trees_equal(parts.progress, whole[0].progress)
    toy.assert_trees_equal(parts.model.params, whole[0].model.params)
    rows = [run_in(where).read_table(HISTORY) for where in (whole[1], folder)]
    for one, other in zip(*rows, strict=True):
        assert {**one, "run_s": ""} == {**other, "run_s": ""}


@pytest.mark.slow
@pytest.mark.parametrize("num_before", [0, 1, 3])
def test_a_broken_off_run_goes_on_with_the_numbers_of_an_unbroken_one(tmp_path: Path, whole, num_before) -> None:
    # Before the first step, before and after the first recall.
    assert num_steps(whole[0]) == TRAINING.num_steps
    assert num_steps(train(tmp_path, stop_after=num_before)) == num_before
    assert_same_run(train(tmp_path), tmp_path, whole)


@pytest.mark.slow
def test_the_second_stage_goes_on_where_it_was_broken_off_and_has_rows_of_its_own(tmp_path: Path) -> None:
    whole = train_both(tmp_path / "whole")
    assert whole.model.config.trained == ("registration", "overlap")
    rows = run_in(tmp_path / "whole").read_table(HISTORY)
    assert [(row["step"], row["stage"]) for row in rows[3:5]] == [("4", "K=2"), ("5", "overlap")]
    assert len(rows) == 8
    assert all(float(row["overlap_loss"]) > 0 for row in rows[4:])
    broken = train_both(tmp_path / "parts", stop_after=6)
    assert (broken.stopped_by, broken.model.config.trained) == (1, ("registration",))
    assert len(run_in(tmp_path / "parts").read_table(HISTORY)) == 6
    resumed = train_both(tmp_path / "parts")
    assert resumed.stopped_by == 0
    toy.assert_trees_equal((resumed.progress.state, resumed.overlap), (whole.progress.state, whole.overlap))
    toy.assert_trees_equal(resumed.model.params, whole.model.params)
    again = run_in(tmp_path / "parts").read_table(HISTORY)
    assert [{**row, "run_s": ""} for row in again] == [{**row, "run_s": ""} for row in rows]


@pytest.mark.slow
def test_drives_without_held_out_places_leave_the_choice_to_the_last_step(monkeypatch) -> None:
    monkeypatch.setattr(train_run, "NUM_HELD_OUT_PAIRS", 4)
    nothing = train_run.draw_selection(TRAINING, [lambda: toy.drive(num_scans=1)], "the drives")
    assert nothing == Selection(None, "the last step: no drive has held-out places")
    some = train_run.draw_selection(TRAINING, [toy.drive, lambda: toy.drive(1)], "the drives")
    assert some.chosen_by == "the drives"
    assert [len(rows) for rows in some.pairs.pairs.values()] == [4, 4]
    assert max(rows.max() for rows in some.pairs.pairs.values()) >= 24  # of the second drive


def test_the_table_has_the_accuracy_of_offsets_at_each_evaluation(tmp_path: Path, monkeypatch) -> None:
    r2 = np.array([0.75, 1.0, -0.25])
    recalls = {"near": registration_recall(np.eye(4)[None], np.eye(4)[None])}
    found = Evaluation(recalls, {}, r2, toy.cloud(np.zeros((1, 3))))
    monkeypatch.setattr(train_run.dpm, "evaluate_registration", lambda model, pairs: found)
    nothing, one = draw_evaluation_pairs([toy.drive()], 1, toy.MODEL), np.ones(())
    records = Records(run_in(tmp_path), TRAINING, Selection(nothing, "a toy"), seed=0)
    report = TrainingReport(one, ObjectiveTerms(one, one, one, one, np.ones((), int)), one, one)
    with records:
        for step, score in ((1, math.nan), (2, records.evaluate(records.untrained))):
            records.on_report(StepRecord(step, TRAINING.stage_at(step), report, score, Speed()), records.start)
    between, evaluated = run_in(tmp_path).read_table(HISTORY)
    np.testing.assert_allclose([float(evaluated[name]) for name in train_run.OFFSETS], r2, rtol=1e-5)
    assert [between[name] for name in train_run.OFFSETS] == ["", "", ""]
    assert between["offset"] == "1"


@pytest.mark.slow
def test_a_cut_off_checkpoint_is_passed_over_for_the_one_before(tmp_path: Path, whole, monkeypatch, caplog) -> None:
    monkeypatch.setattr(train_run, "SAVE_EVERY_S", 0.0)
    train(tmp_path, stop_after=3)
    saved = sorted((tmp_path / CHECKPOINTS).iterdir(), key=lambda path: int(path.name))
    assert [path.name for path in saved] == ["2", "3"]
    for file in saved[-1].rglob("*"):
        if file.is_file() and file.stat().st_size > 100:
            file.write_bytes(file.read_bytes()[:50])
    assert_same_run(train(tmp_path), tmp_path, whole)
    assert "checkpoint 3 cannot be read" in caplog.text


@pytest.mark.slow
def test_batches_made_ahead_are_those_made_alone() -> None:
    maker = SampleMaker(toy.store(), TRAINING, seed=0)
    for step, batch in zip(range(1, 6), maker.batches(1, 6), strict=True):
        toy.assert_trees_equal(batch, maker(step))


def test_groups_and_scans_take_the_place_of_those_of_the_preset() -> None:
    settings = training_settings(TrainOptions(groups=(8, 16, 8), steps=60))
    assert [(stage.max_group, stage.num_steps) for stage in settings.curriculum] == [(8, 20), (16, 20), (8, 20)]
    settings = training_settings(TrainOptions(scans=96, groups=(32,)))
    assert settings.sampling.num_scans == 96
    assert max(settings.layout_at(step, seed=0).num_scans for step in range(20)) == 96
    with pytest.raises(ValueError, match="num_scans: expected at least the largest group, 4, got 3"):
        training_settings(TrainOptions(scans=3, groups=(4,)))


def test_the_paper_trains_for_epochs_and_options_have_its_values_as_defaults() -> None:
    paper = training_settings(TrainOptions(preset="paper"))
    assert (paper.num_epochs, paper.num_variants, paper.refines_labels) == (12, 0, False)
    assert training_settings(TrainOptions(preset="paper", steps=500)).num_epochs is None
    changed = training_settings(TrainOptions(preset="paper", epochs=3, variants=2, refine_labels=True))
    assert (changed.num_epochs, changed.num_variants, changed.refines_labels) == (3, 2, True)
    assert changed.for_scans(1000).num_steps == 3000


def test_a_gpu_computes_all_scans_of_a_step_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    assert training_settings(TrainOptions(scans=96)).scans_at_once == training_preset("tiny").scans_at_once
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert training_settings(TrainOptions(scans=96)).scans_at_once == 96


@pytest.mark.slow
def test_a_run_from_weights_has_their_network_and_begins_with_their_parameters(tmp_path: Path) -> None:
    weights = load_model("dpm_small")
    settings = training_settings(TrainOptions(weights="dpm_small"), weights)
    assert settings.model == replace(weights.config, calibration=None, overlap=None, trained=())
    assert settings.learning_rate == pytest.approx(0.2 * training_settings(TrainOptions()).learning_rate)
    assert settings.curriculum == training_preset("tiny").curriculum
    some = init_model(jax.random.key(5), toy.MODEL)
    pairs = draw_evaluation_pairs([toy.drive(seed=9)], 2, toy.MODEL)
    sets = Selection(pairs, "a toy")
    with Records(run_in(tmp_path), TRAINING, sets, seed=0, weights=some) as records:
        toy.assert_trees_equal(records.start.state.params, some.params)
        toy.assert_trees_equal(records.untrained.params, some.params)
        assert int(records.start.state.step) == 0


def write_drive(folder: Path, *, step_m: float = 2.0, has_poses: bool = True, num: int = 4) -> Path:
    (folder / "velodyne").mkdir(parents=True)
    points = np.random.default_rng(0).uniform(-20, 20, (200, 4)).astype("<f4")
    for number in range(num):
        (folder / "velodyne" / f"{number:06d}.bin").write_bytes(points.tobytes())
    poses = np.tile(np.eye(4)[:3], (num, 1, 1))
    poses[:, 0, 3] = step_m * np.arange(num)
    if has_poses:
        np.savetxt(folder / "poses_lidar.txt", poses.reshape(num, 12))
    return folder


def test_data_that_cannot_be_trained_on_is_named(as_user, tmp_path, refused) -> None:
    (tmp_path / "empty").mkdir()
    assert "empty" in refused("train", "--data", tmp_path / "empty")
    without = write_drive(tmp_path / "without", has_poses=False)
    assert "no poses" in refused("train", "--data", without)
    assert "dpm_small" in refused("train", "--data", without, "--weights", "nobody")
    wide = write_drive(tmp_path / "wide", step_m=50.0)
    assert "no two of them 0.25 to 20.0 m apart" in refused("train", "--data", wide)
    spoiled = write_drive(tmp_path / "spoiled")
    for file in (spoiled / "velodyne").iterdir():
        file.write_bytes(file.read_bytes()[:-3])
    assert "all 4 scans are bad" in refused("train", "--data", spoiled)

    # Before scans are prepared: drives to validate on, and the folder of the results.
    good = write_drive(tmp_path / "good")
    assert "nowhere" in refused("train", "--data", good, "--validate", tmp_path / "nowhere")
    assert "no poses" in refused("train", "--data", good, "--validate", without)
    (tmp_path / "file").write_text("")
    assert "cannot write to" in refused("train", "--data", good, "-o", tmp_path / "file" / "out")


@pytest.mark.slow
def test_a_training_ends_after_its_seconds_at_the_end_of_its_cosine(tmp_path: Path) -> None:
    """The first step compiles and the second one shows the pace: then no second is left."""
    train(tmp_path, total_s=0.01)
    rows = run_in(tmp_path).read_table(HISTORY)
    assert len(rows) == 3 < TRAINING.num_steps
    assert np.all(np.diff([float(row["run_s"]) for row in rows]) > 0)
    trained = train(tmp_path, total_s=3600.0)
    assert num_steps(trained) == 3


@pytest.mark.slow
def test_a_resumed_training_that_finishes_takes_a_quarter_of_its_steps(tmp_path: Path) -> None:
    train(tmp_path, stop_after=2)
    trained = train(tmp_path, total_s=0.0)
    assert num_steps(trained) == int(trained.progress.state.end) == 3
    rates = [float(row["learning_rate"]) for row in run_in(tmp_path).read_table(HISTORY)]
    assert rates[2] == pytest.approx(1e-5 + (1e-3 - 1e-5) * (1 + math.cos(math.pi * 0.5)) / 2, rel=1e-4)


def broken_drive() -> None:
    raise ValueError("no drive")


@pytest.mark.slow
def test_a_broken_drive_ends_the_preparation_of_all(tmp_path) -> None:
    with pytest.raises(ValueError, match="no drive"):
        train_run.prepare_sources([broken_drive, toy.drive], TRAINING, tmp_path, seed=0)


def test_scans_that_do_not_fit_on_the_disk_are_refused_before_any_is_prepared(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=100_000))
    with pytest.raises(ValueError, match=r"^--cache .*: 24 scans of .* need .* --variants 1 needs") as refused:
        train_run.check_space(24, TRAINING, tmp_path / "new")
    assert "\n" not in str(refused.value)
    assert not list(tmp_path.iterdir())
    (drive,) = train_run.prepare_sources([toy.drive], replace(TRAINING, num_variants=0), tmp_path, seed=0)
    assert len(drive.pyramids) == 24
    assert "nothing is kept on disk" in capsys.readouterr().out


@pytest.mark.slow
def test_a_long_drive_is_prepared_in_parts_as_in_one(tmp_path, monkeypatch, capsys) -> None:
    """Twice the same drive is one file; the bar counts scans, and a second call finds the file."""
    monkeypatch.setattr(train_run, "NUM_AT_ONCE", 7)
    alone = prepare_drive(toy.drive(), TRAINING)
    for _ in range(2):
        found = train_run.prepare_sources([toy.drive] * 2, TRAINING, tmp_path, seed=0)
        for drive in found:
            np.testing.assert_array_equal(np.load(drive.pyramids), alone.pyramids)
            assert drive.bad == alone.bad
    told = capsys.readouterr()
    assert told.out.count("prepares 24 scans of 0.0") == 1
    assert "24/24" in told.err
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".json", ".npy"]


@pytest.mark.slow
def test_a_stop_ends_the_preparation_and_leaves_no_half_file(tmp_path, monkeypatch) -> None:
    def stop(_handler: object, number: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(train_run.tqdm, "update", stop)
    with pytest.raises(KeyboardInterrupt):
        train_run.prepare_sources([toy.drive], TRAINING, tmp_path, seed=0)
    assert not list(tmp_path.iterdir())
