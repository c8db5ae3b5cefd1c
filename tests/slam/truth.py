"""A matcher and a geometry that know the truth: noise, gross errors and failures are put in on purpose.

A scan is the number of its pose: `points` is (1, 3), and its first coordinate is the number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax.deeppointmap.compact_scans import CompactElements, CompactImage, CompactScan, expand_elements
from dpmjax.geometry import rigid
from dpmjax.scan.lidar.record import Scan
from dpmjax.scan.lidar.surfaces import surface_of_elements
from dpmjax.slam import Alignment, LocalMap, Match, Proposal, Submap

EMPTY = np.zeros((0, 3))
NO_IMAGE = CompactImage(90, 0, *(np.zeros((0, 180), np.uint8),) * 2)


def compact_of(number: int) -> CompactScan:
    """A keyframe of one element, whose first coordinate is the number of the scan."""
    elements = CompactElements(
        1.0, np.array([[number, 0, 0]], np.int16), np.array([[0, 0, 127]], np.int8), np.array([255], np.uint8), ONE
    )
    return CompactScan(elements, np.zeros((1, 2), np.int8), np.ones(1, np.float32), np.zeros(1, np.int8), NO_IMAGE)


ONE = np.ones(1, bool)


def number_of(compact: CompactScan) -> int:
    """The number of the scan of a keyframe."""
    return int(compact.elements.positions[0, 0])


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


def number_of_scan(scan: Scan) -> int:
    return round(float(scan.surface.points[0, 0]))


@dataclass(frozen=True)
class TruthGeometry:
    """Alignment is right up to noise where a start is near the truth, and fails elsewhere."""

    T_world_scan: np.ndarray
    sigma_m: float = 0.01
    sigma_rad: float = 0.001
    seed: int = 0
    failures: frozenset[int] = frozenset()

    def thin(self, points: np.ndarray) -> Scan | None:
        if not len(points):
            return None
        elements = expand_elements(compact_of(int(points[0, 0])).elements)
        return Scan(surface_of_elements(elements), None, extent_m=10.0)

    def align(self, local_map: LocalMap, scan: Scan, T_map_scan: np.ndarray) -> Alignment:
        return self.search(local_map, scan, T_map_scan[None])

    def search(self, local_map: LocalMap, scan: Scan, T_map_scan: np.ndarray) -> Alignment:
        # Relative to the last keyframe: odometry drifts.
        T_map_last, positions, *_ = local_map.keyframes[0]
        last, number = round(float(positions[0, 0])), number_of_scan(scan)
        rng = np.random.default_rng([self.seed, number, last])
        T = T_map_last @ rigid.inverse(self.T_world_scan[last]) @ self.T_world_scan[number]
        apart_m = np.linalg.norm(T_map_scan[:, :3, 3] - T[:3, 3], axis=1).min()
        if number != last:
            T = T @ noise(rng, self.sigma_m, self.sigma_rad)
        information = np.diag(np.repeat([1 / max(self.sigma_m, 1e-3) ** 2, 1 / max(self.sigma_rad, 1e-4) ** 2], 3))
        if apart_m >= 5.0 or number in self.failures:
            return Alignment(T_map_scan[0], 0.0, 0.5, -1.0, information)
        return Alignment(T, 0.9, 0.0, 0.9, information)

    def other_motions(self, T_last_scan: np.ndarray, extent_m: float) -> np.ndarray:
        return T_last_scan[None]


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

    def encode(self, scan: Scan) -> CompactScan:
        return compact_of(number_of_scan(scan))

    def propose(self, source: CompactScan, target: CompactScan, num_motions: int) -> Proposal:
        match = self._match(number_of(source), number_of(target))
        return Proposal(match.T_target_source[None], match.probability)

    def vector(self, scan: CompactScan) -> np.ndarray:
        # Random Fourier features: the cosine of two places falls with their distance.
        rng = np.random.default_rng(7)
        waves, phases = rng.normal(0, 1 / 10.0, (2, 256)), rng.uniform(0, 2 * np.pi, 256)
        return np.cos(self.T_world_scan[number_of(scan)][:2, 3] @ waves + phases)

    def register(self, pairs: list[tuple[Submap, Submap]]) -> list[Match]:
        return [self._match(number_of(source.scans[0]), number_of(target.scans[0])) for source, target in pairs]

    def match(self, source: Submap, target: Submap) -> Match:
        return self._match(number_of(source.scans[0]), number_of(target.scans[0]))

    def overlaps(self, source: CompactScan, targets: list[CompactScan]) -> np.ndarray:
        rows = [number_of(target) for target in targets]
        apart = self.T_world_scan[rows][:, :2, 3] - self.T_world_scan[number_of(source)][:2, 3]
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

    def overlaps(self, source: CompactScan, targets: list[CompactScan]) -> np.ndarray:
        rng = np.random.default_rng([self.seed, number_of(source), len(targets), 5])
        is_wrong = rng.random(len(targets)) < self.gross_share
        return np.where(is_wrong, rng.random(len(targets)), super().overlaps(source, targets))
