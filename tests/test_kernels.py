"""Laws of all kernels, for each row of `tests.kernel_table`."""

import operator
import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractMesh, AxisType
from jax.sharding import PartitionSpec as P

import dpmjax
from tests import kernel_table
from tests.kernel_table import EXTRA, KERNELS, Arrays, Kernel, example, floats, moved_clouds, padded, total
from tests.processes import REPOSITORY, run_python

# Float32 sums and solutions of small systems; a loop that ends at a millionth of the cloud.
CLOSE: Arrays = {"rtol": 1e-3, "atol": 2e-4}
# These compile for seconds.
SLOW = {"correlate", "deepmapping.solve", "deepmapping.step", "encode_pyramid", "geometry.build_pyramid"}
SLOW |= {"geometry.find_consensus", "icp", "icp to points", "match_hypotheses", "pose_graph.solve_dense"}
WITH_MASKS = {name: kernel for name, kernel in KERNELS.items() if kernel.padding}
WITH_GRADIENT = {name: kernel for name, kernel in KERNELS.items() if kernel.by}


@pytest.fixture(autouse=True, scope="module")
def _made_outside_of_programs() -> None:
    """Makes shared objects outside of programs, because they must hold no tracers of a program that uses them."""
    kernel_table.model()
    kernel_table.toy_1d()


def each(kernels: dict[str, Kernel]) -> pytest.MarkDecorator:
    marks = {name: (pytest.mark.slow,) if name in SLOW else () for name in kernels}
    rows = [pytest.param(kernel, id=name, marks=marks[name]) for name, kernel in kernels.items()]
    return pytest.mark.parametrize("kernel", rows)


def assert_close(found: Any, expected: Any) -> None:
    """The same leaves; rows of padding are left out."""
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        np.testing.assert_allclose(x[tuple(map(slice, y.shape))], y, **CLOSE)


def compiled(kernel: Kernel) -> Callable[[Arrays], Any]:
    return jax.jit(lambda arrays: kernel.call(**arrays))


def gradient_of(kernel: Kernel, arrays: Arrays) -> Callable[[Arrays], Any]:
    """The derivative by some of the arrays, with inner values that are computed again (`jax.checkpoint`)."""
    return jax.grad(jax.checkpoint(lambda moving: total(kernel, arrays | moving)))


@each(KERNELS)
def test_jit_and_vmap_are_the_call(kernel: Kernel, assert_compiles_nothing) -> None:
    examples = [example(kernel, seed) for seed in (0, 1)]
    program = compiled(kernel)
    expected = [kernel.call(**examples[0])]
    assert_close(program(examples[0]), expected[0])
    with assert_compiles_nothing():
        second = program(examples[1])
        expected.append(kernel.call(**examples[1]))
    assert_close(second, expected[1])
    together = jax.jit(jax.vmap(lambda arrays: kernel.call(**arrays)))(jax.tree.map(lambda *x: jnp.stack(x), *examples))
    for row in (0, 1):
        assert_close(jax.tree.map(lambda leaf, row=row: leaf[row], together), expected[row])


@each(WITH_MASKS)
def test_padding_and_points_without_a_place_change_nothing(kernel: Kernel) -> None:
    arrays, program = example(kernel), compiled(kernel)
    expected = kernel.call(**arrays)
    for hidden in (np.nan, 0.5):
        assert_close(program(padded(kernel, arrays, hidden=hidden)), expected)
    for point in (np.nan, np.inf, -np.inf, 1e19) if kernel.points else ():
        assert_close(program(padded(kernel, arrays, point)), expected)


@each(WITH_GRADIENT)
def test_gradients_are_finite_next_to_padding_and_points_without_a_place(kernel: Kernel) -> None:
    arrays = padded(kernel, example(kernel))
    gradient = jax.jit(lambda arrays: gradient_of(kernel, arrays)({by: arrays[by] for by in kernel.by}))
    others = [padded(kernel, example(kernel), point) for point in (np.nan, np.inf, 1e19) if kernel.points]
    for gradients in map(gradient, [arrays, *others]):
        for name, slope in gradients.items():
            assert np.isfinite(slope).all(), name
            assert np.any(np.asarray(slope) != 0), name
            if name in kernel.padding and name != "weights":
                np.testing.assert_array_equal(slope[-EXTRA:], 0)


@each({name: kernel for name, kernel in WITH_GRADIENT.items() if kernel.is_exact})
def test_gradients_are_those_of_differences(kernel: Kernel, float64) -> None:
    arrays = example(kernel, dtype=np.float64)
    here = {by: arrays[by] for by in kernel.by}
    rng, width = np.random.default_rng(2), 1e-4
    along = {name: jnp.asarray(rng.normal(size=value.shape)) for name, value in here.items()}
    function = jax.jit(lambda moving: total(kernel, arrays | moving))
    _, slope = jax.jvp(function, (here,), (along,))
    ends = [function(jax.tree.map(lambda x, d, t=t: x + t * d, here, along)) for t in (width, -width)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * width), rtol=2e-3, atol=2e-3)


