"""Evaluation while training: registration of held-out pairs of scans by their descriptors, and their offsets."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from dpmjax.deeppointmap.encoding import encode_pyramids, pyramid_of_cloud, thin_scan
from dpmjax.deeppointmap.evaluation import draw_scan_pairs, true_poses, turn_scan
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.deeppointmap.registration import trace_match
from dpmjax.deeppointmap.training.offset_quality import WallOffsets, offset_r2, wall_offsets
from dpmjax.deeppointmap.training.preparation import read_or_note
from dpmjax.geometry import rigid
from dpmjax.metrics.poses import RegistrationRecall, registration_recall
from dpmjax.sequences import LidarSequence
from dpmjax.types import DescriptorCloud, PointCloud, PointPyramid, Pose, Poses, Registration

YAW_STREAM = 3103
# Bands of distance of the pairs.
BANDS = ("near", "middle")
# Pairs that one compiled program evaluates in turn.
PAIRS_AT_ONCE = 10


class EvaluationPairs(NamedTuple):
    """Pairs that are ready for all models of one configuration.

    Attributes:
        scans: all scans, thinned, each turned by a random yaw.
        pyramids: their pyramids.
        T_world_scan: (n, 4, 4) true poses after the yaw, float64 metres.
        pairs: rows of the source and the target of each pair, by band of distance.
    """

    scans: list[PointCloud]
    pyramids: list[PointPyramid]
    T_world_scan: Poses
    pairs: dict[str, Int[np.ndarray, "p 2"]]

    def true_motions(self, band: str) -> Poses:
        """Computes the true motions of the pairs of a band.

        Args:
            band: a key of `pairs`.

        Returns:
            Target from source, metres.
        """
        sources, targets = self.T_world_scan[self.pairs[band].T]
        return rigid.inverse(targets) @ sources


class Evaluation(NamedTuple):
    """Results of a model on evaluation pairs.

    Attributes:
        recalls: errors and share of correct registrations, by band.
        matches: stacked registrations, by band.
        offset_r2: coefficients of determination of predicted offsets (`offset_r2`), all bands together.
        clouds: descriptors of all scans, stacked.
    """

    recalls: dict[str, RegistrationRecall]
    matches: dict[str, Registration]
    offset_r2: Float[np.ndarray, " 3"]
    clouds: DescriptorCloud


def draw_evaluation_pairs(
    drives: Iterable[LidarSequence], num_pairs: int, config: ModelConfig, *, seed: int = 0
) -> EvaluationPairs:
    """Draws random pairs of scans of each drive, near ones and farther ones.

    Args:
        drives: scans with true poses; a drive without pairs is left out.
        num_pairs: number of pairs of each band of a drive; fewer where the drive has fewer.
        config: preprocessing and pyramid.
        seed: seed of the draws.

    Returns:
        The pairs, of the bands of which some drive has one.

    Raises:
        ValueError: if a drive has no poses.
    """
    scans, poses = list[PointCloud](), list[Pose]()
    found: dict[str, list[np.ndarray]] = {band: [] for band in BANDS}
    for drive in drives:
        drawn = {band: draw_scan_pairs(drive, band, num_pairs, seed=seed) for band in BANDS}
        if not any(map(len, drawn.values())):
            continue
        for band, rows in drawn.items():
            found[band].append(rows + len(scans))
        rng = np.random.default_rng([YAW_STREAM, seed])
        for row, T in enumerate(true_poses(drive)):
            points, T_turned = turn_scan(read_or_note(drive, row, {}), T, rng)
            scans.append(thin_scan(points, config))
            poses.append(T_turned)
    pairs = {band: np.concatenate(some) for band, some in found.items() if any(map(len, some))}
    return EvaluationPairs(
        scans, [pyramid_of_cloud(scan, config) for scan in scans], np.reshape(poses, (-1, 4, 4)), pairs
    )


def evaluate_registration(model: Model, pairs: EvaluationPairs) -> Evaluation:
    """Encodes each scan once, and registers all pairs by their descriptors.

    Args:
        model: a model of the configuration that the pairs were drawn for.
        pairs: pairs from `draw_evaluation_pairs`.

    Returns:
        Errors, registrations, descriptors, and the accuracy of offsets.
    """
    clouds = encode_pyramids(model, pairs.pyramids)
    recalls, matches, offsets = {}, {}, []
    for band, rows in pairs.pairs.items():
        sides = (jax.tree.map(operator.itemgetter(side), clouds) for side in rows.T)
        motions = pairs.true_motions(band)
        matches[band], wall = in_chunks(partial(_register_all, model), *sides, motions.astype(np.float32))
        recalls[band] = registration_recall(matches[band].T_target_source, motions)
        offsets.append(wall)
    return Evaluation(recalls, matches, offset_r2(offsets if model.config.decoder.predicts_offsets else []), clouds)


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
