"""Certainty of the nodes of a pose graph: marginal covariances, and the nodes that no edge holds.

Nodes are free if no edge joins their part to others, or if no edge measures one of their motions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from dpmjax.checks import runs_on_host
from dpmjax.pose_graph.graph import Floats, PoseGraph, label_parts
from dpmjax.pose_graph.normal_equations import BlockPattern, factorise, linearise

_AXES = {3: ("x", "y", "heading"), 6: ("x", "y", "z", "rotation about x", "rotation about y", "rotation about z")}
# Rounding of the normal equations, scaled to a diagonal of one, is 1e-16 a term; graphs with edges a million times
# stiffer than others have pivots of 1e-9.
_ADDED, _LEAST_PIVOT = 1e-14, 1e-12
# Least share of a motion, of the largest of its node or graph, that counts.
_LEAST_SHARE = 1e-3
_NUM_PROBES = 3


class FreeNodes(NamedTuple):
    """Nodes that can move together without any cost.

    Attributes:
        ids: names of the nodes in files.
        axes: axes in which the first of them can move, in its own frame: "x", "y", "heading" in the plane; "x", "y",
            "z", "rotation about x", .. in space. All of them if no edge joins it to a node that stays.
    """

    ids: tuple[int, ...]
    axes: tuple[str, ...]


def describe_free_nodes(found: Sequence[FreeNodes]) -> str:
    """Names free nodes, of many the first ones.

    Args:
        found: one record or more.

    Returns:
        One line.

    >>> describe_free_nodes([FreeNodes((7, 9), ("heading",))])
    'no edge measures heading of nodes 7, 9'
    """
    parts = []
    for ids, axes in found[:3]:
        more = f" and {len(ids) - 3} more" * (len(ids) > 3)
        parts.append(f"{', '.join(axes)} of node{'s' * (len(ids) > 1)} {', '.join(map(str, ids[:3]))}{more}")
    return "no edge measures " + "; ".join([*parts, *[f"and {len(found) - 3} more such groups"] * (len(found) > 3)])


def find_free_nodes(graph: PoseGraph) -> tuple[FreeNodes, ...]:
    """Finds the nodes that the edges leave free at the present poses.

    Edges without information join nothing. Of several parts that no edge joins, those without a fixed node are free; if
    no node is fixed at all, the largest part stays.

    Args:
        graph: the graph.

    Returns:
        The free nodes, one record for nodes that move together; none for a graph that its edges determine.
    """
    size, axes = len(graph.poses), _AXES[graph.tangent_size]
    has_any = graph.edges.information.any(axis=(1, 2))
    part, rigid_part = (
        label_parts(size, graph.edges.source[rows], graph.edges.target[rows])
        for rows in (has_any, _has_full_rank(graph.edges.information))
    )
    is_free_part = np.ones(part.max() + 1, bool)
    is_free_part[part[graph.is_fixed] if graph.is_fixed.any() else np.bincount(part).argmax()] = False
    found = [FreeNodes(tuple(graph.ids[part == label].tolist()), axes) for label in np.flatnonzero(is_free_part)]
    if rigid_part.max() == part.max():
        return tuple(found)
    held = graph.is_fixed.copy()
    held[[np.flatnonzero(part == label)[0] for label in np.unique(part[~np.isin(part, part[held])])]] = True
    moves = _free_motions(graph, held)
    for label in np.unique(rigid_part[moves.any(axis=1)]):
        rows = np.flatnonzero((rigid_part == label) & moves.any(axis=1))
        # The node with the fewest axes is the one where the motion turns, its neighbours swing around it.
        rows = np.concatenate([(first := rows[[moves[rows].sum(axis=1).argmin()]]), rows[rows != first]])
        named = tuple(name for name, is_one in zip(axes, moves[first[0]], strict=True) if is_one)
        found.append(FreeNodes(tuple(graph.ids[rows].tolist()), named))
    return tuple(found)


def _has_full_rank(information: Floats) -> NDArray[np.bool_]:
    """Returns True for matrices (e, d, d) of full rank, each axis in its own unit."""
    scale = np.sqrt(np.einsum("eii->ei", information))
    is_positive = (scale > 0).all(axis=1)
    scale = np.where(scale > 0, scale, 1.0)
    values = np.linalg.eigvalsh(information / scale[:, :, None] / scale[:, None])
    return np.asarray(is_positive & (values[:, 0] > 1e-10))


def _free_motions(graph: PoseGraph, held: NDArray[np.bool_]) -> Bool[np.ndarray, "n d"]:
    """Returns True for the axes in which a node moves in the null space of the normal equations."""
    nothing = np.zeros((len(held), graph.tangent_size), bool)
    if held.all():
        return nothing
    pattern = BlockPattern.create(graph.ends, held)
    matrix = pattern.matrix(linearise(graph.poses, graph.edges).blocks)
    diagonal = matrix.diagonal()
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = (sp.diags(scale) @ matrix @ sp.diags(scale)).tocsc()
    factors = factorise(scaled, np.full(len(scale), _ADDED), "NATURAL")
    if not (factors.U.diagonal() < _LEAST_PIVOT).any():
        return nothing
    # Inverse iteration: what stays of random vectors lies in the null space.
    probes = np.random.default_rng(0).normal(size=(len(scale), _NUM_PROBES))
    for _ in range(3):
        probes = factors.solve(probes)
        probes /= np.linalg.norm(probes, axis=0)
    motion = np.abs(pattern.to_nodes(scale[:, None] * probes, graph.tangent_size)).max(axis=2)
    of_node = motion.max(axis=1, keepdims=True)
    return np.asarray((motion > _LEAST_SHARE * of_node) & (of_node > _LEAST_SHARE * motion.max()))


# Number of nodes whose columns of the inverse are solved at once: more take more memory.
_BATCH = 64


@runs_on_host("invert the normal equations of pose_graph.residuals there")
def pose_covariances(graph: PoseGraph) -> Float[np.ndarray, "n d d"]:
    """Computes the marginal covariance of each pose at the present poses, the inverse of J^T W J.

    They are as right as the information of the edges. The held nodes (`PoseGraph.held_nodes`) are certain: all
    covariances are relative to them, in each connected part. Runs on the host.

    Args:
        graph: an optimised graph, in the plane or in space.

    Returns:
        (n, 3, 3) or (n, 6, 6) covariances of the step in the frame of each pose, translation first, metres and
        radians. They are zero for held nodes, and infinite for nodes that the edges leave free.

    Raises:
        ValueError: an array is traced.
    """
    held, size = graph.held_nodes(), graph.tangent_size
    covariances = np.zeros((len(held), size, size))
    pattern = BlockPattern.create(graph.ends, held)
    matrix = pattern.matrix(linearise(graph.poses, graph.edges).blocks)
    try:
        factors = factorise(matrix, np.zeros(matrix.shape[0]), "NATURAL")
    except RuntimeError:
        covariances[~held] = np.inf
        return covariances
    for begin in range(0, len(pattern.free_nodes), _BATCH):
        nodes = pattern.free_nodes[begin : begin + _BATCH]
        rows = begin * size + np.arange(len(nodes) * size)
        units = np.zeros((matrix.shape[0], len(rows)))
        units[rows, np.arange(len(rows))] = 1.0
        columns = factors.solve(units)[rows].reshape(len(nodes), size, len(nodes), size)
        covariances[nodes] = columns[np.arange(len(nodes)), :, np.arange(len(nodes))]
    return covariances
