"""Can a registration be trusted? Told from the scans at their poses alone.

A map is wrong where it was put together over a weak joint, or where beams pass through what others have hit. So two
numbers are taken: how many beams the weakest joint holds by, if every scan hangs on the best chain of others; and the
share of beams that contradict another scan.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import scipy.spatial
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.registration import judge_pairs, length_scale, make_profiles, view_margins
from dpmjax.registration.line_fitting import LineScans


@dataclass(frozen=True)
class ConfidenceConfig:
    """Settings, calibrated on right and wrong maps of simulated worlds (docs/deepmapping_notes.md).

    Attributes:
        num_neighbours: each scan is compared with so many nearest ones.
        min_joint: share of beams that the weakest joint of a good map holds by.
        max_contradiction: share of beams that may contradict others in a good map, without noise ...
        noisy_contradiction: ... and so much more when the range noise is a tenth of the length scale or above.
        max_noise: with more range noise than this, in length scales, right and wrong maps look alike: never good.
    """

    num_neighbours: int = 12
    min_joint: float = 0.36
    max_contradiction: float = 0.01
    noisy_contradiction: float = 0.03
    max_noise: float = 0.15


class Confidence(NamedTuple):
    """What is known of a registration without the truth.

    Attributes:
        weakest_joint: share of beams, 0 to 1, that the weakest joint of the best chain holds by.
        contradiction: share of beams, 0 to 1, that end in the free space of another scan.
        is_good: both are within what right maps reach, and there is not too much noise to tell.
    """

    weakest_joint: float
    contradiction: float
    is_good: bool


def judge_trajectory(
    lines: LineScans, valid: NDArray[np.bool_], poses: NDArray[np.float64], config: ConfidenceConfig | None = None
) -> Confidence:
    """Whether the registration of scans can be trusted.

    Args:
        lines: n scans with lines, two at least.
        valid: (n, b) beams that measured something.
        poses: (n, 3) x, y, heading.
        config: settings.

    Returns:
        Confidence.
    """
    config = config or ConfidenceConfig()
    margins, scale = view_margins(lines), length_scale(lines)
    num_scans = len(poses)
    nearest = scipy.spatial.cKDTree(poses[:, :2]).query(poses[:, :2], k=min(config.num_neighbours + 1, num_scans))[1]
    row = np.repeat(np.arange(num_scans), nearest.shape[1])
    pairs = np.unique(np.sort(np.stack([row, nearest.reshape(-1)], -1), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] < pairs[:, 1]].astype(np.int64)
    source, target = pairs[:, 1], pairs[:, 0]
    profiles = make_profiles(lines, np.asarray(valid))
    relative = se2.relative(poses[target], poses[source])
    verdict = judge_pairs(profiles, source, target, relative, margins=margins)
    num_beams = np.maximum(np.asarray(valid).sum(axis=1), 1)
    share = np.clip(verdict.matched / (num_beams[source] + num_beams[target]), 1e-6, 1.0)
    graph = scipy.sparse.csr_matrix((2.0 - share, (source, target)), shape=(num_scans, num_scans))
    tree = scipy.sparse.csgraph.minimum_spanning_tree(graph)
    joint = 2.0 - float(tree.data.max()) if tree.nnz == num_scans - 1 else 0.0
    contradiction = float(np.sum(verdict.crossed)) / max(float(np.sum(verdict.seen)), 1.0)
    noise = float(lines.noise[0]) / scale
    limit = config.max_contradiction + min(1.0, noise / 0.1) * config.noisy_contradiction
    is_good = joint >= config.min_joint and contradiction <= limit and noise <= config.max_noise
    return Confidence(joint, contradiction, is_good)
