"""The folder of a run, its tables and numbers, and options of a command line."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
import pytest
from tyro.conf import Positional, arg

from dpmjax.cli import run as run_module
from dpmjax.cli.options import OutputOptions, RunOptions, parse_options
from dpmjax.cli.run import Run, load_options, write_json


@dataclass(frozen=True)
class Nested:
    rates: tuple[float, ...] = (1.0, 2.0)


@dataclass(frozen=True, kw_only=True)
class ToyOptions(RunOptions):
    may_change: ClassVar[frozenset[str]] = frozenset({"seconds"})

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    seconds: float | None = None
    steps: Annotated[int | None, arg(aliases=["-n"])] = None
    world: Literal[0, 1, "grove"] = 0
    groups: tuple[int, ...] = ()
    nested: Nested = Nested()

    def __post_init__(self):
        if self.steps == 0:
            raise ValueError("--steps: expected at least 1, got 0")


@pytest.fixture(autouse=True)
def _in_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def start():
    runs = []

    def open_run(**options) -> Run:
        runs.append(Run("toy", ToyOptions(**options)))
        runs[-1].open()
        return runs[-1]

    yield open_run
    for run in runs:
        run.close()


def test_every_run_gets_a_folder_of_its_own_and_latest_is_the_newest(start):
    runs = [start() for _ in range(3)]
    assert len({run.path for run in runs}) == 3
    assert Path("results/toy/latest").resolve() == runs[-1].path.resolve()
    assert {path.name for path in Path("results/toy").iterdir()} == {*(run.path.name for run in runs), "latest"}


def test_earlier_run_is_refused_resumed_or_replaced(start, tmp_path):
    (tmp_path / "out").mkdir()  # an empty folder may be there
    run = start(output=tmp_path / "out")
    write_json(run / "metrics.json", {"ate_px": 1.0})
    run.close()
    with pytest.raises(ValueError, match="--resume continues it, --force replaces it"):
        start(output=run.path)
    with pytest.raises(ValueError, match="holds an earlier run: --force replaces it"):
        Run("toy", OutputOptions(output=run.path))
    resumed = start(output=run.path, resume=True)
    assert resumed.is_resumed
    assert (run / "metrics.json").exists()
    resumed.close()
    start(output=run.path, force=True)
    assert {path.name for path in run.path.iterdir()} == {"config.json", "log.txt"}
    assert not Path("results").exists()


@pytest.mark.parametrize("options", [{"output": "."}, {"output": ".", "force": True}, {"resume": True}])
@pytest.mark.parametrize("other", ["thesis.txt", "config.json"])
def test_a_folder_that_is_no_run_is_refused_and_stays_as_it_is(tmp_path, options, other):
    (tmp_path / other).write_text('{"name": "of another program"}')
    if "output" in options:
        options = options | {"output": tmp_path}
    with pytest.raises(ValueError, match="-o"):
        Run("toy", ToyOptions(**options))
    assert [path.name for path in tmp_path.iterdir()] == [other]


@pytest.mark.parametrize("name", ["scans.npy", "rows/a.txt", "."])
def test_force_never_removes_an_input(start, tmp_path, name):
    run = start(output=tmp_path / "out")
    (run / "rows").mkdir()
    for kept in ("scans.npy", "rows/a.txt"):
        (run / kept).write_text("1")
    with pytest.raises(ValueError, match="--force would remove"):
        start(output=run.path, data=Path("out") / name, force=True)
    assert (run / "scans.npy").exists()
    assert (run / "rows" / "a.txt").exists()


def test_resume_takes_the_latest_run_and_refuses_other_options(start):
    with pytest.raises(ValueError, match="is no run of"):
        start(resume=True)
    first = start(seed=1)
    first.close()
    assert start(seed=1, resume=True).path.resolve() == first.path.resolve()
    with pytest.raises(ValueError, match=r"--seed was 1 in .* and is 2 now"):
        start(seed=2, resume=True)
    with pytest.raises(ValueError, match=r"--data was not given in .* and is a now"):
        start(seed=1, data=Path("a"), resume=True)
    with pytest.raises(ValueError, match="give one of them"):
        start(seed=1, resume=True, force=True)
    assert Run("toy", ToyOptions(seed=1, seconds=60.0, resume=True)).is_resumed


def test_a_path_through_latest_names_the_run_that_it_was(start):
    """The next run moves the link, and a resumed one must find the same file."""
    run = start()
    (run / "map.npz").write_text("")

    def main(options: ToyOptions, run: Run) -> None:
        """Takes the options."""

    read = run_module._read_options(main, "toy", None, ["results/toy/latest/map.npz"])
    assert read.data == (run / "map.npz").resolve()


def test_folder_that_cannot_be_made_is_an_input_error(start, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"cannot write to .*file"):
        start(output=tmp_path / "file" / "out")


def test_options_survive_the_way_through_the_file(start):
    options = ToyOptions(data=Path("a/b"), seconds=2.5, nested=Nested((3.0,)))
    run = start(**{name: getattr(options, name) for name in ("data", "seconds", "nested")})
    assert load_options(run.path, ToyOptions) == options
    write_json(run / "config.json", {"sead": 1})
    with pytest.raises(ValueError, match="sead"):
        load_options(run.path, ToyOptions)


def test_metrics_are_valid_json_with_seed_and_versions(start):
    run = start(seed=7)
    run.write_numbers({"ate_px": np.float32(0.5), "steps": np.int64(3), "loss": float("nan"), "x": np.arange(2)})
    found = json.loads((run / "metrics.json").read_text())
    assert (found["ate_px"], found["status"], found["steps"], found["loss"]) == (0.5, "done", 3, None)
    assert (found["x"], found["seed"], found["input_notes"]) == ([0, 1], 7, [])
    assert {"python", "dpmjax", "jax", "jaxlib", "flax", "optax", "numpy"} <= set(found["versions"])
    assert {"device", "git_hash", "platform", "cpu", "num_cores", "wall_s"} <= set(found)


def test_the_table_of_a_resumed_run_continues_at_its_checkpoint(start):
    run = start()
    for step in range(5):
        run.append_row("metrics.csv", step=step, loss=step / 2, ate_px="")
    with (run / "metrics.csv").open("a") as file:
        file.write("5,2.5")  # killed while writing
    assert len(run.read_table("metrics.csv")) == 5
    assert [row["step"] for row in run.continue_table("metrics.csv", until=2)] == ["0", "1", "2"]
    run.append_row("metrics.csv", step=3, loss=9, ate_px=1.5)
    rows = run.read_table("metrics.csv")
    assert [row["step"] for row in rows] == ["0", "1", "2", "3"]
    assert rows[-1] == {"step": "3", "loss": "9", "ate_px": "1.5"}
    assert rows[0]["ate_px"] == ""
    assert run.continue_table("metrics.csv", until=-1) == run.read_table("metrics.csv") == []


def parse(*words):
    return parse_options(ToyOptions, words, prog="dpmjax toy")


def test_a_check_of_the_options_says_what_it_expects():
    with pytest.raises(ValueError, match="^--steps: expected at least 1, got 0$"):
        parse("a", "-n", "0")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("a -n x", "--steps: .*'x'"),
        ("a --world 7", "'7' for argument '--world'. Expected one of .*'grove'"),
        ("a --seconds", "Missing value for argument '--seconds'"),
        ("a --second 3", "Unrecognized options: --second, 3"),
        ("a b", "Unrecognized options: b"),
        ("a " + "/".join(["long"] * 60), "Unrecognized options: long/"),
    ],
)
@pytest.mark.parametrize("columns", ["30", "200"])
def test_an_error_is_one_line_that_names_the_option(words, message, columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(ValueError, match=f"^[^\n]*{message}[^\n]*; --help describes the options$") as error:
        parse(*words.split())
    assert not re.search("[│╭╰\x1b]", str(error.value))
    assert capsys.readouterr().err == ""
