"""Bars of the pipelines: on a terminal, in no file, and not with `progress=False`."""

import io

import numpy as np
import pytest

from dpmjax import progress
from dpmjax.slam import SlamConfig, run_slam
from dpmjax.slam.interfaces import SlamMethods
from tests.slam.truth import TruthGeometry, TruthMatcher, laps, scans_of


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("stream", "is_shown", "is_written"),
    [(Terminal(), True, True), (Terminal(), False, False), (io.StringIO(), True, False)],
)
def test_slam_counts_its_scans_on_a_terminal_alone(stream, is_shown: bool, is_written: bool, monkeypatch) -> None:
    monkeypatch.setattr(progress, "_SILENT_S", 0.0)
    monkeypatch.setattr("sys.stderr", stream)
    truth = laps(1, side_m=4.0, step_m=2.0)
    methods = SlamMethods(TruthMatcher(truth), TruthGeometry(truth), SlamConfig())
    result = run_slam(methods, scans_of(range(len(truth))), progress=is_shown)
    assert np.isfinite(result.T_world_scan).all()
    assert (f"{len(truth)}/{len(truth)}" in stream.getvalue()) == is_written
    assert bool(stream.getvalue()) == is_written


def test_a_share_is_shown_in_percent(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Terminal()
    monkeypatch.setattr(progress, "_SILENT_S", 0.0)
    monkeypatch.setattr("sys.stderr", stream)
    with progress.progress_bar("fit", is_shown=True) as bar:
        bar.update(0.25 - bar.n)
        bar.refresh()
    assert "fit  25%" in stream.getvalue()
