"""Evaluation while training: registration of held-out pairs of scans by their descriptors, and their offsets.

Offsets are measured along the normal of the wall, along the wall, and up, in metres. Along a wall nothing fixes an
offset, because a wall looks the same further on; and the height alone can make the loss small.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dpmjax.deeppointmap.encoding import encode_pyramids, pyramid_of_cloud, thin_scan
from dpmjax.deeppointmap.evaluation import draw_scan_pairs, true_poses, turn_scan
from dpmjax.deeppointmap.model import Model, correlate, predict_offsets
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.deeppointmap.registration import trace_match
from dpmjax.deeppointmap.training.objective import ObjectiveConfig, training_pairs
from dpmjax.deeppointmap.training.preparation import read_or_note
from dpmjax.geometry import rigid
from dpmjax.geometry.bearing import directions_of, ray_directions, to_ray_frame
from dpmjax.metrics.poses import RegistrationRecall, registration_recall
from dpmjax.sequences import LidarSequence
from dpmjax.types import AnyArray, DescriptorCloud, PointCloud, PointPyramid, Pose, Poses, Registration, SurfaceElements

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


TRAINED = ObjectiveConfig()

# Normals at most 30 degrees from the horizontal belong to walls.
MAX_NORMAL_HEIGHT = 0.5

# Planarity of walls. Below, normals of vegetation and of edges count too; above, few walls are left in sparse scans.
MIN_PLANARITY = 0.3


class WallOffsets(NamedTuple):
    """Predicted and true offsets of pairs of descriptors, in the frame of the wall of the first descriptor.

    Attributes:
        predicted: along the horizontal normal, along the wall, and up, metres.
        true: the same of the true offsets.
        mask: True for pairs within the radius whose first descriptor lies on an upright wall; others hold anything.
    """

    predicted: Float[AnyArray, "*p 3"]
    true: Float[AnyArray, "*p 3"]
    mask: Bool[AnyArray, "*p"]


def offset_r2(parts: Sequence[WallOffsets]) -> Float[np.ndarray, " 3"]:
    """Computes the coefficients of determination of predicted offsets, all parts together.

    Args:
        parts: offsets of any number of pairs of clouds.

    Returns:
        1 less the mean squared residual over the variance of the true offsets, along the normal of the wall, along the
        wall, and up. NaN along an axis without variance, and without a pair.
    """
    pairs = [(np.asarray(part.predicted)[part.mask], np.asarray(part.true)[part.mask]) for part in parts]
    if not sum(len(true) for _, true in pairs):
        return np.full(3, np.nan)
    predicted, true = (np.concatenate(some).astype(np.float64) for some in zip(*pairs, strict=True))
    squared, variance = np.mean((predicted - true) ** 2, axis=0), np.var(true, axis=0)
    return np.asarray(1 - np.divide(squared, variance, out=np.full(3, np.nan), where=variance > 0))


def wall_offsets(
    model: Model,
    source: DescriptorCloud,
    target: DescriptorCloud,
    T_target_source: Array,
    config: ObjectiveConfig = TRAINED,
) -> WallOffsets:
    """Predicts the offsets of all close descriptors of which the first lies on an upright wall.

    Args:
        model: encoder and decoder.
        source: uncorrelated descriptors of a scan or a map, with normals.
        target: the same.
        T_target_source: the true motion, metres.
        config: radius and number of close pairs.

    Returns:
        Offsets (m, k, 3) from the descriptors of the source.

    Raises:
        ValueError: if the source has no normals.
    """
    normals, is_wall = _walls(source)
    source, target = source.described, target.described
    correlated, others = correlate(model, source, target)
    close, _ = training_pairs(source, target, T_target_source, config=config)
    directions = directions_of(source)[:, None]
    offsets = predict_offsets(model, correlated.features[:, None], others.features, directions, close.indices)
    predicted, true = (to_ray_frame(values, normals[:, None]) for values in (offsets, close.offsets))
    return WallOffsets(predicted, true, close.mask & is_wall[:, None])


def _walls(cloud: DescriptorCloud) -> tuple[Float[Array, "m 2"], Bool[Array, " m"]]:
    """Returns the horizontal normals of the descriptors, and True where they lie on upright walls."""
    num_described = cloud.features.shape[0]
    elements: SurfaceElements = jax.tree.map(lambda leaf: leaf[:num_described], cloud.elements)
    is_upright = jnp.abs(elements.normals[:, 2]) <= MAX_NORMAL_HEIGHT
    return ray_directions(elements.normals), is_upright & (elements.planarity >= MIN_PLANARITY)
