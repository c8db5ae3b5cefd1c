"""Pose graphs as files of g2o and TORO, in the plane and in space.

An edge `a b` holds `T_a_b`: node a is the target, node b the source. Its information matrix is the upper triangle,
translation first. In space the order is x y z qx qy qz; the block of the quaternion is used for the rotation vector, as
in GTSAM. g2o itself weights the vector part of the quaternion by it, about half the rotation vector: there rotations
count a quarter, and chi2 is another. In the plane chi2 is that of g2o. Quaternions stand as x y z w.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpmjax.io.files import is_number, read_lines, refusing, write_atomically
from dpmjax.pose_graph.graph import Edges, PoseGraph, is_semidefinite, nearest_semidefinite
from dpmjax.pose_graph.optimize import spanning_tree_poses
from dpmjax.sequences import FloatArray, InputError, homogeneous, require


class _Tag(NamedTuple):
    """A kind of line.

    Attributes:
        num_nodes: 1 for a vertex, 2 for an edge.
        pose_size: numbers of its pose: x y heading, x y z roll pitch yaw, or x y z qx qy qz qw.
        triangle: rows and columns of the information matrix, in the order of its numbers.
    """

    num_nodes: int
    pose_size: int
    triangle: tuple[NDArray[np.int64], NDArray[np.int64]] = (np.zeros(0, np.int64), np.zeros(0, np.int64))

    @property
    def tangent_size(self) -> int:
        """Degrees of freedom of the pose."""
        return 3 if self.pose_size == 3 else 6


class _Line(NamedTuple):
    """A vertex or an edge: its line in the file, tag, nodes and numbers."""

    number: int
    tag: str
    nodes: list[int]
    values: list[float]


# Four tags of g2o, then four of TORO. Its EDGE2 has xx xy yy, then heading heading, x heading, y heading.
_TAGS = {
    "VERTEX_SE2": _Tag(1, 3),
    "VERTEX_SE3:QUAT": _Tag(1, 7),
    "EDGE_SE2": _Tag(2, 3, np.triu_indices(3)),
    "EDGE_SE3:QUAT": _Tag(2, 7, np.triu_indices(6)),
    "VERTEX2": _Tag(1, 3),
    "VERTEX3": _Tag(1, 6),
    "EDGE2": _Tag(2, 3, (np.array([0, 0, 1, 2, 0, 1]), np.array([0, 1, 1, 2, 2, 2]))),
    "EDGE3": _Tag(2, 6, np.triu_indices(6)),
}
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
        path: the file: VERTEX and EDGE lines of SE2 or SE3:QUAT (g2o), or VERTEX2, EDGE2, VERTEX3, EDGE3 (TORO). Empty
            lines, lines with # in front and sensor offsets (PARAMS_...) and EQUIV lines are ignored.
        nearest_psd: replaces an information matrix that is not positive semidefinite by the nearest one that is.

    Returns:
        The graph; nodes in the order of the file, those after FIX fixed.

    Raises:
        InputError: no such file, an unknown line, a wrong number of values, or graphs in the plane and in space in one
            file. Also a repeated or missing node, and invalid poses or information matrices. The message names line and
            edge.
    """
    lines, fixed = _read_lines(path)
    _check_nodes(path, lines)
    vertices = [line for line in lines if _TAGS[line.tag].num_nodes == 1]
    edge_lines = [line for line in lines if _TAGS[line.tag].num_nodes == 2]
    require(len(lines) > 0, path, "no vertices and no edges", _READ)
    if vertices:
        ids = np.array([line.nodes[0] for line in vertices], np.int64)
    else:
        ids = np.unique([node for line in edge_lines for node in line.nodes])
    row_of = {int(node): row for row, node in enumerate(ids)}
    for number, node in [*fixed, *((line.number, node) for line in edge_lines for node in line.nodes)]:
        require(node in row_of, f"{path}: line {number}", f"node {node} has no vertex", "add its VERTEX line")
    size = _TAGS[lines[0].tag].tangent_size
    target, source = np.array([[row_of[node] for node in line.nodes] for line in edge_lines], np.int64).reshape(-1, 2).T
    measurements, information = _poses(path, edge_lines, size), _information(path, edge_lines, size, nearest_psd)
    edges, poses = Edges(source, target, measurements, information), _poses(path, vertices, size)
    with refusing(path, "{error}", "mend the file", (ValueError,)):
        is_fixed = np.zeros(len(ids), bool)
        is_fixed[[row_of[node] for _, node in fixed]] = True
        poses = poses if vertices else spanning_tree_poses(len(ids), edges)
        return PoseGraph.create(poses, edges, is_fixed=is_fixed, ids=ids)


def _check_nodes(path: str | Path, lines: list[_Line]) -> None:
    """Refuses a second vertex of a node, and an edge from a node to itself."""
    line_of: dict[int, int] = {}
    for line in lines:
        source, node = f"{path}: line {line.number}", line.nodes[0]
        if len(line.nodes) == 1:
            found = f"node {node} has a vertex in line {line_of.get(node)}, too"
            require(line_of.setdefault(node, line.number) == line.number, source, found, "give every node once")
        else:
            require(node != line.nodes[1], source, f"an edge from node {node} to itself", "remove it")


