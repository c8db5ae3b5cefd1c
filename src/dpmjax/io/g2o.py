"""Pose graphs as files of g2o and TORO, in the plane and in space.

An edge `a b` holds `T_a_b`: node a is the target, node b the source. Its information matrix is the upper triangle,
translation first. In space the order is x y z qx qy qz. The block of the quaternion weights the rotation vector, as in
GTSAM. In g2o itself it weights the vector part of the quaternion, which is about half the rotation vector. So rotations
count a quarter there, and chi2 differs. In the plane chi2 is that of g2o. Quaternions stand as x y z w.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax.io.files import is_number, read_lines, refusing, write_atomically
from dpmjax.pose_graph.graph import Edges, PoseGraph, is_semidefinite, nearest_semidefinite
from dpmjax.pose_graph.optimize import spanning_tree_poses
from dpmjax.sequences import FloatArray, InputError, homogeneous, require


class _Tag(NamedTuple):
    """A kind of line: number of nodes, and of the numbers of its pose and of its information matrix."""

    num_nodes: int
    pose_size: int
    information_size: int = 0

    @property
    def is_planar(self) -> bool:
        """True for x, y, heading; else x y z and roll pitch yaw, or a quaternion."""
        return self.pose_size == 3


class _Line(NamedTuple):
    """A vertex or an edge: its line in the file, tag, nodes and numbers."""

    source: str
    tag: str
    nodes: list[int]
    values: list[float]


# Four tags of g2o, then four of TORO.
_TAGS = {
    "VERTEX_SE2": _Tag(1, 3),
    "VERTEX_SE3:QUAT": _Tag(1, 7),
    "EDGE_SE2": _Tag(2, 3, 6),
    "EDGE_SE3:QUAT": _Tag(2, 7, 21),
    "VERTEX2": _Tag(1, 3),
    "VERTEX3": _Tag(1, 6),
    "EDGE2": _Tag(2, 3, 6),
    "EDGE3": _Tag(2, 6, 21),
}
# TORO's EDGE2 has xx xy yy, then heading heading, x heading, y heading; iSAM's the upper triangle.
_TORO_ORDER = [0, 1, 4, 2, 5, 3]
# EQUIV marks nodes that TORO may collapse on request; their edges stand in the file, too.
_IGNORED = ("PARAMS_SE2OFFSET", "PARAMS_SE3OFFSET", "EQUIV")
_LARGEST_NUMBER = 1e75  # Squared and weighted errors of larger numbers overflow.
_READ = "give VERTEX and EDGE lines of SE2 or SE3:QUAT (g2o), or VERTEX2, EDGE2, VERTEX3, EDGE3 (TORO)"
# Advice for other tags, by parts of their names.
_OTHER_TAGS = {
    ("SWITCH", "MAXMIX", "DCS"): (
        "switchable and mixture edges are not read: give plain edges; --outlier-chi2 10 rejects wrong ones"
    ),
    ("PRIOR",): "priors of single poses are not read: leave them out, and fix nodes with FIX",
    ("XY", "LANDMARK", "POINT", "LINE", "PLANE", "BEARING", "CAM"): (
        "landmarks are not read: leave their lines out; poses and edges between poses are optimised"
    ),
}


def read_g2o(path: str | Path, *, nearest_psd: bool = False) -> PoseGraph:
    """Reads a pose graph.

    A file of edges alone gets poses along a spanning tree; `optimize_pose_graph` also tries the chordal relaxation.

    Args:
        path: the file: VERTEX and EDGE lines of SE2 or SE3:QUAT (g2o), or VERTEX2, EDGE2, VERTEX3, EDGE3 (TORO; EDGE2
            of iSAM, too). Empty lines, lines with # in front and sensor offsets (PARAMS_...) and EQUIV lines are
            ignored.
        nearest_psd: replaces an information matrix that is not positive semidefinite by the nearest one that is.

    Returns:
        The graph; nodes in the order of the file, those after FIX fixed.

    Raises:
        InputError: no such file, an unknown line, a wrong number of values, or graphs in the plane and in space in one
            file. Also a repeated or missing node, and invalid poses or information matrices. The message names line and
            edge.
    """
    lines = _read_lines(path)
    vertices, edge_lines, fixed = (
        [line for line in lines if (line.tag == "FIX", len(line.nodes)) == kind]
        for kind in ((False, 1), (False, 2), (True, 1))
    )
    require(len(vertices) + len(edge_lines) > 0, path, "no vertices and no edges", _READ)
    ids = sorted({node for line in edge_lines for node in line.nodes}) if not vertices else []
    row_of = {node: row for row, node in enumerate(ids)}
    for line in vertices:
        found = f"node {line.nodes[0]} has a vertex in an earlier line, too"
        require(row_of.setdefault(line.nodes[0], len(row_of)) == len(row_of) - 1, line.source, found, "give it once")
    for line in edge_lines + fixed:
        missing = next((node for node in line.nodes if node not in row_of), None)
        require(missing is None, line.source, f"node {missing} has no vertex", "add its VERTEX line")
        found = f"an edge from node {line.nodes[0]} to itself"
        require(line.tag == "FIX" or line.nodes[0] != line.nodes[1], line.source, found, "remove it")
    target, source = np.array([[row_of[node] for node in line.nodes] for line in edge_lines], np.int64).reshape(-1, 2).T
    is_planar = _TAGS[(vertices + edge_lines)[0].tag].is_planar
    information = _information(edge_lines, 3 if is_planar else 6, nearest_psd)
    edges, poses = Edges(source, target, _poses(edge_lines, is_planar), information), _poses(vertices, is_planar)
    with refusing(path, "{error}", "mend the file", (ValueError,)):
        is_fixed = np.isin(list(row_of), [line.nodes[0] for line in fixed])
        poses = poses if vertices else spanning_tree_poses(len(row_of), edges)
        return PoseGraph.create(poses, edges, is_fixed=is_fixed, ids=np.array(list(row_of), np.int64))


def _read_lines(path: str | Path) -> list[_Line]:
    """Reads vertices, edges, and a line for each node after FIX, in the order of the file."""
    lines: list[_Line] = []
    first = None
    for number, text in enumerate(read_lines(path), 1):
        tag, *words = text.split() or ["#"]
        source = f"{path}: line {number}"
        if tag.startswith("#") or tag in _IGNORED:
            continue
        if tag == "FIX":
            with refusing(source, "{error}", "give the numbers of nodes after FIX", (ValueError,)):
                lines += [_Line(source, tag, [int(word)], []) for word in words]
            continue
        advice = next((advice for parts, advice in _OTHER_TAGS.items() if any(part in tag for part in parts)), _READ)
        require(tag in _TAGS, source, f"'{tag[:40]}' is not read here", advice)
        first = first or tag
        found = f"'{tag}' is not read here, the first line is '{first}'"
        is_same = _TAGS[first].is_planar == _TAGS[tag].is_planar
        require(is_same, source, found, "give a graph in the plane, or one in space")
        lines.append(_parse(source, tag, words))
    return lines


def _parse(source: str, tag: str, words: list[str]) -> _Line:
    """Parses a vertex or an edge from the words after its tag."""
    num_nodes, pose_size, information_size = _TAGS[tag]
    count = num_nodes + pose_size + information_size
    found = f"{len(words)} values after {tag}"
    if len(words) == num_nodes + pose_size != count:
        found += ", the information matrix is missing"
    require(len(words) == count, source, found, f"give {count} values")
    kinds: list[type[int | float]] = [int] * num_nodes + [float] * (count - num_nodes)
    for column, (word, kind) in enumerate(zip(words, kinds, strict=True), 2):
        found = f"column {column}, {word[:40]!r}, is not a{' whole' * (kind is int)} number"
        require(is_number(word, kind), source, found, "write plain numbers, with a decimal point")
    nodes, values = [int(word) for word in words[:num_nodes]], [float(word) for word in words[num_nodes:]]
    is_small = max(map(abs, nodes)) <= np.iinfo(np.int64).max
    require(is_small, source, "a node number above 2^63", "number the nodes from 0")
    wrong = next((value for value in values[:pose_size] if not abs(value) < _LARGEST_NUMBER), None)
    found = f"expected finite numbers below {_LARGEST_NUMBER:g}, got {wrong}"
    require(wrong is None, source, found, "mend the line")
    is_unit = pose_size != 7 or abs(float(np.linalg.norm(np.clip(values[3:7], -2, 2))) - 1) <= 0.1
    require(is_unit, source, "a quaternion that is not of length 1", "mend the line")
    if pose_size == 6:
        values[3:6] = Rotation.from_euler("ZYX", values[5:2:-1]).as_quat().tolist()
    return _Line(source, tag, nodes, values)


def _poses(lines: list[_Line], is_planar: bool) -> FloatArray:
    """Returns the poses of vertices or edges, (n, 3) or (n, 4, 4)."""
    size = 3 if is_planar else 7
    values = np.array([line.values[:size] for line in lines]).reshape(-1, size)
    if is_planar or not lines:
        return values if is_planar else np.zeros((0, 4, 4))
    return homogeneous(Rotation.from_quat(values[:, 3:]).as_matrix(), values[:, :3])


def _information(lines: list[_Line], size: int, nearest_psd: bool) -> FloatArray:
    """Returns the information matrices (e, size, size)."""
    rows, columns = np.triu_indices(size)
    values = np.array([line.values[-len(rows) :] for line in lines]).reshape(-1, len(rows))

    def as_matrices(values: FloatArray) -> FloatArray:
        matrices = np.zeros((len(values), size, size))
        matrices[:, rows, columns] = matrices[:, columns, rows] = values
        return matrices

    is_finite = np.asarray((np.abs(values) < _LARGEST_NUMBER).all(axis=1))
    is_edge2 = np.array([line.tag == "EDGE2" for line in lines], bool)
    toro = values[is_edge2][:, _TORO_ORDER] if is_edge2.any() else values[is_edge2]
    is_isam = not is_semidefinite(as_matrices(toro[is_finite[is_edge2]])).all()
    if not is_isam or not is_semidefinite(as_matrices(values[is_edge2 & is_finite])).all():
        values[is_edge2] = toro
    matrices, is_good = as_matrices(values), is_finite.copy()
    is_good[is_finite] = is_semidefinite(matrices[is_finite])
    if nearest_psd:
        matrices[is_finite & ~is_good] = nearest_semidefinite(matrices[is_finite & ~is_good])
        is_good = is_finite
    for row in np.flatnonzero(~is_good)[:1]:
        why, advice = "not finite, or huge", f"give finite numbers below {_LARGEST_NUMBER:g}"
        if is_finite[row]:
            least = float(np.linalg.eigvalsh(matrices[row])[0])
            why = f"not positive semidefinite, its least eigenvalue is {least:.4g}"
            advice = "mend it, or take the nearest such matrix (--nearest-psd)"
        found = f"the information of edge {lines[row].nodes[0]} {lines[row].nodes[1]} is {why}"
        raise InputError(lines[row].source, found, advice)
    return matrices


def write_g2o(path: str | Path, graph: PoseGraph | None) -> Path:
    """Writes a pose graph with all digits, so that reading it gives the same graph.

    Args:
        path: file to write, atomically; missing folders are made.
        graph: the graph; the None of a run without keyframes is refused.

    Returns:
        The path.

    Raises:
        ValueError: there is no graph.
        OSError: the folder cannot be written.
    """
    if graph is None:
        raise ValueError("graph: expected a pose graph, got None: the run has no keyframe")
    kind = "SE2" if graph.poses.ndim == 2 else "SE3:QUAT"
    rows, columns = np.triu_indices(graph.tangent_size)
    edges = graph.edges
    values = np.column_stack([_numbers(edges.measurements), edges.information[:, rows, columns]])
    vertices = zip(graph.ids, _numbers(graph.poses), strict=True)
    lines = [_text(f"VERTEX_{kind}", (node,), pose) for node, pose in vertices]
    lines += [f"FIX {node}" for node in graph.ids[graph.is_fixed]]
    ends = zip(graph.ids[edges.target], graph.ids[edges.source], strict=True)
    lines += [_text(f"EDGE_{kind}", nodes, row) for nodes, row in zip(ends, values, strict=True)]
    return write_atomically(path, "\n".join(lines) + "\n")


def _numbers(poses: FloatArray) -> FloatArray:
    """Converts poses of the graph to numbers of the file."""
    if poses.ndim == 2 or not len(poses):
        return poses if poses.ndim == 2 else np.zeros((0, 7))
    return np.column_stack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])


def _text(tag: str, nodes: Iterable[np.integer], values: FloatArray) -> str:
    return " ".join([tag, *map(str, nodes), *(f"{value:.17g}" for value in values.tolist())])
