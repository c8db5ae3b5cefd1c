from __future__ import annotations

import importlib
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import pytest

import dpmjax
from dpmjax import deeppointmap, geometry, losses, metrics, nets, slam, weights

PACKAGES = [dpmjax, deeppointmap, geometry, losses, metrics, nets, slam, weights]


def test_import_loads_no_jax_and_is_fast() -> None:
    program = (
        "import sys, time; start = time.perf_counter(); import dpmjax; seconds = time.perf_counter() - start;"
        "assert 'jax' not in sys.modules and 'numpy' not in sys.modules, 'import dpmjax imports too much';"
        "print(seconds)"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    # 0.1 s is promised; a busy machine gets some slack.
    assert float(result.stdout) < 0.5


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)
def test_every_listed_name_resolves(package) -> None:
    assert package.__all__
    for name in package.__all__:
        assert getattr(package, name) is not None


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)
def test_no_module_hides_a_public_name(package) -> None:
    # A module with the name of a function of its package takes its place as soon as anybody imports the module.
    for module in pkgutil.iter_modules(package.__path__):
        if module.name != "__main__":
            importlib.import_module(f"{package.__name__}.{module.name}")
    assert not [name for name in package.__all__ if isinstance(getattr(package, name), ModuleType)]


def test_version_is_the_one_of_the_distribution() -> None:
    configuration = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
    assert dpmjax.__version__ == configuration["project"]["version"]


def test_compile_counter_counts(count_compilations) -> None:
    before = count_compilations()
    jax.jit(lambda x: x * 3 + 1)(jnp.ones(7)).block_until_ready()
    assert count_compilations() > before


def test_api_page_lists_exactly_the_root_names() -> None:
    page = (Path(__file__).parents[1] / "docs" / "api.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\* `(\w+)`: .+\.$", page, re.MULTILINE)
    assert len(listed) == page.count("\n* "), "one line each: * `name`: what it is."
    assert sorted(listed) == sorted(set(dpmjax.__all__) - {"__version__"})
    assert page.count("\n## ") == 12, "eleven groups, and the packages"
