"""Several agents: each maps alone, keyframes are exchanged, maps that meet are joined (DeepPointMap section 4)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.model import Model
from dpmjax.geometry import rigid
from dpmjax.slam.config import SlamConfig
from dpmjax.slam.keyframes import KeyframeMap
from dpmjax.slam.map_joining import JoinedMaps, OnKeyframe, join_maps, take_component
from dpmjax.slam.methods import SlamMethods
from dpmjax.slam.reports import Loop, ScanReport
from dpmjax.slam.system import SlamResult, as_methods, finish_slam, init_slam, iterate_slam
from dpmjax.types import AnyArray

Scans = Iterable[Float[AnyArray, "_n 3"]]
BYTES_A_POINT = 12
"""Three float32 numbers."""


class Traffic(NamedTuple):
    """What an agent sends, and what sending points would cost.

    Attributes:
        keyframe_bytes: its keyframes as they are kept: descriptors, and what verifies a loop; poses; retrieval vectors.
        descriptor_bytes: the descriptors among them.
        keyframe_scan_bytes: the raw points of the same keyframes, three float32 numbers each.
        scan_bytes: the raw points of all scans.
    """

    keyframe_bytes: int
    descriptor_bytes: int
    keyframe_scan_bytes: int
    scan_bytes: int


class AgentsResult(NamedTuple):
    """What `run_agents` returns.

    Attributes:
        T_world_scan: of each agent, (n, 4, 4) float64, in the frame of its component, which is that of the component's
            first agent at its first scan.
        component: of each agent; agents with equal numbers have met. Poses of different components cannot be compared.
        joined: all keyframes in one record, and the loops between agents.
        agents: what each found alone.
        traffic: of each agent.
    """

    T_world_scan: tuple[Float[np.ndarray, "_n 4 4"], ...]
    component: tuple[int, ...]
    joined: JoinedMaps
    agents: tuple[SlamResult, ...]
    traffic: tuple[Traffic, ...]


class MergedMaps(NamedTuple):
    """What `merge_maps` returns.

    Attributes:
        maps: one map if both meet, in the frame of the first; else both as they were.
        loops: candidates between them and what became of each; rows are those of the first map, then of the second.
    """

    maps: tuple[KeyframeMap, ...]
    loops: tuple[Loop, ...]

    @property
    def is_joined(self) -> bool:
        """Whether the maps meet."""
        return len(self.maps) == 1


def run_agents(
    sequences: Sequence[Scans],
    model: Model | SlamMethods,
    config: SlamConfig | None = None,
    *,
    on_scan: Callable[[int, ScanReport], None] | None = None,
    on_keyframe: OnKeyframe | None = None,
) -> AgentsResult:
    """Maps with several agents: each runs alone, and what they have in common joins them.

    Loops between agents are found by retrieval over all keyframes of the others, without any position. The order of the
    agents does not change who meets whom.

    Args:
        sequences: scans of each agent, points in metres, each in the frame of its lidar, in the order of time.
        model: a trained model; or methods of your own.
        config: settings; None takes the defaults. Methods of your own carry theirs.
        on_scan: called with the number of the agent and the report, after each scan.
        on_keyframe: called while keyframes of agents are compared.

    Returns:
        Trajectories, who has met whom, the joined graph, bytes sent.

    Raises:
        ValueError: if there is no sequence, if a scan is not (n, 3), or if methods come with another configuration.
    """
    if not sequences:
        raise ValueError("sequences: expected the scans of at least one agent, got none")
    methods = as_methods(model, config)
    agents, num_points = [], []
    for number, scans in enumerate(sequences):
        counts: list[int] = []
        state, reports = init_slam(), []
        for state, report in iterate_slam(methods, _counted(scans, counts)):  # noqa: B007 (the last one is used)
            reports.append(report)
            if on_scan is not None:
                on_scan(number, report)
        agents.append(finish_slam(state, reports, methods.config))
        num_points.append(counts)
    joined = join_maps(methods, [agent.state.slam_map for agent in agents], on_keyframe=on_keyframe)
    traffic = [_traffic(agent, counts) for agent, counts in zip(agents, num_points, strict=True)]
    trajectories = _trajectories(joined, agents)
    return AgentsResult(trajectories, joined.component_of_map, joined, tuple(agents), tuple(traffic))


def merge_maps(
    a: KeyframeMap, b: KeyframeMap, model: Model | SlamMethods, config: SlamConfig | None = None
) -> MergedMaps:
    """Joins two maps, of different days or of different robots, where they show the same places.

    Args:
        a: a map; its frame is kept.
        b: the other.
        model: the model that made both; or methods of your own.
        config: settings; None takes the defaults. Methods of your own carry theirs.

    Returns:
        One map, or both where nothing joins them.

    Raises:
        ValueError: if the maps were made with other weights, or if methods come with another configuration.
    """
    joined = join_maps(as_methods(model, config), [a, b])
    if len(set(joined.component_of_map)) > 1:
        return MergedMaps((a, b), joined.loops)
    return MergedMaps((take_component(joined, 0),), joined.loops)


def _counted(scans: Scans, counts: list[int]) -> Iterator[Float[AnyArray, "_n 3"]]:
    for points in scans:
        counts.append(len(points))
        yield points


def _traffic(agent: SlamResult, num_points: Sequence[int]) -> Traffic:
    slam_map = agent.state.slam_map
    descriptions = [keyframe.description for keyframe in slam_map.keyframes]
    poses = slam_map.T_world_keyframe.nbytes + slam_map.vectors.nbytes
    descriptors = sum(_num_bytes(getattr(description, "descriptors", ())) for description in descriptions)
    keyframe_points = sum(num_points[keyframe.scan] for keyframe in slam_map.keyframes)
    return Traffic(
        sum(map(_num_bytes, descriptions)) + poses,
        descriptors,
        BYTES_A_POINT * keyframe_points,
        BYTES_A_POINT * sum(num_points),
    )


def _num_bytes(record: object) -> int:
    return sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(record))


def _trajectories(joined: JoinedMaps, agents: Sequence[SlamResult]) -> tuple[Float[np.ndarray, "_n 4 4"], ...]:
    """Hangs all scans on the joined keyframes; the first scan of a component's first agent is its origin."""
    found: list[Float[np.ndarray, "_n 4 4"]] = []
    origins: dict[int, Float[np.ndarray, "4 4"]] = {}
    for number, agent in enumerate(agents):
        rows = np.flatnonzero(joined.map_of_keyframe == number)
        T_world = np.tile(np.eye(4), (len(agent.reports), 1, 1))
        if len(rows):
            T_keyframe_scan = np.array([report.T_keyframe_scan for report in agent.reports])
            row = rows[[report.keyframe for report in agent.reports]]
            T_world = joined.slam_map.T_world_keyframe[row] @ T_keyframe_scan
            T_origin = origins.setdefault(joined.component_of_map[number], rigid.inverse(T_world[0]))
            T_world = T_origin @ T_world
        found.append(T_world)
    return tuple(found)
