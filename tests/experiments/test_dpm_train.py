"""The command that trains: options, the background, and runs that are broken off."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np
import pytest

from dpmjax.deeppointmap import CurriculumStage
from experiments._dpm_data import ScanStore, made_ahead
from experiments._dpm_fit import run_training
from experiments._dpm_recall import draw_pairs
from experiments._history import read_history
from experiments._run_folder import HISTORY, RunFolder
from experiments.dpm_train import Config
from tests.deeppointmap import toy

REPOSITORY = Path(__file__).parents[2]
TRAINING = replace(toy.TRAINING, curriculum=(CurriculumStage(2, 4),))


class StopAfter:
    """Asks to stop when it was asked so often."""

    received = None

    def __init__(self, num: int) -> None:
        self._left = num

    @property
    def is_requested(self) -> bool:
        self._left -= 1
        return self._left < 0


def train(folder: Path, *, stop_after: int = 99, is_resumed: bool = False):
    folder.mkdir(exist_ok=True)
    store = ScanStore([toy.drive()], TRAINING)
    paired = draw_pairs(toy.drive(seed=9), 2, seed=0)
    run_folder, stop = RunFolder(folder, is_resumed), StopAfter(stop_after)
    return run_training(run_folder, store, TRAINING, paired, seed=0, recall_every=2, stop=stop)


def test_a_broken_off_run_goes_on_with_the_numbers_of_an_unbroken_one(tmp_path: Path) -> None:
    whole = train(tmp_path / "whole")
    assert train(tmp_path / "parts", stop_after=3).steps == 3
    parts = train(tmp_path / "parts", is_resumed=True)
    assert parts.steps == whole.steps == TRAINING.num_steps
    jax.tree.map(np.testing.assert_array_equal, parts.model.params, whole.model.params)
    rows = [read_history(tmp_path / name / HISTORY) for name in ("whole", "parts")]
    for one, other in zip(*rows, strict=True):
        assert {**one, "run_s": ""} == {**other, "run_s": ""}
    assert 0 <= parts.examined.recall.recall <= 1


def test_results_made_ahead_come_in_order_and_errors_where_they_belong() -> None:
    def make(step: int) -> int:
        if step == 3:
            raise ValueError("bad batch")
        return step

    with made_ahead(make, 1, 9) as results:
        assert [next(results), next(results)] == [1, 2]
        with pytest.raises(ValueError, match="bad batch"):
            next(results)


def test_a_bad_scan_is_empty_and_named() -> None:
    from dpmjax.data import InputError

    drive = toy.drive()

    @dataclass
    class Reader:
        def __call__(self, index: int) -> np.ndarray:
            if index == 2:
                raise InputError("scan 2", "cut off", "leave it out")
            return drive.read_scan(index)

    store = ScanStore([type(drive)(drive.name, drive.sources, Reader(), drive.T_world_lidar)], toy.TRAINING)
    assert store[1].mask.any()
    assert not store[2].mask.any()
    assert list(store.bad) == ["2"]


def test_help_needs_no_jax_and_shows_examples() -> None:
    code = (
        "import sys; from experiments._command import run_command; from experiments import dpm_train as m;"
        "code = run_command(m.main, m.Config, experiment=m.EXPERIMENT, description=m.__doc__, args=['--help']);"
        "assert not {'jax', 'matplotlib', 'scipy'} & set(sys.modules), 'slow imports'; sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for part in ("python -m experiments.dpm_train --resume", "--preset {tiny,small,paper}", "--data", "-o OUT"):
        assert part in done.stdout


@pytest.mark.parametrize(
    ("options", "message"),
    [({"steps": 1}, "--steps"), ({"num_towns": 0}, "--num-towns"), ({"town_length_m": 5.0}, "--town-length-m")],
)
def test_options_out_of_range_are_refused(options, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Config(**options)
