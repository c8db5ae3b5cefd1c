"""All cores at once, for programs that XLA runs on one."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import jax


def on_all_cores(work: Callable[[int], None], items: Iterable[int]) -> None:
    """Does the work on each item, some at a time: XLA's small programs use one core each on a CPU."""
    with ThreadPoolExecutor(os.cpu_count() if jax.default_backend() == "cpu" else 1) as pool:
        list(pool.map(work, items))
