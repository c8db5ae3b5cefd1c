"""Point pyramids on disk: small integers that become a pyramid again in the training step.

A rigid motion changes neither farthest points nor neighbours, so a pyramid is stored once and moved when it is read.
Levels after the first are the first rows of the sampled points, so that positions are stored once. Positions are
rounded to 1/32,767 of the largest coordinate (2 mm at 60 m).
"""

from __future__ import annotations

import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from dpmjax.checks import require_value
from dpmjax.geometry import rigid
from dpmjax.geometry.pyramid import PyramidConfig, build_pyramid_on_host, interpolation_weights
from dpmjax.types import AnyArray, Interpolation, PointPyramid, PyramidLevel

MAX_STORED_POINTS = 1 << 16
LARGEST = np.iinfo(np.int16).max


@flax.struct.dataclass
class StoredPyramid:
    """A stored pyramid; valid points come first on every level.

    Attributes:
        num_points: number of valid points of level 0.
        unit: normalised coordinate that 1 stands for.
        points: positions of level 0, in units.
        samples: rows of level 0 that are level 1; the further levels are the first of these.
        neighbours: neighbours for each stage and block, the rows of the neighbours.
        interpolation: interpolation for each step up, the rows of the nearest points of the coarser level.
    """

    num_points: Int[AnyArray, "*b"]
    unit: Float[AnyArray, "*b"]
    points: Int[AnyArray, "*b _n 3"]
    samples: UInt[AnyArray, "*b _m"]
    neighbours: tuple[tuple[UInt[AnyArray, "*b _m _k"], ...], ...]
    interpolation: tuple[UInt[AnyArray, "*b _m 3"], ...]


@functools.cache
def _empty(config: PyramidConfig, capacity: int) -> StoredPyramid:
    """Returns the stored pyramid of a scan without points: its arrays have the types and shapes of all."""
    nothing = np.zeros((capacity, 3), np.float32)
    return store_pyramid(build_pyramid_on_host(nothing, np.zeros(capacity, bool), config))


def record_type(config: PyramidConfig, capacity: int) -> np.dtype:
    """Returns the type of one pyramid in a file.

    Args:
        config: stages.
        capacity: capacity of level 0.

    Returns:
        A structured type with a field for each array of a stored pyramid.

    Raises:
        ValueError: the capacity has no room in 16 bits.
    """
    require_value(capacity <= MAX_STORED_POINTS, "capacity", f"at most {MAX_STORED_POINTS}", capacity)
    leaves = jax.tree_util.tree_leaves_with_path(_empty(config, capacity))
    names = (jax.tree_util.keystr(path, simple=True, separator="_") for path, _ in leaves)
    return np.dtype([(name, leaf.dtype, leaf.shape) for name, (_, leaf) in zip(names, leaves, strict=True)])


def store_pyramid(pyramid: PointPyramid) -> StoredPyramid:
    """Rounds a pyramid to small integers.

    Args:
        pyramid: pyramid from `build_pyramid_on_host`; the valid points of level 0 must stand in front.

    Returns:
        The stored pyramid, arrays of NumPy.

    Raises:
        ValueError: a masked point stands in front of a valid one.
    """
    first, *levels = pyramid.levels
    mask, points = np.asarray(first.mask), np.asarray(first.positions)
    num_points = int(mask.sum())
    if not mask[:num_points].all():
        raise ValueError("pyramid: expected the valid points of level 0 in front, got masked ones among them")
    unit = np.abs(points[:num_points]).max(initial=np.finfo(np.float32).tiny) / LARGEST

    def rows(values: Any) -> np.ndarray:
        return np.asarray(values).astype(np.uint16)

    return StoredPyramid(
        num_points=np.asarray(num_points, np.int32),
        unit=np.asarray(unit, np.float32),
        points=np.rint(np.where(mask[:, None], points, 0) / unit).astype(np.int16),
        samples=rows(levels[0].sample_indices),
        neighbours=tuple(tuple(map(rows, level.neighbours)) for level in levels),
        interpolation=tuple(rows(step.indices) for step in pyramid.interpolation),
    )


def stored_pyramids(records: np.ndarray, config: PyramidConfig) -> StoredPyramid:
    """Returns records of a file as one tree of arrays.

    Args:
        records: records of `record_type`.
        config: stages.

    Returns:
        The arrays, with the axes of the records in front.
    """
    structure = jax.tree.structure(_empty(config, records["points"].shape[-2]))
    stored: StoredPyramid = jax.tree.unflatten(
        structure, [np.ascontiguousarray(records[name]) for name in records.dtype.names or ()]
    )
    return stored


def sampled_positions(
    stored: StoredPyramid, num: int
) -> tuple[Float[np.ndarray, "*b num 3"], Bool[np.ndarray, "*b num"]]:
    """Computes the positions of the first sampled points on the host.

    Args:
        stored: pyramids of NumPy arrays.
        num: number of points, at most that of level 1.

    Returns:
        Normalised coordinates before any motion, and False for points that are not there.
    """
    rows = np.asarray(stored.samples)[..., :num].astype(np.int64)
    points = np.take_along_axis(np.asarray(stored.points), rows[..., None], axis=-2)
    mask = np.arange(num) < np.asarray(stored.num_points)[..., None]
    return points * np.asarray(stored.unit)[..., None, None], mask


def moved_pyramid(stored: StoredPyramid, T_new_old: Float[AnyArray, "4 4"]) -> PointPyramid:
    """Makes the pyramid of a scan after a rigid motion. For one scan; `vmap` for more.

    Args:
        stored: the pyramid before the motion.
        T_new_old: the motion; its translation is in normalised coordinates.

    Returns:
        The pyramid, positions in float32.
    """
    rows = jnp.arange(stored.points.shape[-2])
    mask = rows < stored.num_points
    points = rigid.transform_points(T_new_old, jnp.asarray(stored.points, jnp.float32) * stored.unit)
    levels = [PyramidLevel(jnp.where(mask[:, None], points, 0), mask, jnp.zeros(0, jnp.int32), ())]
    samples = jnp.asarray(stored.samples, jnp.int32)
    sampled = points[samples]
    for number, blocks in enumerate(stored.neighbours):
        num = blocks[0].shape[-2]
        mask = jnp.arange(num) < stored.num_points
        positions = jnp.where(mask[:, None], sampled[:num], 0)
        chosen = samples if number == 0 else jnp.where(mask, jnp.arange(num), 0)
        levels.append(PyramidLevel(positions, mask, chosen, tuple(jnp.asarray(rows, jnp.int32) for rows in blocks)))
    up = [_interpolation(levels[-2 - step], levels[-1 - step], x) for step, x in enumerate(stored.interpolation)]
    return PointPyramid(tuple(levels), tuple(up))


def _interpolation(fine: PyramidLevel, coarse: PyramidLevel, stored: UInt[AnyArray, "m 3"]) -> Interpolation:
    indices = jnp.asarray(stored, jnp.int32)
    squared: Array = jnp.sum((fine.positions[:, None] - coarse.positions[indices]) ** 2, axis=-1)
    is_used = (jnp.arange(indices.shape[1]) < jnp.sum(coarse.mask)) & jnp.asarray(fine.mask)[:, None]
    return Interpolation(indices, interpolation_weights(squared, is_used))
