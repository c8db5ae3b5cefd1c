"""Loop closure and graph alone, over whole drives: truth plus noise stands in place of the matcher and of odometry.

Routes of 4 km wander through towns of blocks, a scan a metre, and come back to streets in both directions. Odometry is
wrong by 1 cm and 1 mrad (standard deviations) a scan. Registrations have errors of 10 cm and 10 mrad. One in five is
grossly wrong, with a P(correct) as high as that of right ones; the overlap probability of one pair in five is random. A
loop that was accepted is wrong beyond 2 m or 5 degrees.

The second part drives 5,100 scans and counts the CPU time of a scan and the memory around scan 500 and around scan
5,000. It drives twice and counts the second time: in the first the optimiser compiles for each size of graph. The parts
that are replaced cost the same at any length of a drive, so their 200 ms (5 scans a second) are added where the two
costs are compared.
"""

from __future__ import annotations

import pickle
import resource
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import Row
from dpmjax.geometry import rigid
from dpmjax.metrics import absolute_trajectory_error, registration_recall
from dpmjax.simulation import route_poses
from dpmjax.slam import SlamConfig, SlamMethods, SlamResult, SlamState, finish_slam, init_slam, local_map_of, step_slam
from tests.slam.truth import MistakenMatcher, TruthGeometry, scans_of

ROUTE_STREAM = 77
LENGTH_M, BLOCK_M, STEP_M = 4000.0, 100.0, 1.0
EARLY, LATE, WINDOW = 500, 5000, 200
REPLACED_MS = 200.0


class Proof(NamedTuple):
    """Result of a drive with gross errors.

    Attributes:
        ate_m: of all scans.
        ate_odometry_m: the same before loops.
        num_loops: accepted.
        num_wrong: number of wrong ones, beyond 2 m or 5 degrees.
        num_opposite: number of those between scans of opposite headings.
    """

    ate_m: float
    ate_odometry_m: float
    num_loops: int
    num_wrong: int
    num_opposite: int


def run(quick: bool) -> list[Row]:
    """Measures all seeds, then the cost along a long drive."""
    seeds, length_m = (2, 1000.0) if quick else (20, LENGTH_M)
    rows, proofs = [], []
    for seed in range(seeds):
        truth = route(seed, length_m)
        proofs.append(judged(drive(truth, seed), truth))
        print(f"seed {seed}: {proofs[-1]}", file=sys.stderr, flush=True)
        rows += proof_rows(f"seed {seed}, {len(truth)} scans", proofs[-1])
    rows += summary_rows(f"{seeds} seeds, {length_m / 1000:g} km", proofs)
    return rows if quick else rows + growth_rows()


def route(seed: int, length_m: float, kind: str = "wander") -> np.ndarray:
    """Returns poses on the lane of a route through streets, one every metre."""
    rng = np.random.default_rng([ROUTE_STREAM, seed])
    return route_poses(rng, kind, length_m, block_m=BLOCK_M, step_m=STEP_M)


def methods_for(truth: np.ndarray, seed: int) -> SlamMethods:
    """Returns what stands in place of the networks and of the geometry."""
    return SlamMethods(MistakenMatcher(truth, seed=seed), TruthGeometry(truth, seed=seed), SlamConfig())


def drive(truth: np.ndarray, seed: int) -> SlamResult:
    """Drives along the true poses."""
    methods, state, reports = methods_for(truth, seed), init_slam(), []
    for scan in scans_of(range(len(truth))):
        state, report = step_slam(methods, state, scan)
        reports.append(report)
    return finish_slam(state, reports, methods.config)


def judged(result: SlamResult, truth: np.ndarray) -> Proof:
    """Compares a run with the truth."""
    loops = [loop for loop in result.loops if loop.status == "accepted"]
    source, target = (truth[result.keyframes[[getattr(loop, end) for loop in loops]]] for end in ("source", "target"))
    found = np.reshape([loop.T_target_source for loop in loops], (-1, 4, 4))
    right = registration_recall(found, rigid.inverse(target) @ source).is_right
    is_opposite = np.einsum("ni,ni->n", source[:, :3, 0], target[:, :3, 0]) < 0
    ate_m, ate_odometry_m = (
        absolute_trajectory_error(poses[:, :3, 3], truth[:, :3, 3])
        for poses in (result.T_world_scan, result.T_odometry_scan)
    )
    return Proof(ate_m, ate_odometry_m, len(loops), int((~right).sum()), int(is_opposite.sum()))


