"""Direct optimisation without L-Net by jaxopt: of DeepMapping's loss (a baseline of the paper), and of the toy.

By Adam the direct form is `fit_deepmapping` with the settings of `as_direct`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import jaxopt
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from dpmjax import ScanSet
from dpmjax.deepmapping import DeepMappingConfig, init, planar_data, planar_problem, toy_loss


def optimize_directly(
    scans: ScanSet, config: DeepMappingConfig, *, num_iterations: int, key: jax.Array
) -> NDArray[np.float64]:
    """Poses and map from zero by L-BFGS on the loss at the end of the last warm phase, its random samples held.

    Args:
        scans: n planar scans.
        config: settings; its last warm phase gives the loss.
        num_iterations: of L-BFGS.
        key: for the map's weights and the samples.

    Returns:
        (n, 3) poses, unit of the scans.
    """
    data, unit = planar_data(scans, np.zeros((len(scans.points), 3)))
    phase = replace(config.warm_phases[-1], scans_per_step=len(scans.points))
    problem = planar_problem(replace(config, warm_phases=(phase,)), data)
    start = init(problem, data, key=key).params

    def loss(moving: tuple[Array, Any]) -> Float[Array, ""]:
        params = replace(start, poses=moving[0], occupancy=moving[1])
        return problem.loss(problem.config, phase, params, data, jnp.asarray(phase.num_steps), key)[0]

    solver = jaxopt.LBFGS(loss, maxiter=num_iterations, history_size=10, linesearch="backtracking", maxls=20)
    solution, _ = solver.run((start.poses, start.occupancy))
    return np.asarray(solution[0], np.float64) * [unit, unit, 1.0]


def minimize_toy(
    x0: Float[Array, ""], method: Literal["gradient-descent", "lbfgs", "bfgs"], *, max_iterations: int = 1000
) -> Float[Array, ""]:
    """The direct form of the toy by a solver of jaxopt with its own line search.

    Args:
        x0: where to start.
        method: "gradient-descent" (with line search and momentum), "lbfgs" or "bfgs".
        max_iterations: the largest number of iterations.

    Returns:
        Where the solver ends.

    Raises:
        ValueError: the method is unknown.
    """
    solvers = {"gradient-descent": jaxopt.GradientDescent, "lbfgs": jaxopt.LBFGS, "bfgs": jaxopt.BFGS}
    if method not in solvers:
        raise ValueError(f"method: expected one of {', '.join(solvers)}, got {method!r}")
    return solvers[method](fun=toy_loss, maxiter=max_iterations).run(x0).params
