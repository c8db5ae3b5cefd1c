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
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax import cli, load_model, metrics, slam, viz, write_g2o
from dpmjax.geometry import rigid
from dpmjax.io import LidarSequence
from dpmjax.slam import AgentsResult

EXPERIMENT = "dpm_multiagent"
# Parts of a drive that is cut, and the share of its length by which a part is longer at each end.
NUM_AGENTS, OVERLAP = 3, 0.05


@dataclass(frozen=True, kw_only=True)
class Config(cli.DriveOptions):
    """Options of the run."""

    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="[DATA ...]")] = ()
    """Drives: one is cut into parts, of several each is an agent. Without any: a simulated town."""
    cut: FlagCreatePairsOff[bool] = False
    """Cut each of several drives into parts, one run a drive."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        super().__post_init__()
        self.check_data(self.data, None)


def main(config: Config) -> Any:
    """Lets the agents of each run map, joins their maps, writes; returns the numbers, or a row for each drive."""
    started = time.perf_counter()
    methods, runs = slam.make_methods(load_model(config.weights)), open_runs(config)
    if not config.cut:
        folder = cli.open_run_folder(config, EXPERIMENT)
        with cli.recording(folder), cli.StopFlag() as stop:
            numbers = map_agents(cli.TableRun(folder, lambda: stop.is_requested), config, methods, runs[0])
            numbers |= {"status": stop.status, "wall_s": time.perf_counter() - started}
            cli.write_metrics(folder, numbers, seed=config.seed)
            drives = ", ".join(dict.fromkeys(agent["sequence"] for agent in numbers["agents"]))
            print(table([{"sequence": drives, **numbers}]), f"results in {folder.path}", sep="\n")
        return numbers
    by_name = {sequences[0].name: sequences for sequences in runs}

    def work(run: cli.TableRun, sequence: str) -> cli.Row:
        part = run._replace(folder=run.folder.part("drives", sequence))
        row = map_agents(part, config, methods, by_name[sequence])
        run.check_stop()
        return row

    cases, weights = [{"sequence": name} for name in by_name], {"weights": config.weights}
    return cli.run_table(config, EXPERIMENT, cases, work, lambda rows: cli.Summary(weights, table(rows)))


def map_agents(run: cli.TableRun, config: Config, methods: slam.SlamMethods, sequences: list[LidarSequence]) -> cli.Row:
    """Lets the agents of one run map, joins their maps, writes their files; returns the numbers."""
    agents, folder = [], run.folder
    for number, sequence in enumerate(sequences, start=1):
        if not run.is_stopped():
            part = folder.part("agents", f"agent_{number}")
            agents.append(cli.map_drive(part, sequence, methods, run.is_stopped)[1])
    mapped = [sequence.take(slice(0, len(agent.reports))) for sequence, agent in zip(sequences, agents, strict=False)]
    with cli.progress_bar("loops between agents", " keyframes") as on_keyframe:
        result = slam.join_agents(methods, agents, on_keyframe=on_keyframe)
    sizes = write_agents(folder, result, mapped)
    numbers = {"weights": config.weights, "overlap": OVERLAP, **agents_numbers(result, mapped, sizes)}
    status = "interrupted" if run.is_stopped() else "done"
    # Numbers first: a picture that fails must not cost them.
    cli.write_metrics(folder, {"status": status, **numbers}, seed=config.seed)
    viz.save_figure(viz.figure(agent_panels(result, mapped), title=f"{len(mapped)} agents"), folder / "agents.png")
    return numbers


def open_runs(config: Config) -> list[list[LidarSequence]]:
    """Opens the scans of the agents of each run; bad input that can be known before a run is a `ValueError`."""
    drives = [cli.with_reference_only(cli.open_drive(data, config)) for data in config.data or (None,)]
    if len(drives) > 1 and not config.cut:
        return [drives]
    cli.check_names_differ(drives)
    return [cut_sequence(drive, NUM_AGENTS, OVERLAP) for drive in drives]


def cut_sequence(sequence: LidarSequence, num_agents: int, overlap: float) -> list[LidarSequence]:
    """Cuts a sequence into parts of one length, each longer by a share of it at both ends (DeepPointMap section 5.3).

    Raises:
        ValueError: fewer scans than agents.
    """
    num = len(sequence)
    if num < num_agents:
        raise ValueError(f"{sequence.name}: {num} scans are too few for {num_agents} agents")
    length, parts = num / num_agents, []
    for agent in range(num_agents):
        start = max(round(agent * length - overlap * length), 0)
        end = min(round((agent + 1) * length + overlap * length), num)
        parts.append(sequence.take(slice(start, end)))
    return parts


def write_agents(folder: cli.RunFolder, result: AgentsResult, sequences: list[LidarSequence]) -> list[dict[str, int]]:
    """Writes trajectories, graph, loops and maps; returns the bytes that each agent sends at each precision."""
    sizes = []
    for number, (T_world_scan, agent, sequence) in enumerate(
        zip(result.T_world_scan, result.agents, sequences, strict=True), start=1
    ):
        cli.write_trajectory(folder.path, T_world_scan, sequence.times, f"agent_{number}")
        path = folder.part("agents", f"agent_{number}") / "map.npz"
        sizes.append(cli.write_map_file(path, agent.map) if len(agent.map) else {})
    for component in range(max(result.component) + 1):
        slam_map = slam.take_component(result.joined, component)
        if len(slam_map):
            cli.write_map_file(folder / f"map_{component + 1}.npz", slam_map)
    if len(result.joined.slam_map):
        write_g2o(folder / "graph.g2o", slam.as_pose_graph(result.joined.slam_map))
    columns = ("kind", "agent", "scan", "other_agent", "other_scan", *cli.LOOP_CELLS)
    cli.write_table(folder / "loops.csv", columns, loop_rows(result))
    return sizes


def loop_rows(result: AgentsResult) -> list[dict[str, Any]]:
    """Returns candidates within agents, then those between them, by agents counted from 1 and their scans."""
    joined: list[dict[str, int]] = []
    within: list[dict[str, Any]] = []
    for number, agent in enumerate(result.agents, start=1):
        ends = [{"agent": number, "scan": int(scan)} for scan in agent.keyframes]
        within += cli.loop_rows(agent.loops, ends)
        joined += ends
    kinds = {"within": within, "between": cli.loop_rows(result.joined.loops, joined)}
    return [{"kind": kind, **row} for kind, rows in kinds.items() for row in rows]


def agents_numbers(result: AgentsResult, sequences: list[LidarSequence], sizes: list[dict[str, int]]) -> cli.Row:
    """Returns what `metrics.json` says: errors of each component in its one frame, of each agent, and bytes."""
    agents = [
        {
            "agent": number,
            "sequence": sequence.name,
            "component": result.component[number - 1] + 1,
            "num_scans": len(T_world_scan),
            "num_keyframes": len(agent.keyframes),
            "num_loops": len(cli.accepted_ends(agent.loops)),
            **cli.trajectory_errors(T_world_scan, sequence.T_world_lidar),
            **cli.trajectory_errors(agent.T_world_scan, sequence.T_world_lidar, "_alone"),
            **traffic._asdict(),
            **size,
        }
        for number, (T_world_scan, agent, traffic, sequence, size) in enumerate(
            zip(result.T_world_scan, result.agents, result.traffic, sequences, sizes, strict=True), start=1
        )
    ]
    components = [
        {
            "component": component + 1,
            "agents": [number + 1 for number in members],
            "ate_m": joint_ate_m(result, sequences, members),
        }
        for component, members in enumerate(members_of(result))
    ]
    return {
        "num_agents": len(agents),
        "num_components": len(components),
        "num_loops_between": len(cli.accepted_ends(result.joined.loops)),
        "num_wrong_loops_between": num_wrong(result, sequences),
        "meetings": [{"agents": pair, "num_loops": num} for pair, num in cli.count_meetings(result.joined)],
        "ate_m": components[0]["ate_m"] if len(components) == 1 else None,
        "components": components,
        "agents": agents,
    }


def num_wrong(result: AgentsResult, sequences: list[LidarSequence]) -> int | None:
    """Returns how many loops between agents are wrong beyond 2 m or 5 degrees; None without a reference for each."""
    known = [sequence.T_world_lidar for sequence in sequences if sequence.T_world_lidar is not None]
    if len(known) < len(sequences):
        return None
    T, (source, target) = keyframe_poses(result, known), cli.accepted_ends(result.joined.loops).T
    accepted = [loop.T_target_source for loop in result.joined.loops if loop.status == "accepted"]
    found = np.reshape(accepted, (-1, 4, 4))
    return int((~metrics.registration_recall(found, rigid.inverse(T[target]) @ T[source]).is_right).sum())


def keyframe_poses(result: AgentsResult, T_world_scan: list[np.ndarray]) -> np.ndarray:
    """Returns the poses of all keyframes, agent by agent, out of those of all scans."""
    return np.concatenate([T[agent.keyframes] for T, agent in zip(T_world_scan, result.agents, strict=True)])


def members_of(result: AgentsResult) -> list[list[int]]:
    """Returns the agents of each component."""
    components = np.array(result.component)
    return [np.flatnonzero(components == number).tolist() for number in range(components.max() + 1)]


def joint_ate_m(result: AgentsResult, sequences: list[LidarSequence], members: list[int]) -> float | None:
    """Returns the ATE of agents in their one frame; None without a reference for each, or from different drives."""
    pairs = _positions(result, sequences, members)
    return None if pairs is None or len(pairs[0]) < 2 else metrics.absolute_trajectory_error(*pairs)


def _positions(
    result: AgentsResult, sequences: list[LidarSequence], members: list[int]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns (n, 3) positions of agents and of their references, metres; None without a reference for each."""
    known = [T[:, :3, 3] for number in members if (T := sequences[number].T_world_lidar) is not None]
    if len(known) < len(members):
        return None
    return np.concatenate([result.T_world_scan[number][:, :3, 3] for number in members]), np.concatenate(known)


