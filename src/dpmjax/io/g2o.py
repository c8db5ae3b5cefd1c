"""Pose graphs as files of g2o and TORO, in the plane and in space.

An edge `a b` holds `T_a_b`: node a is the target, node b the source. Its information matrix is the upper triangle,
translation first. In space the order is x y z qx qy qz. The block of the quaternion weights the rotation vector, as in
GTSAM. In g2o itself it weights the vector part of the quaternion, which is about half the rotation vector. So rotations
count a quarter there, and chi2 differs. In the plane chi2 is that of g2o. Quaternions stand as x y z w.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dpmjax.io.files import read_lines, refusing, write_atomically
from dpmjax.pose_graph.graph import Edges, PoseGraph, is_semidefinite, nearest_semidefinite
from dpmjax.pose_graph.optimize import spanning_tree_poses
from dpmjax.sequences import BoolArray, FloatArray, InputError, homogeneous, require


class _Line(NamedTuple):
    """A vertex, an edge or a fixed node: its line in the file, tag, nodes and numbers."""

    source: str
    tag: str
    nodes: list[int]
    values: list[float]


# Number of nodes, of numbers of a pose, and of numbers of an information matrix: four tags of g2o, four of TORO.
_TAGS = {
    "VERTEX_SE2": (1, 3, 0), "EDGE_SE2": (2, 3, 6), "VERTEX_SE3:QUAT": (1, 7, 0), "EDGE_SE3:QUAT": (2, 7, 21),
    "VERTEX2": (1, 3, 0), "EDGE2": (2, 3, 6), "VERTEX3": (1, 6, 0), "EDGE3": (2, 6, 21),
}  # fmt: skip
# TORO's EDGE2 has xx xy yy, then heading heading, x heading, y heading; iSAM's the upper triangle.
_TORO_ORDER = [0, 1, 4, 2, 5, 3]
# EQUIV marks nodes that TORO may collapse on request; their edges stand in the file, too.
_IGNORED = ("PARAMS_SE2OFFSET", "PARAMS_SE3OFFSET", "EQUIV")
_LARGEST_NUMBER = 1e75  # Squared and weighted errors of larger numbers overflow.
_READ = "give VERTEX and EDGE lines of SE2 or SE3:QUAT (g2o), or VERTEX2, EDGE2, VERTEX3, EDGE3 (TORO)"
# Advice for other tags, by parts of their names.
_OTHER_TAGS = {
    ("SWITCH", "MAXMIX", "DCS"): "switchable and mixture edges are not read: give plain edges, and --outlier-chi2 10",
    ("PRIOR",): "priors of single poses are not read: leave them out, and fix nodes with FIX",
    ("XY", "LANDMARK", "POINT", "LINE", "PLANE", "BEARING", "CAM"): "landmarks are not read: leave their lines out",
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
    is_planar = _TAGS[(vertices + edge_lines)[0].tag][1] == 3
    information = _information(edge_lines, 3 if is_planar else 6, nearest_psd)
    edges, poses = Edges(source, target, _poses(edge_lines, is_planar), information), _poses(vertices, is_planar)
    with refusing(path, "{error}", "mend the file", (ValueError, OverflowError)):
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
        if tag != "FIX":
            advice = next(
                (advice for parts, advice in _OTHER_TAGS.items() if any(part in tag for part in parts)), _READ
            )
            require(tag in _TAGS, source, f"'{tag[:40]}' is not read here", advice)
            first = first or tag
            is_same = (_TAGS[first][1] == 3) == (_TAGS[tag][1] == 3)
            found = f"'{tag}' is not read here, the first line is '{first}'"
            require(is_same, source, found, "give a graph in the plane, or one in space")
        with refusing(source, "{error}", "mend the line; numbers have a decimal point", (ValueError,)):
            lines += _parse(source, tag, words)
    return lines


def _parse(source: str, tag: str, words: list[str]) -> list[_Line]:
    """Parses the words after a tag; a ValueError tells what is wrong."""
    if tag == "FIX":
        return [_Line(source, tag, [int(word)], []) for word in words]
    num_nodes, pose_size, information_size = _TAGS[tag]
    if len(words) != num_nodes + pose_size + information_size:
        missing = ", the information matrix is missing" if len(words) == num_nodes + pose_size else ""
        raise ValueError(f"{len(words)} values after {tag}{missing}")
    nodes, values = [int(word) for word in words[:num_nodes]], [float(word) for word in words[num_nodes:]]
    wrong = next((value for value in values[:pose_size] if not abs(value) < _LARGEST_NUMBER), None)
    if wrong is not None:
        raise ValueError(f"expected finite numbers below {_LARGEST_NUMBER:g}, got {wrong}")
    if pose_size == 7 and abs(float(np.linalg.norm(np.clip(values[3:7], -2, 2))) - 1) > 0.1:
        raise ValueError("a quaternion that is not of length 1")
    if pose_size == 6:
        values[3:6] = Rotation.from_euler("ZYX", values[5:2:-1]).as_quat().tolist()
    return [_Line(source, tag, nodes, values)]


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
    is_finite = np.asarray((np.abs(values) < _LARGEST_NUMBER).all(axis=1))

    def refuse(is_good: BoolArray, why: str, advice: str) -> None:
        for row in np.flatnonzero(~is_good)[:1]:
            found = f"the information of edge {lines[row].nodes[0]} {lines[row].nodes[1]} is {why}"
            raise InputError(lines[row].source, found, advice)

    def as_matrices(values: FloatArray) -> FloatArray:
        matrices = np.zeros((len(values), size, size))
        matrices[:, rows, columns] = matrices[:, columns, rows] = values
        return matrices

    refuse(is_finite, "not finite, or huge", f"give finite numbers below {_LARGEST_NUMBER:g}")
    is_edge2 = np.array([line.tag == "EDGE2" for line in lines], bool)
    if is_edge2.any():
        given, toro = values[is_edge2], values[is_edge2][:, _TORO_ORDER]
        is_isam = not is_semidefinite(as_matrices(toro)).all() and is_semidefinite(as_matrices(given)).all()
        values[is_edge2] = given if is_isam else toro
    matrices = as_matrices(values)
    is_good = is_semidefinite(matrices)
    if nearest_psd:
        matrices[~is_good] = nearest_semidefinite(matrices[~is_good])
    elif not is_good.all():
        least = float(np.linalg.eigvalsh(matrices[~is_good])[0, 0])
        why = f"not positive semidefinite, its least eigenvalue is {least:.4g}"
        refuse(is_good, why, "mend it, or take the nearest such matrix (--nearest-psd)")
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

    def text(tag: str, ids: Sequence[NDArray[np.integer]], values: FloatArray) -> list[str]:
        ends = zip(*ids, strict=True)
        return [f"{tag} {' '.join(map(str, nodes))} " + " ".join(f"{x:.17g}" for x in row)
                for nodes, row in zip(ends, values.tolist(), strict=True)]  # fmt: skip

    information = edges.information[:, rows, columns]
    lines = text(f"VERTEX_{kind}", [graph.ids], _numbers(graph.poses))
    lines += [f"FIX {node}" for node in graph.ids[graph.is_fixed]]
    ends = [graph.ids[edges.target], graph.ids[edges.source]]
    lines += text(f"EDGE_{kind}", ends, np.column_stack([_numbers(edges.measurements), information]))
    return write_atomically(path, "\n".join(lines) + "\n")


def _numbers(poses: FloatArray) -> FloatArray:
    """Converts poses of the graph to numbers of the file."""
    if poses.ndim == 2 or not len(poses):
        return poses if poses.ndim == 2 else np.zeros((0, 7))
    return np.column_stack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
