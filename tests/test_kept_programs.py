"""Laws of traced programs on disk: traced once for all processes, and the same function as ever."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpmjax
from dpmjax.compile_cache import TRACED_FOLDER
from dpmjax.kept_programs import KeptProgram, keep_result, prepare_program

traced: list[str] = []


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.setenv(TRACED_FOLDER, str(tmp_path / "traced"))
    traced.clear()
    return tmp_path / "traced"


def fresh() -> KeptProgram:
    """The function as a process of its own knows it."""

    def scaled(points: jax.Array, options: dict[str, jax.Array], *, power: int = 1) -> dict[str, jax.Array]:
        traced.append("scaled")
        if points.shape[-1] > 3:
            raise ValueError("points: too wide")
        return {"sum": (options["scale"] * points**power).sum(), "points": jnp.sin(points)}

    return KeptProgram(scaled, ("power",))


POINTS, OPTIONS = jnp.arange(6.0).reshape(2, 3), {"scale": np.float32(2.0)}


def test_a_later_process_does_not_trace(folder: Path) -> None:
    first = fresh()(POINTS, OPTIONS, power=2)
    assert len(traced) == 1
    again = fresh()
    second = again(points=POINTS, options=OPTIONS, power=2)
    assert len(traced) == 1
    assert len(list(folder.iterdir())) == 1
    assert float(second["sum"]) == float(first["sum"]) == 110.0
    np.testing.assert_array_equal(second["points"], first["points"])
    np.testing.assert_array_equal(prepare_program(again, POINTS, OPTIONS)()["sum"], 30.0)
    assert len(traced) == 2  # another static argument


@pytest.mark.parametrize(
    ("points", "power"), [(POINTS[:1], 2), (POINTS.astype(jnp.int32), 2), (POINTS, 3)], ids=["shape", "dtype", "static"]
)
def test_other_arguments_are_another_program(folder: Path, points, power: int) -> None:
    fresh()(POINTS, OPTIONS, power=2)
    found = fresh()(points, OPTIONS, power=power)
    assert len(traced) == 2
    assert float(found["sum"]) == pytest.approx(float((2.0 * np.asarray(points, float) ** power).sum()))


def test_derivatives_and_batches_are_those_of_the_function(folder: Path) -> None:
    kept = fresh()
    kept(POINTS, OPTIONS)
    slope = jax.grad(lambda points: kept(points, OPTIONS, power=2)["sum"])(POINTS)
    np.testing.assert_allclose(slope, 4.0 * POINTS)
    sums = jax.vmap(lambda points: kept(points, OPTIONS)["sum"])(POINTS)
    np.testing.assert_allclose(sums, 2.0 * POINTS.sum(axis=1))


def test_errors_of_the_function_are_raised(folder: Path) -> None:
    with pytest.raises(ValueError, match="too wide"):
        fresh()(jnp.ones((2, 4)), OPTIONS)
    assert not folder.exists() or not list(folder.iterdir())


@pytest.mark.parametrize("content", [b"", b"half a file"])
def test_a_broken_file_is_made_again(folder: Path, content: bytes) -> None:
    fresh()(POINTS, OPTIONS)
    (path,) = folder.iterdir()
    path.write_bytes(content)
    assert float(fresh()(POINTS, OPTIONS)["sum"]) == 30.0
    assert path.stat().st_size > len(content)


def test_nothing_is_kept_without_a_folder(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.delenv(TRACED_FOLDER, raising=False)
    assert float(fresh()(POINTS, OPTIONS)["sum"]) == 30.0
    assert keep_result("seven", 1, lambda: 7) == 7


def test_a_result_is_computed_once_for_each_key(folder: Path) -> None:
    found = [keep_result("name", key, lambda: traced.append("computed") or len(traced)) for key in (1, 1, 2)]
    assert found == [1, 1, 2]


def test_programs_of_the_network_are_kept(folder: Path, model) -> None:
    rng = np.random.default_rng(0)
    clouds = [dpmjax.encode(model, rng.normal(size=(200, 3)).astype(np.float32)) for _ in range(2)]
    dpmjax.overlap_pairs(model, clouds[:1], clouds[1:])
    dpmjax.register(model, *clouds)
    kept = {path.name.rpartition("-")[0] for path in folder.iterdir()}
    assert {"deeppointmap.overlap_prediction.overlap_probability", "deeppointmap.registration.trace_match"} <= kept
