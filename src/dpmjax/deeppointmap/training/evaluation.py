"""Evaluation while training: registration of held-out pairs of maps, and their offsets."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from dpmjax.deeppointmap.encoding import encode_pyramids, pyramid_of_cloud, thin_scan
from dpmjax.deeppointmap.evaluation_pairs import draw_rows_apart, scan_distances, true_poses, turn_scan
from dpmjax.deeppointmap.matching import merge_clouds, thinned_mask
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.deeppointmap.scan_registration import trace_match
from dpmjax.deeppointmap.training.offset_quality import WallOffsets, offset_r2, wall_offsets
from dpmjax.deeppointmap.training.preparation import read_or_note
from dpmjax.geometry import rigid
from dpmjax.metrics.poses import RegistrationRecall, registration_recall
from dpmjax.sequences import LidarSequence
from dpmjax.types import DescriptorCloud, PointCloud, PointPyramid, Pose, Poses, Registration

PAIR_STREAM = 3103
# Maps or pairs that one compiled program evaluates in turn.
PAIRS_AT_ONCE = 10
# Largest distance of the scans of an evaluated map from its first scan.
MAP_RADIUS_M = 10.0


_merge_all = jax.jit(jax.vmap(merge_clouds))


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
        scans: all scans, thinned, each turned by a random yaw.
        pyramids: their pyramids.
        T_world_scan: (n, 4, 4) true poses after the yaw, float64 metres.
        pairs: pairs of each kind.
    """

    scans: list[PointCloud]
    pyramids: list[PointPyramid]
    T_world_scan: Poses
    pairs: tuple[Pairs, ...]

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
        offset_r2: coefficients of determination of predicted offsets (`offset_r2`), all kinds together.
        clouds: descriptors of all scans, stacked.
    """

    recalls: tuple[RegistrationRecall, ...]
    matches: tuple[Registration, ...]
    offset_r2: Float[np.ndarray, " 3"]
    clouds: DescriptorCloud


def draw_evaluation_pairs(
    drives: Iterable[LidarSequence],
    num_pairs: int,
    config: ModelConfig,
    *,
    kinds: tuple[PairKind, ...] = (PairKind(),),
    seed: int = 0,
) -> EvaluationPairs:
    """Draws random pairs of scans of each drive.

    Args:
        drives: scans with true poses; a drive without pairs of any kind is left out.
        num_pairs: number of pairs of each kind of a drive; fewer where the drive has fewer.
        config: preprocessing and pyramid.
        kinds: kinds of pairs.
        seed: seed of the draws.

    Returns:
        The pairs, of the kinds of which some drive has one.

    Raises:
        ValueError: if a drive has no poses.
    """
    scans, poses = list[PointCloud](), list[Pose]()
    found: dict[PairKind, list[tuple[np.ndarray, np.ndarray]]] = {kind: [] for kind in kinds}
    for drive in drives:
        rng = np.random.default_rng([PAIR_STREAM, seed])
        drawn = [_draw(drive, num_pairs, kind, rng) for kind in kinds]
        if not any(len(sources) for sources, _ in drawn):
            continue
        for kind, (sources, targets) in zip(kinds, drawn, strict=True):
            found[kind].append((sources + len(scans), targets + len(scans)))
        for row, T in enumerate(true_poses(drive)):
            points, T_turned = turn_scan(read_or_note(drive, row, {}), T, rng)
            scans.append(thin_scan(points, config))
            poses.append(T_turned)
    joined = (Pairs(kind, *map(np.concatenate, zip(*some, strict=True))) for kind, some in found.items() if some)
    pairs = tuple(some for some in joined if len(some.sources))
    pyramids = [pyramid_of_cloud(scan, config) for scan in scans]
    return EvaluationPairs(scans, pyramids, np.reshape(poses, (-1, 4, 4)), pairs)


def _draw(
    drive: LidarSequence, num_pairs: int, kind: PairKind, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "p s"], Int[np.ndarray, "p s"]]:
    distances = scan_distances(drive)
    pairs = draw_rows_apart(distances, kind.min_distance_m, kind.max_distance_m, num_pairs, rng)

    def maps(rows: Int[np.ndarray, " p"]) -> Int[np.ndarray, "p s"]:
        is_near = (distances <= MAP_RADIUS_M) & ~np.eye(len(distances), dtype=bool)
        # A scan without neighbours is repeated.
        near = [np.flatnonzero(is_near[row]) if is_near[row].any() else np.array([row]) for row in rows]
        others = [rng.choice(around, kind.num_scans - 1, len(around) < kind.num_scans - 1) for around in near]
        return np.concatenate([rows[:, None], np.reshape(others, (len(rows), kind.num_scans - 1))], axis=1).astype(int)

    return maps(pairs[:, 0]), maps(pairs[:, 1])


def evaluate_registration(model: Model, pairs: EvaluationPairs) -> Evaluation:
    """Encodes each scan once, and registers all pairs.

    Args:
        model: a model of the configuration that the pairs were drawn for.
        pairs: pairs from `draw_evaluation_pairs`.

    Returns:
        Errors, registrations, descriptors, and the accuracy of offsets.
    """
    clouds = encode_pyramids(model, pairs.pyramids)
    matches, offsets, recalls = [], [], []
    for some in pairs.pairs:
        sides = [_maps(clouds, rows, pairs.T_world_scan) for rows in (some.sources, some.targets)]
        motions = pairs.true_motions(some)
        match, found = in_chunks(functools.partial(_register_all, model), *sides, motions.astype(np.float32))
        matches.append(match)
        offsets.append(found)
        recalls.append(registration_recall(match.T_target_source, motions))
    r2 = offset_r2(offsets if model.config.decoder.predicts_offsets else [])
    return Evaluation(tuple(recalls), tuple(matches), r2, clouds)


def in_chunks(function: Callable[..., Any], *trees: Any, at_once: int = PAIRS_AT_ONCE) -> Any:
    """Applies a function to parts of equal size, so that no number of scans or pairs compiles it again.

    Args:
        function: function of trees of arrays.
        *trees: its arguments, whose leaves have one length.
        at_once: number of entries of a part; the last one is repeated.

    Returns:
        The results, joined, as arrays of NumPy.
    """
    trees = jax.tree.map(np.asarray, trees)
    num = len(jax.tree.leaves(trees)[0])
    parts = []
    for start in range(0, num, at_once):
        rows = np.minimum(np.arange(start, start + at_once), num - 1)
        parts.append(jax.device_get(function(*jax.tree.map(operator.itemgetter(rows), trees))))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:num], *parts)


@jax.jit
def _register_all(
    model: Model, sources: DescriptorCloud, targets: DescriptorCloud, T_target_source: Float[Array, "p 4 4"]
) -> tuple[Registration, WallOffsets]:
    def best_motion(pair: tuple[DescriptorCloud, DescriptorCloud, Array]) -> tuple[Registration, WallOffsets]:
        source, target, T = pair
        hypotheses = trace_match(model, source.described, target.described, config=model.config.matching)
        return jax.tree.map(lambda leaf: leaf[0], hypotheses), wall_offsets(model, source, target, T)

    return jax.lax.map(best_motion, (sources, targets, T_target_source))


def _maps(clouds: DescriptorCloud, rows: Int[np.ndarray, "p s"], T_world_scan: Poses) -> DescriptorCloud:
    T_map_scan = rigid.inverse(T_world_scan[rows[:, :1]]) @ T_world_scan[rows]
    of_maps = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], clouds)
    merged = in_chunks(_merge_all, of_maps, T_map_scan.astype(np.float32))
    unions = zip(merged.positions, merged.mask, strict=True)
    masks = [thinned_mask(positions, mask, clouds.mask.shape[1]) for positions, mask in unions]
    return replace(merged, mask=np.stack(masks))
