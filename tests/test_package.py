import importlib
import importlib.metadata
import inspect
import pkgutil
import re
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpmjax
from tests.processes import run_python
from tests.test_kernels import KERNELS

ROOMS = sorted({module.name for module in pkgutil.iter_modules(dpmjax.__path__)} - {"__main__"})
FOLDERS = sorted(module.name for module in pkgutil.iter_modules(dpmjax.__path__) if module.ispkg)
PACKAGES = [dpmjax, *(getattr(dpmjax, name) for name in FOLDERS)]
API = Path(__file__).parents[1] / "docs" / "api.md"


def test_import_loads_neither_jax_nor_numpy() -> None:
    program = "import sys, dpmjax; assert not {'jax', 'numpy'} & sys.modules.keys(), 'import dpmjax imports too much'"
    done = run_python("-c", program)
    assert done.returncode == 0, done.stderr


def test_every_room_is_reached_from_the_package_alone() -> None:
    # In a process of its own: an import of a room elsewhere would make it an attribute of the package.
    program = f"import dpmjax; print([getattr(dpmjax, room).__name__ for room in {ROOMS}])"
    assert run_python("-c", program).stdout.strip() == str([f"dpmjax.{room}" for room in ROOMS])


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
    modules = {name for name in package.__all__ if isinstance(getattr(package, name), ModuleType)}
    stub = Path(package.__path__[0], "__init__.pyi").read_text(encoding="utf-8")
    listed = set(re.findall(r"^from \. import (\w+) as", stub, re.MULTILINE))
    assert modules == listed
    assert package is not dpmjax or listed == set(ROOMS)


def test_results_of_public_functions_are_public() -> None:
    functions = [value for name in dpmjax.__all__ if inspect.isfunction(value := getattr(dpmjax, name))]
    results = [inspect.signature(function).return_annotation for function in functions]
    records = {result for result in results if re.fullmatch(r"[A-Z]\w+", str(result))} - {"Path", "None"}
    assert len(records) > 20
    assert records <= set(dpmjax.__all__)


def test_a_record_prints_one_line_of_shapes() -> None:
    edges = dpmjax.Edges(np.array([0]), np.array([1]), np.zeros((1, 3)), np.eye(3)[None])
    graph = dpmjax.PoseGraph.create(np.zeros((500, 3)), edges)
    assert repr(graph).startswith("PoseGraph(poses=float64[500, 3], edges=")
    match = dpmjax.IcpResult(jnp.zeros((4, 4)), jnp.float32(0.25), jnp.int32(3), jnp.bool_(True))
    assert "T_target_source=float32[4, 4], rmse=0.25, num_inliers=3" in repr(match)
    for record in (graph, match, dpmjax.ScanSet(jnp.zeros((99, 9, 2)), jnp.ones((99, 9), bool))):
        assert len(repr(record)) < 300
        assert "\n" not in repr(record)
    jax.jit(lambda result: len(repr(result)))(match)  # tracers have no numbers


def test_compile_counter_counts(count_compilations) -> None:
    before = count_compilations()
    jax.jit(lambda x: x * 3 + 1)(jnp.ones(7)).block_until_ready()
    assert count_compilations() > before


def test_api_page_lists_exactly_the_root_names() -> None:
    page = API.read_text(encoding="utf-8")
    listed = re.findall(r"^\* `(\w+)`(?: \(K\))?: .+\.$", page, re.MULTILINE)
    assert len(listed) == page.count("\n* "), "one line each: * `name`: what it is."
    assert sorted(listed) == sorted(set(dpmjax.__all__) - {"__version__", *ROOMS})
    assert page.count("\n## ") == 13, "twelve groups, and the packages"
    assert sorted(re.findall(r"^\| `dpmjax\.(\w+)` \|", page, re.MULTILINE)) == FOLDERS


def test_what_the_api_page_calls_a_kernel_is_tested_as_one() -> None:
    marked = set(re.findall(r"^\* `(\w+)` \(K\):", API.read_text(encoding="utf-8"), re.MULTILINE))
    tested = {name.split()[0] for name in KERNELS}
    assert marked == tested & set(dpmjax.__all__)
