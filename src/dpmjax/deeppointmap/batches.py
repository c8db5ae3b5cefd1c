"""What a step of training takes: pyramids of augmented scans and how they belong together, in fixed shapes.

A sample is made on the host; a batch is samples stacked along a new first axis, which is spread over devices.
"""

from __future__ import annotations

from collections.abc import Sequence

import flax.struct
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from dpmjax.deeppointmap.sampling import Group, SamplingConfig
from dpmjax.types import AnyArray, PointPyramid


@flax.struct.dataclass
class MapOfScans:
    """One map of each group.

    Attributes:
        rows: of its scans among the pyramids of the sample; 0 where `mask` is False.
        mask: False where a map has fewer scans.
        T_map_scan: poses of the scans in the frame of the map, metres.
    """

    rows: Int[AnyArray, "*b g s"]
    mask: Bool[AnyArray, "*b g s"]
    T_map_scan: Float[AnyArray, "*b g s 4 4"]


@flax.struct.dataclass
class RegistrationSample:
    """Groups of scans that make two maps each; a batch has one more axis in front.

    Attributes:
        pyramids: of all scans; spare ones repeat the first.
        source: the one map.
        target: the other.
        T_target_source: the true motion between them, metres.
        mask: False where there are fewer groups.
    """

    pyramids: PointPyramid
    source: MapOfScans
    target: MapOfScans
    T_target_source: Float[AnyArray, "*b g 4 4"]
    mask: Bool[AnyArray, "*b g"]


@flax.struct.dataclass
class OverlapSample:
    """Pairs of scans; a batch has one more axis in front.

    Attributes:
        first: pyramids of the one scan of each pair.
        second: those of the other.
        is_overlap: the truth.
    """

    first: PointPyramid
    second: PointPyramid
    is_overlap: Bool[AnyArray, "*b p"]


def arrange_groups(
    groups: Sequence[Group],
    pyramids: Sequence[PointPyramid],
    T_world_scan: Float[np.ndarray, "s 4 4"],
    max_group: int,
    config: SamplingConfig,
) -> RegistrationSample:
    """A sample from groups, with arrays of NumPy; its shapes depend on `max_group` and `config` only.

    Args:
        groups: from `draw_groups`.
        pyramids: of the scans of the groups: the source of the first group, its target, the source of the second, ...
        T_world_scan: float64 poses of the frames that the pyramids are in, in the same order.
        max_group: of the stage of the curriculum.
        config: sizes.

    Raises:
        ValueError: not as many pyramids and poses as the groups have scans, or more than fit.
    """
    sizes = [len(side) for group in groups for side in group]
    if not len(pyramids) == len(T_world_scan) == sum(sizes) <= config.num_scans:
        found = f"{len(pyramids)} and {len(T_world_scan)} for groups of {sum(sizes)} scans"
        raise ValueError(f"pyramids, T_world_scan: expected as many as scans, at most {config.num_scans}, got {found}")
    num_groups, capacity = config.num_groups(max_group), config.side_capacity(max_group)
    ends = np.cumsum(sizes)
    rows = [np.arange(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    source = _map_of_scans(rows[0::2], T_world_scan, num_groups, capacity)
    target = _map_of_scans(rows[1::2], T_world_scan, num_groups, capacity)
    T = np.tile(np.eye(4), (num_groups, 1, 1))
    for number, (a, b) in enumerate(zip(rows[0::2], rows[1::2], strict=True)):
        T[number] = np.linalg.inv(T_world_scan[b[0]]) @ T_world_scan[a[0]]
    spare = [pyramids[0]] * (config.num_scans - len(pyramids))
    mask = np.arange(num_groups) < len(groups)
    return RegistrationSample(stack([*pyramids, *spare]), source, target, T.astype(np.float32), mask)


def stack(trees: Sequence[PointPyramid]) -> PointPyramid:
    """Pytrees of NumPy arrays stacked along a new first axis; samples too."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def _map_of_scans(
    rows: Sequence[Int[np.ndarray, " s"]], T_world_scan: Float[np.ndarray, "s 4 4"], num_groups: int, capacity: int
) -> MapOfScans:
    padded = np.zeros((num_groups, capacity), np.int32)
    mask = np.zeros((num_groups, capacity), bool)
    T_map_scan = np.tile(np.eye(4, dtype=np.float32), (num_groups, capacity, 1, 1))
    for number, scans in enumerate(rows):
        padded[number, : len(scans)] = scans
        mask[number, : len(scans)] = True
        T_map_scan[number, : len(scans)] = np.linalg.inv(T_world_scan[scans[0]]) @ T_world_scan[scans]
    return MapOfScans(padded, mask, T_map_scan)
