"""Pairs of scans with true motions, and how many of them a model registers and recognises."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dpmjax.deeppointmap import Model
    from dpmjax.io import LidarSequence
    from dpmjax.metrics import RegistrationRecall
    from dpmjax.types import PointPyramid

PAIR_STREAM = 3103


class PairedScans(NamedTuple):
    """Raw scans and pairs of them.

    Attributes:
        scans: (n, 3) points each, metres, turned about z by an angle of its own.
        T_world_scan: poses of the turned scans.
        pairs: (p, 2) source and target.
    """

    scans: list[NDArray[np.float32]]
    T_world_scan: NDArray[np.float64]
    pairs: NDArray[np.int64]


def draw_pairs(
    drive: LidarSequence, num_pairs: int, *, seed: int, distance_m: tuple[float, float] = (2.0, 10.0)
) -> PairedScans:
    """Random pairs of one drive at such distances, each scan turned by any yaw.

    Raises:
        ValueError: the drive has no such pairs.
    """
    rng = np.random.default_rng([PAIR_STREAM, seed])
    poses = drive.T_world_lidar
    if poses is None:
        raise ValueError(f"{drive.name}: no poses")
    distances = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    sources, targets = np.nonzero((distances >= distance_m[0]) & (distances <= distance_m[1]))
    if len(sources) == 0:
        raise ValueError(f"{drive.name}: no two scans {distance_m[0]} to {distance_m[1]} m apart")
    chosen = rng.choice(len(sources), min(num_pairs, len(sources)), replace=False)
    rows = np.stack([sources[chosen], targets[chosen]], axis=1)
    scans, turned = [], []
    for row, yaw in zip(rows.ravel(), rng.uniform(-np.pi, np.pi, rows.size), strict=True):
        T = np.eye(4)
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        scans.append((drive.read_scan(int(row)) @ T[:3, :3].T).astype(np.float32))
        turned.append(poses[row] @ np.linalg.inv(T))
    return PairedScans(scans, np.stack(turned), np.arange(rows.size).reshape(-1, 2))


@dataclass(frozen=True)
class Examination:
    """Pairs that are ready for any model of one configuration: the pyramids do not depend on parameters.

    Attributes:
        pyramids: of all scans.
        T_world_scan: their poses.
        pairs: (p, 2) source and target.
        scale_m: metres in one unit of the pyramids.
    """

    pyramids: list[PointPyramid]
    T_world_scan: NDArray[np.float64]
    pairs: NDArray[np.int64]
    scale_m: float

    def scan_points(self, row: int) -> NDArray[np.float32]:
        """The preprocessed points of a scan, metres."""
        level = self.pyramids[row].levels[0]
        return np.asarray(level.positions)[np.asarray(level.mask)] * np.float32(self.scale_m)


def prepare(model: Model, paired: PairedScans) -> Examination:
    """Preprocesses the scans as the model wants them."""
    from dpmjax.deeppointmap import pyramid_of_scan

    pyramids = [pyramid_of_scan(model, scan) for scan in paired.scans]
    return Examination(pyramids, paired.T_world_scan, paired.pairs, model.config.scale_m)


class Examined(NamedTuple):
    """What a model made of the pairs.

    Attributes:
        recall: errors and the share that is right.
        matches: the registrations, in the order of the pairs.
        clouds: descriptors of all scans.
        T_true: (p, 4, 4) true motions, target from source.
    """

    recall: RegistrationRecall
    matches: list[Any]
    clouds: list[Any]
    T_true: NDArray[np.float64]


def examine(model: Model, examination: Examination) -> Examined:
    """Registers all pairs."""
    from dpmjax.deeppointmap import encode_pyramid, register
    from dpmjax.metrics import registration_recall

    clouds = [encode_pyramid(model, pyramid) for pyramid in examination.pyramids]
    matches = [register(model, clouds[a], clouds[b]) for a, b in examination.pairs]
    poses, (sources, targets) = examination.T_world_scan, examination.pairs.T
    T_true = np.linalg.inv(poses[targets]) @ poses[sources]
    T_found = np.stack([np.asarray(match.T_target_source) for match in matches])
    return Examined(registration_recall(T_found, T_true), matches, clouds, T_true)


def overlap_accuracy(model: Model, examined: Examined, examination: Examination) -> float:
    """Share of pairs of scans on the right side of one half: the near pairs, and as many that are over 40 m apart."""
    from dpmjax.deeppointmap import overlap

    places = examination.T_world_scan[:, :3, 3]
    right = []
    for a, b in examination.pairs:
        right.append(float(overlap(model, examined.clouds[a], examined.clouds[b])) > 0.5)
        far = np.flatnonzero(np.linalg.norm(places - places[a], axis=1) > 40.0)
        if len(far) > 0:
            other = int(far[(7 * int(a)) % len(far)])
            right.append(float(overlap(model, examined.clouds[a], examined.clouds[other])) <= 0.5)
    return float(np.mean(right))