def proof_rows(case: str, proof: Proof) -> list[Row]:
    """Returns the rows of one drive."""
    names = ("ATE", "ATE of odometry", "loops", "wrong loops", "loops, other direction")
    return [Row(case, name, value, "m" if "ATE" in name else "") for name, value in zip(names, proof, strict=True)]


def summary_rows(case: str, proofs: list[Proof]) -> list[Row]:
    """Returns the rows of all drives together."""
    ates = np.array([proof.ate_m for proof in proofs])
    return [
        Row(case, "median ATE", float(np.median(ates)), "m"),
        Row(case, "largest ATE", float(ates.max()), "m"),
        Row(case, "drives below 1 m", int((ates < 1.0).sum()), ""),
        Row(case, "wrong loops", sum(proof.num_wrong for proof in proofs), ""),
    ]


class Cost(NamedTuple):
    """Cost of a scan at one moment of a drive.

    Attributes:
        cpu_ms: mean over the scans around it.
        map_mb: keyframes, edges and loop candidates.
        front_end_mb: the local map after a keyframe, and all further preparation of the next scan.
        resident_mb: memory of the whole process.
    """

    cpu_ms: float
    map_mb: float
    front_end_mb: float
    resident_mb: float


def growth_rows() -> list[Row]:
    """Returns the rows of a drive of 5,100 scans."""
    truth = route(0, 1.5 * LATE * STEP_M)[: LATE + WINDOW // 2]
    _, (early, late) = costs(truth, (EARLY, LATE)), costs(truth, (EARLY, LATE))
    rows = []
    for number, cost in ((EARLY, early), (LATE, late)):
        names = ("CPU time a scan, parts replaced", "map and loop candidates", "front end", "memory of the process")
        units = ("ms", "MB", "MB", "MB")
        rows += [Row(f"around scan {number}", *named) for named in zip(names, cost, units, strict=True)]
    ratio = (REPLACED_MS + late.cpu_ms) / (REPLACED_MS + early.cpu_ms)
    rows.append(Row(f"scan {LATE} / scan {EARLY}", f"cost a scan, with {REPLACED_MS:g} ms for the parts", ratio, ""))
    return rows


def costs(truth: np.ndarray, moments: tuple[int, int]) -> list[Cost]:
    """Drives once, and counts around each moment."""
    methods, state, found = methods_for(truth, 0), init_slam(), []
    clocks = [time.process_time()]
    for scan in scans_of(range(len(truth))):
        state, _ = step_slam(methods, state, scan)
        clocks.append(time.process_time())
        if len(clocks) - 1 in moments:
            found.append((_megabytes(state.slam_map, state.loops), front_end_mb(methods, state), resident_mb()))
    half = WINDOW // 2
    cpu_ms = [1e3 * (clocks[moment + half] - clocks[moment - half]) / WINDOW for moment in moments]
    return [Cost(ms, *memory) for ms, memory in zip(cpu_ms, found, strict=True)]


def resident_mb() -> float:
    """Returns the memory that this process holds now; NaN where the system does not tell."""
    path = Path("/proc/self/statm")
    if not path.exists():
        return float("nan")
    return int(path.read_text().split()[1]) * resource.getpagesize() / 1e6


def front_end_mb(methods: SlamMethods, state: SlamState) -> float:
    """Returns the size of the state of odometry; the search tree is made of the points."""
    local_map = local_map_of(state.slam_map, state.front_end.recent, methods.config.odometry)
    local_map = local_map._replace(surface=local_map.surface._replace(tree=None))
    return _megabytes(state.front_end._replace(local_map=local_map))


def _megabytes(*parts: object) -> float:
    return len(pickle.dumps(parts)) / 1e6
