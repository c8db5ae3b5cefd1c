"""Registration of a set of 3-D scans without any poses or order.

Pairs that may overlap are registered. Motions join the scans to parts, the most probable motions first. Less probable
motions join two parts if several of them agree. Parts that no motion joins have frames of their own.

Each part is refined jointly (Borrmann et al. 2008: globally consistent scans). Near scans are aligned pair by pair from
their present poses, and all these motions make a pose graph. So all scans with a common surface constrain a pose. In a
chain of alignments, a single scan would constrain it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from dpmjax.deeppointmap.encoding import descriptors_of, pooled_vector, prepare_scans
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.overlap_prediction import overlap_pairs
from dpmjax.deeppointmap.registration import register_each
from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import are_near
from dpmjax.pose_graph.graph import Edges, PoseGraph
from dpmjax.pose_graph.optimize import ROBUST, optimize_pose_graph
from dpmjax.progress import progress_bar
from dpmjax.reading import read_path
from dpmjax.scan.lidar.align import AlignmentLevel, align_on_host
from dpmjax.scan.lidar.pairs import nearest_planes
from dpmjax.scan.lidar.record import Scan
from dpmjax.scan.lidar.slide import scattered_information, with_least_covariance
from dpmjax.scan.lidar.surfaces import Surface
from dpmjax.types import Information, Pose, Poses, RawScan

# Number of scans with the most similar vectors whose overlap with a scan is predicted, and number of the most probable
# ones that are registered: fewer leave scans alone, more take longer.
NUM_SIMILAR, NUM_REGISTERED = 16, 6

# Parts are joined where the probabilities of agreeing motions add up to this, and those of agreeing contradicting
# ones to at most this share of it.
SURE, MAX_RIVAL = 0.9, 0.5

# Number of pairs that are registered between two counts of the bar.
_BATCH = 8

# Two motions agree if they put a scan to the same place.
AGREE_M, AGREE_RAD = 2.0, math.radians(5.0)

# Alignment of a pair from nearly right poses. A larger radius joins different surfaces.
NEAR = (AlignmentLevel(1.0, 3000, 8), AlignmentLevel(0.4, 6000, 10))

# Least standard deviation of an aligned pair: systematic errors of the lidar.
FLOOR_M, FLOOR_RAD = 0.01, math.radians(0.05)

# Elements of the pairs whose residuals give the information, and their largest distance.
NUM_SAMPLES, RADIUS_M = 3000, 0.5


class PairMotion(NamedTuple):
    """A registered pair.

    Attributes:
        source: row of a scan.
        target: row of the second scan.
        T_target_source: its motion.
        confidence: probability that the motion is right.
    """

    source: int
    target: int
    T_target_source: Pose
    confidence: float


class RegisteredClouds(NamedTuple):
    """Poses of a set of scans.

    Attributes:
        T_world_scan: (n, 4, 4) float64 poses; the world of each part is the frame of its first scan.
        part: (n,) number of the part of each scan, from 0. Poses of different parts cannot be compared.
        pairs: all registered pairs, the most probable ones first.
    """

    T_world_scan: Poses
    part: Int[np.ndarray, " n"]
    pairs: tuple[PairMotion, ...]

    @property
    def is_joined(self) -> bool:
        """True if all scans have one frame."""
        return not self.part.any()


def register_unposed(model: Model, scans: Sequence[RawScan] | Path, *, progress: bool = True) -> RegisteredClouds:
    """Registers 3-D scans that have no poses and no order; takes some seconds a scan.

    Args:
        model: a trained model.
        scans: two or more, (n, 3) points in metres, each in the frame of its lidar, or their files; or a folder.
        progress: False shows no bars.

    Returns:
        The poses and their parts. Poses of one part can be compared.

    Raises:
        ValueError: there are fewer than two scans, or the points of one are no real numbers (n, 3).
    """
    given: Sequence[RawScan] = read_path(scans, "io.open_lidar_sequence")
    if len(given) < 2:
        raise ValueError(f"scans: expected two or more, got {len(given)}")
    with progress_bar("encode", given, unit="scans", is_shown=progress) as bar:
        prepared = prepare_scans(model, bar)
    pairs = _probable_pairs(model, prepared)
    with progress_bar("register", total=len(pairs), unit="pairs", is_shown=progress) as bar:
        found = []
        for begin in range(0, len(pairs), _BATCH):
            some = pairs[begin : begin + _BATCH]
            found += register_each(model, [(prepared[a], prepared[b]) for a, b in some])
            bar.update(len(some))
    motions = [
        PairMotion(*pair, np.asarray(match.T_target_source, np.float64), float(match.confidence))
        for pair, match in zip(pairs, found, strict=True)
    ]
    motions.sort(key=lambda motion: -motion.confidence)
    T_world, part = join_scans(motions, len(given))
    for number in range(part.max() + 1):
        rows = np.flatnonzero(part == number)
        surfaces = [prepared[row].surface for row in rows]
        T_world[rows] = refine_jointly(surfaces, T_world[rows], scans_in_reach(surfaces, T_world[rows]))
    first = np.array([np.flatnonzero(part == number)[0] for number in part])
    return RegisteredClouds(rigid.inverse(T_world[first]) @ T_world, part, tuple(motions))


def _probable_pairs(model: Model, scans: Sequence[Scan]) -> list[tuple[int, int]]:
    """Returns the pairs of each scan with the scans that it most probably overlaps, each pair once."""
    clouds = [descriptors_of(scan) for scan in scans]
    vectors = np.stack([pooled_vector(cloud.described) for cloud in clouds])
    similarity = vectors @ vectors.T
    np.fill_diagonal(similarity, -np.inf)
    nearest = np.argsort(-similarity, axis=1)[:, : min(NUM_SIMILAR, len(scans) - 1)]
    ends = {tuple(sorted((row, int(other)))) for row, others in enumerate(nearest) for other in others}
    pairs = np.array(sorted(ends))
    described = [cloud.described for cloud in clouds]
    overlaps = np.asarray(overlap_pairs(model, [described[a] for a, _ in pairs], [described[b] for _, b in pairs]))
    is_taken = np.zeros(len(pairs), bool)
    for row in range(len(scans)):
        own = np.flatnonzero((pairs == row).any(axis=1))
        best = own[np.argsort(-overlaps[own], kind="stable")[:NUM_REGISTERED]]
        # Least probability of overlap of a registered pair.
        is_taken[best[overlaps[best] >= 0.1]] = True
    return [(int(a), int(b)) for a, b in pairs[is_taken]]


def join_scans(motions: Sequence[PairMotion], count: int) -> tuple[Poses, Int[np.ndarray, " n"]]:
    """Joins scans to parts, by the motions with most support first.

    Args:
        motions: of pairs, the most probable first.
        count: number of scans.

    Returns:
        Poses of the scans in the frames of their parts, and the part number of each scan.
    """
    T_world, part = np.tile(np.eye(4), (count, 1, 1)), np.arange(count)
    while (best := _best_supported(motions, T_world, part)) is not None:
        into, moved = part[best.target], part[best.source]
        T_new_world = T_world[best.target] @ best.T_target_source @ rigid.inverse(T_world[best.source])
        rows = part == moved
        T_world[rows] = T_new_world @ T_world[rows]
        part[rows] = into
    return T_world, np.unique(part, return_inverse=True)[1]


def _best_supported(motions: Sequence[PairMotion], T_world: Poses, part: np.ndarray) -> PairMotion | None:
    """Returns the motion with most support between two parts; None if no motion has enough."""
    between: dict[tuple[int, ...], list[_Joint]] = {}
    for motion in motions:
        ends = part[motion.source], part[motion.target]
        # Less probable motions support nothing.
        if ends[0] != ends[1] and motion.confidence >= 0.05:
            T = T_world[motion.target] @ motion.T_target_source @ rigid.inverse(T_world[motion.source])
            at = T_world[motion.source if ends[0] < ends[1] else motion.target]
            joint = _Joint(motion, T if ends[0] < ends[1] else rigid.inverse(T), at)
            between.setdefault(tuple(sorted(ends)), []).append(joint)
    best, most = None, SURE
    for joints in between.values():
        confidences = np.array([joint.motion.confidence for joint in joints])
        agrees = np.array([[one.agrees(other) for other in joints] for one in joints])
        supports = agrees @ confidences
        first = int(supports.argmax())
        rival = supports[~agrees[first]].max(initial=0.0)
        if supports[first] >= most and rival <= MAX_RIVAL * supports[first]:
            best, most = joints[first].motion, supports[first]
    return best


class _Joint(NamedTuple):
    # A motion between two parts: the motion of their worlds, and the pose of its scan in the first part.
    motion: PairMotion
    T_second_first: Pose
    T_first_scan: Pose

    def agrees(self, other: _Joint) -> bool:
        """Returns True if both motions put the scan of this one at the same place."""
        T_first_scan = self.T_first_scan
        return are_near(self.T_second_first @ T_first_scan, other.T_second_first @ T_first_scan, AGREE_M, AGREE_RAD)


def refine_jointly(surfaces: Sequence[Surface], T_world_scan: Poses, pairs: Int[np.ndarray, "p 2"]) -> Poses:
    """Refines the poses of scans by the alignments of pairs that see the same surfaces.

    Args:
        surfaces: surface of each of n scans.
        T_world_scan: (n, 4, 4) poses, right within about a metre and 5 degrees relative to each other.
        pairs: rows of scans that overlap; each pair once.

    Returns:
        The poses. The first scan keeps its pose, and so do scans without a pair.
    """
    T_world = np.array(T_world_scan, np.float64)
    # Rounds of alignment and optimisation: after the second the poses move by millimetres.
    for _ in range(2):
        found = [(pair, align_pair(surfaces, T_world, pair)) for pair in pairs.tolist()]
        kept = [(pair, *edge) for pair, edge in found if edge is not None]
        if not kept:
            break
        ends, T, information = zip(*kept, strict=True)
        source, target = np.array(ends).T
        edges = Edges(source, target, np.stack(T), np.stack(information))
        T_before = T_world[0]
        T_world = optimize_pose_graph(PoseGraph.create(T_world, edges), ROBUST).graph.poses
        T_world = T_before @ rigid.inverse(T_world[0]) @ T_world
    return T_world


def scans_in_reach(surfaces: Sequence[Surface], T_world_scan: Poses) -> Int[np.ndarray, "p 2"]:
    """Finds scans that are nearer to each other than the median range of both.

    Args:
        surfaces: surface of each of n scans.
        T_world_scan: (n, 4, 4) their poses.

    Returns:
        Rows of each pair, the later scan first.
    """
    extents = np.array([np.median(np.linalg.norm(surface.points, axis=1)) for surface in surfaces])
    apart = np.linalg.norm(T_world_scan[:, None, :3, 3] - T_world_scan[:, :3, 3], axis=-1)
    # Scans are near where their distance is less than this share of their median ranges. A smaller share joins fewer
    # scans.
    return np.argwhere(np.tril(apart < 1.0 * np.minimum.outer(extents, extents), k=-1))


def align_pair(
    surfaces: Sequence[Surface], T_world_scan: Poses, pair: Sequence[int]
) -> tuple[Pose, Information] | None:
    """Aligns two scans from their present poses.

    Args:
        surfaces: surface of each scan.
        T_world_scan: present poses.
        pair: rows of the source and the target.

    Returns:
        T_target_source and its information; None if the result is far from the present poses.
    """
    source, target = (surfaces[row] for row in pair)
    T_start = rigid.inverse(T_world_scan[pair[1]]) @ T_world_scan[pair[0]]
    found = align_on_host(source, target, T_start[None], NEAR)
    T = found.T_target_source[0]
    # An alignment that moves farther from the present poses than this has found other surfaces.
    if not np.isfinite(found.rmse[0]) or not are_near(T_start, T, *(1.0, math.radians(5.0))):
        return None
    planes = nearest_planes(source, target, T[None], RADIUS_M, NUM_SAMPLES).take(0)
    information = scattered_information(planes.take(planes.is_paired), T)
    return T, with_least_covariance(information, FLOOR_M, FLOOR_RAD)
