"""Held-out pairs of scans, and how well a model registers them and tells their overlap."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dpmjax.deeppointmap.encoding import encode as encode
from dpmjax.deeppointmap.encoding import pyramid_of_cloud as pyramid_of_cloud
from dpmjax.deeppointmap.encoding import pyramid_of_scan
from dpmjax.deeppointmap.model import Model, ModelConfig, encode_pyramid
from dpmjax.deeppointmap.scan_registration import overlap, register
from dpmjax.geometry import se2
from dpmjax.metrics.poses import RegistrationRecall, registration_recall
from dpmjax.sequences import LidarSequence
from dpmjax.types import DescriptorCloud, PointPyramid, Registration

PAIR_STREAM = 3103
NEAR_M = (2.0, 10.0)
"""Least and largest distance between the scans of an evaluation pair."""

FAR_M = 40.0
"""Scans farther apart than this do not overlap."""


class EvaluationPairs(NamedTuple):
    """Pairs of scans that are ready for all models of one configuration.

    Attributes:
        pyramids: pyramids of all scans, in normalised coordinates.
        T_world_scan: (n, 4, 4) true poses, metres.
        pairs: (p, 2) source and target of each pair.
        scale_m: metres in one unit of the pyramids.
    """

    pyramids: list[PointPyramid]
    T_world_scan: Float[np.ndarray, "n 4 4"]
    pairs: Int[np.ndarray, "p 2"]
    scale_m: float

    def scan_points(self, row: int) -> Float[np.ndarray, "n 3"]:
        """Returns the preprocessed points of a scan.

        Args:
            row: number of the scan.

        Returns:
            Points in the frame of the scan, metres.
        """
        level = self.pyramids[row].levels[0]
        return np.asarray(level.positions)[np.asarray(level.mask)] * np.float32(self.scale_m)


class Evaluation(NamedTuple):
    """Results of a model on evaluation pairs.

    Attributes:
        recall: errors, and the share of correct registrations.
        matches: registrations in the order of the pairs.
        clouds: descriptors of all scans.
        T_true: (p, 4, 4) true motions, target from source, metres.
    """

    recall: RegistrationRecall
    matches: list[Registration]
    clouds: list[DescriptorCloud]
    T_true: Float[np.ndarray, "p 4 4"]


def draw_evaluation_pairs(
    drive: LidarSequence, num_pairs: int, config: ModelConfig, *, seed: int = 0
) -> EvaluationPairs:
    """Draws random pairs of one drive; each scan is rotated by a random yaw. The two are 2 to 10 m apart.

    Args:
        drive: scans with true poses.
        num_pairs: number of pairs; fewer where the drive has fewer.
        config: preprocessing and pyramid.
        seed: seed of the draws.

    Returns:
        The pairs.

    Raises:
        ValueError: if the drive has no poses, or no such pairs.
    """
    rng = np.random.default_rng([PAIR_STREAM, seed])
    poses = drive.T_world_lidar
    if poses is None:
        raise ValueError("drive: expected a true pose for each scan, got none")
    distances = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    sources, targets = np.nonzero((distances >= NEAR_M[0]) & (distances <= NEAR_M[1]))
    if len(sources) == 0:
        raise ValueError(f"drive: expected scans {NEAR_M[0]} to {NEAR_M[1]} m apart, got none")
    chosen = rng.choice(len(sources), min(num_pairs, len(sources)), replace=False)
    rows = np.stack([sources[chosen], targets[chosen]], axis=1)
    pyramids, rotated = [], []
    for row, yaw in zip(rows.ravel(), rng.uniform(-np.pi, np.pi, rows.size), strict=True):
        T = np.eye(4)
        T[:2, :2] = se2.rotation(np.asarray(yaw))
        points = (drive.read_scan(int(row)) @ T[:3, :3].T).astype(np.float32)
        pyramids.append(pyramid_of_scan(points, config))
        rotated.append(poses[row] @ np.linalg.inv(T))
    return EvaluationPairs(pyramids, np.stack(rotated), np.arange(rows.size).reshape(-1, 2), config.scale_m)


def evaluate_registration(model: Model, pairs: EvaluationPairs) -> Evaluation:
    """Registers all pairs.

    Args:
        model: a model of the configuration that the pairs were drawn for.
        pairs: from `draw_evaluation_pairs`.

    Returns:
        Errors, registrations and descriptors.
    """
    clouds = [encode_pyramid(model, pyramid) for pyramid in pairs.pyramids]
    matches = [register(model, clouds[a], clouds[b]) for a, b in pairs.pairs]
    poses, (sources, targets) = pairs.T_world_scan, pairs.pairs.T
    T_true = np.linalg.inv(poses[targets]) @ poses[sources]
    T_found = np.stack([np.asarray(match.T_target_source) for match in matches])
    return Evaluation(registration_recall(T_found, T_true), matches, clouds, T_true)


def overlap_accuracy(model: Model, evaluation: Evaluation, pairs: EvaluationPairs) -> float:
    """Measures the overlap prediction on the pairs, and on as many pairs that are over 40 m apart.

    Args:
        model: the model of the evaluation.
        evaluation: from `evaluate_registration`.
        pairs: the pairs of the evaluation.

    Returns:
        Share of correct predictions.
    """
    positions, clouds = pairs.T_world_scan[:, :3, 3], evaluation.clouds
    is_right = []
    for a, b in pairs.pairs:
        is_right.append(float(overlap(model, clouds[a], clouds[b])) > 0.5)
        far = np.flatnonzero(np.linalg.norm(positions - positions[a], axis=1) > FAR_M)
        if len(far) > 0:
            other = int(far[(7 * int(a)) % len(far)])
            is_right.append(float(overlap(model, clouds[a], clouds[other])) <= 0.5)
    return float(np.mean(is_right))
