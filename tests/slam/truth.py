"""A matcher and a geometry that know the truth: noise, gross errors and failures are put in on purpose.

A scan is the number of its pose: `points` is (1, 3), and its first coordinate is the number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax.geometry import rigid
from dpmjax.slam import Alignment, Match, Submap

EMPTY = np.zeros((0, 3))


def pose(x: float, y: float, heading: float) -> np.ndarray:
    """A pose on the ground."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", heading).as_matrix()
    T[:3, 3] = x, y, 0
    return T


def noise(rng: np.random.Generator, sigma_m: float, sigma_rad: float) -> np.ndarray:
    """A small random motion."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rng.normal(0, sigma_rad, 3)).as_matrix()
    T[:3, 3] = rng.normal(0, sigma_m, 3)
    return T


def scans_of(numbers) -> list[np.ndarray]:
    """One scan a number."""
    return [np.array([[number, 0.0, 0.0]]) for number in numbers]


def laps(num_laps: int, side_m: float = 100.0, step_m: float = 1.0) -> np.ndarray:
    """Poses along a square with the corners cut by turns on the spot, driven several times."""
    poses = []
    for _ in range(num_laps):
        for side in range(4):
            heading = side * np.pi / 2
            corner = np.array([[0, 0], [side_m, 0], [side_m, side_m], [0, side_m]])[side]
            ahead = np.array([np.cos(heading), np.sin(heading)])
            poses += [pose(*(corner + way * ahead), heading) for way in np.arange(0.0, side_m, step_m)]
    return np.array(poses)


class TruthMap(NamedTuple):
    """The last scan of the local map."""

    number: int
    T_map_scan: np.ndarray


@dataclass(frozen=True)
class TruthGeometry:
    """Alignment is right up to noise where the start is near the truth, and fails elsewhere."""

    T_world_scan: np.ndarray
    sigma_m: float = 0.01
    sigma_rad: float = 0.001
    seed: int = 0
    failures: frozenset[int] = frozenset()

    def measure(self, points: np.ndarray) -> int | None:
        return int(points[0, 0]) if len(points) else None

    def extent_m(self, measured: int) -> float:
        return 10.0

    def insert(self, local_map: TruthMap | None, measured: int, T_map_scan: np.ndarray, scan: int) -> TruthMap:
        return TruthMap(measured, T_map_scan)

    def move(self, local_map: TruthMap, T_new_map: np.ndarray) -> TruthMap:
        return TruthMap(local_map.number, T_new_map @ local_map.T_map_scan)

    def align(self, local_map: TruthMap, measured: int, starts: Any) -> Alignment:
        rng = np.random.default_rng([self.seed, measured, local_map.number])
        T = local_map.T_map_scan @ rigid.inverse(self.T_world_scan[local_map.number]) @ self.T_world_scan[measured]
        start = starts.T_map_last @ starts.T_last_scan
        is_near = np.linalg.norm(T[:3, 3] - start[:3, 3]) < 5.0 and measured not in self.failures
        if measured != local_map.number:
            T = T @ noise(rng, self.sigma_m, self.sigma_rad)
        information = np.diag(np.repeat([1 / max(self.sigma_m, 1e-3) ** 2, 1 / max(self.sigma_rad, 1e-4) ** 2], 3))
        if not is_near:
            return Alignment(start, 0.0, 0.5, -1.0, information)
        return Alignment(T, 0.9, 0.0, 0.9, information)

    def pack(self, local_map: TruthMap) -> dict[str, np.ndarray]:
        return {"number": np.array(local_map.number), "T_map_scan": local_map.T_map_scan}

    def unpack(self, arrays: dict[str, np.ndarray], measure_again: Any) -> TruthMap:
        return TruthMap(int(arrays["number"]), arrays["T_map_scan"])


@dataclass(frozen=True)
class TruthMatcher:
    """Registration is right up to noise, or grossly wrong with a confidence as high; retrieval knows the place."""

    T_world_scan: np.ndarray
    gross_share: float = 0.2
    sigma_m: float = 0.1
    sigma_rad: float = 0.01
    seed: int = 0
    reach_m: float = 15.0
    least_probability: float = 0.6
    fingerprint: str = "truth"

    def describe(self, points: np.ndarray, measured: int) -> int:
        return measured

    def pack(self, description: int) -> dict[str, np.ndarray]:
        return {"number": np.array(description)}

    def unpack(self, arrays: dict[str, np.ndarray]) -> int:
        return int(arrays["number"])

    def vector(self, description: int) -> np.ndarray:
        # Random Fourier features: the cosine of two places falls with their distance.
        rng = np.random.default_rng(7)
        waves, phases = rng.normal(0, 1 / 10.0, (2, 256)), rng.uniform(0, 2 * np.pi, 256)
        return np.cos(self.T_world_scan[description][:2, 3] @ waves + phases)

    def register(self, pairs: list[tuple[Submap, Submap]]) -> list[Match]:
        return [self._match(source.descriptions[0], target.descriptions[0]) for source, target in pairs]

    def align_scans(self, source: int, target: int, T_target_source: np.ndarray) -> Alignment | None:
        return None

    def overlaps(self, source: int, targets: list[int]) -> np.ndarray:
        apart = self.T_world_scan[targets][:, :2, 3] - self.T_world_scan[source][:2, 3]
        return 1 / (1 + np.exp((np.linalg.norm(apart, axis=1) - self.reach_m) / 2))

    def _match(self, source: int, target: int) -> Match:
        rng = np.random.default_rng([self.seed, source, target])
        T = rigid.inverse(self.T_world_scan[target]) @ self.T_world_scan[source]
        if rng.random() < self.gross_share or np.linalg.norm(T[:3, 3]) > 2 * self.reach_m:
            T = noise(rng, 20.0, 1.0) @ T
        probability = float(rng.uniform(self.least_probability, 1.0))
        return Match(T @ noise(rng, self.sigma_m, self.sigma_rad), probability, 0.3)


@dataclass(frozen=True)
class MistakenMatcher(TruthMatcher):
    """Overlap is wrong as often as registrations are."""

    def overlaps(self, source: int, targets: list[int]) -> np.ndarray:
        rng = np.random.default_rng([self.seed, source, len(targets), 5])
        is_wrong = rng.random(len(targets)) < self.gross_share
        return np.where(is_wrong, rng.random(len(targets)), super().overlaps(source, targets))
