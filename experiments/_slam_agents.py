"""The agents of dpm_multiagent: which scans each has, its run, and the files of all together."""

from __future__ import annotations

import collections
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dpmjax.cli import (
    RunFolder,
    gather_map,
    loop_cells,
    trajectory_errors,
    write_map_file,
    write_table,
    write_trajectory,
)
from dpmjax.geometry import rigid

if TYPE_CHECKING:
    from dpmjax.io import LidarSequence
    from dpmjax.slam import AgentsResult, Loop
    from dpmjax.viz import AgentPanel

LOOP_COLUMNS = (
    "kind", "agent", "scan", "other_agent", "other_scan", "found_by", "status", "overlap", "probability", "rmse_m"
)  # fmt: skip


def cut_sequence(sequence: LidarSequence, num_agents: int, overlap: float) -> list[LidarSequence]:
    """Cuts a sequence into parts of one length, each longer by a share of it at both ends (DeepPointMap section 5.3).

    Raises:
        ValueError: fewer scans than agents.
    """
    num = len(sequence)
    if num < num_agents:
        raise ValueError(f"{sequence.name}: {num} scans are too few for --agents {num_agents}")
    length, parts = num / num_agents, []
    for agent in range(num_agents):
        start = max(round(agent * length - overlap * length), 0)
        end = min(round((agent + 1) * length + overlap * length), num)
        parts.append(sequence.take(slice(start, end)))
    return parts


def write_agents(folder: RunFolder, result: AgentsResult, sequences: Sequence[LidarSequence]) -> list[dict[str, int]]:
    """Writes trajectories, graph, loops and maps; returns the bytes that each agent sends at each precision."""
    import dpmjax
    from dpmjax.slam import as_pose_graph, take_component

    sizes = []
    for number, (T_world_scan, agent, sequence) in enumerate(
        zip(result.T_world_scan, result.agents, sequences, strict=True), start=1
    ):
        write_trajectory(folder.path, T_world_scan, sequence.times, f"agent_{number}")
        path = folder.part("agents", f"agent_{number}") / "map.npz"
        sizes.append(write_map_file(path, agent.map) if len(agent.map) else {})
    for component in range(max(result.component) + 1):
        slam_map = take_component(result.joined, component)
        if len(slam_map):
            write_map_file(folder / f"map_{component + 1}.npz", slam_map)
    if len(result.joined.slam_map):
        dpmjax.write_g2o(folder / "graph.g2o", as_pose_graph(result.joined.slam_map))
    write_table(folder / "loops.csv", LOOP_COLUMNS, _loop_rows(result))
    return sizes


def _loop_rows(result: AgentsResult) -> list[dict[str, Any]]:
    """Candidates within agents, then those between them, by agents counted from 1 and their scans."""
    rows = []
    for number, agent in enumerate(result.agents, start=1):
        ends = [(number, int(scan)) for scan in agent.keyframes]
        rows += [_loop_row("within", loop, ends) for loop in agent.loops]
    between = [(number, int(scan)) for number, agent in enumerate(result.agents, start=1) for scan in agent.keyframes]
    return rows + [_loop_row("between", loop, between) for loop in result.joined.loops]


def _loop_row(kind: str, loop: Loop, ends: Sequence[tuple[int, int]]) -> dict[str, Any]:
    (agent, scan), (other_agent, other_scan) = ends[loop.source], ends[loop.target]
    return {
        "kind": kind,
        "agent": agent,
        "scan": scan,
        "other_agent": other_agent,
        "other_scan": other_scan,
        **loop_cells(loop),
    }


