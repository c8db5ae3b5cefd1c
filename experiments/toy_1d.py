"""The one-dimensional example of DeepMapping (supplement D, figure 14), and how often its claim holds.

    python -m experiments.toy_1d
    python -m experiments.toy_1d --seeds 100 -o out

Writes toy.png (figure 14), endings.png (the ends of all seeds) and metrics.json. The metrics are the share of seeds
that reach the global minimum, in the network form and in the direct form, from the same starts. The direct form is
solved by plain descent and by three solvers of jaxopt. The metrics cover several initialisations and learning rates.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, get_args

import numpy as np
from tqdm import tqdm
from tyro.conf import arg

from dpmjax import cli, viz
from dpmjax import deepmapping as dm

EXPERIMENT = "toy_1d"
FORMS = ("network", "direct")
# Solvers of jaxopt with a line search.
SOLVERS = {"gradient-descent": "GradientDescent", "lbfgs": "LBFGS", "bfgs": "BFGS"}
# Half the way to the next local minimum is 0.31; an end this close is in the right valley and at its bottom.
_SAME_PLACE = 0.05
# The pictures show -VIEW to VIEW.
VIEW = 6.0
# The paper's is 2e-4.
LEARNING_RATES = (1e-4, 2e-4, 5e-4, 1e-3)


@dataclass(frozen=True, kw_only=True)
class Config(cli.OutputOptions):
    """Options of the example."""

    seeds: Annotated[int, arg(metavar="N")] = 1000
    """Starts, all in one vmap."""
    steps: Annotated[int, arg(metavar="N")] = 1000
    """Steps of descent; the paper's number."""
    seed: int = 0
    """Seed of everything random."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, seeds=1, steps=1)


def main(config: Config) -> None:
    """Runs all seeds, then all variants, draws, measures, writes."""
    cli.require_importable("jaxopt", "the solvers of the direct form")
    folder = cli.open_run_folder(config, EXPERIMENT)
    with cli.recording(folder):
        paper = dm.ToyConfig(num_steps=config.steps)
        ends, figure = run_paper(paper, config)
        variants = []
        settings = list(itertools.product(get_args(dm.Initialization), LEARNING_RATES))
        for initialization, rate in tqdm(settings, desc="initialisations and learning rates", dynamic_ncols=True):
            runs = descend(replace(paper, initialization=initialization, learning_rate=rate), config)
            shares = {form: share_at_minimum(run.poses) for form, run in runs.items()}
            variants.append({"initialization": initialization, "learning_rate": rate, **shares})
        x_best, loss_best = dm.global_minimum()
        metrics = {
            "x_global": x_best,
            "loss_global": loss_best,
            "seeds": config.seeds,
            "steps": config.steps,
            "share_at_global_minimum": {name: share_at_minimum(x) for name, x in ends.items()},
            "variants": variants,
        }
        cli.write_metrics(folder, metrics, seed=config.seed)
        x = np.linspace(-VIEW, VIEW, 2401)
        loss = np.asarray(dm.toy_loss(x))
        viz.save_figure(viz.toy_figure((x, loss), **figure), folder / "toy.png")
        ends_figure = viz.endings_figure(x, loss, ends, metrics["share_at_global_minimum"])
        viz.save_figure(ends_figure, folder / "endings.png")
        print(report(metrics), f"results in {folder.path}", sep="\n")


def descend(toy: dm.ToyConfig, config: Config) -> dict[str, dm.Fit]:
    """Fits all seeds as starts of one fit in each form, from the same starts."""
    import jax

    problems = {form: dm.toy_problem(replace(toy, form=form)) for form in FORMS}
    starts = {"key": jax.random.key(config.seed), "num_starts": config.seeds}
    return {form: dm.fit(problem, None, **starts) for form, problem in problems.items()}


def path(run: dm.Fit) -> np.ndarray:
    """Returns (seeds, steps + 1) x of every seed from the start to the end."""
    x = np.atleast_2d(np.asarray(run.report.terms))
    return np.concatenate([x, np.reshape(run.poses, (-1, 1))], axis=1)


def run_paper(toy: dm.ToyConfig, config: Config) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Returns the ends of all methods with the paper's settings, and the data of figure 14 of one seed."""
    import jax
    import jax.numpy as jnp

    runs = descend(toy, config)
    network, direct = map(path, runs.values())
    ends = {f"{name} form, gradient descent": x[:, -1] for name, x in zip(FORMS, (network, direct), strict=True)}
    for solver in SOLVERS:
        solve = jax.jit(jax.vmap(partial(minimize, solver=solver, max_iterations=config.steps)))
        ends[f"direct form, jaxopt {solver}"] = np.asarray(solve(jnp.asarray(direct[:, 0])))
    # Out of the same vmap as the shares: the descent is chaotic, and one seed compiled alone rounds its way elsewhere.
    chosen = choose_seed(network, direct)
    z = jnp.linspace(-VIEW, VIEW, 1201)
    params = runs["network"].state.params
    if config.seeds > 1:
        params = jax.tree.map(lambda x: x[chosen], params)
    converted = dm.toy_loss(jax.vmap(lambda one: dm.network_value(toy, replace(params, z=one)))(z))
    x_direct, visited = float(direct[chosen, -1]), network[chosen]
    return ends, {
        "converted": (np.asarray(z), np.asarray(converted)),
        "visited": (visited, np.asarray(dm.toy_loss(visited))),
        "direct_end": (x_direct, float(dm.toy_loss(x_direct))),
        "network_end_z": float(params.z),
    }


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
    return np.abs(np.asarray(x, np.float64) - dm.global_minimum()[0]) < _SAME_PLACE


def share_at_minimum(x: np.ndarray) -> float:
    """Returns the share of the seeds that end at the global minimum."""
    return float(is_at_minimum(x).mean())


def report(metrics: dict[str, Any]) -> str:
    """Returns the shares as lines."""
    minimum = f"x = {metrics['x_global']:.3f}, L = {metrics['loss_global']:.3f}"
    lines = [
        f"{name:36} {100 * share:5.1f} % at {minimum}" for name, share in metrics["share_at_global_minimum"].items()
    ]
    lines += [
        f"{row['initialization']:12} rate {row['learning_rate']:g}: "
        f"network {100 * row['network']:5.1f} %, direct {100 * row['direct']:5.1f} %"
        for row in metrics["variants"]
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
