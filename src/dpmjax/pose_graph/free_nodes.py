"""Nodes that the edges leave free: those of parts that no edge joins, and those with motions that no edge measures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float
from numpy.typing import NDArray

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
    parts = [f"{', '.join(free.axes)} of node{'s' * (len(free.ids) > 1)} {_first(free.ids)}" for free in found[:3]]
    return "no edge measures " + "; ".join([*parts, *[f"and {len(found) - 3} more such groups"] * (len(found) > 3)])


def _first(ids: Sequence[int]) -> str:
    return ", ".join(map(str, ids[:3])) + (f" and {len(ids) - 3} more" if len(ids) > 3 else "")


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
    edges, axes = graph.edges, graph.tangent_size
    still = np.zeros((len(graph.poses), axes))
    if held.all():
        return still > 0
    pattern = BlockPattern.create(np.stack([edges.target, edges.source], axis=1), held)
    matrix = pattern.matrix(linearise(graph.poses, still, edges).blocks)
    diagonal = matrix.diagonal()
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = (sp.diags(scale) @ matrix @ sp.diags(scale)).tocsc()
    factors = factorise(scaled, np.full(len(scale), _ADDED), "NATURAL")
    if not (factors.U.diagonal() < _LEAST_PIVOT).any():
        return still > 0
    # Inverse iteration: what stays of random vectors lies in the null space.
    probes = np.random.default_rng(0).normal(size=(len(scale), _NUM_PROBES))
    for _ in range(3):
        probes = factors.solve(probes)
        probes /= np.linalg.norm(probes, axis=0)
    motion = np.abs(pattern.to_nodes(scale[:, None] * probes, axes)).max(axis=2)
    return _is_share(motion)


def _is_share(motion: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, "n d"]:
    """Returns True for axes with a share of the motion of their node, and of that of the graph."""
    of_node = motion.max(axis=1, keepdims=True)
    return np.asarray((motion > _LEAST_SHARE * of_node) & (of_node > _LEAST_SHARE * motion.max()))
