"""Baselines of the DeepMapping paper: its chain of ICP, and three that stand on other packages (extra `baselines`).

L-BFGS by jaxopt on DeepMapping's loss without L-Net. Particle swarms of evosax over all poses of a walk. Multiway
registration by Open3D, whose pairs are registered by iterated closest points. Neighbours in time are sure edges of a
pose graph, and all further pairs uncertain ones. A line process removes wrong edges (Choi, Zhou and Koltun, Robust
Reconstruction of Indoor Scenes, CVPR 2015). By Adam the direct form is `fit_deepmapping` with the settings of
`as_direct`.

The chain aligns each scan onto the one before, from the identity. It is a textbook ICP: nearest points, equal weights,
no search, no robust kernel. The steps of `incremental_icp` are searched where they are unclear: another method.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from dpmjax import ScanSet, estimate_normals
from dpmjax.deepmapping import DeepMappingConfig, init, mapping_data, mapping_problem
from dpmjax.geometry import rigid, se2, typical_range
from dpmjax.metrics import align_rigid


def optimize_directly(scans: ScanSet, config: DeepMappingConfig, *, num_iterations: int, key: jax.Array) -> np.ndarray:
    """Returns poses from zero by L-BFGS on the loss at the end of the last warm phase, its random samples held.

    Args:
        scans: n planar scans.
        config: settings; its last warm phase gives the loss.
        num_iterations: number of iterations of L-BFGS.
        key: key for the map's weights and the samples.

    Returns:
        (n, 3) poses, unit of the scans.
    """
    import jaxopt

    data, unit = mapping_data(scans, np.zeros((len(scans.points), 3)))
    phase = replace(config.warm_phases[-1], scans_per_step=len(scans.points))
    problem = mapping_problem(replace(config, warm_phases=(phase,)), data)
    start = init(problem, data, key=key).params

    def loss(moving: tuple[Array, Any]) -> Float[Array, ""]:
        params = replace(start, poses=moving[0], occupancy=moving[1])
        return problem.loss(problem.config, phase, params, data, jnp.asarray(phase.num_steps), key)[0]

    solver = jaxopt.LBFGS(loss, maxiter=num_iterations, history_size=10, linesearch="backtracking", maxls=20)
    solution, _ = solver.run((start.poses, start.occupancy))
    return np.asarray(solution[0], np.float64) * [unit, unit, 1.0]


# Poses that a swarm tries at a time, iterations of a swarm, and beams of each scan that are compared.
NUM_PARTICLES, NUM_ITERATIONS, NUM_BEAMS = 32, 60, 86
# Particles over all poses start within this: one typical range along each axis, and half a turn.
POSE_SPREAD = (1.0, 1.0, np.pi)


def swarm_poses(scans: ScanSet, config: DeepMappingConfig, *, cpu_s: float, key: jax.Array) -> np.ndarray:
    """Returns poses by swarms over all poses at once on the Chamfer distance of the fit (DeepMapping section 4.1).

    As in the paper, rounds of fresh swarms follow each other until a time is used. Without evosax it ends in a
    ModuleNotFoundError.

    Args:
        scans: n scans in order of time.
        config: settings; its first cold phase gives the loss, here of the whole set.
        cpu_s: process time of all rounds, without compilation; a round that has begun is finished.
        key: key of the swarms and of the pairs that are compared.

    Returns:
        (n, 3) T_world_scan, x, y, heading; the first one zero.
    """
    from evosax.algorithms import PSO

    data, unit = mapping_data(scans)
    whole = {"poses": "free", "scans_per_window": None, "occupancy_weight": 0.0, "beams_per_step": NUM_BEAMS}
    phase = replace(config.cold_phases[0], **whole, scans_per_step=len(scans.points))
    problem = mapping_problem(replace(config, cold_phases=(phase,)), data)
    start, count = init(problem, data, key=key).params, len(scans.points) - 1
    widths = jnp.array(POSE_SPREAD)

    def misfit(particle: Float[Array, " u"]) -> Float[Array, ""]:
        poses = jnp.concatenate([jnp.zeros((1, 3)), particle.reshape(count, 3) * widths])
        return problem.loss(problem.config, phase, replace(start, poses=poses), data, jnp.asarray(0), key)[0]

    algorithm = PSO(population_size=NUM_PARTICLES, solution=jnp.zeros(3 * count))
    misfits = partial(jax.lax.map, misfit)

    @jax.jit
    def run_round(key: jax.Array) -> tuple[Array, Array]:
        start_key, init_key, key = jax.random.split(key, 3)
        particles = jax.random.uniform(start_key, (NUM_PARTICLES, 3 * count), minval=-1.0, maxval=1.0)
        state = algorithm.init(init_key, particles, misfits(particles), algorithm.default_params)

        def iterate(state: Any, key: jax.Array) -> tuple[Any, None]:
            ask_key, tell_key = jax.random.split(key)
            particles, state = algorithm.ask(ask_key, state, algorithm.default_params)
            state, _ = algorithm.tell(tell_key, particles, misfits(particles), state, algorithm.default_params)
            return state, None

        state, _ = jax.lax.scan(iterate, state, jax.random.split(key, NUM_ITERATIONS))
        return state.best_solution, state.best_fitness

    program = run_round.lower(key).compile()
    best, least, begun, number = jnp.zeros(3 * count), np.inf, time.process_time(), 0
    while number == 0 or time.process_time() - begun < cpu_s:
        particle, value = program(jax.random.fold_in(key, number))
        if float(value) < least:
            best, least = particle, float(value)
        number += 1
    poses = np.asarray(best, np.float64).reshape(count, 3) * np.array(POSE_SPREAD) * [unit, unit, 1.0]
    return np.concatenate([np.zeros((1, 3)), poses])


Floats = NDArray[np.float64]
# Largest distances of matched points in the first round, and in the second round and the graph, in typical ranges of
# the scans.
_COARSE, _FINE = 0.09, 0.0225
# Scans that the start puts nearer than this share of the typical range are matched too.
_RADIUS = 0.3
# Doubtful edges below this confidence are removed.
_PRUNE = 0.25


def multiway(scans: ScanSet) -> np.ndarray:
    """Returns poses of planar scans by Open3D's multiway registration; a ModuleNotFoundError without Open3D.

    Args:
        scans: n scans in order of time.

    Returns:
        (n, 3) T_world_scan, x, y, heading; the first one zero.
    """
    unit = typical_range(scans.points, scans.mask)
    pairs = zip(np.asarray(scans.points), np.asarray(scans.mask), strict=True)
    clouds = [_cloud(np.pad(points[mask], [(0, 0), (0, 1)])) for points, mask in pairs]
    poses = _registered(clouds, unit, is_planar=True)
    planar = np.stack([poses[:, 0, 3], poses[:, 1, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])], -1)
    return se2.relative(planar[0], planar)


def multiway_images(points: Float[np.ndarray, "n h w 3"], mask: Bool[np.ndarray, "n h w"]) -> np.ndarray:
    """Returns poses of depth images by Open3D's multiway registration; a ModuleNotFoundError without Open3D.

    Args:
        points: points of n images in order of time, each in the frame of its camera.
        mask: True where something was measured.

    Returns:
        (n, 4, 4) T_world_camera, the first one the identity.
    """
    unit = typical_range(points, mask)
    clouds = [_cloud(p[m]) for p, m in zip(np.asarray(points), np.asarray(mask), strict=True)]
    for cloud in clouds:
        cloud.estimate_normals()
    return _registered(clouds, unit, is_planar=False)


def _registered(clouds: list[Any], unit: float, *, is_planar: bool) -> np.ndarray:
    """Returns the poses of clouds, (n, 4, 4), the first one the identity; flat ones by points, others by planes.

    Each cloud is matched from where the one before is.
    """
    import open3d

    coarse, fine, registration = _COARSE * unit, _FINE * unit, open3d.pipelines.registration
    graph, estimation = registration.PoseGraph(), registration.TransformationEstimationPointToPlane()
    if is_planar:  # planes of flat clouds leave three directions open
        estimation = registration.TransformationEstimationPointToPoint()

    def add_edge(source: int, target: int, T: np.ndarray, *, is_doubtful: bool) -> np.ndarray:
        """Adds the motion of a pair with its information, matched from a first guess; returns the motion."""
        pair = clouds[source], clouds[target]
        for distance in (coarse, fine):
            T = registration.registration_icp(*pair, distance, T, estimation).transformation
        information = registration.get_information_matrix_from_point_clouds(*pair, fine, T)
        graph.edges.append(registration.PoseGraphEdge(source, target, T, information, uncertain=is_doubtful))
        return T

    T_world = [np.eye(4)]
    for scan in range(1, len(clouds)):
        # An edge maps its source, the earlier scan, into the later one.
        T_world.append(T_world[-1] @ np.linalg.inv(add_edge(scan - 1, scan, np.eye(4), is_doubtful=False)))
    for T_world_scan in T_world:
        graph.nodes.append(registration.PoseGraphNode(T_world_scan))
    placed = np.stack(T_world)
    apart = np.linalg.norm(placed[:, None, :3, 3] - placed[None, :, :3, 3], axis=-1)
    for source, target in np.argwhere(np.triu(apart < _RADIUS * unit, k=2)).tolist():
        add_edge(source, target, rigid.inverse(placed[target]) @ placed[source], is_doubtful=True)
    solver = registration.GlobalOptimizationLevenbergMarquardt()
    limits = registration.GlobalOptimizationConvergenceCriteria()
    option = registration.GlobalOptimizationOption(fine, _PRUNE, reference_node=0)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        registration.global_optimization(graph, solver, limits, option)
    return np.stack([node.pose for node in graph.nodes])


def _cloud(points: np.ndarray) -> Any:
    import open3d

    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))


# Numbers of the published program: a step ends after this many iterations, or when the mean distance changes by less
# than this share of the typical range; a normal is fitted to this many points.
_MAX_ITERATIONS, _TOLERANCE, _NORMAL_NEIGHBOURS = 100, 1e-6, 6


def chain_icp(scans: ScanSet, metric: Literal["point", "plane"]) -> Floats:
    """Registers planar scans by a chain of pairwise ICP.

    Args:
        scans: n scans in the order of time.
        metric: distance to the nearest point (Besl and McKay 1992) or to its line (Chen and Medioni 1992).

    Returns:
        (n, 3) T_world_scan, x, y, heading; the first one zero.
    """
    tolerance = _TOLERANCE * typical_range(scans.points, scans.mask)
    pairs = zip(np.asarray(scans.points, np.float64), np.asarray(scans.mask), strict=True)
    clouds = [points[mask] for points, mask in pairs]
    steps = [align(source, target, metric, tolerance) for target, source in itertools.pairwise(clouds)]
    return se2.chain(np.array(steps).reshape(-1, 3))


def align(source: Floats, target: Floats, metric: Literal["point", "plane"], tolerance: float) -> Floats:
    """Aligns two clouds from the identity by textbook ICP.

    Args:
        source: (n, 2) points.
        target: (m, 2) points.
        metric: distance to the nearest point or to its line.
        tolerance: change of the mean distance below which the iteration ends, unit of the points.

    Returns:
        (3,) T_target_source, x, y, heading.
    """
    from scipy.spatial import KDTree

    tree, pose, before = KDTree(target), np.zeros(3), np.inf
    normals = None
    if metric == "plane":
        normals = np.asarray(estimate_normals(target.astype(np.float32), _NORMAL_NEIGHBOURS).normals, np.float64)
    for _ in range(_MAX_ITERATIONS):
        moved = se2.transform_points(pose, source)
        distance, nearest = tree.query(moved)
        if abs(before - distance.mean()) < tolerance:
            break
        before = distance.mean()
        if normals is None:
            step = se2.from_matrix(align_rigid(moved, target[nearest]))
        else:
            step = _step_to_lines(moved, target[nearest], normals[nearest])
        pose = se2.compose(step, pose)
    return pose


def _step_to_lines(source: Floats, matched: Floats, normals: Floats) -> Floats:
    """Returns the motion of the least sum of squared distances to lines, linear in the angle."""
    turning = source[:, 0] * normals[:, 1] - source[:, 1] * normals[:, 0]
    residuals = ((matched - source) * normals).sum(axis=1)
    return np.linalg.lstsq(np.column_stack([normals, turning]), residuals, rcond=None)[0]
