"""Registers eight data sets at once: `jax.vmap` over the whole fit of DeepMapping, L-Net and M-Net included.

    python examples/07_fit_many.py

All sets need equal shapes. Each number is the error of one walk after its fit, in pixels of its floor plan.
"""

import jax
import jax.numpy as jnp

import dpmjax
from dpmjax import deepmapping, simulation

walks = [simulation.simulate_sequence(seed, 8, num_beams=64) for seed in range(8)]
config = deepmapping.with_steps(deepmapping.preset("fast"), 60)

# The data of a problem are arrays in units of the typical range; stacked, they are eight data sets.
data, units = zip(*(deepmapping.mapping_data(walk) for walk in walks), strict=True)
problem = deepmapping.mapping_problem(config, data[0])
stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *data)
references = jnp.stack([walk.reference_poses[:, :2] / unit for walk, unit in zip(walks, units, strict=True)])


@jax.jit
@jax.vmap
def fit_one(data, reference, key):
    """Fits one data set; returns its error and the losses of the last steps."""
    _, report = deepmapping.solve(problem, data, key=key)
    return dpmjax.absolute_trajectory_error(report.poses[:, :2], reference), report.losses


errors, losses = fit_one(stacked, references, jax.random.split(jax.random.key(0), 8))
for number, unit in enumerate(units):
    print(f"walk {number}: ATE {errors[number] * unit:.1f} px, loss {losses[number].mean():.3f}")
