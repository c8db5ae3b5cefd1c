"""Compiled programs on disk: where they are kept, and that a later process takes them from there."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import sys
import jax, jax.numpy as jnp
import dpmjax
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event.endswith("/cache_hits")))
jnp.arange(3).block_until_ready()  # JAX has compiled before
folder = dpmjax.enable_compile_cache(sys.argv[1])
jax.jit(lambda x: jnp.sin(x) * 7 + 1)(jnp.arange(5.0)).block_until_ready()
print(folder, sum(hits))
"""


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"XDG_CACHE_HOME": "/caches"}, "/caches/dpmjax"),
        ({"DPMJAX_COMPILATION_CACHE": "/here"}, "/here"),
        ({"DPMJAX_COMPILATION_CACHE": "off"}, None),
        ({"JAX_COMPILATION_CACHE_DIR": "/mine"}, "/mine"),
    ],
)
def test_programs_are_kept_where_the_user_says(variables, expected, monkeypatch) -> None:
    from dpmjax.compile_cache import enable_compile_cache

    monkeypatch.setattr(os, "environ", {"HOME": "/home/somebody", **variables})
    monkeypatch.delitem(sys.modules, "jax")  # nothing of this process is configured
    folder = enable_compile_cache()
    found = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if expected is None:
        assert folder is None
        assert found is None
    else:
        assert str(folder) == found
        assert found == expected or found.startswith(f"{expected}/")


@pytest.mark.slow
def test_a_second_process_loads_what_the_first_has_compiled(tmp_path) -> None:
    folder = tmp_path / "programs"
    variables = {name: value for name, value in os.environ.items() if "CACHE" not in name}
    numbers = []
    for _ in range(2):
        command = [sys.executable, "-c", PROGRAM, str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=variables)
        where, hits = done.stdout.split()
        assert where == str(folder)
        numbers.append(int(hits))
    assert numbers[0] == 0
    assert numbers[1] > 0
