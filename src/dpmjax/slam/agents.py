"""Several agents: each maps alone, keyframes are exchanged, maps that meet are joined (DeepPointMap section 4)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.model import Model
from dpmjax.geometry import rigid
from dpmjax.slam.config import SlamConfig
from dpmjax.slam.front_end import AnyScan
from dpmjax.slam.interfaces import SlamMethods
from dpmjax.slam.keyframes import KeyframeMap
from dpmjax.slam.map_joining import JoinedMaps, OnKeyframe, join_maps, take_component
from dpmjax.slam.reports import Loop
from dpmjax.slam.system import SlamResult, as_methods, place_scans, run_slam

BYTES_A_POINT = 12
"""Three float32 numbers."""


class SentBytes(NamedTuple):
    """Bytes that an agent sends, and those of its points.

    Attributes:
        keyframe_bytes: its keyframes: descriptors, surface elements, range images, poses, retrieval vectors.
        descriptor_bytes: features of the descriptors among them.
        keyframe_scan_bytes: the raw points of the same keyframes, three float32 numbers each.
        scan_bytes: the raw points of all scans.
    """

    keyframe_bytes: int
    descriptor_bytes: int
    keyframe_scan_bytes: int
    scan_bytes: int


class AgentsResult(NamedTuple):
    """Trajectories and maps of several agents.

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
    traffic: tuple[SentBytes, ...]


class MergedMaps(NamedTuple):
    """Merged maps, and the maps that have met.

    Attributes:
        maps: one map for each component, in the frame of its first map; a map that met no other is as it was.
        joined: the keyframes of all maps in one record, and the loops between maps.
    """

    maps: tuple[KeyframeMap, ...]
    joined: JoinedMaps

    @property
    def component(self) -> tuple[int, ...]:
        """Row of `maps` that each given map is part of; maps with equal numbers have met."""
        return self.joined.component_of_map

    @property
    def loops(self) -> tuple[Loop, ...]:
        """Candidates between maps and their outcome; rows are those of the first map, then of the next."""
        return self.joined.loops

    @property
    def is_joined(self) -> bool:
        """True where all maps have become one."""
        return len(self.maps) == 1


def run_agents(
    model: Model | SlamMethods, sequences: Sequence[Iterable[AnyScan]], config: SlamConfig | None = None
) -> AgentsResult:
    """Maps with several agents: each runs alone, and loops between their maps join them.

    These loops are found by retrieval over the keyframes of all other agents, without any position. The order of the
    agents does not change who meets whom.

    Args:
        model: a trained model; or methods of your own.
        sequences: scans of each agent as `run_slam` takes them.
        config: settings; None takes the defaults. Methods of your own carry theirs.

    Returns:
        Trajectories, who has met whom, the joined graph, bytes sent.

    Raises:
        ValueError: if there is no sequence, if a scan is not (n, 3), or if methods come with another configuration.
    """
    if not sequences:
        raise ValueError("sequences: expected the scans of at least one agent, got none")
    methods = as_methods(model, config)
    return join_agents(methods, [run_slam(methods, scans) for scans in sequences])


def join_agents(
    methods: SlamMethods, agents: Sequence[SlamResult], *, on_keyframe: OnKeyframe | None = None
) -> AgentsResult:
    """Joins what agents have mapped alone; `run_agents` does both.

    Args:
        methods: of all agents.
        agents: at least one.
        on_keyframe: for progress, while keyframes are compared.

    Returns:
        Trajectories, who has met whom, the joined graph, bytes sent.
    """
    joined = join_maps(methods, [agent.state.slam_map for agent in agents], on_keyframe=on_keyframe)
    trajectories = _trajectories(joined, agents)
    traffic = tuple(map(_traffic, agents))
    return AgentsResult(trajectories, joined.component_of_map, joined, tuple(agents), traffic)


def merge_maps(
    model: Model | SlamMethods,
    *maps: KeyframeMap,
    config: SlamConfig | None = None,
    on_keyframe: OnKeyframe | None = None,
) -> MergedMaps:
    """Joins maps of different days or of different robots where they show the same places.

    Args:
        model: the model that made the maps; or methods of your own.
        *maps: two or more. The frame of the first map of each component is kept.
        config: settings; None takes those of the first map. Methods of your own carry theirs.
        on_keyframe: called while keyframes are compared, for progress.

    Returns:
        One map, or several where no loop joins them, and who has met whom.

    Raises:
        ValueError: if there are fewer than two maps, if a map was made with other weights, or if methods come with
            another configuration.
    """
    if len(maps) < 2:
        raise ValueError(f"maps: expected at least two, got {len(maps)}")
    if config is None and not isinstance(model, SlamMethods) and maps[0].origin is not None:
        config = maps[0].origin.config
    joined = join_maps(as_methods(model, config), maps, on_keyframe=on_keyframe)
    numbers = joined.component_of_map
    merged = [
        take_component(joined, component) if numbers.count(component) > 1 else maps[numbers.index(component)]
        for component in range(max(numbers) + 1)
    ]
    return MergedMaps(tuple(merged), joined)


def _traffic(agent: SlamResult) -> SentBytes:
    slam_map = agent.state.slam_map
    scans = [keyframe.compact for keyframe in slam_map.keyframes]
    vectors_and_poses = slam_map.vectors.nbytes + slam_map.T_world_keyframe.nbytes
    scan_bytes = [BYTES_A_POINT * report.num_points for report in agent.reports]
    return SentBytes(
        keyframe_bytes=sum(map(_num_bytes, scans)) + vectors_and_poses,
        descriptor_bytes=sum(_num_bytes((scan.features, scan.feature_steps, scan.directions)) for scan in scans),
        keyframe_scan_bytes=sum(scan_bytes[keyframe.scan] for keyframe in slam_map.keyframes),
        scan_bytes=sum(scan_bytes),
    )


def _num_bytes(record: object) -> int:
    return sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(record))


def _trajectories(joined: JoinedMaps, agents: Sequence[SlamResult]) -> tuple[Float[np.ndarray, "_n 4 4"], ...]:
    """Hangs all scans on the joined keyframes; the first scan of a component's first agent is its origin."""
    found: list[Float[np.ndarray, "_n 4 4"]] = []
    origins: dict[int, Float[np.ndarray, "4 4"]] = {}
    for number, agent in enumerate(agents):
        T_world_keyframe = joined.slam_map.T_world_keyframe[joined.map_of_keyframe == number]
        T_agent_scan = place_scans(T_world_keyframe, agent.reports)
        if len(T_world_keyframe):
            # `place_scans` has the first scan as its origin.
            first = agent.reports[0]
            T_world_agent = T_world_keyframe[first.keyframe] @ first.T_keyframe_scan
            T_origin_world = origins.setdefault(joined.component_of_map[number], rigid.inverse(T_world_agent))
            T_agent_scan = T_origin_world @ T_world_agent @ T_agent_scan
        found.append(T_agent_scan)
    return tuple(found)
