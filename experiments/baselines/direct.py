"""Direct optimisation of the poses: DeepMapping's loss without L-Net, from zero, by L-BFGS (a baseline of the paper).

By Adam it is `fit_deepmapping` with a single phase of free poses.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from dpmjax.deepmapping.config import DeepMappingConfig
from dpmjax.deepmapping.fit import as_scan_set, init, map_logits, measure_reach
from dpmjax.deepmapping.objective import Batch, registration_loss
from dpmjax.types import ScanSet


def optimize_directly(
    scans: ScanSet, config: DeepMappingConfig, *, num_iterations: int, key: jax.Array
) -> NDArray[np.float64]:
    """Poses and map from zero by L-BFGS on the loss of the config's last warm phase, its random samples held.

    Args:
        scans: n planar scans.
        config: settings; its last warm phase gives the loss.
        num_iterations: of L-BFGS.
        key: for the map's weights and the samples.

    Returns:
        (n, 3) poses, unit of the scans.
    """
    import jaxopt

    scans = as_scan_set(scans)
    reach = measure_reach(scans)
    scans = ScanSet(points=scans.points / reach, mask=scans.mask)
    phase = config.warm_phases[-1]
    start = init(key, scans, config, start_poses=jnp.zeros((scans.mask.shape[0], 3)))
    stride = max(1, -(-scans.mask.shape[1] // phase.beams_per_step))
    rows = jnp.arange(scans.mask.shape[0])
    batch = Batch(scans.points[:, ::stride], scans.mask[:, ::stride], rows, jnp.zeros_like(rows))

    def loss(moving: tuple[Array, Any]) -> Float[Array, ""]:
        poses, occupancy = moving
        state = start.replace(params=start.params.replace(occupancy=occupancy))  # type: ignore[attr-defined]
        value, _ = registration_loss(poses, batch, map_logits(state, config), phase, jnp.ones(()), key=key)
        return value

    solver = jaxopt.LBFGS(loss, maxiter=num_iterations, history_size=10, linesearch="backtracking", maxls=20)
    solution, _ = solver.run((start.params.poses, start.params.occupancy))
    return np.asarray(solution[0], np.float64) * [reach, reach, 1.0]
