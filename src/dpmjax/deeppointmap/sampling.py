"""Sampling for training: which scans form two maps, and which pairs of scans overlap. On the host.

Scans are drawn by their true poses, before augmentation, and from the given generator only, so that the sample of a
step does not depend on the steps before.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from dpmjax.checks import require_count

NUM_ATTEMPTS = 100


@dataclass(frozen=True)
class SamplingConfig:
    """Sizes and distances of samples (defaults: DeepPointMap's published configuration).

    Attributes:
        num_scans: capacity of one sample, all groups together.
        min_distance_m: scans nearer to the anchor are too similar to it.
        max_distance_m: scans farther from the anchor do not belong to its group.
        pair_probability: probability that a group is one pair of scans, in every stage.
        max_side: largest number of scans of one map. Half of the groups up to this size are split into one scan
            against all others.
        num_overlap_pairs: pairs of one sample of the overlap part.
        overlap_distance_m: scans nearer to each other than this overlap.
        far_distance_m: a quarter of the overlap pairs is farther apart than this, a quarter lies between the two
            distances.
    """

    num_scans: int = 32
    min_distance_m: float = 0.25
    max_distance_m: float = 20.0
    pair_probability: float = 0.34
    max_side: int = 16
    num_overlap_pairs: int = 32
    overlap_distance_m: float = 20.0
    far_distance_m: float = 40.0

    def __post_init__(self) -> None:
        require_count("max_side", self.max_side)
        require_count("num_overlap_pairs", self.num_overlap_pairs)
        if self.num_scans < 2:
            raise ValueError(f"num_scans: expected at least 2, got {self.num_scans}")
        if not 0 <= self.min_distance_m < self.max_distance_m:
            raise ValueError(f"min_distance_m: expected 0 to below {self.max_distance_m}, got {self.min_distance_m}")
        if not 0 < self.overlap_distance_m <= self.far_distance_m:
            raise ValueError(f"far_distance_m: expected {self.overlap_distance_m} at least, got {self.far_distance_m}")
        if not 0 <= self.pair_probability <= 1:
            raise ValueError(f"pair_probability: expected from 0 to 1, got {self.pair_probability}")

    def side_capacity(self, max_group: int) -> int:
        """Returns the capacity of one map of a group.

        Args:
            max_group: scans in both maps of a group together, at most.

        Returns:
            The largest number of scans in one map.
        """
        return min(max_group - 1, self.max_side)

    def num_groups(self, max_group: int) -> int:
        """Returns the number of groups in a sample.

        Args:
            max_group: scans in both maps of a group together, at most.

        Returns:
            About as many groups as fill the sample.
        """
        mean = 2 * self.pair_probability + (1 - self.pair_probability) * (2 + max_group) / 2
        return max(1, round(self.num_scans / mean))


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

    @functools.cached_property
    def positions(self) -> Float[np.ndarray, "n 3"]:
        """Positions of the lidar, metres."""
        return self.T_world_lidar[:, :3, 3]

    @functools.cached_property
    def trees(self) -> tuple[cKDTree, ...]:
        """One search tree for each scene."""
        return tuple(cKDTree(self.positions[rows]) for rows in self.rows)

    @functools.cached_property
    def rows(self) -> tuple[Int[np.ndarray, " s"], ...]:
        """Numbers of the scans of each scene."""
        return tuple(np.flatnonzero(self.scene == scene) for scene in range(int(self.scene.max()) + 1))

    def within(self, row: int, max_distance_m: float) -> Int[np.ndarray, " k"]:
        """Finds the scans of the same scene up to a distance.

        Args:
            row: number of the scan in the middle.
            max_distance_m: the distance.

        Returns:
            Numbers of the scans in order, `row` among them.
        """
        scene = int(self.scene[row])
        near = self.trees[scene].query_ball_point(self.positions[row], max_distance_m)
        return self.rows[scene][np.sort(np.asarray(near, int))]


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
        distances = np.linalg.norm(table.positions - table.positions[anchor], axis=1)
        distances = np.where(table.scene == table.scene[anchor], distances, np.inf)
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
    near = table.within(anchor, config.max_distance_m)
    distances = np.linalg.norm(table.positions[near] - table.positions[anchor], axis=1)
    others = near[(distances >= config.min_distance_m) & (near != anchor)]
    chosen = rng.choice(others, min(size - 1, len(others)), replace=False) if len(others) > 0 else others
    return rng.permutation(np.concatenate([[anchor], chosen]).astype(int))


def _split(members: Int[np.ndarray, " s"], config: SamplingConfig, rng: np.random.Generator) -> Group:
    # Half of the groups are split into one scan and all others, the rest anywhere; no side exceeds `max_side`.
    num = len(members)
    least, most = max(1, num - config.max_side), min(num - 1, config.max_side)
    is_one_to_all = least == 1 and num <= config.max_side and rng.random() < 0.5
    num_source = 1 if is_one_to_all else int(rng.integers(least, most + 1))
    return Group(members[:num_source], members[num_source:])