def agents_numbers(result: AgentsResult, sequences: Sequence[LidarSequence]) -> dict[str, Any]:
    """Returns what `metrics.json` says: errors of each component in its one frame, of each agent, and bytes."""
    references = [sequence.T_world_lidar for sequence in sequences]
    accepted = [loop for loop in result.joined.loops if loop.status == "accepted"]
    agents = [
        {
            "agent": number,
            "sequence": sequence.name,
            "component": result.component[number - 1] + 1,
            "num_scans": len(T_world_scan),
            "num_keyframes": len(agent.keyframes),
            "num_loops": sum(loop.status == "accepted" for loop in agent.loops),
            **trajectory_errors(T_world_scan, reference),
            **trajectory_errors(agent.T_world_scan, reference, "_alone"),
            **traffic._asdict(),
        }
        for number, (T_world_scan, agent, traffic, sequence, reference) in enumerate(
            zip(result.T_world_scan, result.agents, result.traffic, sequences, references, strict=True), start=1
        )
    ]
    components = [
        {
            "component": component + 1,
            "agents": [number + 1 for number in members],
            "ate_m": joint_ate_m(result, references, members),
        }
        for component, members in enumerate(members_of(result))
    ]
    return {
        "num_agents": len(agents),
        "num_components": len(components),
        "num_loops_between": len(accepted),
        "num_wrong_loops_between": num_wrong(result, accepted, references),
        "meetings": meetings(result, accepted),
        "ate_m": components[0]["ate_m"] if len(components) == 1 else None,
        "components": components,
        "agents": agents,
    }


def meetings(result: AgentsResult, accepted: Sequence[Loop]) -> list[dict[str, Any]]:
    """Returns which two agents have met, and by how many loops."""
    agent_of = result.joined.map_of_keyframe
    met = collections.Counter(tuple(sorted(int(agent_of[row]) + 1 for row in loop[:2])) for loop in accepted)
    return [{"agents": list(pair), "num_loops": number} for pair, number in sorted(met.items())]


def num_wrong(result: AgentsResult, accepted: Sequence[Loop], references: Sequence[np.ndarray | None]) -> int | None:
    """Returns how many loops between agents are wrong beyond 2 m or 5 degrees; None without a reference for each."""
    from dpmjax.metrics import registration_recall

    known = [
        reference[agent.keyframes]
        for agent, reference in zip(result.agents, references, strict=True)
        if reference is not None
    ]
    if len(known) < len(references):
        return None
    T = np.concatenate(known)
    source, target = (np.array([loop[end] for loop in accepted], int) for end in (0, 1))
    found = np.reshape([loop.T_target_source for loop in accepted], (-1, 4, 4))
    return int((~registration_recall(found, rigid.inverse(T[target]) @ T[source]).is_right).sum())


def members_of(result: AgentsResult) -> list[list[int]]:
    """Returns the agents of each component."""
    return [
        [number for number, each in enumerate(result.component) if each == component]
        for component in range(max(result.component) + 1)
    ]


def joint_ate_m(result: AgentsResult, references: Sequence[np.ndarray | None], members: Sequence[int]) -> float | None:
    """Returns the ATE of agents in their one frame; None without a reference for each, or from different drives."""
    from dpmjax.metrics import absolute_trajectory_error

    known = [(result.T_world_scan[number], references[number]) for number in members]
    pairs = [(found[:, :3, 3], reference[:, :3, 3]) for found, reference in known if reference is not None]
    if len(pairs) < len(known) or sum(len(found) for found, _ in pairs) < 2:
        return None
    return absolute_trajectory_error(*(np.concatenate(side) for side in zip(*pairs, strict=True)))


def agent_panels(result: AgentsResult, sequences: Sequence[LidarSequence]) -> list[AgentPanel]:
    """Gathers the data of the picture: clouds, tracks and loops of each component."""
    from dpmjax import viz

    panels = []
    map_of_row, T_keyframe = result.joined.map_of_keyframe, result.joined.slam_map.T_world_keyframe
    for members in members_of(result):
        alignment = _alignment(result, sequences, members)
        tracks = []
        for number in members:
            agent, sequence, T = result.agents[number], sequences[number], result.T_world_scan[number]
            reference = None
            if alignment is not None and sequence.T_world_lidar is not None:
                reference = sequence.T_world_lidar[:, :3, 3] @ alignment[:3, :3].T + alignment[:3, 3]
            cloud = gather_map((sequence.read_points(scan), T[scan]) for scan in agent.keyframes.tolist())
            label = f"agent {number + 1}, {len(T)} scans"
            color = viz.COLORS[number % len(viz.COLORS)]
            tracks.append(viz.AgentTrack(label, color, T[:, :3, 3], reference, cloud.points, cloud.heights_m))
        # Rows lie in the frame of the map, trajectories begin at their own origin.
        T_shown_map = _shown_frame(result, members)
        accepted = [loop for loop in result.joined.loops if loop.status == "accepted"]
        accepted = [loop for loop in accepted if map_of_row[loop.source] in members]
        ends = np.array([[loop.source, loop.target] for loop in accepted], np.int64).reshape(-1, 2)
        loops = T_keyframe[ends][..., :3, 3] @ T_shown_map[:3, :3].T + T_shown_map[:3, 3]
        drives = ", ".join(dict.fromkeys(sequences[number].name for number in members))
        title = drives + (", in one frame" if len(members) > 1 else ", in a frame of its own")
        panels.append(viz.AgentPanel(title, tracks, loops))
    return panels


