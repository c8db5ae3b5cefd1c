"""Evaluation while training: registration of held-out pairs of maps, and their offsets."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from dpmjax.deeppointmap.evaluation_pairs import draw_rows_apart, scan_distances, true_poses
from dpmjax.deeppointmap.matching import merge_clouds, thinned_mask
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.deeppointmap.scan_registration import trace_match
from dpmjax.deeppointmap.training.curriculum import TrainingConfig
from dpmjax.deeppointmap.training.offset_quality import TRAINED, WallOffsets, wall_offsets
from dpmjax.deeppointmap.training.preparation import prepare_drive
from dpmjax.deeppointmap.training.sampling import SampleScans
from dpmjax.deeppointmap.training.scan_store import ScanStore
from dpmjax.deeppointmap.training.step import encode_sample
from dpmjax.geometry import rigid
from dpmjax.metrics.poses import RegistrationRecall, registration_recall
from dpmjax.scans.augment import AugmentConfig
from dpmjax.sequences import LidarSequence
from dpmjax.types import DescriptorCloud, Poses, Registration

PAIR_STREAM = 3103
# Scans, maps or pairs that one compiled program evaluates in turn.
CHUNK = 10
# Largest distance of the scans of an evaluated map from its first scan.
MAP_RADIUS_M = 10.0

# No augmentation but a random yaw.
UPRIGHT = AugmentConfig(
    max_drop_ratio=0.0,
    sector_probability=0.0,
    box_probability=0.0,
    max_tilt_rad=0.0,
    translation_sigma_m=0.0,
    jitter_sigma_m=0.0,
)


class PairKind(NamedTuple):
    """Distances and sizes of the pairs of an evaluation.

    Attributes:
        min_distance_m: least distance between the two scans, or between the first scans of the two maps.
        max_distance_m: largest such distance.
        num_scans: number of scans in each of the two maps; 1 for pairs of scans.
    """

    min_distance_m: float = 2.0
    max_distance_m: float = 10.0
    num_scans: int = 1


class Pairs(NamedTuple):
    """Pairs of one kind.

    Attributes:
        kind: distances and sizes of the pairs.
        sources: (p, s) scans of the first map of each pair; the first scan is its frame.
        targets: (p, s) scans of the second map.
    """

    kind: PairKind
    sources: Int[np.ndarray, "p s"]
    targets: Int[np.ndarray, "p s"]


class EvaluationPairs(NamedTuple):
    """Pairs that are ready for all models of one configuration.

    Attributes:
        scans: all scans, and the yaw of each.
        T_world_scan: (n, 4, 4) true poses after the yaw, float64 metres.
        pairs: pairs of each kind.
        scale_m: metres in one unit of the pyramids.
    """

    scans: SampleScans
    T_world_scan: Poses
    pairs: tuple[Pairs, ...]
    scale_m: float

    def scan_points(self, row: int) -> Float[np.ndarray, "n 3"]:
        """Returns the preprocessed points of a scan.

        Args:
            row: number of the scan.

        Returns:
            Points in the frame of the scan, metres.
        """
        stored, T = self.scans.pyramids, self.scans.T_augmented_lidar[row]
        points = stored.points[row, : stored.num_points[row]] * (stored.unit[row] * np.float32(self.scale_m))
        return np.asarray(points @ T[:3, :3].T + T[:3, 3])

    def true_motions(self, pairs: Pairs) -> Poses:
        """Computes the true motions of pairs.

        Args:
            pairs: pairs of these scans.

        Returns:
            Target from source, metres.
        """
        poses = self.T_world_scan
        return rigid.inverse(poses[pairs.targets[:, 0]]) @ poses[pairs.sources[:, 0]]


class Evaluation(NamedTuple):
    """Results of a model on evaluation pairs.

    Attributes:
        recalls: errors and share of correct registrations of each kind.
        matches: stacked registrations of each kind.
        offsets: stacked offsets of the close descriptors of each kind; `measure_offsets` measures them.
        clouds: descriptors of all scans, stacked.
    """

    recalls: tuple[RegistrationRecall, ...]
    matches: tuple[Registration, ...]
    offsets: tuple[WallOffsets, ...]
    clouds: DescriptorCloud


def draw_evaluation_pairs(
    drive: LidarSequence,
    num_pairs: int,
    config: ModelConfig,
    *,
    kinds: tuple[PairKind, ...] = (PairKind(),),
    max_scans: int = 160,
    seed: int = 0,
) -> EvaluationPairs:
    """Draws random pairs of one drive.

    Args:
        drive: scans with true poses.
        num_pairs: number of pairs of each kind; fewer where the drive has fewer.
        config: preprocessing and pyramid.
        kinds: kinds of pairs.
        max_scans: a longer drive is thinned to this number of scans, evenly.
        seed: seed of the draws.

    Returns:
        The pairs.

    Raises:
        ValueError: if the drive has no poses, or no pairs of a kind.
    """
    true_poses(drive)
    rng = np.random.default_rng([PAIR_STREAM, seed])
    thinned = drive.take(slice(None, None, -(-len(drive) // max_scans)))
    pairs = tuple(_draw(thinned, num_pairs, kind, rng) for kind in kinds)
    settings = TrainingConfig(model=config, augment=UPRIGHT, num_variants=1, thins_as_in_use=True)
    store = ScanStore([prepare_drive(thinned, settings)])
    scans, placed = store.read(np.arange(len(thinned)), settings, rng)
    return EvaluationPairs(scans, placed.T_world_scan, pairs, config.scale_m)


def join_evaluation_pairs(parts: Sequence[EvaluationPairs]) -> EvaluationPairs:
    """Joins the pairs of several drives, those of one kind together.

    Args:
        parts: at least one; pairs of one configuration.

    Returns:
        The pairs of all drives.
    """
    starts = np.cumsum([0, *(len(part.T_world_scan) for part in parts)])
    found: dict[PairKind, list[Pairs]] = {}
    for start, part in zip(starts, parts, strict=False):
        for some in part.pairs:
            found.setdefault(some.kind, []).append(Pairs(some.kind, some.sources + start, some.targets + start))
    joined = tuple(
        Pairs(kind, *(np.concatenate([getattr(one, side) for one in some]) for side in ("sources", "targets")))
        for kind, some in found.items()
    )
    scans = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(part.scans for part in parts))
    poses = np.concatenate([part.T_world_scan for part in parts])
    return EvaluationPairs(scans, poses, joined, parts[0].scale_m)


def pair_kinds(drive: LidarSequence, kinds: Sequence[PairKind]) -> tuple[PairKind, ...]:
    """Finds the kinds of which a drive has pairs.

    Args:
        drive: scans with true poses.
        kinds: kinds of pairs.

    Returns:
        Some of the kinds, in order.
    """
    distances = scan_distances(drive)
    return tuple(
        kind for kind in kinds if np.any((distances >= kind.min_distance_m) & (distances <= kind.max_distance_m))
    )


def _draw(drive: LidarSequence, num_pairs: int, kind: PairKind, rng: np.random.Generator) -> Pairs:
    distances = scan_distances(drive)
    pairs = draw_rows_apart(distances, kind.min_distance_m, kind.max_distance_m, num_pairs, rng)
    if len(pairs) == 0:
        raise ValueError(f"drive: expected scans {kind.min_distance_m} to {kind.max_distance_m} m apart, got none")

    def maps(rows: Int[np.ndarray, " p"]) -> Int[np.ndarray, "p s"]:
        is_near = (distances <= MAP_RADIUS_M) & ~np.eye(len(distances), dtype=bool)
        # A scan without neighbours is repeated.
        near = [np.flatnonzero(is_near[row]) if is_near[row].any() else np.array([row]) for row in rows]
        others = [rng.choice(around, kind.num_scans - 1, len(around) < kind.num_scans - 1) for around in near]
        return np.concatenate([rows[:, None], np.stack(others)], axis=1).astype(int)

    return Pairs(kind, maps(pairs[:, 0]), maps(pairs[:, 1]))


def evaluate_registration(model: Model, pairs: EvaluationPairs) -> Evaluation:
    """Encodes each scan once, and registers all pairs.

    Args:
        model: a model of the configuration that the pairs were drawn for.
        pairs: pairs from `draw_evaluation_pairs`.

    Returns:
        Errors, registrations, offsets and descriptors.
    """
    clouds = _in_chunks(functools.partial(_encode_all, model), pairs.scans)
    matches, offsets, recalls = [], [], []
    for some in pairs.pairs:
        sides = [_maps(clouds, rows, pairs.T_world_scan) for rows in (some.sources, some.targets)]
        motions = pairs.true_motions(some)
        match, found = _in_chunks(functools.partial(_register_all, model), *sides, motions.astype(np.float32))
        matches.append(match)
        offsets.append(found)
        recalls.append(registration_recall(match.T_target_source, motions))
    return Evaluation(tuple(recalls), tuple(matches), tuple(offsets), clouds)


def _in_chunks(function: Callable[..., Any], *trees: Any) -> Any:
    """Applies a function to so many entries at a time, so that no number of scans or pairs compiles it again."""
    trees = jax.tree.map(np.asarray, trees)
    num = len(jax.tree.leaves(trees)[0])
    parts = []
    for start in range(0, num, CHUNK):
        rows = np.minimum(np.arange(start, start + CHUNK), num - 1)
        parts.append(jax.device_get(function(*jax.tree.map(operator.itemgetter(rows), trees))))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:num], *parts)


@jax.jit
def _encode_all(model: Model, scans: SampleScans) -> DescriptorCloud:
    return jax.lax.map(functools.partial(encode_sample, model), scans)


@jax.jit
def _register_all(
    model: Model, sources: DescriptorCloud, targets: DescriptorCloud, T_target_source: Float[Array, "p 4 4"]
) -> tuple[Registration, WallOffsets]:
    def best_motion(pair: tuple[DescriptorCloud, DescriptorCloud, Array]) -> tuple[Registration, WallOffsets]:
        source, target, T = pair
        hypotheses = trace_match(model, source.described, target.described, config=model.config.matching)
        return jax.tree.map(lambda leaf: leaf[0], hypotheses), wall_offsets(model, source, target, T, TRAINED)

    return jax.lax.map(best_motion, (sources, targets, T_target_source))


def _maps(clouds: DescriptorCloud, rows: Int[np.ndarray, "p s"], T_world_scan: Poses) -> DescriptorCloud:
    T_map_scan = rigid.inverse(T_world_scan[rows[:, :1]]) @ T_world_scan[rows]
    of_maps = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], clouds)
    merged = _in_chunks(_merge_all, of_maps, T_map_scan.astype(np.float32))
    unions = zip(merged.positions, merged.mask, strict=True)
    masks = [thinned_mask(positions, mask, clouds.mask.shape[1]) for positions, mask in unions]
    thinned: DescriptorCloud = merged.replace(mask=np.stack(masks))
    return thinned


@jax.jit
def _merge_all(clouds: DescriptorCloud, T_map_scan: Array) -> DescriptorCloud:
    return jax.vmap(merge_clouds)(clouds, T_map_scan)
