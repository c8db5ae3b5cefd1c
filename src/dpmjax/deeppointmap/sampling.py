"""Sampling for training, on the host: which scans form two maps, which pairs overlap, and both as arrays.

Scans are drawn by their true poses, before augmentation, and from the given generator only, so that the sample of a
step does not depend on the steps before. A batch is samples stacked along a new first axis, which is spread over
devices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import flax.struct
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from dpmjax.deeppointmap.curriculum import SamplingConfig
from dpmjax.types import AnyArray, PointPyramid

TreeT = TypeVar("TreeT")
NUM_ATTEMPTS = 100


@dataclass(frozen=True)
class ScanTable:
    """True poses of the scans of all drives; a `ValueError` says if there are fewer than two, or one is not finite.

    Attributes:
        T_world_lidar: (n, 4, 4) float64 true poses, metres.
        scene: (n,) number of the world of each pose; poses of different worlds are unrelated.
    """

    T_world_lidar: Float[np.ndarray, "n 4 4"]
    scene: Int[np.ndarray, " n"]

    def __post_init__(self) -> None:
        if self.T_world_lidar.shape != (len(self.scene), 4, 4) or len(self.scene) < 2:
            found = f"got {self.T_world_lidar.shape} and {self.scene.shape}"
            raise ValueError(f"T_world_lidar, scene: expected (n, 4, 4) and (n,) with n >= 2, {found}")
        if not np.isfinite(self.T_world_lidar).all():
            raise ValueError("T_world_lidar: expected finite poses")

    def __len__(self) -> int:
        return len(self.scene)

    @property
    def positions(self) -> Float[np.ndarray, "n 3"]:
        """Positions of the lidar, metres."""
        return self.T_world_lidar[:, :3, 3]

    def distances_from(self, row: int) -> Float[np.ndarray, " n"]:
        """Computes the distances of all scans from one scan.

        Args:
            row: number of the scan.

        Returns:
            Metres; infinite for scans of other scenes.
        """
        distances = np.linalg.norm(self.positions - self.positions[row], axis=1)
        return np.where(self.scene == self.scene[row], distances, np.inf)


class Group(NamedTuple):
    """Numbers of the scans that form two maps of one place.

    Attributes:
        source: scans of the first map; its first scan is the frame of the map.
        target: scans of the second map; its first scan is the frame of the map.
    """

    source: Int[np.ndarray, " a"]
    target: Int[np.ndarray, " b"]


class OverlapPairs(NamedTuple):
    """Numbers of the scans of each pair, and whether they are closer than `overlap_distance_m`."""

    first: Int[np.ndarray, " p"]
    second: Int[np.ndarray, " p"]
    is_overlap: Bool[np.ndarray, " p"]


def draw_groups(
    table: ScanTable, first_anchor: int, max_group: int, config: SamplingConfig, rng: np.random.Generator
) -> tuple[Group, ...]:
    """Draws the groups of one sample: at most `config.num_groups`, with at most `config.num_scans` scans together.

    A group is an anchor and random scans around it: two scans with `pair_probability`, else 2 to `max_group`, each
    number equally likely. Every group draws its own size, so that all steps of a stage have the same shapes (the
    published program draws one size for each step).

    Args:
        table: the scans.
        first_anchor: anchor of the first group; the other anchors are random.
        max_group: scans in both maps of a group together, at most.
        config: sizes and distances.
        rng: source of the draws.

    Returns:
        At least one group.

    Raises:
        ValueError: if no scan has another one near it.
    """
    groups: list[Group] = []
    num_left, anchor = config.num_scans, first_anchor
    for _ in range(NUM_ATTEMPTS):
        if len(groups) == config.num_groups(max_group) or num_left < 2:
            break
        size = 2 if rng.random() < config.pair_probability else int(rng.integers(2, max_group + 1))
        members = _members(table, anchor, min(size, num_left), config, rng)
        if len(members) > 1:
            groups.append(_split(members, config, rng))
            num_left -= len(members)
        anchor = int(rng.integers(len(table)))
    if not groups:
        limits = f"{config.min_distance_m} to {config.max_distance_m} m"
        raise ValueError(f"table: expected scans with others {limits} from them, found none in {NUM_ATTEMPTS} draws")
    return tuple(groups)


def draw_overlap_pairs(table: ScanTable, config: SamplingConfig, rng: np.random.Generator) -> OverlapPairs:
    """Draws the pairs of the overlap part: half overlap, a quarter lies just beyond that, a quarter is far apart.

    Where a scene has no pair of one kind (a short drive), scans of other scenes replace it, or the next nearer kind.

    Args:
        table: the scans.
        config: number of pairs, and distances.
        rng: source of the draws.

    Returns:
        `config.num_overlap_pairs` pairs.
    """
    bands = ((0.0, config.overlap_distance_m), (config.overlap_distance_m, config.far_distance_m))
    first, second = [], []
    for _ in range(config.num_overlap_pairs):
        anchor = int(rng.integers(len(table)))
        kind = int(rng.choice(3, p=(0.5, 0.25, 0.25)))
        distances = table.distances_from(anchor)
        choices = [np.flatnonzero((distances > low) & (distances <= high)) for low, high in bands]
        choices.append(np.flatnonzero(np.isfinite(distances) & (distances > config.far_distance_m)))
        elsewhere = np.flatnonzero(np.isinf(distances))
        usable = [rows for rows in (choices[kind], elsewhere, *choices[::-1]) if len(rows) > 0]
        first.append(anchor)
        second.append(int(rng.choice(usable[0])) if usable else anchor)
    a, b = np.array(first), np.array(second)
    distances = np.linalg.norm(table.positions[a] - table.positions[b], axis=1)
    return OverlapPairs(a, b, (table.scene[a] == table.scene[b]) & (distances <= config.overlap_distance_m))


def _members(
    table: ScanTable, anchor: int, size: int, config: SamplingConfig, rng: np.random.Generator
) -> Int[np.ndarray, " s"]:
    distances = table.distances_from(anchor)
    distances[anchor] = np.inf
    others = np.flatnonzero((distances >= config.min_distance_m) & (distances <= config.max_distance_m))
    chosen = rng.choice(others, min(size - 1, len(others)), replace=False) if len(others) > 0 else others
    return rng.permutation(np.concatenate([[anchor], chosen]).astype(int))


def _split(members: Int[np.ndarray, " s"], config: SamplingConfig, rng: np.random.Generator) -> Group:
    # Half of the groups are split into one scan and all others, the rest anywhere; no side exceeds `max_side`.
    num = len(members)
    least, most = max(1, num - config.max_side), min(num - 1, config.max_side)
    is_one_to_all = least == 1 and num <= config.max_side and rng.random() < 0.5
    num_source = 1 if is_one_to_all else int(rng.integers(least, most + 1))
    return Group(members[:num_source], members[num_source:])


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
    source, target = (_map_of_scans(rows[side::2], T_world_scan, num_groups, capacity) for side in (0, 1))
    T_world_source, T_world_target = (T_world_scan[[of_map[0] for of_map in rows[side::2]]] for side in (0, 1))
    T = np.tile(np.eye(4), (num_groups, 1, 1))
    T[: len(groups)] = np.linalg.inv(T_world_target) @ T_world_source
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
