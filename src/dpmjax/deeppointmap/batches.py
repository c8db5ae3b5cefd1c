"""Batches: pyramids of augmented scans and the maps that they form, as arrays of fixed shapes. On the host.

A batch is samples stacked along a new first axis, which is spread over devices.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import flax.struct
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from dpmjax.deeppointmap.sampling import Group, SamplingConfig
from dpmjax.types import AnyArray, PointPyramid

TreeT = TypeVar("TreeT")


@flax.struct.dataclass
class MapOfScans:
    """One map of each group.

    Attributes:
        rows: its scans, as rows of the pyramids of the sample; 0 where `mask` is False.
        mask: False where a map has fewer scans.
        T_map_scan: poses of the scans in the frame of the map, metres.
    """

    rows: Int[AnyArray, "*b s"]
    mask: Bool[AnyArray, "*b s"]
    T_map_scan: Float[AnyArray, "*b s 4 4"]


@flax.struct.dataclass
class RegistrationSample:
    """Groups of scans that form two maps each; a batch has one more axis in front.

    Attributes:
        pyramids: pyramids of all scans; unused rows repeat the first.
        source: first map of each group.
        target: second map of each group.
        T_target_source: true motion between both maps, metres.
        mask: False where there are fewer groups.
    """

    pyramids: PointPyramid
    source: MapOfScans
    target: MapOfScans
    T_target_source: Float[AnyArray, "*b 4 4"]
    mask: Bool[AnyArray, "*b"]


@flax.struct.dataclass
class OverlapSample:
    """Pairs of scans; a batch has one more axis in front.

    Attributes:
        first: pyramid of the first scan of each pair.
        second: pyramid of the second scan of each pair.
        is_overlap: whether the two overlap in truth.
    """

    first: PointPyramid
    second: PointPyramid
    is_overlap: Bool[AnyArray, "*b p"]


Sample = RegistrationSample | OverlapSample
"""What a step trains on; a batch has one more axis in front, which is spread over devices."""


def arrange_groups(
    groups: Sequence[Group],
    pyramids: Sequence[PointPyramid],
    T_world_scan: Float[np.ndarray, "s 4 4"],
    max_group: int,
    config: SamplingConfig,
) -> RegistrationSample:
    """Arranges groups as a sample of NumPy arrays; its shapes depend on `max_group` and `config` only.

    Args:
        groups: from `draw_groups`.
        pyramids: one for each scan: the source of the first group, its target, the source of the second, ...
        T_world_scan: float64 poses of the frames of the pyramids, in the same order.
        max_group: scans in both maps of a group together, at most.
        config: sizes.

    Returns:
        The sample.

    Raises:
        ValueError: if there are not as many pyramids and poses as scans in the groups, or more than fit.
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


def stack(trees: Sequence[TreeT]) -> TreeT:
    """Stacks pytrees of NumPy arrays along a new first axis.

    Args:
        trees: pyramids or samples of the same shapes.

    Returns:
        One tree of NumPy arrays.
    """
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def _map_of_scans(
    rows: Sequence[Int[np.ndarray, " k"]], T_world_scan: Float[np.ndarray, "s 4 4"], num_groups: int, capacity: int
) -> MapOfScans:
    padded = np.zeros((num_groups, capacity), np.int32)
    mask = np.zeros((num_groups, capacity), bool)
    T_map_scan = np.tile(np.eye(4, dtype=np.float32), (num_groups, capacity, 1, 1))
    for number, scans in enumerate(rows):
        padded[number, : len(scans)] = scans
        mask[number, : len(scans)] = True
        T_map_scan[number, : len(scans)] = np.linalg.inv(T_world_scan[scans[0]]) @ T_world_scan[scans]
    return MapOfScans(padded, mask, T_map_scan)
