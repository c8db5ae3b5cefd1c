"""Planar scans without poses become one map: the whole pipeline first, then DeepMapping's networks alone.

Each takes about a minute and prints nothing meanwhile.
"""

import jax

import dpmjax
from dpmjax import simulation

# 96 scans of 256 beams in a simulated office; lengths are pixels of its floor plan.
walk = simulation.simulate_sequence(0, 96)
reference = walk.reference_poses[:, :2]

# Start, fit, refinement; the best candidate is kept without a reference.
result = dpmjax.register_scans(walk.points, key=jax.random.key(0))
error = dpmjax.absolute_trajectory_error(result.poses[:, :2], reference)
print(f"kept {result.kept!r} of {list(result.candidates)}")
print(f"ATE {error:.3f} {walk.unit}, trusted: {result.assessment.is_trusted}")

# L-Net and M-Net alone, from zero poses: 1,200 steps on these 96 scans.
fit = dpmjax.fit_deepmapping(walk.points, key=jax.random.key(0))
error = dpmjax.absolute_trajectory_error(fit.poses[:, :2], reference)
print(f"DeepMapping alone: ATE {error:.3f} {walk.unit}, poses {fit.T_world_scan.shape}")
