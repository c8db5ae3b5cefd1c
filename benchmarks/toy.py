"""The one-dimensional example of DeepMapping (supplement D): a thousand seeds in one vmap, beside a PyTorch loop."""

from __future__ import annotations

from dataclasses import replace

import jax

from benchmarks.rows import Row, measure
from dpmjax.cli import why_not_importable
from dpmjax.deepmapping import ToyConfig, fit, toy_problem
from experiments.toy_1d import FORMS, share_at_minimum, torch_seconds

NAME = "toy"


def run(quick: bool) -> list[Row]:
    """Times both forms for one seed and for many, and the usual loop in PyTorch for one."""
    toy = ToyConfig(num_steps=100 if quick else 1000)
    rows: list[Row] = []
    for num_seeds in (1, 100) if quick else (1, 1000):
        for form in FORMS:

            def ends(form: str = form, num_seeds: int = num_seeds) -> jax.Array:
                problem = toy_problem(replace(toy, form=form))
                return fit(problem, None, key=jax.random.key(0), num_starts=num_seeds).poses

            case = f"{form} form, {num_seeds} seeds x {toy.num_steps} steps"
            rows += measure(ends, repeats=3).rows(f"{case}: dpmjax")
            if num_seeds > 1:
                rows.append(Row(f"{case}: dpmjax", "share at global minimum", share_at_minimum(ends()), ""))
    if why_not_importable("torch") is None:
        seconds = min(torch_seconds(toy, seed) for seed in range(3))
        rows.append(Row(f"network form, 1 seeds x {toy.num_steps} steps: PyTorch", "min", 1e3 * seconds, "ms"))
    return rows
