"""The lines of pose-graph files: tags of g2o and of TORO, with the numbers that follow them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax.io.poses import homogeneous
from dpmjax.sequences import FloatArray


class Tag(NamedTuple):
    """A kind of line.

    Attributes:
        num_nodes: 1 for a vertex, 2 for an edge.
        pose_size: numbers of its pose: x y heading, x y z roll pitch yaw, or x y z qx qy qz qw.
        triangle: rows and columns of the information matrix, in the order of its numbers.
    """

    num_nodes: int
    pose_size: int
    triangle: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())

    @property
    def num_values(self) -> int:
        """Number of values after the nodes."""
        return self.pose_size + len(self.triangle[0])

    @property
    def tangent_size(self) -> int:
        """Degrees of freedom of the pose."""
        return 3 if self.pose_size == 3 else 6


def _upper(size: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    rows, columns = np.triu_indices(size)
    return tuple(rows.tolist()), tuple(columns.tolist())


# TORO writes xx xy yy, then heading heading, x heading, y heading.
_TORO_TRIANGLE = ((0, 0, 1, 2, 0, 1), (0, 1, 1, 2, 2, 2))
TAGS = {
    "VERTEX_SE2": Tag(1, 3),
    "VERTEX_SE3:QUAT": Tag(1, 7),
    "EDGE_SE2": Tag(2, 3, _upper(3)),
    "EDGE_SE3:QUAT": Tag(2, 7, _upper(6)),
    "VERTEX2": Tag(1, 3),
    "VERTEX3": Tag(1, 6),
    "EDGE2": Tag(2, 3, _TORO_TRIANGLE),
    "EDGE3": Tag(2, 6, _upper(6)),
}
"""Supported tags: the first four are of g2o, the others of TORO; an edge `a b` has `T_a_b` in all of them."""
# EQUIV marks nodes that TORO may collapse on request; their edges stand in the file, too.
IGNORED = ("PARAMS_SE2OFFSET", "PARAMS_SE3OFFSET", "EQUIV")
_READ = "give VERTEX and EDGE lines of SE2 or SE3:QUAT (g2o), or VERTEX2, EDGE2, VERTEX3, EDGE3 (TORO)"
_KINDS: tuple[tuple[Callable[[str], bool], str], ...] = (
    (
        lambda tag: "SWITCH" in tag or "MAXMIX" in tag,
        "switchable and mixture edges are not read: give plain edges, a robust kernel lets wrong ones go",
    ),
    (
        lambda tag: "PRIOR" in tag,
        "priors of single poses are not read: leave them out, and fix nodes with FIX",
    ),
    (
        lambda tag: any(word in tag for word in ("XY", "LANDMARK", "POINT", "LINE", "PLANE", "BEARING", "CAM")),
        "landmarks are not read: leave their lines out; poses and edges between poses are optimised",
    ),
)


def advice_of(tag: str) -> str:
    """Returns the advice for a line of an unsupported tag."""
    return next((advice for is_kind, advice in _KINDS if is_kind(tag)), _READ)


def poses_of(numbers: FloatArray) -> FloatArray:
    """Converts numbers of a file to poses of the graph.

    Args:
        numbers: (n, 3) x y heading, (n, 6) x y z roll pitch yaw, or (n, 7) x y z qx qy qz qw.

    Returns:
        (n, 3), or (n, 4, 4).

    Raises:
        ValueError: a number that is not finite, or a quaternion of another length than 1.
    """
    if not np.isfinite(numbers).all():
        raise ValueError(f"expected finite numbers, got {numbers[~np.isfinite(numbers)][0]}")
    if numbers.shape[1] == 3:
        return numbers
    if not len(numbers):
        return np.zeros((0, 4, 4))
    if numbers.shape[1] == 6:
        rotations = Rotation.from_euler("ZYX", numbers[:, [5, 4, 3]])
    else:
        if (np.abs(np.linalg.norm(np.clip(numbers[:, 3:], -2, 2), axis=1) - 1) > 0.1).any():
            raise ValueError("a quaternion that is not of length 1")
        rotations = Rotation.from_quat(numbers[:, 3:])
    return homogeneous(rotations.as_matrix(), numbers[:, :3])


def information_of(tag: Tag, numbers: FloatArray) -> FloatArray:
    """Converts numbers of a file to information matrices.

    Args:
        tag: tag of the lines.
        numbers: (n, k) entries in the order of the tag.

    Returns:
        (n, 3, 3) or (n, 6, 6), symmetric, translation first.
    """
    matrices = np.zeros((len(numbers), tag.tangent_size, tag.tangent_size))
    rows, columns = (list(places) for places in tag.triangle)
    matrices[:, rows, columns] = matrices[:, columns, rows] = numbers
    return matrices
