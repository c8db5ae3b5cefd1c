"""A run folder never loses an earlier run, is never half-written, and can be read back."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from dpmjax.cli import resumable_table, run_folder
from dpmjax.cli.options import without_latest
from dpmjax.cli.result_files import HistoryFile, commits_note, read_history, write_json
from dpmjax.cli.resumable_table import do_row, row_path
from dpmjax.cli.run_folder import (
    OutputOptions,
    RunFailedError,
    RunOptions,
    check_run_folder,
    load_config,
    open_run_folder,
    recording,
    write_metrics,
)


@dataclass(frozen=True)
class Nested:
    rates: tuple[float, ...] = (1.0, 2.0)


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    may_change: ClassVar[frozenset[str]] = frozenset({"seconds"})

    data: Path | None = None
    seconds: float | None = None
    nested: Nested = Nested()


@pytest.fixture(autouse=True)
def _in_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def open_run(**options):
    return open_run_folder(Config(**options), "toy")


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
    (run / "rows").mkdir()
    open_run(output=run.path, force=True)
    assert sorted(path.name for path in run.path.iterdir()) == ["config.json", "notes.md"]


def test_no_second_process_may_write_a_run_before_the_first_one_ends(tmp_path):
    folder = open_run(output=tmp_path / "out")
    program = (
        "import sys; from pathlib import Path; from dpmjax import cli\n"
        "try: cli.open_run_folder(cli.RunOptions(output=Path(sys.argv[1]), resume=True), 'toy')\n"
        "except ValueError as error: print(error)"
    )
    other = [sys.executable, "-c", program, str(folder.path)]
    said = subprocess.run(other, capture_output=True, text=True, check=True).stdout
    assert said == f"{folder.path}: another process is writing this run; let it end, or stop it\n"
    with recording(folder):
        pass
    assert subprocess.run(other, capture_output=True, text=True, check=True).stdout == ""


def test_force_never_touches_a_folder_that_is_no_run(tmp_path):
    (tmp_path / "thesis.txt").write_text("years")
    with pytest.raises(ValueError, match="no earlier run"):
        open_run(output=tmp_path, force=True)
    assert (tmp_path / "thesis.txt").read_text() == "years"


@pytest.mark.parametrize("name", ["scans.npy", "rows/a.txt", "."])
def test_force_never_removes_an_input(tmp_path, name):
    run = open_run(output=tmp_path / "out")
    (run / "rows").mkdir()
    for kept in ("scans.npy", "rows/a.txt"):
        (run / kept).write_text("1")
    with pytest.raises(ValueError, match="--force would remove"):
        open_run(output=run.path, data=Path("out") / name, force=True)
    assert (run / "scans.npy").exists()
    assert (run / "rows" / "a.txt").exists()


def test_a_run_that_was_killed_before_it_had_a_configuration_may_start_again(tmp_path):
    (tmp_path / ".config.json.x1").write_text("{")
    assert open_run(output=tmp_path).path == tmp_path


def test_resume_takes_the_latest_run_and_refuses_other_options():
    with pytest.raises(ValueError, match="is no run of"):
        open_run(resume=True)
    first = open_run(seed=1)
    assert open_run(seed=1, resume=True).path.resolve() == first.path.resolve()
    with pytest.raises(ValueError, match=r"--seed was 1 in .* and is 2 now"):
        open_run(seed=2, resume=True)
    with pytest.raises(ValueError, match=r"--data was not given in .* and is a now"):
        open_run(seed=1, data=Path("a"), resume=True)
    assert open_run(seed=1, seconds=60.0, resume=True).is_resumed


def test_a_path_through_latest_names_the_run_that_it_was(tmp_path):
    """The next run moves the link, and a resumed one must find the same file."""
    first = open_run(seed=1)
    link = run_folder.RESULTS / "toy" / "latest"
    config = without_latest(Config(data=link / "map.npz"))
    assert config.data == first.path / "map.npz"
    assert without_latest(Config(data=Path("latest/map.npz"))).data == Path("latest/map.npz")


def test_folder_that_cannot_be_made_is_an_input_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"cannot write to .*file"):
        open_run(output=tmp_path / "file" / "out")


def test_resume_is_named_only_to_a_command_that_has_it(tmp_path):
    open_run(output=tmp_path / "out")
    with pytest.raises(ValueError, match="holds an earlier run: --force replaces it"):
        open_run_folder(OutputOptions(output=tmp_path / "out"), "toy")


def test_check_refuses_without_touching_anything(tmp_path):
    (tmp_path / "thesis.txt").write_text("years")
    for options in ({"output": tmp_path}, {"resume": True}, {"resume": True, "force": True}):
        with pytest.raises(ValueError, match="-o|give one"):
            check_run_folder(Config(**options), "toy")
    check_run_folder(Config(output=tmp_path / "new"), "toy")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_options_survive_the_way_through_the_file():
    config = Config(data=Path("a/b"), seconds=2.5, nested=Nested((3.0,)), force=True)
    run = open_run_folder(config, "toy")
    assert load_config(run.path, Config) == replace(config, force=False)
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
    assert metrics["status"] == "done"
    assert metrics["steps"] == 3
    assert metrics["loss"] is None
    assert metrics["seed"] == 7
    assert {"python", "dpmjax", "jax", "jaxlib", "flax", "optax", "numpy"} <= set(metrics["versions"])
    assert {"device", "git_hash", "platform", "cpu", "num_cores"} <= set(metrics)


def run_rows(folder, commit, monkeypatch, methods):
    monkeypatch.setattr(resumable_table, "git_hash", lambda: commit)
    return [do_row(folder.path, {"method": method}, lambda: {"ate_px": 1.5}, seed=3) for method in methods]


def test_each_row_carries_its_own_commit_seed_and_versions(monkeypatch):
    run = open_run()
    (row,) = run_rows(run, "abc", monkeypatch, ["icp"])
    assert row == run_rows(run, "def", monkeypatch, ["icp"])[0]
    assert (row["git_hash"], row["seed"], row["ate_px"]) == ("abc", 3, 1.5)
    assert "jax " in row["versions"]


def test_the_file_names_the_rows_of_other_commits(monkeypatch):
    run = open_run()
    first = run_rows(run, "a" * 40, monkeypatch, ["icp", "swarm"])
    path = next((run.path / "rows").glob("*swarm*"))
    stored = json.loads(path.read_text())
    del stored["git_hash"]
    path.write_text(json.dumps(stored))
    rows = run_rows(run, "b" * 40 + "+changes", monkeypatch, ["icp", "swarm", "fit"])
    assert [row["git_hash"] for row in rows] == ["a" * 40, "unknown", "b" * 40 + "+changes"]
    monkeypatch.setattr(run_folder, "environment", lambda: {"git_hash": "b" * 40 + "+changes"})
    note = write_metrics(run, {}, seed=0, rows=rows)
    assert json.loads((run / "metrics.json").read_text())["note"] == note
    assert note == (
        "2 of 3 rows were made by another commit than this file (bbbbbbbbbb+changes): "
        "1 of aaaaaaaaaa (icp); 1 of unknown (swarm)"
    )
    assert commits_note(first, "a" * 40) is None
    # Rows that summarise others carry no commit.
    assert write_metrics(run, {}, seed=0, rows=rows, table=[{"num_rows": 3}]) == note
    assert json.loads((run / "metrics.json").read_text())["rows"] == [{"num_rows": 3}]


def test_a_failed_row_leaves_no_file_and_no_two_cases_share_one():
    run = open_run()

    def work():
        raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        do_row(run.path, {"method": "x"}, work, seed=0)
    assert not list((run.path).glob("rows/*"))
    case = {"method": "icp", "walk": 3, "noise_px": 0.5}
    assert row_path(run.path, case) != row_path(run.path, {**case, "noise_px": 5})


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
    assert not any(logging.getLogger(name).handlers for name in run_folder.LOGGERS)
