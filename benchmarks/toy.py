"""The one-dimensional example of DeepMapping (supplement D): a thousand seeds in one vmap, beside a PyTorch loop."""

from __future__ import annotations

import importlib.util

import jax

from benchmarks.rows import Row
from benchmarks.timing import measure
from dpmjax.deepmapping import ToyConfig, descend_direct, descend_network, init_toy, network_value
from experiments.toy_1d import share_at_minimum, torch_seconds

NAME = "toy"


def run(quick: bool) -> list[Row]:
    """Times both forms for one seed and for many, and the usual loop in PyTorch for one."""
    toy = ToyConfig(num_steps=100 if quick else 1000)
    rows: list[Row] = []
    for num_seeds in (1, 100) if quick else (1, 1000):
        keys = jax.random.split(jax.random.key(0), num_seeds)
        starts = jax.vmap(lambda key: init_toy(key, toy))(keys)
        network = jax.jit(jax.vmap(lambda start: descend_network(start, toy).x[-1]))
        direct = jax.jit(jax.vmap(lambda start: descend_direct(network_value(start, toy), toy).x[-1]))
        for form, function in (("network", network), ("direct", direct)):
            case = f"{form} form, {num_seeds} seeds x {toy.num_steps} steps"
            rows += measure(function, starts, repeats=3).rows(f"{case}: dpmjax")
            if num_seeds > 1:
                rows.append(Row(f"{case}: dpmjax", "share at global minimum", share_at_minimum(function(starts)), ""))
    if importlib.util.find_spec("torch") is not None:
        seconds = min(torch_seconds(toy, seed) for seed in range(3))
        rows.append(Row(f"network form, 1 seeds x {toy.num_steps} steps: PyTorch", "min", 1e3 * seconds, "ms"))
    return rows
