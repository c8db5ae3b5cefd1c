"""The 1-D toy of DeepMapping's supplement: both forms for one seed and for many, beside the usual loop in PyTorch."""

from __future__ import annotations

import itertools
import time
from dataclasses import replace

import jax

from benchmarks import Row, measure
from dpmjax import cli
from dpmjax.deepmapping import ScalarNet, ToyConfig, solve, toy_problem
from experiments.toy_1d import FORMS, share_at_minimum


def run(quick: bool) -> list[Row]:
    """Times descents from random starts."""
    toy = ToyConfig(num_steps=100 if quick else 1000)
    rows: list[Row] = []
    for num_seeds, form in itertools.product((1, 100 if quick else 1000), FORMS):

        def ends(form: str = form, num_seeds: int = num_seeds) -> jax.Array:
            problem = toy_problem(replace(toy, form=form))
            keys = jax.random.split(jax.random.key(0), num_seeds)
            return jax.vmap(lambda key: solve(problem, None, key=key))(keys)[1].poses

        case = f"{form} form, {num_seeds} seeds x {toy.num_steps} steps: dpmjax"
        rows += measure(ends, repeats=3).rows(case)
        if num_seeds > 1:
            rows.append(Row(case, "share at global minimum", share_at_minimum(ends()), ""))
    if cli.why_not_importable("torch") is None:
        seconds = min(torch_seconds(toy, seed) for seed in range(3))
        rows.append(Row(f"network form, 1 seeds x {toy.num_steps} steps: PyTorch", "min", 1e3 * seconds, "ms"))
    return rows


def torch_seconds(toy: ToyConfig, seed: int) -> float:
    """Returns the seconds of the same descent of one seed as a plain loop in PyTorch."""
    import torch

    torch.manual_seed(seed)
    layers: list[torch.nn.Module] = []
    for before, after in itertools.pairwise((1, *ScalarNet(toy.initialization).features, 1)):
        layers += [torch.nn.Linear(before, after), torch.nn.ELU()]
    net = torch.nn.Sequential(*layers[:-1])
    z = torch.randn(1, requires_grad=True)
    optimizer = torch.optim.SGD([*net.parameters(), z], lr=toy.learning_rate)
    begun = time.perf_counter()
    for _ in range(toy.num_steps):
        x = net(z)
        loss = (0.5 * x**2 + 5.0 * torch.sin(10.0 * x) + 20.0 * torch.sin(x)).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return time.perf_counter() - begun
