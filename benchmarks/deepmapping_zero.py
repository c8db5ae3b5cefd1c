"""DeepMapping from zero poses: success, error and seconds of the whole call on six walks, beside the paper's figures.

The networks' losses alone: no search, no ICP, no refinement. The walks are not those of the suite. The authors'
trajectory (v1_pose0) is added where it lies in `$DPMJAX_DATA/deepmapping_2d` (default `../shared/data`).
"""

from __future__ import annotations

import time
from typing import NamedTuple

import jax
import numpy as np

from benchmarks.deepmapping import DATA
from benchmarks.rows import Row
from dpmjax import ScanSet, fit_deepmapping
from dpmjax.io import ScanSequence, read_sequence
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.simulation import simulate_sequence

NAME = "deepmapping_zero"
_FIRST_SEED = 700
# Section 4.1: a run below this ATE is a success; numbers of the paper.
_SUCCESS_PX, _PAPER = 20.0, {"success": 0.842, "median ate": 5.7, "median wall": 1740.0}


class _Call(NamedTuple):
    """ATE in px and wall seconds of a call, compilation among them."""

    ate: float
    seconds: float


def run(quick: bool) -> list[Row]:
    """Rows of each walk, and of all together; the first walk compiles."""
    lengths = (64,) * 2 if quick else (128, 128, 128, 128, 256, 256)
    rows, calls = [], []
    for number, length in enumerate(lengths):
        sequence = simulate_sequence(number % 3, length, seed=_FIRST_SEED + number)
        calls.append(_call(sequence))
        rows += _rows(f"{sequence.name}, {length} scans, from zero", calls[-1])
    ates, seconds = np.array(calls).T
    ours = {"success": np.mean(ates < _SUCCESS_PX), "median ate": np.median(ates), "median wall": np.median(seconds)}
    units = {"success": "", "median ate": "px", "median wall": "s"}
    rows += [Row(f"{len(lengths)} walks, from zero", name, float(value), units[name]) for name, value in ours.items()]
    rows += [Row("the paper's 75 walks (GPU)", name, value, units[name]) for name, value in _PAPER.items()]
    if DATA.is_dir():
        sequence = read_sequence(DATA / "v1_pose0.tar", selection=slice(64 if quick else None))
        rows += _rows(f"{sequence.name}, from zero", _call(sequence))
    return rows


def _call(sequence: ScanSequence) -> _Call:
    assert sequence.reference_poses is not None
    begun = time.perf_counter()
    fitted = fit_deepmapping(ScanSet(sequence.points, sequence.mask), key=jax.random.key(0))
    seconds = time.perf_counter() - begun
    return _Call(absolute_trajectory_error(fitted.poses[:, :2], sequence.reference_poses[:, :2]), seconds)


def _rows(case: str, call: _Call) -> list[Row]:
    return [Row(case, "ate", call.ate, "px"), Row(case, "wall", call.seconds, "s")]
