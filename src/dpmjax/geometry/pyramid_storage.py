"""Point pyramids on disk: small integers that become a pyramid again in the training step.

A rigid motion changes neither farthest points nor neighbours, so a pyramid is stored once and moved when it is read.
Levels after the first are the first rows of the sampled points, so that positions are stored once. Positions are
rounded to 1/32,767 of the largest coordinate (2 mm at 60 m).
"""

from __future__ import annotations

from typing import Any

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from dpmjax.checks import require_value
from dpmjax.geometry import rigid
from dpmjax.geometry.pyramid import PyramidConfig, interpolation_weights
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


def record_type(config: PyramidConfig, capacity: int) -> np.dtype:
    """Returns the type of one pyramid in a file.

    Args:
        config: sizes of the pyramid.
        capacity: rows of level 0.

    Returns:
        A structured type of NumPy.

    Raises:
        ValueError: if row numbers of this many points exceed 16 bits.
    """
    require_value(capacity <= MAX_STORED_POINTS, "capacity", f"at most {MAX_STORED_POINTS}", capacity)
    fields: list[Any] = [
        ("num_points", "<i4"),
        ("unit", "<f4"),
        ("points", "<i2", (capacity, 3)),
        ("samples", "<u2", (config.stages[0].num_points,)),
    ]
    for number, stage in enumerate(config.stages):
        shape = (stage.num_points, stage.num_neighbours)
        fields += [(_neighbours(number, block), "<u2", shape) for block in range(len(stage.radii))]
    for step in range(config.num_interpolations):
        fields.append((f"interpolation_{step}", "<u2", (config.stages[-2 - step].num_points, 3)))
    return np.dtype(fields)


def pack_pyramid(pyramid: PointPyramid, record: np.void) -> None:
    """Writes a pyramid into a record of a file.

    Args:
        pyramid: one scan; the valid points of level 0 stand in front.
        record: record of `record_type`.

    Raises:
        ValueError: if a masked point stands before a valid one.
    """
    level = pyramid.levels[0]
    mask, points = np.asarray(level.mask), np.asarray(level.positions)
    num_points = int(mask.sum())
    if not mask[:num_points].all():
        raise ValueError("pyramid: expected the valid points of level 0 in front, got masked ones among them")
    unit = np.abs(points[:num_points]).max(initial=np.finfo(np.float32).tiny) / LARGEST
    record["num_points"], record["unit"] = num_points, unit
    record["points"] = np.rint(np.where(mask[:, None], points, 0) / unit)
    record["samples"] = pyramid.levels[1].sample_indices
    for number, level in enumerate(pyramid.levels[1:]):
        for block, rows in enumerate(level.neighbours):
            record[_neighbours(number, block)] = rows
    for step, interpolation in enumerate(pyramid.interpolation):
        record[f"interpolation_{step}"] = interpolation.indices


def stored_pyramids(records: np.ndarray, config: PyramidConfig) -> StoredPyramid:
    """Returns records of a file as one tree of arrays.

    Args:
        records: (s,) of `record_type`.
        config: sizes of the pyramids.

    Returns:
        The pyramids, stacked.
    """

    def field(name: str) -> np.ndarray:
        return np.ascontiguousarray(records[name])

    neighbours = tuple(
        tuple(field(_neighbours(number, block)) for block in range(len(stage.radii)))
        for number, stage in enumerate(config.stages)
    )
    interpolation = tuple(field(f"interpolation_{step}") for step in range(config.num_interpolations))
    num_points, unit, points, samples = map(field, ("num_points", "unit", "points", "samples"))
    return StoredPyramid(num_points, unit, points, samples, neighbours, interpolation)


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


def _neighbours(stage: int, block: int) -> str:
    return f"neighbours_{stage}_{block}"
