"""A run folder never loses an earlier run, is never half-written, and can be read back."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from experiments import _run_folder
from experiments._history import HistoryFile, read_history
from experiments._json import write_json
from experiments._run_folder import RunFailedError, load_config, open_run_folder, recording, write_metrics


@dataclass(frozen=True)
class Nested:
    rates: tuple[float, ...] = (1.0, 2.0)


@dataclass(frozen=True)
class Config:
    data: Path | None = None
    output: Path | None = None
    init: str = "icp-plane"
    seed: int = 0
    seconds: float | None = None
    resume: bool = False
    force: bool = False
    nested: Nested = Nested()


@pytest.fixture(autouse=True)
def _in_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def open_run(config=None, **options):
    return open_run_folder(config or Config(), "toy", output=options.pop("output", None), **options)


def test_every_run_gets_a_folder_of_its_own_and_latest_is_the_newest():
    runs = [open_run() for _ in range(3)]
    assert len({run.path for run in runs}) == 3
    assert Path("results/toy/latest").resolve() == runs[-1].path.resolve()
    assert sorted(path.name for path in Path("results/toy").iterdir()) == sorted(
        [*(r.path.name for r in runs), "latest"]
    )


def test_named_folder_may_exist_if_it_is_empty(tmp_path):
    (tmp_path / "out").mkdir()
    assert open_run(output=tmp_path / "out").path == tmp_path / "out"
    assert not Path("results").exists()


def test_earlier_run_is_refused_resumed_or_replaced(tmp_path):
    run = open_run(output=tmp_path / "out")
    write_json(run / "metrics.json", {"ate_px": 1.0})
    (run / "notes.md").write_text("mine")
    (run / "checkpoints").mkdir()
    with pytest.raises(ValueError, match="--resume continues it, --force replaces it"):
        open_run(output=run.path)
    assert open_run(output=run.path, resume=True).is_resumed
    assert (run / "metrics.json").exists()
    open_run(output=run.path, force=True)
    assert sorted(path.name for path in run.path.iterdir()) == ["config.json", "notes.md"]


def test_force_never_touches_a_folder_that_is_no_run(tmp_path):
    (tmp_path / "thesis.txt").write_text("years")
    with pytest.raises(ValueError, match="no earlier run"):
        open_run(output=tmp_path, force=True)
    assert (tmp_path / "thesis.txt").read_text() == "years"


def test_resume_takes_the_latest_run_and_refuses_other_options():
    with pytest.raises(ValueError, match="nothing to resume"):
        open_run(resume=True)
    first = open_run(Config(seed=1))
    assert open_run(Config(seed=1, resume=True), resume=True).path.resolve() == first.path.resolve()
    with pytest.raises(ValueError, match=r"--seed was 1 in .* and is 2 now"):
        open_run(Config(seed=2), resume=True)
    longer = Config(seed=1, seconds=60.0)
    assert open_run(longer, resume=True, may_change=frozenset({"seconds"})).is_resumed


def test_folder_that_cannot_be_made_is_an_input_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"cannot write to .*file"):
        open_run(output=tmp_path / "file" / "out")


def test_options_survive_the_way_through_the_file():
    config = Config(data=Path("a/b"), seconds=2.5, nested=Nested((3.0,)), resume=True)
    run = open_run(config)
    assert load_config(run.path, Config) == replace(config, resume=False)
    write_json(run / "config.json", {"sead": 1})
    with pytest.raises(ValueError, match="sead"):
        load_config(run.path, Config)


def test_metrics_are_valid_json_with_seed_and_versions():
    run = open_run()
    write_metrics(
        run, {"ate_px": np.float32(0.5), "steps": np.int64(3), "loss": float("nan"), "x": np.arange(2)}, seed=7
    )
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["ate_px"] == 0.5
    assert metrics["steps"] == 3
    assert metrics["loss"] is None
    assert metrics["seed"] == 7
    assert {"python", "dpmjax", "jax", "jaxlib", "flax", "optax", "numpy"} <= set(metrics["versions"])
    assert {"device", "git_hash", "platform", "cpu", "num_cores"} <= set(metrics)


def test_failed_write_keeps_the_old_file(tmp_path):
    write_json(tmp_path / "a.json", {"x": 1})
    with pytest.raises(TypeError):
        write_json(tmp_path / "a.json", {"x": object()})
    assert json.loads((tmp_path / "a.json").read_text()) == {"x": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_history_of_a_resumed_run_continues_at_its_checkpoint():
    run = open_run()
    with HistoryFile(run / "metrics.csv", ["step", "loss", "ate_px"]) as history:
        for step in range(5):
            history.append(step=step, loss=step / 2)
    with (run / "metrics.csv").open("a") as file:
        file.write("5,2.5")  # killed while writing
    with HistoryFile(run / "metrics.csv", ["step", "loss", "ate_px"], keep_until=2) as history:
        history.append(step=3, loss=9, ate_px=1.5)
    rows = read_history(run / "metrics.csv")
    assert [row["step"] for row in rows] == ["0", "1", "2", "3"]
    assert rows[-1] == {"step": "3", "loss": "9", "ate_px": "1.5"}
    assert rows[0]["ate_px"] == ""


def test_log_holds_what_happened_and_the_traceback():
    run = open_run()

    def fit():
        with recording(run):
            logging.getLogger("dpmjax.fit").info("step %d", 3)
            raise ValueError("broken")

    with pytest.raises(RunFailedError, match="ValueError: broken"):
        fit()
    log = (run / "log.txt").read_text()
    assert "step 3" in log
    assert "Traceback" in log
    assert not any(logging.getLogger(name).handlers for name in _run_folder.LOGGERS)