def _alignment(result: AgentsResult, sequences: Sequence[LidarSequence], members: Sequence[int]) -> np.ndarray | None:
    """Returns the motion that brings the references of agents to their trajectories; None where one has none."""
    from dpmjax.metrics import align_rigid

    references = [sequences[number].T_world_lidar for number in members]
    known = [reference[:, :3, 3] for reference in references if reference is not None]
    if len(known) < len(references):
        return None
    found = np.concatenate([result.T_world_scan[number][:, :3, 3] for number in members])
    return np.asarray(align_rigid(np.concatenate(known), found))


def _shown_frame(result: AgentsResult, members: Sequence[int]) -> np.ndarray:
    for number in members:
        rows = np.flatnonzero(result.joined.map_of_keyframe == number)
        if len(rows):
            first = result.agents[number].reports[0]
            T_map_scan = result.joined.slam_map.T_world_keyframe[rows[first.keyframe]] @ first.T_keyframe_scan
            return np.asarray(result.T_world_scan[number][0] @ rigid.inverse(T_map_scan))
    return np.eye(4)


def summary(metrics: dict[str, Any]) -> str:
    """Returns the lines on the console."""
    lines = []
    for agent in metrics["agents"]:
        sent, scans = agent.get("map_bytes_int8", agent["keyframe_bytes"]) / 1e6, agent["scan_bytes"] / 1e6
        line = f"agent {agent['agent']}: {agent['num_scans']} scans, {agent['num_keyframes']} keyframes, "
        line += f"{sent:.1f} MB sent instead of {scans:.1f} MB of points"
        if "ate_m" in agent:
            line += f"; ATE {agent['ate_m']:.3f} m, alone {agent['ate_alone_m']:.3f} m"
        lines.append(line)
    for component in metrics["components"]:
        members = ", ".join(map(str, component["agents"]))
        text = "one frame" if len(component["agents"]) > 1 else "met nobody, a frame of its own"
        ate = component["ate_m"]
        lines.append(f"agents {members}: {text}" + ("" if ate is None else f", ATE together {ate:.3f} m"))
    return "\n".join([*lines, f"{metrics['num_loops_between']} loops between agents"])


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns a table as Markdown, one line for each drive that was cut."""
    lines = [
        "| drive | scans | ATE of each agent (alone), m | loops between (wrong) | in one frame: ATE, m "
        "| sent by each, MB | points of all scans, MB |",
        "|---|---|---|---|---|---|---|",
    ]
    return "\n".join([*lines, *map(_drive_line, rows)])


def _drive_line(row: dict[str, Any]) -> str:
    agents = row["agents"]
    errors = "; ".join(f"{a['ate_m']:.3f} ({a['ate_alone_m']:.3f})" if "ate_m" in a else "-" for a in agents)
    met = [f"{' and '.join(map(str, one['agents']))}: {one['num_loops']}" for one in row["meetings"]]
    wrong = "" if row["num_wrong_loops_between"] is None else f" ({row['num_wrong_loops_between']})"
    together = [
        f"{', '.join(map(str, one['agents']))}: " + ("-" if one["ate_m"] is None else f"{one['ate_m']:.3f}")
        for one in row["components"]
    ]
    cells = (
        row["sequence"],
        ", ".join(str(agent["num_scans"]) for agent in agents),
        errors,
        (", ".join(met) or "none") + wrong,
        "; ".join(together),
        ", ".join(f"{agent.get('map_bytes_int8', agent['keyframe_bytes']) / 1e6:.2f}" for agent in agents),
        ", ".join(f"{agent['scan_bytes'] / 1e6:.0f}" for agent in agents),
    )
    return f"| {' | '.join(cells)} |"
