"""Sampling for training, on the host: which scans form two maps, and the maps as arrays.

Scans are drawn by their true poses, before augmentation, and from the given generator only, so that the sample of a
step does not depend on the steps before. A batch is samples stacked along a new first axis, which is spread over
devices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import flax.struct
import numpy as np
from jaxtyping import Bool, Float, Int

from dpmjax.checks import require_shape, require_value
from dpmjax.deeppointmap.matching import thinned_mask
from dpmjax.deeppointmap.training.curriculum import MIN_DISTANCE_M, Layout, SamplingConfig
from dpmjax.geometry import rigid
from dpmjax.geometry.pyramid_storage import StoredPyramid
from dpmjax.types import AnyArray, Poses

NUM_ATTEMPTS = 100


@dataclass(frozen=True)
class ScanTable:
    """True poses of the scans of all drives; raises a `ValueError` if there are fewer than two, or one is not finite.

    Attributes:
        T_world_lidar: (n, 4, 4) float64 true poses, metres.
        scene: (n,) number of the world of each pose; poses of different worlds are unrelated.
    """

    T_world_lidar: Poses
    scene: Int[np.ndarray, " n"]

    def __post_init__(self) -> None:
        require_value(len(self.scene) >= 2, "scene", "at least two scans", len(self.scene))
        require_shape("T_world_lidar", self.T_world_lidar, (len(self.scene), 4, 4))
        require_value(np.isfinite(self.T_world_lidar).all(), "T_world_lidar", "finite poses", "others")

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

    @property
    def rows(self) -> Int[np.ndarray, " s"]:
        """Scans of both maps."""
        return np.concatenate([self.source, self.target])


def draw_groups(
    table: ScanTable, first_anchor: int, layout: Layout, config: SamplingConfig, rng: np.random.Generator
) -> tuple[Group, ...]:
    """Draws the groups of one sample: for each an anchor, and random scans around it.

    Args:
        table: the scans.
        first_anchor: anchor of one of the groups; all further anchors are random.
        layout: number and size of the groups.
        config: distances.
        rng: source of the draws.

    Returns:
        The groups; smaller where there are fewer scans, and fewer where too few anchors have a scan near them.

    Raises:
        ValueError: if there is no group.
    """
    groups = list[Group]()
    anchor, num_left = first_anchor, NUM_ATTEMPTS
    while len(groups) < layout.num_groups and num_left > 0:
        group = _group_at(table, anchor, layout, config, rng)
        if group is None:
            num_left -= 1
        else:
            groups.append(group)
        anchor = int(rng.integers(len(table)))
    if not groups:
        limits = f"{MIN_DISTANCE_M} to {config.max_distance_m} m"
        raise ValueError(f"table: expected scans with others {limits} from them, found none in {NUM_ATTEMPTS} draws")
    return tuple(groups)


def _group_at(
    table: ScanTable, anchor: int, layout: Layout, config: SamplingConfig, rng: np.random.Generator
) -> Group | None:
    distances = table.distances_from(anchor)
    distances[anchor] = np.inf
    others = np.flatnonzero((distances >= MIN_DISTANCE_M) & (distances <= config.max_distance_m))
    if len(others) == 0:
        return None
    chosen = rng.choice(others, min(layout.num_source + layout.num_target - 1, len(others)), replace=False)
    members = rng.permutation(np.concatenate([[anchor], chosen]))
    num_source = min(layout.num_source, len(members) - 1)
    # The scan nearest to the opposite map stands first, as the nearest keyframe does in SLAM. It is the frame of its
    # map, and thinning keeps all its descriptors.
    target = _nearest_first(table, members[num_source:], int(members[0]))
    return Group(_nearest_first(table, members[:num_source], int(target[0])), target)


def number_scans(groups: Sequence[Group]) -> list[Group]:
    """Numbers the scans of groups anew: the source of the first group, its target, the source of the second, ...

    Args:
        groups: groups from `draw_groups`.

    Returns:
        The same groups with the new numbers.
    """
    ends = np.cumsum([len(group.rows) for group in groups])
    return [
        Group(*np.split(np.arange(end - len(group.rows), end), [len(group.source)]))
        for group, end in zip(groups, ends, strict=True)
    ]


def _nearest_first(table: ScanTable, rows: Int[np.ndarray, " k"], row: int) -> Int[np.ndarray, " k"]:
    distances = np.linalg.norm(table.positions[rows] - table.positions[row], axis=1)
    return rows[np.argsort(distances, kind="stable")]


@flax.struct.dataclass
class MapOfScans:
    """One map of each group.

    Attributes:
        rows: rows of its scans in the sample; 0 where a map has fewer scans.
        mask: False where a map has fewer scans or descriptors, and where thinning removes one.
        T_map_scan: poses of the scans in the frame of the map, metres.
    """

    rows: Int[AnyArray, "*b s"]
    mask: Bool[AnyArray, "*b s n"]
    T_map_scan: Float[AnyArray, "*b s 4 4"]


@flax.struct.dataclass
class GroupBatch:
    """The groups of a sample.

    Attributes:
        source: first map of each group.
        target: second map of each group.
        T_target_source: true motion between both maps, metres.
        mask: False where there are fewer groups.
    """

    source: MapOfScans
    target: MapOfScans
    T_target_source: Float[AnyArray, "*b 4 4"]
    mask: Bool[AnyArray, "*b"]


@flax.struct.dataclass
class SampleScans:
    """The stored scans of a sample, and the motion that each gets in the step.

    Attributes:
        pyramids: stored pyramids; spare rows repeat the first.
        T_augmented_lidar: the motion of each scan, metres.
    """

    pyramids: StoredPyramid
    T_augmented_lidar: Float[AnyArray, "*b 4 4"]


class PlacedScans(NamedTuple):
    """True places of the scans of a sample.

    Attributes:
        T_world_scan: float64 poses of the scans after their motions, metres.
        positions_world: positions of their descriptors, metres.
        mask: False for descriptors that are not there.
    """

    T_world_scan: Poses
    positions_world: Float[np.ndarray, "s n 3"]
    mask: Bool[np.ndarray, "s n"]


@flax.struct.dataclass
class RegistrationSample:
    """Groups of scans that form two maps each; a batch has one more axis in front.

    Attributes:
        scans: all scans.
        groups: the groups.
    """

    scans: SampleScans
    groups: GroupBatch


def arrange_groups(groups: Sequence[Group], capacity: Layout, placed: PlacedScans, *, thins: bool = True) -> GroupBatch:
    """Arranges groups as NumPy arrays, whose shapes depend on the capacity only.

    Args:
        groups: groups from `draw_groups`.
        capacity: capacity from `layout_capacity`.
        placed: the scans of all groups in the order of `number_scans`.
        thins: True for maps without the descriptors that `matching.thinned_mask` removes.

    Returns:
        The groups.
    """
    numbered, T_world_scan = number_scans(groups), placed.T_world_scan
    sources, targets = (
        _maps_of_scans([group[side] for group in numbered], placed, capacity, side, thins) for side in (0, 1)
    )
    T = np.tile(np.eye(4, dtype=np.float32), (capacity.num_groups, 1, 1))
    for number, (source, target) in enumerate(numbered):
        T[number] = rigid.inverse(T_world_scan[target[0]]) @ T_world_scan[source[0]]
    return GroupBatch(sources, targets, T, np.arange(capacity.num_groups) < len(numbered))


def _maps_of_scans(
    maps: Sequence[Int[np.ndarray, " k"]], placed: PlacedScans, capacity: Layout, side: int, thins: bool
) -> MapOfScans:
    shape, num_descriptors = (capacity.num_groups, capacity[side]), placed.mask.shape[1]
    rows, mask = np.zeros(shape, np.int32), np.zeros((*shape, num_descriptors), bool)
    T_map_scan = np.tile(np.eye(4, dtype=np.float32), (*shape, 1, 1))
    for number, scans in enumerate(maps):
        rows[number, : len(scans)] = scans
        positions, is_there = placed.positions_world[scans].reshape(-1, 3), placed.mask[scans].reshape(-1)
        kept = thinned_mask(positions, is_there, num_descriptors) if thins else is_there
        mask[number, : len(scans)] = kept.reshape(len(scans), -1)
        T_world_first = placed.T_world_scan[scans[0]]
        T_map_scan[number, : len(scans)] = rigid.inverse(T_world_first) @ placed.T_world_scan[scans]
    return MapOfScans(rows, mask, T_map_scan)
