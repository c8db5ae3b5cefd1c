"""Evaluation of the overlap probability on the pairs of a drive: near ones, or revisits, against far ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from dpmjax.deeppointmap.batches import overlap_pairs
from dpmjax.deeppointmap.encoding import encode
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.overlap_prediction import OVERLAP_M
from dpmjax.deeppointmap.scan_pairs import draw_rows, scan_distances, true_poses
from dpmjax.geometry import se2
from dpmjax.metrics.statistics import area_under_curve, brier_score
from dpmjax.sequences import LidarSequence
from dpmjax.types import DescriptorCloud

NO_OVERLAP_M = 40.0
"""Scans between `OVERLAP_M` and this apart may see the same place; the evaluation leaves them out."""

REVISIT_PATH_M = 100.0
"""Scans seen again after so many metres of driving are revisits."""

REVISIT_STREAM = 4133


class OverlapEvaluation(NamedTuple):
    """Overlap probabilities of pairs.

    Attributes:
        probability: of each pair.
        is_overlap: whether the scans are less than 20 m apart.
        has_revisits: whether the overlapping pairs are revisits, because the drive comes back to places.
    """

    probability: Float[np.ndarray, " p"]
    is_overlap: Bool[np.ndarray, " p"]
    has_revisits: bool

    @property
    def area_under_curve(self) -> float:
        """Share of comparisons in which the overlapping pair has the higher probability; NaN without pairs."""
        return area_under_curve(self.probability, self.is_overlap)

    @property
    def brier_score(self) -> float:
        """Mean squared error of the probabilities; NaN without pairs."""
        return brier_score(self.probability, self.is_overlap)


def evaluate_overlap(
    model: Model,
    drive: LidarSequence,
    num_pairs: int,
    *,
    seed: int = 0,
    on_scan: Callable[[], object] | None = None,
) -> OverlapEvaluation:
    """Predicts the overlap of pairs nearer than 20 m, and of pairs farther than 40 m.

    The near pairs are revisits if the drive comes back to places. Each scan is turned by a random yaw.

    Args:
        model: encoder and decoder.
        drive: scans with true poses.
        num_pairs: pairs of each of the two kinds; fewer where the drive has fewer.
        seed: seed of the draws.
        on_scan: called after each scan that is encoded, to show progress.

    Returns:
        The probabilities; none where the drive lacks pairs of one kind.

    Raises:
        ValueError: if the drive has no poses, or a scan cannot be read.
    """
    near, far, has_revisits = _candidates(drive)
    rng = np.random.default_rng([REVISIT_STREAM, seed])
    if min(len(near), len(far)) == 0:
        return OverlapEvaluation(np.zeros(0), np.zeros(0, bool), has_revisits)
    near, far = draw_rows(near, num_pairs, rng), draw_rows(far, num_pairs, rng)
    pairs = np.concatenate([near, far])
    rows, places = np.unique(pairs, return_inverse=True)
    clouds = encode_turned(model, drive, rows, rng=rng, on_scan=on_scan)
    sides = ([clouds[place] for place in side] for side in places.reshape(pairs.shape).T)
    probability = np.asarray(overlap_pairs(model, *sides), float)
    return OverlapEvaluation(probability, np.arange(len(pairs)) < len(near), has_revisits)


def encode_turned(
    model: Model,
    drive: LidarSequence,
    rows: Int[np.ndarray, " s"],
    *,
    rng: np.random.Generator,
    on_scan: Callable[[], object] | None = None,
) -> list[DescriptorCloud]:
    """Encodes scans of a drive, each turned by a random yaw.

    Args:
        model: encoder.
        drive: scans.
        rows: numbers of the scans.
        rng: source of the yaws.
        on_scan: called after each scan, to show progress.

    Returns:
        Descriptors of each scan, as arrays of NumPy.
    """
    turns = np.asarray(se2.rotation(rng.uniform(-np.pi, np.pi, len(rows))))
    clouds = []
    for row, turn in zip(rows, turns, strict=True):
        points = drive.read_scan(int(row)).astype(np.float32)
        points[:, :2] = points[:, :2] @ turn.T
        clouds.append(jax.device_get(encode(model, points)))
        if on_scan is not None:
            on_scan()
    return clouds


def _candidates(drive: LidarSequence) -> tuple[Int[np.ndarray, "k 2"], Int[np.ndarray, "l 2"], bool]:
    """Returns near pairs, far pairs, and whether the near ones are revisits."""
    distances = scan_distances(drive)
    steps = np.linalg.norm(np.diff(true_poses(drive)[:, :3, 3], axis=0), axis=1)
    path = np.concatenate([[0], np.cumsum(steps)])
    is_near = (distances < OVERLAP_M) & (distances > 0)
    is_revisit = is_near & (np.abs(path[:, None] - path[None]) > REVISIT_PATH_M)
    has_revisits = bool(is_revisit.any())
    return np.argwhere(is_revisit if has_revisits else is_near), np.argwhere(distances > NO_OVERLAP_M), has_revisits
