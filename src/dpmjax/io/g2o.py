"""Pose graphs as files of g2o and TORO, in the plane and in space.

An edge `a b` holds `T_a_b`: node a is the target, node b the source. Its information matrix is the upper triangle,
translation first. In space the order is x y z qx qy qz; the block of the quaternion is used for the rotation vector, as
in GTSAM. Quaternions stand as x y z w.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpmjax.io.files import read_lines, refusing, write_atomically
from dpmjax.io.graph_tags import IGNORED, TAGS, advice_of, information_of, poses_of
from dpmjax.pose_graph.chordal import spanning_tree_poses
from dpmjax.pose_graph.graph import Edges, PoseGraph, is_semidefinite, nearest_semidefinite
from dpmjax.sequences import FloatArray, InputError, require


class _Line(NamedTuple):
    """A vertex or an edge: its line in the file, tag, nodes and numbers."""

    number: int
    tag: str
    nodes: list[int]
    values: list[float]


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
    vertices = [line for line in lines if TAGS[line.tag].num_nodes == 1]
    edge_lines = [line for line in lines if TAGS[line.tag].num_nodes == 2]
    require(len(lines) > 0, path, "no vertices and no edges", advice_of(""))
    if vertices:
        ids = np.array([line.nodes[0] for line in vertices], np.int64)
    else:
        ids = np.unique([node for line in edge_lines for node in line.nodes])
    row_of = {int(node): row for row, node in enumerate(ids)}
    size = TAGS[lines[0].tag].tangent_size
    target, source = (_rows_of(path, edge_lines, row_of, end) for end in (0, 1))
    measurements, information = _poses(path, edge_lines, size), _information(path, edge_lines, size, nearest_psd)
    edges = Edges(source, target, measurements, information)
    with (
        refusing(path, "node {error} has no vertex", "add its VERTEX line", (KeyError,)),
        refusing(path, "{error}", "mend the file", (ValueError,)),
    ):
        is_fixed = np.zeros(len(ids), bool)
        is_fixed[[row_of[int(node)] for node in fixed]] = True
        poses = _poses(path, vertices, size) if vertices else spanning_tree_poses(len(ids), edges)
        return PoseGraph.create(poses, edges, is_fixed=is_fixed, ids=ids)


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
    triangle = np.triu_indices(graph.tangent_size)
    edges = graph.edges
    values = np.column_stack([_numbers(edges.measurements), edges.information[:, triangle[0], triangle[1]]])
    vertices = zip(graph.ids, _numbers(graph.poses), strict=True)
    lines = [_text(f"VERTEX_{kind}", (node,), pose) for node, pose in vertices]
    lines += [f"FIX {node}" for node in graph.ids[graph.is_fixed]]
    for target, source, row in zip(graph.ids[edges.target], graph.ids[edges.source], values, strict=True):
        lines.append(_text(f"EDGE_{kind}", (target, source), row))
    return write_atomically(path, "\n".join(lines) + "\n")


def _read_lines(path: str | Path) -> tuple[list[_Line], list[str]]:
    """Reads vertices and edges in the order of the file, and the nodes after FIX."""
    lines: list[_Line] = []
    fixed: list[str] = []
    for number, text in enumerate(read_lines(path), 1):
        words = text.split()
        if not words or words[0].startswith("#") or words[0] in IGNORED:
            continue
        tag = words[0]
        if tag == "FIX":
            fixed += words[1:]
            continue
        source = f"{path}: line {number}"
        require(tag in TAGS, source, f"'{tag[:40]}' is not read here", advice_of(tag))
        if lines and TAGS[lines[0].tag].tangent_size != TAGS[tag].tangent_size:
            found = f"'{tag}' is not read here, line {lines[0].number} is '{lines[0].tag}'"
            raise InputError(source, found, "give a graph in the plane, or one in space")
        lines.append(_parse(source, number, words))
    return lines, fixed


def _parse(source: str, number: int, words: list[str]) -> _Line:
    """Parses a vertex or an edge from its words."""
    tag = TAGS[words[0]]
    count = tag.num_nodes + tag.num_values
    found = f"{len(words) - 1} values after {words[0]}"
    if len(words) - 1 == tag.num_nodes + tag.pose_size != count:
        found += ", the information matrix is missing"
    require(len(words) - 1 == count, source, found, f"give {count} values")
    kinds = [int] * tag.num_nodes + [float] * tag.num_values
    numbers: list[float] = []
    try:
        numbers += [kind(word) for kind, word in zip(kinds, words[1:], strict=True)]
    except ValueError as error:
        wrong = next(i for i, kind in enumerate(kinds, 1) if not _is_number(kind, words[i]))
        what = "a whole number" if wrong <= tag.num_nodes else "a number"
        found = f"column {wrong + 1}, {words[wrong][:40]!r}, is not {what}"
        raise InputError(source, found, "write plain numbers, with a decimal point") from error
    nodes, values = [int(number) for number in numbers[: tag.num_nodes]], numbers[tag.num_nodes :]
    is_small = max(map(abs, nodes)) <= np.iinfo(np.int64).max
    require(is_small, source, "a node number above 2^63", "number the nodes from 0")
    return _Line(number, words[0], nodes, values)


def _is_number(kind: type[int | float], word: str) -> bool:
    try:
        kind(word)
    except ValueError:
        return False
    return True


def _rows_of(path: str | Path, lines: list[_Line], row_of: dict[int, int], end: int) -> NDArray[np.int64]:
    """Returns the rows of the first or the second node of each edge."""
    for line in lines:
        is_known = line.nodes[end] in row_of
        require(is_known, f"{path}: line {line.number}", f"node {line.nodes[end]} has no vertex", "add its VERTEX line")
    return np.array([row_of[line.nodes[end]] for line in lines], np.int64)


def _by_tag(lines: list[_Line]) -> Iterable[tuple[str, list[int], FloatArray]]:
    """Yields the numbers of the lines of each tag, with their indices among all lines."""
    for tag in dict.fromkeys(line.tag for line in lines):
        places = [place for place, line in enumerate(lines) if line.tag == tag]
        yield tag, places, np.array([lines[place].values for place in places]).reshape(len(places), -1)


def _poses(path: str | Path, lines: list[_Line], size: int) -> FloatArray:
    """Returns the poses of vertices or edges, in the order of the file."""
    poses = np.zeros((len(lines), 3) if size == 3 else (len(lines), 4, 4))
    for tag, places, values in _by_tag(lines):
        numbers = values[:, : TAGS[tag].pose_size]
        try:
            poses[places] = poses_of(numbers)
        except ValueError as error:
            place = next(place for place, row in zip(places, numbers, strict=True) if not _is_pose(row[None]))
            raise InputError(f"{path}: line {lines[place].number}", str(error), "mend the line") from error
    return poses


def _is_pose(numbers: FloatArray) -> bool:
    try:
        poses_of(numbers)
    except ValueError:
        return False
    return True


def _information(path: str | Path, lines: list[_Line], size: int, nearest_psd: bool) -> FloatArray:
    """Returns the information matrices in the order of the file."""
    matrices = np.zeros((len(lines), size, size))
    for tag, places, values in _by_tag(lines):
        matrices[places] = information_of(TAGS[tag], values[:, TAGS[tag].pose_size :])
    is_finite: NDArray[np.bool_] = np.asarray(np.isfinite(matrices.reshape(len(lines), size * size)).all(axis=1))
    is_good = np.zeros(len(lines), bool)
    is_good[is_finite] = is_semidefinite(matrices[is_finite])
    if nearest_psd:
        matrices[is_finite & ~is_good] = nearest_semidefinite(matrices[is_finite & ~is_good])
        is_good = is_finite
    if not is_good.all():
        place = int(np.argmin(is_good))
        line, is_number = lines[place], bool(is_finite[place])
        least = float(np.linalg.eigvalsh(matrices[place])[0]) if is_number else 0.0
        why = f"not positive semidefinite, its least eigenvalue is {least:.4g}" if is_number else "not finite"
        found = f"the information of edge {line.nodes[0]} {line.nodes[1]} is {why}"
        advice = "mend it, or take the nearest such matrix (nearest_psd=True, --nearest-psd)"
        raise InputError(f"{path}: line {line.number}", found, advice if is_number else "give expected finite numbers")
    return matrices


def _numbers(poses: FloatArray) -> FloatArray:
    """Converts poses of the graph to numbers of the file."""
    if poses.ndim == 2 or not len(poses):
        return poses if poses.ndim == 2 else np.zeros((0, 7))
    return np.column_stack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])


def _text(tag: str, nodes: Iterable[np.integer], values: FloatArray) -> str:
    return " ".join([tag, *map(str, nodes), *(f"{value:.17g}" for value in values.tolist())])
