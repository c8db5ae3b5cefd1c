"""The promises of every command to the shell: exit codes, one-line errors, results on Ctrl-C, resume."""

import signal
import time

import pytest

from dpmjax.cli.run import STOPPING
from tests.processes import start_python

TOY = '''
"""A toy.

    python -m experiments.toy scans.txt -o out
"""
from __future__ import annotations
import sys, time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
import tyro
from dpmjax.cli.options import RunOptions
from dpmjax.cli.run import HISTORY, Numbers, Run, run_command

@dataclass(frozen=True, kw_only=True)
class ToyOptions(RunOptions):
    may_change: ClassVar[frozenset[str]] = frozenset({"steps"})

    data: tyro.conf.Positional[Path | None] = None
    """Scans."""
    steps: int = 3
    fail: bool = False
    no_loop: tyro.conf.FlagCreatePairsOff[bool] = False

def main(options: ToyOptions, run: Run) -> Numbers:
    if options.data is not None and not options.data.exists():
        raise ValueError(f"{options.data}: no such file\\n  name a file of scans")
    run.open()
    start = len(run.continue_table(HISTORY))
    for step in range(start, options.steps):
        run.append_row(HISTORY, step=step)
        print(step, flush=True)
        if options.fail:
            raise ValueError("diverged")
        if options.steps > 100:
            time.sleep(0.01)
        if run.is_stopped:
            break
    if options.seed == 99:
        while True:  # a step that does not end
            time.sleep(0.01)
    assert "jax" not in sys.modules
    return {"steps": options.steps, "verdict": "all steps are done"}

if __name__ == "__main__":
    raise SystemExit(run_command(main, name="toy", description=__doc__))
'''


@pytest.fixture
def toy(tmp_path):
    (tmp_path / "toy.py").write_text(TOY)
    return lambda *arguments: start_python("toy.py", *arguments, cwd=tmp_path)


def finish(process):
    output, errors = process.communicate(timeout=20)
    return process.returncode, output, errors


def stop_after_first_step(process, *signals):
    assert process.stdout.readline() == "0\n"
    for number in signals:
        process.send_signal(number)
        time.sleep(0.3)
    return finish(process)


def test_help_shows_the_examples(toy):
    code, output, _ = finish(toy("--help"))
    assert code == 0
    assert "    python -m experiments.toy scans.txt -o out\n" in output
    assert "usage: python -m experiments.toy" in output


def test_bad_input_is_one_line_and_leaves_no_folder(toy, tmp_path):
    code, _, errors = finish(toy("missing.pcd", "-o", "out"))
    assert code == 2
    assert errors == "dpmjax: error: missing.pcd: no such file name a file of scans\n"
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "results").exists()


def test_failure_on_the_way_exits_with_one_and_names_the_partial_results(toy, tmp_path):
    code, _, errors = finish(toy("-o", "out", "--fail"))
    assert code == 1
    assert errors.splitlines()[-1] == "dpmjax: error: ValueError: diverged; what was finished is in out"
    assert "Traceback" in (tmp_path / "out" / "log.txt").read_text()
    assert (tmp_path / "out" / "metrics.csv").read_text() == "step\n0\n"


@pytest.mark.parametrize(("number", "expected"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_stopped_run_writes_what_it_has_and_resumes(toy, tmp_path, number, expected):
    code, _, errors = stop_after_first_step(toy("-o", "out", "--steps", "5000"), number)
    assert code == expected
    assert errors == f"{STOPPING}dpmjax: stopped by {number.name}\n"
    assert (tmp_path / "out" / "metrics.json").exists()
    done = len((tmp_path / "out" / "metrics.csv").read_text().splitlines()) - 1
    code, output, _ = finish(toy("-o", "out", "--resume", "--steps", str(done + 2)))
    assert code == 0
    assert output.splitlines() == [str(done), str(done + 1), "all steps are done", "results in out"]
    rows = (tmp_path / "out" / "metrics.csv").read_text().split()
    assert rows == ["step", *map(str, range(done + 2))]


def test_second_signal_ends_at_once(toy):
    code, _, errors = stop_after_first_step(toy("--seed", "99"), signal.SIGINT, signal.SIGINT)
    assert (code, errors) == (130, f"{STOPPING}dpmjax: stopped by SIGINT\n")


@pytest.mark.slow
def test_resumed_command_may_repeat_its_flags(toy):
    assert finish(toy("-o", "out", "--no-loop"))[0] == 0
    assert finish(toy("-o", "out", "--no-loop", "--resume"))[0] == 0
    assert finish(toy("-o", "out", "--no_loop", "--resume"))[0] == 0
    assert finish(toy("-o", "other"))[0] == 0
    code, _, errors = finish(toy("-o", "other", "--no-loop", "--resume"))
    assert code == 2
    assert "--no-loop was False" in errors