@each({name: kernel for name, kernel in WITH_GRADIENT.items() if not kernel.is_exact})
def test_forward_and_backward_derivatives_agree(kernel: Kernel, float64) -> None:
    arrays = example(kernel, dtype=np.float64)
    here = {by: arrays[by] for by in kernel.by}
    along = {name: jnp.asarray(np.random.default_rng(2).normal(size=value.shape)) for name, value in here.items()}
    slope = jax.jit(lambda along: jax.jvp(lambda moving: total(kernel, arrays | moving), (here,), (along,))[1])(along)
    backward = jax.jit(gradient_of(kernel, arrays))(here)
    np.testing.assert_allclose(slope, sum(jnp.vdot(along[name], backward[name]) for name in here), rtol=1e-3)
    assert abs(slope) > 0


@each({name: kernel for name, kernel in KERNELS.items() if kernel.dtypes is not None})
def test_float32_and_float64_are_kept_and_half_precision_is_computed_in_float32(kernel: Kernel, float64) -> None:
    for dtype, expected in ((np.float64, "float64"), (np.float32, "float32"), (jnp.bfloat16, "float32")):
        arrays = example(kernel, dtype=dtype)
        found = {leaf.dtype.name for leaf in floats_of_shape(kernel.call, **arrays)}
        kept = {arrays[name].dtype.name for name in arrays} if kernel.dtypes else set()  # positions, which are kept
        assert found <= {expected, *kernel.dtypes, *kept}
        if kernel.by and dtype is np.float64:
            slopes = jax.eval_shape(gradient_of(kernel, arrays), {by: arrays[by] for by in kernel.by})
            assert {slope.dtype.name for slope in slopes.values()} == {"float64"}


def floats_of_shape(function: Callable[..., Any], **arrays: Any) -> list[Any]:
    return jax.eval_shape(lambda arrays: floats(function(**arrays)), arrays)


@each(KERNELS)
def test_half_precision_gives_the_numbers_of_float32(kernel: Kernel) -> None:
    half = example(kernel, dtype=jnp.bfloat16)
    rounded = {name: jnp.asarray(value, example(kernel)[name].dtype) for name, value in half.items()}
    found, expected = kernel.call(**half), kernel.call(**rounded)
    if kernel.dtypes == ():
        assert_close(found, expected)
    else:  # positions and parameters keep eight bits
        for x, y in zip(floats(found), floats(expected), strict=True):
            np.testing.assert_allclose(x.astype(jnp.float32), y, rtol=0.02, atol=0.02)


@each(KERNELS)
def test_kernels_are_split_over_devices(kernel: Kernel) -> None:
    """`jax.shard_map` with its default checks, where the first array is split alone; nothing is compiled."""
    mesh = AbstractMesh((8,), ("scans",), axis_types=(AxisType.Auto,))
    arrays = example(kernel)
    first, *others = arrays
    many = arrays | {first: jnp.stack([arrays[first]] * 8)}
    axes, specs = {first: 0} | dict.fromkeys(others), {first: P("scans")} | dict.fromkeys(others, P())
    of_each = jax.vmap(lambda arrays: value_and_gradient(kernel, arrays), in_axes=(axes,))
    found = jax.eval_shape(jax.shard_map(of_each, mesh=mesh, in_specs=(specs,), out_specs=P("scans")), many)
    assert all(leaf.shape[0] == 8 for leaf in jax.tree.leaves(found))


def value_and_gradient(kernel: Kernel, arrays: Arrays) -> Any:
    value = jax.tree.map(jnp.asarray, kernel.call(**arrays))
    return value, gradient_of(kernel, arrays)({by: arrays[by] for by in kernel.by}) if kernel.by else ()


ON_EIGHT_DEVICES = """
import jax, jax.numpy as jnp
from jax.sharding import PartitionSpec as P
from tests.test_kernels import KERNELS, assert_close, example, floats, kernel_table, value_and_gradient

assert jax.device_count() == 8 and jnp.ones(1).dtype == jnp.float64
kernel_table.model(), kernel_table.toy_1d()
mesh = jax.make_mesh((8,), ("scans",), axis_types=(jax.sharding.AxisType.Auto,))
for name, kernel in KERNELS.items():
    examples = [example(kernel, seed, "float64") for seed in range(8)]
    many = jax.tree.map(lambda *arrays: jnp.stack(arrays), *examples)
    of_each = jax.vmap(lambda arrays: value_and_gradient(kernel, arrays))
    split = jax.jit(jax.shard_map(of_each, mesh=mesh, in_specs=P("scans"), out_specs=P("scans")))(many)
    assert all(len(leaf.sharding.device_set) == 8 for leaf in jax.tree.leaves(split)), name
    assert_close(split, jax.jit(of_each)(many))
    narrow = jax.jit(lambda arrays: kernel.call(**arrays))(example(kernel, 0, "float32"))
    assert_close(jax.tree.map(lambda leaf: leaf[0], split[0]), narrow)
    print(name)
"""


