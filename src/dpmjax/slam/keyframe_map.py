"""The map: keyframes, their poses, and measured relative poses between them. Functions change no map in place.

A map for localisation may be thinned. Redundant keyframes are left out, and the graph is contracted.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from dpmjax.checks import require_positive
from dpmjax.deeppointmap.compact_scans import CompactScan, expand_elements
from dpmjax.geometry import rigid, se3
from dpmjax.pose_graph.graph import Edges, PoseGraph, label_parts
from dpmjax.slam.config import SlamConfig
from dpmjax.types import Information, Pose, Poses

# Largest distance of the keyframes of a submap (DeepPointMap's published configuration).
SUBMAP_RADIUS_M = 20.0

EdgeKind = Literal["odometry", "loop", "guess"]


class Keyframe(NamedTuple):
    """A scan that the map keeps.

    Attributes:
        scan: number of the scan.
        T_odometry_keyframe: pose by the chain of odometry alone, which no loop corrects.
        path_m: length of the path to this keyframe, by odometry.
        segment: number of its unbroken chain of odometry.
        extent_m: median range of its points.
        compact: descriptors, surface elements and free space.
    """

    scan: int
    T_odometry_keyframe: Pose
    path_m: float
    segment: int
    extent_m: float
    compact: CompactScan


class MapEdge(NamedTuple):
    """A measured relative pose between two keyframes.

    Attributes:
        source: row of a keyframe.
        target: row of the second keyframe.
        T_target_source: float64.
        information: (6, 6) inverse covariance in the tangent of the source, translation first.
        kind: source of the relative pose; a "guess" was predicted and not measured.
    """

    source: int
    target: int
    T_target_source: Pose
    information: Information
    kind: EdgeKind


class MapOrigin(NamedTuple):
    """Matcher and settings that made a keyframe map.

    Attributes:
        fingerprint: fingerprint of the matcher; keyframes of another matcher cannot be compared.
        config: settings of SLAM.
        weights: name of the weights, for messages; may be empty.
    """

    fingerprint: str
    config: SlamConfig
    weights: str = ""

    def __str__(self) -> str:
        return f"{self.weights} ({self.fingerprint})" if self.weights else self.fingerprint


@dataclass(frozen=True, eq=False)
class KeyframeMap:
    """Keyframes (k of them), poses and edges.

    Attributes:
        keyframes: keyframes in the order of time.
        T_world_keyframe: (k, 4, 4) float64, corrected by loops.
        vectors: (k, c) unit vectors for retrieval, float32.
        edges: all relative poses.
        origin: matcher and settings that made it; None for an empty map.
    """

    keyframes: tuple[Keyframe, ...] = ()
    T_world_keyframe: Poses = field(default_factory=lambda: np.zeros((0, 4, 4)))
    vectors: Float[np.ndarray, "k c"] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    edges: tuple[MapEdge, ...] = ()
    origin: MapOrigin | None = None

    def __len__(self) -> int:
        return len(self.keyframes)

    def __repr__(self) -> str:
        return f"KeyframeMap({len(self)} keyframes, {len(self.edges)} edges, by {self.origin})"

    def column(self, name: str) -> np.ndarray:
        """Returns one field of all keyframes, such as "path_m", as an array."""
        return np.array([getattr(keyframe, name) for keyframe in self.keyframes])

    def edges_of(self, *kinds: EdgeKind) -> list[MapEdge]:
        """Returns the edges of some kinds; those of "odometry" and "loop" are measured."""
        return [edge for edge in self.edges if edge.kind in kinds]

    def distances_to(self, position_world: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " k"]:
        """Returns the distances of all keyframes to a position, in metres."""
        return np.asarray(np.linalg.norm(self.T_world_keyframe[:, :3, 3] - position_world, axis=1))


class Submap(NamedTuple):
    """Keyframes around a central one, which are registered as a whole.

    Attributes:
        scans: compact scans of the keyframes, the central one first.
        T_submap_keyframe: (n, 4, 4) their poses in the frame of the first.
    """

    scans: tuple[CompactScan, ...]
    T_submap_keyframe: Poses


def add_keyframe(
    slam_map: KeyframeMap,
    keyframe: Keyframe,
    T_world_keyframe: Pose,
    vector: Float[np.ndarray, " c"],
    edge: MapEdge | None,
) -> KeyframeMap:
    """Adds a keyframe.

    Args:
        slam_map: the map before.
        keyframe: the new one.
        T_world_keyframe: its pose.
        vector: vector for retrieval, of any norm.
        edge: edge to an earlier keyframe; None for the first of a map.

    Returns:
        The map after.
    """
    unit = np.asarray(vector, np.float32)[None] / np.float32(max(float(np.linalg.norm(vector)), 1e-12))
    edges = () if edge is None else (edge,)
    return joined_maps(slam_map, KeyframeMap((keyframe,), T_world_keyframe[None], unit, edges))


def joined_maps(slam_map: KeyframeMap, other: KeyframeMap) -> KeyframeMap:
    """Appends the keyframes and the edges of another map. Rows in its edges must count from the start of the first map.

    Args:
        slam_map: the map before.
        other: the further keyframes; at least one.

    Returns:
        The map after, with the origin of the first.
    """
    if len(slam_map) == 0:
        return replace(other, origin=slam_map.origin)
    return KeyframeMap(
        (*slam_map.keyframes, *other.keyframes),
        np.concatenate([slam_map.T_world_keyframe, other.T_world_keyframe]),
        np.concatenate([slam_map.vectors, other.vectors]),
        (*slam_map.edges, *other.edges),
        slam_map.origin,
    )


def take_keyframes(slam_map: KeyframeMap, rows: Sequence[int]) -> KeyframeMap:
    """Selects keyframes of a map, and the edges between them.

    Args:
        slam_map: the map.
        rows: rows of the selected keyframes.

    Returns:
        The smaller map.
    """
    keyframes, new_row = tuple(slam_map.keyframes[row] for row in rows), {row: new for new, row in enumerate(rows)}
    edges = tuple(
        edge._replace(source=new_row[edge.source], target=new_row[edge.target])
        for edge in slam_map.edges
        if edge.source in new_row and edge.target in new_row
    )
    return KeyframeMap(keyframes, slam_map.T_world_keyframe[rows], slam_map.vectors[rows], edges, slam_map.origin)


def with_origin(slam_map: KeyframeMap, origin: MapOrigin) -> KeyframeMap:
    """Records the matcher and the settings of a map.

    Args:
        slam_map: the map.
        origin: origin of the matcher that reads or extends it.

    Returns:
        The map after.

    Raises:
        ValueError: if another matcher made it.
    """
    made_by = slam_map.origin
    if made_by is not None and made_by.fingerprint != origin.fingerprint:
        advice = "load the weights that made the map, or map again"
        raise ValueError(f"slam_map: made with weights {made_by}, these are {origin}; {advice}")
    return replace(slam_map, origin=origin)


def connected_parts(num_nodes: int, edges: Iterable[Sequence[Any]]) -> Int[np.ndarray, " n"]:
    """Numbers the connected parts of a graph.

    Args:
        num_nodes: number of nodes.
        edges: records whose first two fields are the nodes that they join.

    Returns:
        The number of the part of each node.
    """
    return label_parts(num_nodes, *_ends(edges))


def submap_around(slam_map: KeyframeMap, row: int, num_keyframes: int, *, radius_m: float = SUBMAP_RADIUS_M) -> Submap:
    """Gathers a keyframe and the nearest of those that measured edges join to it.

    Args:
        slam_map: the map.
        row: row of the central keyframe.
        num_keyframes: largest number of keyframes, the central one included, and of edges from it to each of them.
        radius_m: keyframes farther away are left out.

    Returns:
        The submap, in the frame of the central keyframe. Its neighbours follow it, nearest first.
    """
    steps = steps_from(slam_map, row, num_keyframes)
    apart_m = slam_map.distances_to(slam_map.T_world_keyframe[row, :3, 3])
    rows = np.flatnonzero(np.isfinite(steps) & (apart_m <= radius_m))
    rows = rows[np.lexsort((apart_m[rows], rows != row))][:num_keyframes]
    return submap_of(slam_map, rows.tolist())


def steps_from(slam_map: KeyframeMap, row: int, most: float = np.inf) -> Float[np.ndarray, " k"]:
    """Counts the measured edges between a keyframe and each other one.

    Args:
        slam_map: the map.
        row: row of the keyframe.
        most: largest number of edges that is counted.

    Returns:
        The least number of edges; infinite beyond `most`, and for keyframes that no edges join to `row`.
    """
    source, target = _ends(slam_map.edges_of("odometry", "loop"))
    joined = sp.coo_array((np.ones(len(source)), (source, target)), (len(slam_map), len(slam_map))).tocsr()
    found = sp.csgraph.dijkstra(joined, directed=False, indices=[row], unweighted=True, limit=most)
    return np.asarray(found[0])


def submap_of(slam_map: KeyframeMap, rows: Sequence[int]) -> Submap:
    """Gathers keyframes in the frame of the first of them.

    Args:
        slam_map: the map.
        rows: rows of the keyframes; at least one.

    Returns:
        The submap.
    """
    T_world_keyframe = slam_map.T_world_keyframe[list(rows)]
    scans = tuple(slam_map.keyframes[row].compact for row in rows)
    return Submap(scans, rigid.inverse(T_world_keyframe[0]) @ T_world_keyframe)


def keyframe_points(slam_map: KeyframeMap, row: int) -> Float[np.ndarray, "n 3"]:
    """Returns the surface elements of a keyframe.

    Args:
        slam_map: the map.
        row: row of the keyframe.

    Returns:
        (n, 3) metres, in the frame of the keyframe's lidar.
    """
    elements = expand_elements(slam_map.keyframes[row].compact.elements)
    return np.asarray(elements.positions)[np.asarray(elements.mask)]


def measured_parts(slam_map: KeyframeMap) -> Int[np.ndarray, " k"]:
    """Numbers the parts of a map that measured edges join; the first keyframe belongs to part 0.

    Args:
        slam_map: the map.

    Returns:
        The number of the part of each keyframe. The relative pose of two parts is a guess.
    """
    return connected_parts(len(slam_map), slam_map.edges_of("odometry", "loop"))


def as_pose_graph(slam_map: KeyframeMap) -> PoseGraph:
    """Makes the pose graph of a map; the ids of its nodes are numbers of scans.

    The graph has a guess only if no measured edges join its ends.

    Args:
        slam_map: map with at least one keyframe.

    Returns:
        The graph.
    """
    part = measured_parts(slam_map)
    edges = [edge for edge in slam_map.edges if edge.kind != "guess" or part[edge.source] != part[edge.target]]
    return PoseGraph.create(slam_map.T_world_keyframe, edge_arrays(edges), ids=slam_map.column("scan"))


def edge_arrays(edges: Sequence[MapEdge]) -> Edges:
    """Returns the ends, motions and information of edges as stacked arrays."""
    source, target = _ends(edges)
    T_target_source = np.array([edge.T_target_source for edge in edges]).reshape(-1, 4, 4)
    return Edges(source, target, T_target_source, np.array([edge.information for edge in edges]).reshape(-1, 6, 6))


def _ends(edges: Iterable[Sequence[Any]]) -> Int[np.ndarray, "2 e"]:
    return np.array([edge[:2] for edge in edges], np.int64).reshape(-1, 2).T


def thin_map(slam_map: KeyframeMap, *, spacing_share: float = 0.8) -> KeyframeMap:
    """Leaves out keyframes near others, also of other laps, so that repeated drives of a place do not enlarge the map.

    Poses do not change. Each keyframe that is left out has a nearby kept one. Edges join the kept keyframes instead.
    The information of such an edge is divided by the number of steps that it replaces.

    Args:
        slam_map: map of a run.
        spacing_share: smallest distance of joined keyframes, as a share of the extent of the earlier one.

    Returns:
        The smaller map; the first keyframe stays.

    Raises:
        ValueError: if the spacing is not positive.
    """
    require_positive("spacing_share", spacing_share)
    if len(slam_map) == 0:
        return slam_map
    kept, cover = _covering(slam_map, spacing_share)
    edges: dict[tuple[int, int, str], MapEdge] = {}
    for edge in slam_map.edges:
        found = _contracted(slam_map, edge, cover)
        key = (found.source, found.target, found.kind)
        is_better = key not in edges or np.trace(found.information) > np.trace(edges[key].information)
        if found.source != found.target and is_better:
            edges[key] = found
    return take_keyframes(replace(slam_map, edges=tuple(edges.values())), kept)


def _covering(slam_map: KeyframeMap, spacing_share: float) -> tuple[list[int], Int[np.ndarray, " k"]]:
    """Returns the rows that stay, and the nearest one of these for each row."""
    extents_m = slam_map.column("extent_m")
    # Parts of a map that no loop has joined have no known distance.
    part = measured_parts(slam_map)

    def apart_m(row: int) -> Float[np.ndarray, " n"]:
        distances = slam_map.distances_to(slam_map.T_world_keyframe[row, :3, 3])[kept]
        return np.where(part[kept] == part[row], distances, np.inf)

    kept: list[int] = []
    for row in range(len(slam_map)):
        if not (apart_m(row) < spacing_share * extents_m[kept]).any():
            kept.append(row)
    return kept, np.array([kept[int(np.argmin(apart_m(row)))] for row in range(len(slam_map))], np.int64)


def _contracted(slam_map: KeyframeMap, edge: MapEdge, cover: Int[np.ndarray, " k"]) -> MapEdge:
    """Moves both ends of an edge to the keyframes that cover them."""
    source, target = int(cover[edge.source]), int(cover[edge.target])
    T_world = slam_map.T_world_keyframe
    T_target_end = rigid.inverse(T_world[target]) @ T_world[edge.target]
    T_start_source = rigid.inverse(T_world[edge.source]) @ T_world[source]
    T = T_target_end @ edge.T_target_source @ T_start_source
    num_steps = 1 + (source != edge.source) + (target != edge.target)
    adjoint = se3.adjoint(T_start_source)
    information = adjoint.T @ edge.information @ adjoint / num_steps
    return MapEdge(source, target, T, (information + information.T) / 2, edge.kind)
