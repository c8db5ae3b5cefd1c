"""The state of a SLAM run in one file: the map, and what odometry and loop closure have beside it.

It is written after a keyframe. A run that was killed goes on from the file and repeats the scans since that keyframe.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dpmjax.io.files import load_arrays, refusing, write_atomically
from dpmjax.saved_maps.columns import from_columns, part_of, prefixed, to_columns
from dpmjax.saved_maps.map_file import map_arrays, map_of_arrays
from dpmjax.sequences import InputError, require
from dpmjax.slam.front_end import FrontEndState
from dpmjax.slam.loop_state import LoopState
from dpmjax.slam.reports import Loop, ScanReport
from dpmjax.slam.system import SlamState

ADVICE = "start the run again without --resume"
OF_LOOPS = ("loops",)
OF_FRONT_END = ("local_map", "scores")
"""Fields that are written apart, or made again from the map."""


class RunState(NamedTuple):
    """A run after a keyframe.

    Attributes:
        state: after the keyframe.
        reports: of all scans of the run until then.
    """

    state: SlamState
    reports: tuple[ScanReport, ...]


def save_state(path: str | Path, state: SlamState, reports: Sequence[ScanReport]) -> Path:
    """Writes the state of a run; an interruption never leaves half of it.

    Args:
        path: an existing file is replaced.
        state: after a keyframe.
        reports: of all scans of the run until then.

    Returns:
        The path.

    Raises:
        ValueError: if the map is empty, or the last scan is not the one of a keyframe.
    """
    if state.front_end.local_map is not None:
        raise ValueError("state: expected the state after a keyframe, got scans since the last one")
    arrays = prefixed(map_arrays(state.slam_map, "float32"), "map") | to_columns(reports, "report")
    arrays |= to_columns(state.loops.loops, "loop") | to_columns([state.loops], "loops", without=OF_LOOPS)
    arrays |= to_columns([state.front_end], "front_end", without=OF_FRONT_END)
    arrays["scores"] = np.array(state.front_end.scores)
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    return write_atomically(path, content.getvalue())


def load_state(path: str | Path) -> RunState:
    """Reads the state that `save_state` wrote.

    Args:
        path: the file.

    Returns:
        The state, bit for bit, and the reports.

    Raises:
        InputError: no such file, or one that cannot be read.
    """
    try:
        arrays = load_arrays(path)
        require("front_end" in arrays, path, "no state of a run", ADVICE)
        slam_map = map_of_arrays(path, part_of(arrays, "map"))
    except InputError as error:
        raise InputError(path, error.found, ADVICE) from error
    with refusing(path, "damaged: {error}", ADVICE, (Exception,)):
        (loops,) = from_columns(LoopState, arrays, "loops", without=OF_LOOPS)
        (front_end,) = from_columns(FrontEndState, arrays, "front_end", without=OF_FRONT_END)
        front_end = front_end._replace(scores=tuple(arrays["scores"].tolist()))
        loops = loops._replace(loops=tuple(from_columns(Loop, arrays, "loop")))
        return RunState(SlamState(front_end, slam_map, loops), tuple(from_columns(ScanReport, arrays, "report")))