def _read_lines(path: str | Path) -> tuple[list[_Line], list[tuple[int, int]]]:
    """Reads vertices and edges in the order of the file, and the nodes after FIX, each with its line."""
    lines: list[_Line] = []
    fixed: list[tuple[int, int]] = []
    for number, text in enumerate(read_lines(path), 1):
        tag, *words = text.split() or ["#"]
        if tag.startswith("#") or tag in _IGNORED:
            continue
        source = f"{path}: line {number}"
        if tag == "FIX":
            with refusing(source, "{error}", "give the numbers of nodes after FIX", (ValueError,)):
                fixed += [(number, int(word)) for word in words]
            continue
        advice = next((advice for parts, advice in _OTHER_TAGS.items() if any(part in tag for part in parts)), _READ)
        require(tag in _TAGS, source, f"'{tag[:40]}' is not read here", advice)
        if lines and _TAGS[lines[0].tag].tangent_size != _TAGS[tag].tangent_size:
            found = f"'{tag}' is not read here, line {lines[0].number} is '{lines[0].tag}'"
            raise InputError(source, found, "give a graph in the plane, or one in space")
        lines.append(_parse(source, number, tag, words))
    return lines, fixed


def _parse(source: str, number: int, tag: str, words: list[str]) -> _Line:
    """Parses a vertex or an edge from the words after its tag."""
    num_nodes, pose_size, triangle = _TAGS[tag]
    count = num_nodes + pose_size + len(triangle[0])
    found = f"{len(words)} values after {tag}"
    if len(words) == num_nodes + pose_size != count:
        found += ", the information matrix is missing"
    require(len(words) == count, source, found, f"give {count} values")
    try:
        nodes, values = [int(word) for word in words[:num_nodes]], [float(word) for word in words[num_nodes:]]
    except ValueError as error:
        kinds = [int] * num_nodes + [float] * (count - num_nodes)
        wrong = next(i for i, (word, kind) in enumerate(zip(words, kinds, strict=True)) if not is_number(word, kind))
        what = "a whole number" if wrong < num_nodes else "a number"
        found = f"column {wrong + 2}, {words[wrong][:40]!r}, is not {what}"
        raise InputError(source, found, "write plain numbers, with a decimal point") from error
    is_small = max(map(abs, nodes)) <= np.iinfo(np.int64).max
    require(is_small, source, "a node number above 2^63", "number the nodes from 0")
    return _Line(number, tag, nodes, values)


def _by_tag(lines: list[_Line]) -> Iterable[tuple[_Tag, NDArray[np.int64], FloatArray]]:
    """Yields the numbers of the lines of each tag, with their indices among all lines."""
    for tag in dict.fromkeys(line.tag for line in lines):
        places = np.array([place for place, line in enumerate(lines) if line.tag == tag])
        yield _TAGS[tag], places, np.array([lines[place].values for place in places])


def _poses(path: str | Path, lines: list[_Line], size: int) -> FloatArray:
    """Returns the poses of vertices or edges, (n, 3) or (n, 4, 4), in the order of the file."""
    poses = np.zeros((len(lines), 3) if size == 3 else (len(lines), 4, 4))
    for tag, places, values in _by_tag(lines):
        numbers = values[:, : tag.pose_size]
        is_finite: NDArray[np.bool_] = np.asarray((np.abs(numbers) < _LARGEST_NUMBER).all(axis=1))
        lengths = np.linalg.norm(np.clip(numbers[:, 3:], -2, 2), axis=1)
        is_good = is_finite & ((tag.pose_size != 7) | (np.abs(lengths - 1) <= 0.1))
        if not is_good.all():
            row = int(np.argmin(is_good))
            found = "a quaternion that is not of length 1"
            if not is_finite[row]:
                wrong = numbers[row][~(np.abs(numbers[row]) < _LARGEST_NUMBER)][0]
                found = f"expected finite numbers below {_LARGEST_NUMBER:g}, got {wrong:g}"
            raise InputError(f"{path}: line {lines[places[row]].number}", found, "mend the line")
        if tag.pose_size == 3:
            poses[places] = numbers
        else:
            angles, quaternions, is_euler = numbers[:, [5, 4, 3]], numbers[:, 3:], tag.pose_size == 6
            turns = Rotation.from_euler("ZYX", angles) if is_euler else Rotation.from_quat(quaternions)
            poses[places] = homogeneous(turns.as_matrix(), numbers[:, :3])
    return poses


def _information(path: str | Path, lines: list[_Line], size: int, nearest_psd: bool) -> FloatArray:
    """Returns the information matrices in the order of the file."""
    matrices = np.zeros((len(lines), size, size))
    for tag, places, values in _by_tag(lines):
        rows, columns = tag.triangle
        places, numbers = places[:, None], values[:, tag.pose_size :]
        matrices[places, rows, columns] = matrices[places, columns, rows] = numbers
    is_small = np.abs(matrices.reshape(len(lines), size * size)) < _LARGEST_NUMBER
    is_finite: NDArray[np.bool_] = np.asarray(is_small.all(axis=1))
    is_good = np.zeros(len(lines), bool)
    is_good[is_finite] = is_semidefinite(matrices[is_finite])
    if nearest_psd:
        matrices[is_finite & ~is_good] = nearest_semidefinite(matrices[is_finite & ~is_good])
        is_good = is_finite
    if not is_good.all():
        place = int(np.argmin(is_good))
        why, advice = "not finite, or huge", f"give finite numbers below {_LARGEST_NUMBER:g}"
        if is_finite[place]:
            least = float(np.linalg.eigvalsh(matrices[place])[0])
            why = f"not positive semidefinite, its least eigenvalue is {least:.4g}"
            advice = "mend it, or take the nearest such matrix (--nearest-psd)"
        found = f"the information of edge {lines[place].nodes[0]} {lines[place].nodes[1]} is {why}"
        raise InputError(f"{path}: line {lines[place].number}", found, advice)
    return matrices


def write_g2o(path: str | Path, graph: PoseGraph) -> Path:
    """Writes a pose graph with all digits, so that reading it gives the same graph.

    Args:
        path: file to write, atomically; missing folders are made.
        graph: the graph.

    Returns:
        The path.

    Raises:
        OSError: the folder cannot be written.
    """
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
