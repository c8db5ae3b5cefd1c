"""A finished run of `dpmjax map2d`: scans and fit, read from the folder of the run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dpmjax.cli.map2d import NAME, Config, fit_settings, read_scans
from dpmjax.cli.map2d_results import scan_set_of
from dpmjax.cli.run_folder import CHECKPOINTS, find_run, load_config

if TYPE_CHECKING:
    from dpmjax.deepmapping import Fitted
    from dpmjax.sequences import ScanSequence


class Map2dRun(NamedTuple):
    """A finished run.

    Attributes:
        sequence: the scans.
        fitted: the fit, with the poses of the map.
        world: the built-in world; None where the scans were read from files.
    """

    sequence: ScanSequence
    fitted: Fitted
    world: int | str | None


def read_map2d_run(path: Path) -> Map2dRun:
    """Reads a run of all scans in their order.

    Args:
        path: the folder.

    Returns:
        Map2dRun.

    Raises:
        ValueError: the folder holds no options, no trajectory or no checkpoint that can be read; or its fit has other
            scans than the sequence, or another order of them.
    """
    import jax

    from dpmjax.checkpoints import Checkpoints
    from dpmjax.deepmapping import Fitted, init, mapping_data, mapping_problem

    config, trajectory = load_config(find_run(NAME, path), Config), path / "trajectory.npy"
    if not trajectory.is_file():
        raise ValueError(f"{path} holds no trajectory.npy: let the run end, or resume it")
    if not config.ordered:
        raise ValueError(
            f"{path} is a run with --no-ordered, whose fit has another order of the scans; use an ordered one"
        )
    sequence = read_scans(config)
    if sequence.unit == "m":
        raise ValueError(f"{path} is a run on {sequence.name}, in metres, whose fit may have a part of the scans")
    settings = fit_settings(config, sequence)
    data, unit = mapping_data(scan_set_of(sequence), None if config.init == "zero" else np.load(trajectory))
    problem = mapping_problem(settings, data)
    like = init(problem, data, key=jax.random.key(0))
    state = Checkpoints((path / CHECKPOINTS).resolve()).restore_latest(like, fallback=None)
    if state is None:
        raise ValueError(f"{path} holds no checkpoint that can be read")
    poses = np.asarray(problem.poses(settings, problem.phases[int(state.phase)], state.params, data), np.float64)
    fitted = Fitted(poses * [unit, unit, 1.0], state.params, None, unit, settings, int(state.step))
    return Map2dRun(sequence, fitted, config.world if config.data is None else None)
