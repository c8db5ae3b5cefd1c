"""Fixtures of all tests. Shapes and types are checked at run time, by jaxtyping and beartype."""

import gc
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# The tests run each program for a moment and compile hundreds: quick compilation is worth more than quick programs. The
# fusion emitters double the time of compilation and the memory; JAX 0.11 has no choice of them any more. Programs that
# are compiled in parts, by several threads, take 14 % longer, because each core has a worker.
os.environ["XLA_FLAGS"] = " ".join(
    [
        os.environ.get("XLA_FLAGS", ""),
        "--xla_backend_optimization_level=0",
        "--xla_cpu_parallel_codegen_split_count=1",
        *["--xla_cpu_use_fusion_emitters=false"] * (tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11)),
    ]
)

# Both workers, and the next run, take programs of the same code from one cache instead of compiling them again.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
# Traced programs are not kept: the types of their arguments are checked where they are traced.
os.environ.setdefault("DPMJAX_TRACED", "")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

import jax
import jaxtyping
import pytest

# Once a process, at a moment that depends on the caches: no test of a message may meet it.
logging.getLogger("dpmjax.compile_cache").setLevel(logging.ERROR)
# Collecting all tests makes millions of objects that stay: looking for garbage among them takes a sixth of its time.
gc.disable()

# Before the first import of the package, so that the functions of these rooms (kernels and network) are wrapped: all
# rooms would take twelve seconds of each worker. An integer is a float, as for mypy.
CHECKED_ROOMS = ("checks", "deeppointmap", "geometry", "losses", "metrics", "nets", "pose_graph", "sequences")
CHECKED_FILES = (
    *("deepmapping.objective", "deepmapping.relocalization"),
    "scan.lidar",
    *(f"scan.depth.{name}" for name in ("propose", "compare", "track")),
)
jaxtyping.install_import_hook(
    [f"dpmjax.{name}" for name in (*CHECKED_ROOMS, *CHECKED_FILES)],
    "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))",
)

_COMPILE_EVENT = "/jax/core/compile/backend_compile_duration"
_num_compiled = _num_kept = 0
MAX_PROGRAMS = 300


def _count_compilation(event: str, duration_secs: float, **_: object) -> None:
    global _num_compiled
    _num_compiled += event == _COMPILE_EVENT


jax.monitoring.register_event_duration_secs_listener(_count_compilation)


def pytest_collection_finish() -> None:
    """From here on, garbage is looked for among the objects of the tests alone."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="module", autouse=True)
def drop_programs() -> Iterator[None]:
    """Frees compiled programs every few modules, because the programs of all tests together take 4 GB."""
    yield
    global _num_kept
    if _num_compiled - _num_kept > MAX_PROGRAMS:
        jax.clear_caches()
        _num_kept = _num_compiled


@pytest.fixture
def count_compilations() -> Callable[[], int]:
    """Returns the number of programs that XLA has compiled in this process so far."""
    return lambda: _num_compiled


@pytest.fixture
def assert_compiles_nothing() -> Callable[[], AbstractContextManager[None]]:
    """A context in which nothing may be compiled: `with assert_compiles_nothing(): second_call()`."""

    @contextmanager
    def context() -> Iterator[None]:
        before = _num_compiled
        yield
        assert _num_compiled == before, f"{_num_compiled - before} programs were compiled again"

    return context


@pytest.fixture
def float64() -> Iterator[None]:
    """JAX with 64-bit floats, for this test only."""
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


@pytest.fixture
def as_user() -> Iterator[None]:
    """Without the run-time type checks, as users run: so that a test sees the ValueError that a user sees."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def model():
    """A network that compiles in seconds."""
    import dpmjax
    from tests.deeppointmap import toy

    return dpmjax.init_model(jax.random.key(0), toy.MODEL)


@pytest.fixture
def weights(model, tmp_path) -> Path:
    """The file of this network."""
    import dpmjax

    dpmjax.save_model(model, tmp_path / "model.safetensors", card="toy")
    return tmp_path / "model.safetensors"


@pytest.fixture
def real_data() -> Path:
    """Folder of the real data; the test is skipped where there is none."""
    folder = Path(os.environ.get("DPMJAX_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data in {folder} (set DPMJAX_DATA)")
    return folder
