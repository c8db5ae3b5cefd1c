"""Makes one map of the drives of several agents that map independently (DeepPointMap, sections 4 and 5.3).

    python -m experiments.dpm_multiagent                         a simulated town, cut into three parts
    python -m experiments.dpm_multiagent path/to/drive           a drive of your own, cut into three parts
    python -m experiments.dpm_multiagent monday tuesday friday   one agent a folder
    python -m experiments.dpm_multiagent --cut kitti_00.txt kitti_05.txt   each cut into three parts, a row each (5.3)
    python -m experiments.dpm_multiagent --resume                go on where the last run stopped, or was killed

Agents exchange keyframes. Loops between them are found by the appearance of places; no position is given. Agents that
meet share one frame, others keep their own. Results go to results/dpm_multiagent/<time>/ (latest links to the newest):
a trajectory of each agent (agent_1 and so on) as TUM, KITTI and npy, graph.g2o, loops.csv and agents.png. Agents that
met have a common map (map_1.npz and so on). Errors and bytes are in metrics.json. With --cut, drives/ has these files
of each drive, and table.md a row a drive. A file of poses (TUM, KITTI) stands for a town that is simulated along it.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax.cli import (
    DriveSelection,
    RunFolder,
    RunOptions,
    StopFlag,
    check_least,
    do_row,
    open_drive,
    open_run_folder,
    recording,
    run_command,
    write_metrics,
)

if TYPE_CHECKING:
    from dpmjax.io import LidarSequence
    from dpmjax.slam import AgentsResult, SlamMethods, SlamResult

EXPERIMENT = "dpm_multiagent"


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="[DATA ...]")] = ()
    """Drives: one is cut into parts, of several each is an agent. Without any: a simulated town."""
    cut: FlagCreatePairsOff[bool] = False
    """Cut each of several drives into parts, one run a drive."""
    sequence: Annotated[str | None, arg(aliases=["-s"], metavar="NAME")] = None
    """Which drive, where DATA holds several."""
    agents: Annotated[int, arg(metavar="N")] = 3
    """Number of parts that one drive is cut into."""
    overlap: Annotated[float, arg(metavar="SHARE")] = 0.05
    """By this share of its length a part is longer at each end."""
    weights: Annotated[str, arg(metavar="NAME|FILE")] = "dpm_small"
    """Name of a shipped model, or a .safetensors file."""
    kitti_angle_correction: FlagCreatePairsOff[bool] = False
    """Raise the beams by 0.205 degrees, as KITTI's HDL-64E needs."""
    n_scans: Annotated[int | None, arg(aliases=["-n"], metavar="N")] = None
    """Number of scans of each folder."""
    jump: Annotated[int, arg(aliases=["-j"], metavar="N")] = 1
    """Use every Nth scan."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_least(self, n_scans=1, jump=1, seed=0, agents=1, overlap=0)
        if self.overlap > 1:
            raise ValueError(f"--overlap: expected a share from 0 to 1, got {self.overlap:g}")
        if self.sequence is not None and len(self.data) != 1:
            raise ValueError("--sequence chooses a drive of DATA: give one folder")
        if self.kitti_angle_correction and not self.data:
            raise ValueError("--kitti-angle-correction is for the scans of KITTI's car: give their folder, DATA")

    @property
    def selection(self) -> DriveSelection:
        """The scans of each folder."""
        return DriveSelection(
            sequence=self.sequence,
            num_scans=self.n_scans,
            jump=self.jump,
            is_kitti_corrected=self.kitti_angle_correction,
            seed=self.seed,
        )


def main(config: Config) -> dict[str, Any]:
    """Lets the agents of each run map, joins their maps, writes; returns the content of `metrics.json`."""
    from experiments._slam_agents import summary, table
    from experiments._slam_evaluation import StoppedError

    started = time.perf_counter()
    methods, runs = agent_methods(config), open_runs(config)
    folder = open_run_folder(config, EXPERIMENT)
    with recording(folder), StopFlag() as stop:
        if not config.cut:
            metrics = map_agents(folder, config, methods, runs[0], stop)
            metrics |= {"is_interrupted": stop.is_requested, "wall_s": time.perf_counter() - started}
            write_metrics(folder, metrics, seed=config.seed)
            print(f"{summary(metrics)}\nresults in {folder.path}")
            return metrics
        rows: list[dict[str, Any]] = []
        for sequences in runs:
            name = sequences[0].name
            part = folder.part("drives", name)
            work = partial(cut_row, part, config, methods, sequences, stop)
            with suppress(StoppedError):
                rows.append(do_row(folder.path, {"sequence": name}, work, seed=config.seed))
            write_metrics(folder, {"weights": config.weights}, seed=config.seed, rows=rows)
        (folder / "table.md").write_text(table(rows) + "\n", encoding="utf-8")
        print(f"{table(rows)}\nresults in {folder.path}")
    return {"rows": rows}


def cut_row(
    folder: RunFolder, config: Config, methods: SlamMethods, sequences: list[LidarSequence], stop: StopFlag
) -> dict[str, Any]:
    """Returns the numbers of a drive that is cut into parts; a run that a signal stops makes no row."""
    from experiments._slam_evaluation import StoppedError

    numbers = {} if stop.is_requested else map_agents(folder, config, methods, sequences, stop)
    if stop.is_requested:
        raise StoppedError
    return numbers


def map_agents(
    folder: RunFolder, config: Config, methods: SlamMethods, sequences: list[LidarSequence], stop: StopFlag
) -> dict[str, Any]:
    """Lets the agents of one run map, joins their maps, writes their files; returns the numbers."""
    from dpmjax.cli import map_drive, progress_bar
    from dpmjax.slam import join_agents

    agents: list[SlamResult] = []
    for number, sequence in enumerate(sequences, start=1):
        if not stop.is_requested:
            part = folder.part("agents", f"agent_{number}")
            _, agent = map_drive(part, sequence, methods, lambda: stop.is_requested)
            agents.append(agent)
    sequences = [
        sequence.take(slice(0, len(agent.reports))) for sequence, agent in zip(sequences, agents, strict=False)
    ]
    with progress_bar("loops between agents", " keyframes") as on_keyframe:
        result = join_agents(methods, agents, on_keyframe=on_keyframe)
    return write_results(folder, config, result, sequences)


def agent_methods(config: Config) -> SlamMethods:
    """Returns the methods of the model, which all agents share."""
    from dpmjax import load_model
    from dpmjax.slam import make_methods

    return make_methods(load_model(config.weights))


def open_runs(config: Config) -> list[list[LidarSequence]]:
    """Opens the scans of the agents of each run; bad input that can be known before a run is a `ValueError`."""
    from experiments._slam_agents import cut_sequence

    drives = [open_drive(replace(config.selection, data=data)) for data in config.data or (None,)]
    if len(drives) > 1 and not config.cut:
        return [drives]
    if len({drive.name for drive in drives}) < len(drives):
        raise ValueError(f"two drives have the same name ({', '.join(drive.name for drive in drives)})")
    return [cut_sequence(drive, config.agents, config.overlap) for drive in drives]


def write_results(
    folder: RunFolder, config: Config, result: AgentsResult, sequences: list[LidarSequence]
) -> dict[str, Any]:
    """Writes all files but metrics.json, and returns its numbers; the picture comes last."""
    from dpmjax import viz
    from experiments._slam_agents import agent_panels, agents_numbers, write_agents

    metrics = {"weights": config.weights, "overlap": config.overlap, **agents_numbers(result, sequences)}
    sizes = write_agents(folder, result, sequences)
    for agent, size in zip(metrics["agents"], sizes, strict=True):
        agent |= size
    write_metrics(folder, metrics, seed=config.seed)  # numbers first: a picture that fails must not cost them
    figure = viz.agents_figure(f"{len(sequences)} agents", agent_panels(result, sequences))
    viz.save_figure(figure, folder / "agents.png")
    return metrics


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))
