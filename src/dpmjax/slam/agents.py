"""Several agents: each maps alone, keyframes are exchanged, maps that meet are joined (DeepPointMap section 4).

The relative pose of two maps is unknown. Candidates of loops are similar keyframes of different maps. Each candidate is
registered and verified. It is accepted only together with further loops that agree with it by the odometry of both
maps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from dpmjax.checks import require_type, runs_on_host
from dpmjax.deeppointmap.model import Model
from dpmjax.geometry import rigid
from dpmjax.reading import read_path
from dpmjax.slam.config import SlamConfig
from dpmjax.slam.interfaces import AnyScan, SlamMethods
from dpmjax.slam.keyframe_map import (
    KeyframeMap,
    connected_parts,
    joined_maps,
    measured_parts,
    take_keyframes,
    with_origin,
)
from dpmjax.slam.loops import Loop, LoopState, has_new_loops, loops_of_map, optimize_map
from dpmjax.slam.model_methods import as_methods, methods_for
from dpmjax.slam.system import SlamResult, place_scans, procedure_of, run_slam
from dpmjax.types import Pose, Poses, with_short_repr

# Callback for progress: number of compared keyframes, and number of all keyframes to compare.
OnKeyframe = Callable[[int, int], None]


@with_short_repr
class MergedMaps(NamedTuple):
    """Merged maps, and the maps that have met.

    Attributes:
        maps: one map for each component, in the frame of its first map; a map that met no other is unchanged. Poses of
            different maps or of different `measured_parts` cannot be compared.
        component: row of `maps` that each given map is part of; maps with equal numbers have met.
        loops: candidates between maps and their outcome; rows are those of `slam_map`.
        slam_map: the keyframes of all maps in one record, map by map; the scan numbers of each map continue those of
            the map before.
        map_of_keyframe: (k,) number of the given map that each keyframe comes from.
    """

    maps: tuple[KeyframeMap, ...]
    component: tuple[int, ...]
    loops: tuple[Loop, ...]
    slam_map: KeyframeMap
    map_of_keyframe: Int[np.ndarray, " k"]

    @property
    def is_joined(self) -> bool:
        """True if all maps have become one, and measured motions join all its keyframes."""
        return len(self.maps) == 1 and not measured_parts(self.maps[0]).any()


@with_short_repr
class AgentsResult(NamedTuple):
    """Trajectories and maps of several agents.

    Attributes:
        T_world_scan: (n, 4, 4) float64 poses of each agent. The world of a component is the frame of the first scan of
            its first agent.
        component: number of the component of each agent. Agents of one component have met. Only their poses can be
            compared, within `measured_parts`.
        joined: their merged maps, and the loops between agents.
        agents: result of each agent alone.
    """

    T_world_scan: tuple[Poses, ...]
    component: tuple[int, ...]
    joined: MergedMaps
    agents: tuple[SlamResult, ...]


@runs_on_host("call it outside, and pass its result in")
def run_agents(
    model: Model | SlamMethods, sequences: Sequence[Iterable[AnyScan] | Path], config: SlamConfig | None = None
) -> AgentsResult:
    """Maps with several agents: each runs alone, and loops between their maps join them.

    These loops are found by retrieval over the keyframes of all other agents, without any position. The order of the
    agents does not change the joined maps.

    Args:
        model: a trained model; or methods of your own.
        sequences: scans of each agent as `run_slam` takes them.
        config: settings; None takes the defaults. Methods of your own carry theirs.

    Returns:
        Trajectories, who has met whom, the joined graph.

    Raises:
        ValueError: if there is no sequence, if a scan is not (n, 3), or if methods come with another configuration.
    """
    if not sequences:
        raise ValueError("sequences: expected the scans of at least one agent, got none")
    methods = as_methods(model, config)
    agents = tuple(run_slam(methods, scans) for scans in sequences)
    joined = join_maps(methods, [agent.map for agent in agents])
    return AgentsResult(_trajectories(joined, agents), joined.component, joined, agents)


@runs_on_host("call it outside, and pass its result in")
def merge_maps(
    model: Model | SlamMethods, *maps: KeyframeMap | str | Path, on_keyframe: OnKeyframe = lambda _num, _all: None
) -> MergedMaps:
    """Joins maps of different days or of different robots at the places that they share.

    Args:
        model: the model that made the maps, or methods of your own. A model takes the settings of the first map.
        *maps: two or more, or their files. The frame of the first map of each component is kept.
        on_keyframe: called while keyframes are compared, for progress.

    Returns:
        One map, or several if no loop joins them, and the maps that have met.

    Raises:
        ValueError: if there are fewer than two maps, if one is no map, or if one was made with other weights.
    """
    if len(maps) < 2:
        raise ValueError(f"maps: expected at least two, got {len(maps)}")
    loaded: list[KeyframeMap] = [read_path(slam_map, "saved_maps.load_map") for slam_map in maps]
    for slam_map in loaded:
        require_type("maps", slam_map, KeyframeMap, "load_map")
    return join_maps(methods_for(model, loaded[0]), loaded, on_keyframe=on_keyframe)


def join_maps(
    methods: SlamMethods, maps: Sequence[KeyframeMap], *, on_keyframe: OnKeyframe = lambda _num, _all: None
) -> MergedMaps:
    """Finds loops between maps, and optimises each group of joined maps as one graph.

    The order of the maps changes only the order of the rows and the frames: a component has the frame of its first map.

    Args:
        methods: matcher and settings; the matcher that made the maps.
        maps: at least one.
        on_keyframe: callback for progress.

    Returns:
        The merged maps.

    Raises:
        ValueError: if a map was made by another matcher.
    """
    joined = _side_by_side(maps)
    with_origin(joined, methods.origin)
    map_of_row = np.repeat(np.arange(len(maps)), [len(each) for each in maps])
    inner = loops_of_map(joined).loops
    loops: tuple[Loop, ...] = ()
    order = sorted(range(len(maps)), key=lambda number: (-len(maps[number]), maps[number].vectors.tobytes()))
    compared = [
        (row, place) for place in range(1, len(maps)) for row in np.flatnonzero(map_of_row == order[place]).tolist()
    ]
    for number, (row, place) in enumerate(compared, start=1):
        is_other = np.isin(map_of_row, order[:place])
        joined, loops = procedure_of(methods.config).join_keyframe(methods, joined, loops, row, is_other)
        on_keyframe(number, len(compared))
    if has_new_loops(joined, (*inner, *loops)):
        joined, state = optimize_map(joined, LoopState((*inner, *loops)))
        loops = state.loops[len(inner) :]
    between = [map_of_row[list(loop[:2])].tolist() for loop in loops if loop.status == "accepted"]
    # Scipy numbers the parts in the order of their first nodes.
    components = tuple(connected_parts(len(maps), between).tolist())
    joined = replace(joined, T_world_keyframe=_in_own_frames(joined, map_of_row, components, maps))
    component_of_row, merged = np.array(components)[map_of_row], []
    for number in range(max(components) + 1):
        alone = maps[components.index(number)]
        rows = np.flatnonzero(component_of_row == number).tolist()
        merged.append(take_keyframes(joined, rows) if components.count(number) > 1 else alone)
    return MergedMaps(tuple(merged), components, loops, joined, map_of_row)


def _side_by_side(maps: Sequence[KeyframeMap]) -> KeyframeMap:
    """Concatenates maps; rows, segments and scans are numbered consecutively, and no edge joins two maps."""
    joined, rows, scans, segments = KeyframeMap(), 0, 0, 0
    for other in maps:
        keyframes = [one._replace(scan=one.scan + scans, segment=one.segment + segments) for one in other.keyframes]
        edges = [edge._replace(source=edge.source + rows, target=edge.target + rows) for edge in other.edges]
        if other.origin is not None:
            joined = joined_maps(joined, replace(other, keyframes=tuple(keyframes), edges=tuple(edges)))
            origin = joined.origin or other.origin
            joined, rows = replace(with_origin(joined, other.origin), origin=origin), len(joined)
            scans, segments = (1 + int(joined.column(name).max()) for name in ("scan", "segment"))
    return joined


def _in_own_frames(
    joined: KeyframeMap, map_of_row: np.ndarray, components: Sequence[int], maps: Sequence[KeyframeMap]
) -> Poses:
    """Moves each component so that the first keyframe of its first map keeps its pose."""
    T_old = joined.T_world_keyframe
    _, first_rows, component = np.unique(np.array(components)[map_of_row], return_index=True, return_inverse=True)
    T_new_old = [maps[map_of_row[row]].T_world_keyframe[0] @ rigid.inverse(T_old[row]) for row in first_rows]
    return np.reshape(T_new_old, (-1, 4, 4))[component] @ T_old


def _trajectories(joined: MergedMaps, agents: Sequence[SlamResult]) -> tuple[Poses, ...]:
    """Computes the poses of all scans; the first scan of a component's first agent is its origin."""
    found: list[Poses] = []
    origins: dict[int, Pose] = {}
    for number, agent in enumerate(agents):
        T_world_keyframe = joined.slam_map.T_world_keyframe[joined.map_of_keyframe == number]
        T_agent_scan = place_scans(T_world_keyframe, agent.reports)
        if len(T_world_keyframe):
            # `place_scans` has the first scan as its origin.
            first = agent.reports[0]
            T_world_agent = T_world_keyframe[first.keyframe] @ first.T_keyframe_scan
            T_origin_world = origins.setdefault(joined.component[number], rigid.inverse(T_world_agent))
            T_agent_scan = T_origin_world @ T_world_agent @ T_agent_scan
        found.append(T_agent_scan)
    return tuple(found)
