"""The one-dimensional example of DeepMapping (supplement D, figure 14), and how often its claim holds.

    python -m experiments.toy_1d
    python -m experiments.toy_1d --seeds 100 -o out

Writes toy.png (figure 14), rows.csv and table.md. They have the share of seeds that reach the global minimum, in the
network form and in the direct form, from the same starts, for several initialisations and learning rates. The file
metrics.json also has these shares for three solvers of jaxopt on the direct form.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from tyro.conf import arg

from dpmjax import cli, viz
from dpmjax import deepmapping as dm

FORMS = ("network", "direct")
# Solvers of jaxopt with a line search.
SOLVERS = {"gradient-descent": "GradientDescent", "lbfgs": "LBFGS", "bfgs": "BFGS"}
# Half the way to the next local minimum is 0.31; an end this close is in the right valley and at its bottom.
SAME_PLACE = 0.05
# The picture shows -VIEW to VIEW.
VIEW = 6.0
# The paper's is 2e-4.
LEARNING_RATES = (1e-4, 2e-4, 5e-4, 1e-3)


@dataclass(frozen=True, kw_only=True)
class ToyOptions(cli.RunOptions):
    """Options of the example."""

    seeds: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 1000
    """Starts, all in one vmap."""
    steps: Annotated[int, arg(metavar="N"), cli.Bound(1)] = 1000
    """Steps of descent; the paper's number."""


def main(options: ToyOptions, run: cli.Run) -> cli.Row:
    """Runs all seeds and all variants, draws, and writes the table."""
    cli.require_importable("jaxopt", "the solvers of the direct form")
    run.open()
    paper = dm.ToyConfig(num_steps=options.steps)
    fits = descend(paper, options)
    draw(run, paper, fits)

    def work(initialization: Any, learning_rate: float) -> cli.Row:
        found = descend(replace(paper, initialization=initialization, learning_rate=learning_rate), options)
        return {form: share_at_minimum(path(fit)[:, -1]) for form, fit in found.items()}

    shares = {f"{form} form, gradient descent": share_at_minimum(path(fit)[:, -1]) for form, fit in fits.items()}
    starts = jnp.asarray(path(fits["direct"])[:, 0])
    for solver in SOLVERS:
        descent = jax.jit(jax.vmap(partial(minimize, solver=solver, max_iterations=options.steps)))
        shares[f"direct form, jaxopt {solver}"] = share_at_minimum(np.asarray(descent(starts)))
    cases = [
        {"initialization": one, "learning_rate": rate} for one in get_args(dm.Initialization) for rate in LEARNING_RATES
    ]
    summary = cli.summarize(cli.fill_table(run, cases, work), tuple(cases[0]), FORMS)
    x_best, loss_best = dm.GLOBAL_MINIMUM
    notes = [f"{name}: {share:.1%} at x = {x_best:.3f}, L = {loss_best:.3f}" for name, share in shares.items()]
    numbers = {"x_global": x_best, "loss_global": loss_best, "share_at_global_minimum": shares}
    return numbers | cli.write_summary(run, summary, *notes)


Fits = tuple[dm.FitState, dm.Report]


def descend(toy: dm.ToyConfig, options: ToyOptions) -> dict[str, Fits]:
    """Fits all seeds in one vmap in each form, from the same starts."""
    keys = jax.random.split(jax.random.key(options.seed), options.seeds)
    problems = {form: dm.toy_problem(replace(toy, form=form)) for form in FORMS}
    return {form: jax.jit(jax.vmap(partial(solve, problem)))(keys) for form, problem in problems.items()}


def solve(problem: dm.Problem, key: jax.Array) -> Fits:
    """Returns the last state and the report of one seed."""
    return dm.solve(problem, None, key=key)


def path(fits: Fits) -> np.ndarray:
    """Returns (seeds, steps + 1) x of every seed from the start to the end."""
    _, report = fits
    return np.concatenate([np.asarray(report.terms), np.asarray(report.poses)[:, None]], axis=1)


def draw(run: cli.Run, toy: dm.ToyConfig, fits: dict[str, Fits]) -> None:
    """Draws figure 14 of one seed."""
    network, direct = map(path, fits.values())
    # Out of the same vmap as the shares: the descent is chaotic, and one seed compiled alone rounds its way elsewhere.
    chosen = choose_seed(network, direct)
    z, x = jnp.linspace(-VIEW, VIEW, 1201), np.linspace(-VIEW, VIEW, 2401)
    params = jax.tree.map(lambda leaf: leaf[chosen], fits["network"][0].params)
    converted = dm.toy_loss(jax.vmap(lambda one: dm.network_value(toy, params.replace(z=one)))(z))
    x_direct, visited = float(direct[chosen, -1]), network[chosen]
    figure = viz.toy_figure(
        (x, np.asarray(dm.toy_loss(x))),
        converted=(np.asarray(z), np.asarray(converted)),
        visited=(visited, np.asarray(dm.toy_loss(visited))),
        direct_end=(x_direct, float(dm.toy_loss(x_direct))),
        network_end_z=float(params.z),
    )
    viz.save_figure(figure, run / "toy.png")


def minimize(x0: Any, *, solver: str, max_iterations: int) -> Any:
    """Returns the end of the descent of the direct form from `x0` by one of `SOLVERS`."""
    import jaxopt

    return getattr(jaxopt, SOLVERS[solver])(fun=dm.toy_loss, maxiter=max_iterations).run(x0).params


def choose_seed(network_x: np.ndarray, direct_x: np.ndarray) -> int:
    """Returns the first seed that the network form brings to the minimum and the direct form does not, as in figure 14.

    Args:
        network_x: (seeds, steps) x of the network form.
        direct_x: (seeds, steps) x of the direct form.

    Returns:
        The seed; one whose x stays inside of the picture where there is such a seed.
    """
    is_example = is_at_minimum(network_x[:, -1]) & ~is_at_minimum(direct_x[:, -1])
    return int(np.argmax(2 * is_example + (np.abs(network_x).max(axis=1) < VIEW)))


def is_at_minimum(x: np.ndarray) -> np.ndarray:
    """Returns True for ends at the global minimum."""
    return np.abs(np.asarray(x, np.float64) - dm.GLOBAL_MINIMUM[0]) < SAME_PLACE


def share_at_minimum(x: np.ndarray) -> float:
    """Returns the share of the seeds that end at the global minimum."""
    return float(is_at_minimum(x).mean())


if __name__ == "__main__":
    cli.run_experiment(main)
