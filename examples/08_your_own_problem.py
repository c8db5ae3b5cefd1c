"""A registration problem of your own in DeepMapping's engine: free poses, and the Chamfer distance of neighbours."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import optax

import dpmjax
from dpmjax import deepmapping, simulation
from dpmjax.geometry import se2


@dataclass(frozen=True)
class Phase:
    """Settings of the only phase."""

    name: str = "free poses"
    num_steps: int = 600
    learning_rate: float = 0.01


def loss(config, phase, poses, scans, step, key):
    """Returns the mean distance of each scan to the next one in the world, and no further terms."""
    points_world = jax.vmap(se2.transform_points)(poses, scans)
    return jnp.mean(jax.vmap(dpmjax.chamfer_distance)(points_world[1:], points_world[:-1])), ()


walk = simulation.simulate_sequence(0, 24)
unit = 100.0  # Pixels in one unit of the problem, so that one learning rate suits metres and radians.
scans = jnp.asarray(walk.points[:, ::2]) / unit
problem = deepmapping.Problem(
    config=None, phases=(Phase(),), init=lambda config, key, scans: jnp.zeros((len(scans), 3)),
    optimizer=lambda config, phase: optax.adam(optax.cosine_decay_schedule(phase.learning_rate, phase.num_steps)),
    loss=loss, poses=lambda config, phase, poses, scans: poses, next_phase=lambda *_: None, steps_per_call=100,
)  # fmt: skip
fitted = deepmapping.fit(problem, scans, key=jax.random.key(0))
error = dpmjax.absolute_trajectory_error(fitted.poses[:, :2] * unit, walk.reference_poses[:, :2])
print(f"ATE {error:.2f} {walk.unit} after {fitted.run_s:.1f} s")