@pytest.mark.slow
def test_eight_devices_and_64_bits_give_the_numbers_of_one_and_of_32() -> None:
    flags = "--xla_force_host_platform_device_count=8 --xla_backend_optimization_level=0"
    done = run_python("-c", ON_EIGHT_DEVICES, variables={"XLA_FLAGS": flags, "JAX_ENABLE_X64": "1"})
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines() == [*KERNELS]


@pytest.mark.slow
@pytest.mark.parametrize("name", KERNELS)
def test_nothing_needs_jit(name: str) -> None:
    kernel = KERNELS[name]
    expected = kernel.call(**example(kernel))
    with jax.disable_jit():
        assert_close(kernel.call(**example(kernel)), expected)


@pytest.mark.parametrize("name", ["weighted_svd", "occupancy_loss"])
def test_only_ratios_of_weights_count(name: str) -> None:
    kernel, program = KERNELS[name], compiled(KERNELS[name])
    arrays = example(kernel)
    expected = kernel.call(**arrays)
    for factor in (2e-37, 1e37):
        assert_close(program(arrays | {"weights": arrays["weights"] * jnp.float32(factor)}), expected)
    without = program(arrays | {"weights": arrays["weights"].at[:3].set(0)})
    assert not np.allclose(without, expected, **CLOSE)
    for weight in (np.nan, np.inf, -np.inf, -1.0, 1e-39):
        assert_close(program(arrays | {"weights": arrays["weights"].at[:3].set(weight)}), without)


@pytest.mark.parametrize("name", ["occupancy_loss", "info_nce", "absolute_trajectory_error"])
def test_a_prediction_that_is_not_finite_is_never_left_out(name: str) -> None:
    arrays = example(KERNELS[name])
    by = KERNELS[name].by[0]
    masks = {mask: jnp.ones_like(value) for mask, value in arrays.items() if value.dtype == bool}
    assert np.isnan(compiled(KERNELS[name])(arrays | masks | {by: arrays[by].at[2].set(jnp.nan)}))


def test_the_guide_lists_every_public_kernel() -> None:
    text = (REPOSITORY / "docs" / "guides" / "pure_functions.md").read_text()
    rows = re.findall(r"^\* (Derivative|No derivative), (masks|weights|neither): (.+)\.$", text, re.MULTILINE)
    found = {name: row[:2] for row in rows for name in re.findall("`(.+?)`", row[2])}
    expected: dict[str, tuple[str, str]] = {}
    for name, kernel in KERNELS.items():
        if " " not in name and name != "match_hypotheses":
            masks = [mask for mask, filler in kernel.padding.items() if filler is False]
            missing = "weights" if "weights" in kernel.padding else "masks" if masks else "neither"
            expected[name] = ("Derivative" if kernel.by else "No derivative", missing)
            assert callable(operator.attrgetter(name)(dpmjax))
    assert found == expected


def test_degenerate_trajectories_have_an_error_and_a_gradient() -> None:
    line, every = jnp.linspace(0.0, 4.0, 5)[:, None] * jnp.asarray([1.0, 2.0, -1.0]), jnp.ones(5, bool)
    error = jax.jit(jax.value_and_grad(dpmjax.absolute_trajectory_error))
    for path, mask in ((line, every), (jnp.ones((5, 3)), every), (line, jnp.arange(5) == 2), (line, ~every)):
        value, gradient = error(path, path + 3.0, mask)
        assert float(value) == pytest.approx(0.0, abs=1e-5)
        assert np.isfinite(gradient).all()


@pytest.mark.slow
@pytest.mark.parametrize(("metric", "dim"), [("point", 2), ("plane", 3)])
def test_gradient_of_icp_is_that_of_its_solution(metric: str, dim: int, float64) -> None:
    arrays = {name: jnp.asarray(x, float) for name, x in moved_clouds(dim)(np.random.default_rng(3)).items()}
    source, target = arrays["source"], arrays["target"]

    def solution(source: Any) -> Any:
        T = None
        for _ in range(25):  # each call goes on from the last one, beyond its millionth of the cloud
            T = dpmjax.icp(source, target, metric, T).T_target_source
        return T

    along, width = jnp.asarray(np.random.default_rng(4).normal(size=source.shape)), 1e-5
    T = solution(source)
    _, slope = jax.jvp(lambda source: dpmjax.icp(source, target, metric, T).T_target_source, (source,), (along,))
    ends = [solution(source + step * along) for step in (width, -width)]
    difference = (ends[0] - ends[1]) / (2 * width)
    assert np.abs(difference).max() > 1e-2
    np.testing.assert_allclose(slope, difference, rtol=1e-3, atol=1e-4)
