"""Compiled programs on disk: where they are kept, and that a later process takes them from there."""

import logging
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
from dpmjax.checks import runs_on_host
work = lambda: jax.jit(lambda x: jnp.sin(x) * 7 + 1)(jnp.arange(5.0)).block_until_ready()
if len(sys.argv) > 1:
    dpmjax.enable_compile_cache(sys.argv[1])
    work()
else:
    runs_on_host("")(work)()
print(jax.config.jax_compilation_cache_dir, sum(hits))
"""


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"XDG_CACHE_HOME": "/caches"}, "/caches/dpmjax"),
        ({"DPMJAX_CACHE": "/here"}, "/here"),
        ({"DPMJAX_CACHE": "0"}, None),
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
@pytest.mark.parametrize("is_named", [True, False])
def test_a_second_process_loads_what_the_first_has_compiled(tmp_path, is_named: bool) -> None:
    """A pipeline keeps its programs by default."""
    folder = tmp_path / "programs"
    variables = {name: value for name, value in os.environ.items() if "CACHE" not in name}
    numbers = []
    for _ in range(2):
        command = [sys.executable, "-c", PROGRAM, *[str(folder)] * is_named]
        variables["XDG_CACHE_HOME"] = str(tmp_path)
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=variables)
        where, hits = done.stdout.split()
        assert where == str(folder) if is_named else where.startswith(str(tmp_path / "dpmjax"))
        numbers.append(int(hits))
    assert numbers[0] == 0
    assert numbers[1] > 0


def test_long_compilation_is_announced_once_and_loading_never(caplog) -> None:
    from dpmjax.compile_cache import announcer

    caplog.set_level(logging.INFO, logger="dpmjax.compile_cache")
    announce = announcer("and so on")
    compiled, loaded = "/jax/core/compile/backend_compile_duration", "/jax/compilation_cache/cache_retrieval_time_sec"
    for _ in range(9):
        announce(loaded, 1.0)
        announce(compiled, 1.1)
    assert not caplog.messages
    for _ in range(9):
        announce(compiled, 1.1)
    assert len(caplog.messages) == 1