def agent_panels(result: AgentsResult, sequences: list[LidarSequence]) -> list[viz.Panel]:
    """Gathers the data of the picture: clouds, tracks and loops of each component."""
    panels, T_shown_keyframe = [], keyframe_poses(result, result.T_world_scan)
    for members in members_of(result):
        pairs = _positions(result, sequences, members)
        references: list[np.ndarray] = []
        T_shown_reference = None if pairs is None else metrics.align_rigid(*reversed(pairs))
        layers: list[viz.Layer] = []
        for number in members:
            scans, sequence, T = result.agents[number].keyframes, sequences[number], result.T_world_scan[number]
            cloud = cli.gather_map(T[scans], lambda row, read=sequence.read_points, scans=scans: read(int(scans[row])))
            layers += cli.map_layers(f"agent {number + 1}, {len(T)} scans", number, T, cloud)
            if T_shown_reference is not None:
                R, t = T_shown_reference[:3, :3], T_shown_reference[:3, 3]
                references += [sequence.T_world_lidar[:, :3, 3] @ R.T + t, np.full((1, 3), np.nan)]
        ends = cli.accepted_ends(result.joined.loops)
        ends = ends[np.isin(result.joined.map_of_keyframe[ends[:, 0]], members)]
        drives = ", ".join(dict.fromkeys(sequences[number].name for number in members))
        title = drives + (", in one frame" if len(members) > 1 else ", in a frame of its own")
        layers.append(viz.Edges(T_shown_keyframe[ends, :3, 3], viz.INK, "loops between them"))
        panels.append(viz.Panel(title, layers, np.concatenate(references) if references else None))
    return panels


