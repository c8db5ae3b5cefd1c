"""Pose graphs as g2o files, in the plane (SE2) and in space (SE3:QUAT).

An edge `a b` holds `T_a_b`: node a is the target, node b the source. Its information matrix stands as the upper
triangle, row by row, translation first; in space the order is x y z qx qy qz, and the part of the quaternion is taken
for that of the rotation vector, as GTSAM does. Quaternions stand as x y z w.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpmjax.io.files import read_lines, refusing, write_atomically
from dpmjax.io.poses import homogeneous
from dpmjax.pose_graph.graph import Edges, PoseGraph
from dpmjax.sequences import FloatArray, require


class _Kind(NamedTuple):
    """One kind of graph: its tags, the numbers of a pose, the axes of its tangent."""

    vertex: str
    edge: str
    pose_size: int
    tangent_size: int


_PLANAR = _Kind("VERTEX_SE2", "EDGE_SE2", 3, 3)
_SPATIAL = _Kind("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", 7, 6)
_ADVICE = "give VERTEX_SE2 and EDGE_SE2, or VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines"
_IGNORED = ("PARAMS_SE2OFFSET", "PARAMS_SE3OFFSET")


def read_g2o(path: str | Path) -> PoseGraph:
    """Reads a pose graph.

    Args:
        path: the file. Empty lines, lines with # in front and sensor offsets (PARAMS_...) are ignored.

    Returns:
        The graph; nodes in the order of the file, those after FIX fixed.

    Raises:
        InputError: no such file, an unknown line, a wrong number of values, both kinds in one file, a node that occurs
            twice or not at all, or numbers that make no poses or information matrices.
    """
    lines = _read_words(path)
    tags = {words[0] for _, words in lines} - {"FIX"}
    kind = _PLANAR if tags <= {_PLANAR.vertex, _PLANAR.edge} else _SPATIAL
    for number, (tag, *_) in lines:
        is_known = tag in ("FIX", kind.vertex, kind.edge)
        require(is_known, f"{path}: line {number}", f"'{tag[:40]}' is not read here", _ADVICE)
    triangle = np.triu_indices(kind.tangent_size)
    nodes, poses = _rows(path, (line for line in lines if line[1][0] == kind.vertex), 1, kind.pose_size)
    ends, values = _rows(
        path, (line for line in lines if line[1][0] == kind.edge), 2, kind.pose_size + len(triangle[0])
    )
    require(len(nodes) > 0, path, "no vertices", _ADVICE)
    row_of = {int(node): row for row, node in enumerate(nodes[:, 0])}
    fixed = [number for _, words in lines if words[0] == "FIX" for number in words[1:]]
    information = np.zeros((len(values), kind.tangent_size, kind.tangent_size))
    information[:, triangle[0], triangle[1]] = information[:, triangle[1], triangle[0]] = values[:, kind.pose_size :]
    with (
        refusing(path, "node {error} has no vertex", "add its VERTEX line", (KeyError,)),
        refusing(path, "{error}", "mend the file", (ValueError,)),
    ):
        target, source = (np.array([row_of[int(node)] for node in column], np.int64) for column in ends.T)
        is_fixed = np.zeros(len(nodes), bool)
        is_fixed[[row_of[int(node)] for node in fixed]] = True
        edges = Edges(source, target, _poses(values[:, : kind.pose_size]), information)
        return PoseGraph.create(_poses(poses), edges, is_fixed=is_fixed, ids=nodes[:, 0])


def write_g2o(path: str | Path, graph: PoseGraph) -> Path:
    """Writes a pose graph, with all digits, so that it is read again as it was.

    Args:
        path: file to write, atomically; missing folders are made.
        graph: the graph.

    Returns:
        The path.

    Raises:
        OSError: the folder cannot be written.
    """
    kind = _PLANAR if graph.poses.ndim == 2 else _SPATIAL
    triangle = np.triu_indices(kind.tangent_size)
    edges = graph.edges
    values = np.column_stack([_numbers(edges.measurements), edges.information[:, triangle[0], triangle[1]]])
    lines = [_line(kind.vertex, (node,), pose) for node, pose in zip(graph.ids, _numbers(graph.poses), strict=True)]
    lines += [f"FIX {node}" for node in graph.ids[graph.is_fixed]]
    for target, source, row in zip(graph.ids[edges.target], graph.ids[edges.source], values, strict=True):
        lines.append(_line(kind.edge, (target, source), row))
    return write_atomically(path, "\n".join(lines) + "\n")


def _read_words(path: str | Path) -> list[tuple[int, list[str]]]:
    """The words of each line that is read, and its number."""
    lines = ((number, line.split()) for number, line in enumerate(read_lines(path), 1) if line.strip()[:1] != "#")
    return [(number, words) for number, words in lines if words and words[0] not in _IGNORED]


def _rows(
    path: str | Path, lines: Iterable[tuple[int, list[str]]], num_nodes: int, num_values: int
) -> tuple[NDArray[np.int64], FloatArray]:
    """Node ids and numbers of all lines of one tag."""
    nodes, values = [], []
    for number, (tag, *words) in lines:
        source, count = f"{path}: line {number}", num_nodes + num_values
        require(len(words) == count, source, f"{len(words)} values after {tag}", f"give {count} values")
        with refusing(source, "not a number ({error})", "write plain numbers", (ValueError,)):
            nodes.append([int(word) for word in words[:num_nodes]])
            values.append([float(word) for word in words[num_nodes:]])
        is_small = max(map(abs, nodes[-1])) <= np.iinfo(np.int64).max
        require(is_small, source, "a node number above 2^63", "number the nodes from 0")
    return np.array(nodes, np.int64).reshape(-1, num_nodes), np.array(values).reshape(-1, num_values)


def _poses(numbers: FloatArray) -> FloatArray:
    """Poses of the graph from numbers of the file: x y heading, or x y z qx qy qz qw to matrices."""
    if numbers.shape[1] == 3:
        return numbers
    quaternions = numbers[:, 3:]
    if not np.isfinite(numbers).all() or (np.abs(np.linalg.norm(np.clip(quaternions, -2, 2), axis=1) - 1) > 0.1).any():
        raise ValueError("a quaternion that is not of length 1, or a number that is not finite")
    rotations = Rotation.from_quat(quaternions).as_matrix() if len(numbers) else np.zeros((0, 3, 3))
    return homogeneous(rotations, numbers[:, :3])


def _numbers(poses: FloatArray) -> FloatArray:
    """Numbers of the file from poses of the graph."""
    if poses.ndim == 2 or not len(poses):
        return poses if poses.ndim == 2 else np.zeros((0, 7))
    return np.column_stack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])


def _line(tag: str, nodes: Iterable[np.integer], values: FloatArray) -> str:
    return " ".join([tag, *map(str, nodes), *(f"{value:.17g}" for value in values.tolist())])
