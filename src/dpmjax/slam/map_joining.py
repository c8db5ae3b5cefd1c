"""Joining of maps: loops between them are found by retrieval, and maps that meet become one graph.

The relative pose of two maps is unknown (DeepPointMap section 4, multi-agent SLAM). Candidates are similar keyframes of
different maps. They are registered, verified and accepted like all loops: only together with loops that agree with them
over the odometry of both maps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dpmjax.geometry import rigid
from dpmjax.slam.interfaces import SlamMethods
from dpmjax.slam.keyframes import KeyframeMap, MapEdge, connected_parts, with_origin, with_poses
from dpmjax.slam.loop_candidates import find_meetings
from dpmjax.slam.loop_closure import examine_candidates, is_resting, num_accepted
from dpmjax.slam.map_optimization import optimize_map
from dpmjax.slam.reports import Loop, LoopState, loops_of_map

OnKeyframe = Callable[[int, int], None]
"""Called with the number of keyframes that were compared, and with that of all to be compared."""


class JoinedMaps(NamedTuple):
    """Several maps in one record; those that meet have one frame.

    Attributes:
        slam_map: the keyframes of all maps, map by map; the scan numbers of each map continue those of the map before.
        map_of_keyframe: (k,) which map each keyframe comes from.
        component_of_map: which maps are joined: equal numbers, counted from 0. Maps of other components have frames
            of their own, and their poses cannot be compared.
        loops: candidates between maps and what became of them, by rows of `slam_map`.
    """

    slam_map: KeyframeMap
    map_of_keyframe: Int[np.ndarray, " k"]
    component_of_map: tuple[int, ...]
    loops: tuple[Loop, ...]


def join_maps(
    methods: SlamMethods, maps: Sequence[KeyframeMap], *, on_keyframe: OnKeyframe | None = None
) -> JoinedMaps:
    """Finds loops between maps and optimises those that meet as one graph.

    The order of the maps changes only the order of the rows and the frames: a component has the frame of its first map.

    Args:
        methods: matcher and settings; the matcher that made the maps.
        maps: at least one.
        on_keyframe: for progress.

    Returns:
        All keyframes, and which maps were joined.

    Raises:
        ValueError: if there is no map, or if a map was made by another matcher.
    """
    if not maps:
        raise ValueError("maps: expected at least one, got none")
    joined = _side_by_side(maps)
    with_origin(joined, methods.origin)
    map_of_row = np.repeat(np.arange(len(maps)), [len(each) for each in maps])
    inner = loops_of_map(joined).loops
    loops: tuple[Loop, ...] = ()
    order = sorted(range(len(maps)), key=lambda number: (-len(maps[number]), maps[number].vectors.tobytes()))
    num_compared, num_all = 0, len(joined) - len(maps[order[0]])
    for place, number in enumerate(order[1:], start=1):
        is_other = np.isin(map_of_row, order[:place])
        for row in np.flatnonzero(map_of_row == number):
            loops = _compared(methods, joined, loops, int(row), is_other)
            num_compared += 1
            if on_keyframe is not None:
                on_keyframe(num_compared, num_all)
    if num_accepted(loops):
        joined, state = optimize_map(joined, LoopState((*inner, *loops)), methods.config.loops)
        loops = state.loops[len(inner) :]
    components = _components(len(maps), map_of_row, loops)
    joined = with_poses(joined, _in_own_frames(joined, map_of_row, components, maps))
    return JoinedMaps(joined, map_of_row, components, loops)


def take_component(joined: JoinedMaps, component: int) -> KeyframeMap:
    """Takes one component out.

    Args:
        joined: from `join_maps`.
        component: its number.

    Returns:
        The map of the keyframes and edges of that component, with rows of its own.
    """
    is_taken = np.array(joined.component_of_map)[joined.map_of_keyframe] == component
    rows, new_row = np.flatnonzero(is_taken), np.cumsum(is_taken) - 1
    edges = [
        edge._replace(source=int(new_row[edge.source]), target=int(new_row[edge.target]))
        for edge in joined.slam_map.edges
        if is_taken[edge.source]
    ]
    slam_map = joined.slam_map
    return replace(
        slam_map,
        keyframes=tuple(slam_map.keyframes[row] for row in rows),
        T_world_keyframe=slam_map.T_world_keyframe[rows],
        vectors=slam_map.vectors[rows],
        edges=tuple(edges),
    )


def _compared(
    methods: SlamMethods, joined: KeyframeMap, loops: tuple[Loop, ...], row: int, is_other: np.ndarray
) -> tuple[Loop, ...]:
    if is_resting(joined, loops, row):
        return loops
    candidates = find_meetings(joined, row, is_other, methods.config.loops)
    return examine_candidates(methods, joined, loops, row, candidates)


def _side_by_side(maps: Sequence[KeyframeMap]) -> KeyframeMap:
    """Puts all keyframes into one record; rows, segments and scans are numbered on, and no edge joins two maps."""
    joined = maps[0]
    for other in maps[1:]:
        if len(other) == 0:
            continue
        if len(joined) == 0:
            joined = other
            continue
        if other.origin is not None:
            joined = with_origin(joined, other.origin)
        rows, scans = len(joined), 1 + max(keyframe.scan for keyframe in joined.keyframes)
        segments = 1 + max(keyframe.segment for keyframe in joined.keyframes)
        keyframes = [
            keyframe._replace(scan=keyframe.scan + scans, segment=keyframe.segment + segments)
            for keyframe in other.keyframes
        ]
        edges = [edge._replace(source=edge.source + rows, target=edge.target + rows) for edge in other.edges]
        joined = replace(
            joined,
            keyframes=(*joined.keyframes, *keyframes),
            T_world_keyframe=np.concatenate([joined.T_world_keyframe, other.T_world_keyframe]),
            vectors=np.concatenate([joined.vectors, other.vectors]),
            edges=(*joined.edges, *edges),
        )
    return joined


def _components(num_maps: int, map_of_row: np.ndarray, loops: Sequence[Loop]) -> tuple[int, ...]:
    """Returns the component of each map, numbered in the order of the maps."""
    accepted = [loop for loop in loops if loop.status == "accepted"]
    between = [
        MapEdge(int(map_of_row[loop.source]), int(map_of_row[loop.target]), np.eye(4), np.eye(6), "loop")
        for loop in accepted
    ]
    parts = connected_parts(num_maps, between)
    numbers = {part: number for number, part in enumerate(dict.fromkeys(parts.tolist()))}
    return tuple(numbers[part] for part in parts.tolist())


def _in_own_frames(
    joined: KeyframeMap, map_of_row: np.ndarray, components: Sequence[int], maps: Sequence[KeyframeMap]
) -> Float[np.ndarray, "k 4 4"]:
    """Moves each component, so that the first keyframe of its first map stays where it was."""
    T_world = joined.T_world_keyframe.copy()
    for component in set(components):
        members = [number for number, each in enumerate(components) if each == component and len(maps[number])]
        if not members:
            continue
        row = int(np.flatnonzero(map_of_row == members[0])[0])
        rows = np.isin(map_of_row, members)
        T_new_old = maps[members[0]].T_world_keyframe[0] @ rigid.inverse(T_world[row])
        T_world[rows] = T_new_old @ T_world[rows]
    return T_world
