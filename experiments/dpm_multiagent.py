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
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax import cli, load_model, viz
from dpmjax.io import LidarSequence
from dpmjax.slam import SlamMethods, join_agents, make_methods
from experiments._slam_agents import agent_panels, agents_numbers, cut_sequence, summary, table, write_agents

EXPERIMENT = "dpm_multiagent"


@dataclass(frozen=True, kw_only=True)
class Config(cli.DriveOptions):
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

    def __post_init__(self) -> None:
        """Checks ranges."""
        super().__post_init__()
        cli.check_least(self, agents=1, overlap=0)
        self.check_data(self.data, self.sequence)
        if self.overlap > 1:
            raise ValueError(f"--overlap: expected a share from 0 to 1, got {self.overlap:g}")
        if self.sequence is not None and len(self.data) != 1:
            raise ValueError("--sequence chooses a drive of DATA: give one folder")


def main(config: Config) -> Any:
    """Lets the agents of each run map, joins their maps, writes; returns the numbers, or a row for each drive."""
    started = time.perf_counter()
    methods, runs = agent_methods(config), open_runs(config)
    if not config.cut:
        folder = cli.open_run_folder(config, EXPERIMENT)
        with cli.recording(folder), cli.StopFlag() as stop:
            metrics = map_agents(folder, config, methods, runs[0], lambda: stop.is_requested)
            metrics |= {"is_interrupted": stop.is_requested, "wall_s": time.perf_counter() - started}
            cli.write_metrics(folder, metrics, seed=config.seed)
            print(f"{summary(metrics)}\nresults in {folder.path}")
        return metrics
    by_name = {sequences[0].name: sequences for sequences in runs}

    def work(run: cli.TableRun, sequence: str) -> cli.Row:
        part = run.folder.part("drives", sequence)
        numbers = map_agents(part, config, methods, by_name[sequence], run.is_stopped)
        run.check_stop()
        return numbers

    numbers = {"weights": config.weights}
    cases = [{"sequence": name} for name in by_name]
    return cli.run_table(config, EXPERIMENT, cases, work, lambda rows: cli.Summary(numbers, table(rows)))


def map_agents(
    folder: cli.RunFolder,
    config: Config,
    methods: SlamMethods,
    sequences: list[LidarSequence],
    is_stopped: Callable[[], bool],
) -> dict[str, Any]:
    """Lets the agents of one run map, joins their maps, writes their files; returns the numbers."""
    agents = []
    for number, sequence in enumerate(sequences, start=1):
        if not is_stopped():
            part = folder.part("agents", f"agent_{number}")
            agents.append(cli.map_drive(part, sequence, methods, is_stopped)[1])
    mapped = [sequence.take(slice(0, len(agent.reports))) for sequence, agent in zip(sequences, agents, strict=False)]
    with cli.progress_bar("loops between agents", " keyframes") as on_keyframe:
        result = join_agents(methods, agents, on_keyframe=on_keyframe)
    metrics = {"weights": config.weights, "overlap": config.overlap, **agents_numbers(result, mapped)}
    for agent, size in zip(metrics["agents"], write_agents(folder, result, mapped), strict=True):
        agent |= size
    cli.write_metrics(folder, metrics, seed=config.seed)  # numbers first: a picture that fails must not cost them
    viz.save_figure(viz.agents_figure(f"{len(mapped)} agents", agent_panels(result, mapped)), folder / "agents.png")
    return metrics


def agent_methods(config: Config) -> SlamMethods:
    """Returns the methods of the model, which all agents share."""
    return make_methods(load_model(config.weights))


def open_runs(config: Config) -> list[list[LidarSequence]]:
    """Opens the scans of the agents of each run; bad input that can be known before a run is a `ValueError`."""
    drives = [cli.open_drive(data, config, config.sequence) for data in config.data or (None,)]
    if len(drives) > 1 and not config.cut:
        return [drives]
    if len({drive.name for drive in drives}) < len(drives):
        raise ValueError(f"two drives have the same name ({', '.join(drive.name for drive in drives)})")
    return [cut_sequence(drive, config.agents, config.overlap) for drive in drives]


if __name__ == "__main__":
    raise SystemExit(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