def table(rows: list[cli.Row]) -> str:
    """Returns a table as Markdown, one line for each run of agents."""
    columns = ("drive", "scans", "ATE of each agent (alone), m", "loops between (wrong)", "in one frame: ATE, m")
    return cli.markdown((*columns, "sent by each, MB", "points of all scans, MB"), map(_drive_cells, rows))


def _drive_cells(row: cli.Row) -> list[str]:
    agents = row["agents"]
    errors = "; ".join(f"{a['ate_m']:.3f} ({a['ate_alone_m']:.3f})" if "ate_m" in a else "-" for a in agents)
    met = [f"{' and '.join(map(str, one['agents']))}: {one['num_loops']}" for one in row["meetings"]]
    wrong = "" if row["num_wrong_loops_between"] is None else f" ({row['num_wrong_loops_between']})"
    together = (f"{', '.join(map(str, one['agents']))}: {cli.cell_text(one['ate_m'], 3)}" for one in row["components"])
    return [
        row["sequence"],
        ", ".join(str(agent["num_scans"]) for agent in agents),
        errors,
        (", ".join(met) or "none") + wrong,
        "; ".join(together),
        ", ".join(f"{agent['keyframe_bytes'] / 1e6:.2f}" for agent in agents),
        ", ".join(f"{agent['scan_bytes'] / 1e6:.0f}" for agent in agents),
    ]


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
