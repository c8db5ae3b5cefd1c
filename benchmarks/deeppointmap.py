"""DeepPointMap from a raw scan to descriptors, motions and overlap, beside the authors' program and the goal.

Each stage runs in a process of its own. The input is a scan of the simulated town (HDL-64E, about 100,000 points), and
one of KITTI where `$DPMJAX_DATA/lidar_3d` (default `../shared/data`) has it. On the CPU always, on a GPU too where JAX
has one.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import NamedTuple

import jax

from benchmarks.deeppointmap_stages import stage_rows
from benchmarks.rows import Row, in_new_process

FULL = (
    "products",
    *(f"encode {preset}" for preset in ("tiny", "small", "paper")),
    "JAX builders paper",
    "match scan",
    "match map",
    "overlap",
    "train tiny",
    "train small",
    "everything paper",
)
QUICK = ("products", "encode tiny", "match tiny", "everything tiny")


class Figure(NamedTuple):
    """Reference of a number, in its unit.

    Attributes:
        theirs: the authors' program, measured once on two cores of an AMD EPYC with random weights (paper size, a KITTI
            scan of 122,500 points); None where they have no such thing.
        goal: ours; None where there is none.
    """

    theirs: float | None = None
    goal: float | None = None


FIGURES: dict[str, Figure] = {
    "paper, KITTI scan: preprocess": Figure(theirs=98.0),
    "paper, KITTI scan: pyramid": Figure(theirs=990.0),
    "paper, KITTI scan: network": Figure(theirs=250.0),
    "paper, KITTI scan: preprocess + encode": Figure(theirs=1318.0, goal=60.0),
    "paper, town scan: preprocess + encode": Figure(goal=60.0),
    "small, KITTI scan: preprocess + encode": Figure(goal=30.0),
    "small, town scan: preprocess + encode": Figure(goal=30.0),
    "paper, 256 x 256: registration (correlate, match, align)": Figure(theirs=75.0, goal=40.0),
    "paper, 256 x 2048: registration (correlate, match, align)": Figure(theirs=540.0, goal=300.0),
    "paper, one pair: overlap": Figure(theirs=82.0, goal=40.0),
    "small, K = 2, 16 scans: training step": Figure(goal=450.0),
    "process of everything paper": Figure(theirs=1.0, goal=1.0),
}
"""By case. Held against the median, or against the peak memory of the one process that does all of it."""


def run(quick: bool) -> list[Row]:
    """Returns rows of all stages on the CPU; then on the GPU, where JAX has one, under names that say so."""
    # Several processes share the GPU.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = run_stage("scans", folder, quick)
        rows = [row for row in rows if row.metric == "size"]
        for stage in QUICK if quick else FULL:
            rows += with_figures(run_stage(stage, folder, quick, platform="cpu"))
        if jax.default_backend() == "gpu":
            for stage in QUICK if quick else FULL:
                rows += [row._replace(case=f"GPU, {row.case}") for row in run_stage(stage, folder, quick)]
    return rows


def run_stage(stage: str, folder: Path, quick: bool, *, platform: str | None = None) -> list[Row]:
    """Returns rows of one stage, run in a fresh process on a platform, or on the device that JAX chooses."""
    return in_new_process(stage_rows, stage, folder, quick, **({} if platform is None else {"JAX_PLATFORMS": platform}))


def with_figures(rows: list[Row]) -> list[Row]:
    """Returns the rows, each followed by the authors' figure and by the goal, where they exist."""
    result = []
    for row in rows:
        result.append(row)
        figure = FIGURES.get(row.case, Figure())
        if row.metric in ("median", "peak memory"):
            result += [
                Row(row.case, f"{row.metric}, {name}", value, row.unit)
                for name, value in (("authors' program", figure.theirs), ("goal", figure.goal))
                if value is not None
            ]
    return result
