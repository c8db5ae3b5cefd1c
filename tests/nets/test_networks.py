from __future__ import annotations

import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest

from dpmjax.deepmapping import preset
from dpmjax.nets.mapping import (
    LocalizationNet,
    LocalizationNetConfig,
    OccupancyConfig,
    double_resolution,
    init_map_net,
    interpolate_grid,
    make_map_net,
)
from tests.tolerances import ACCUMULATED

KEY = jax.random.key(0)
interpolate = jax.jit(interpolate_grid)  # Call by call, each of its operations would be compiled alone.


def init_map(config: OccupancyConfig):
    return jax.jit(lambda key: init_map_net(config, key=key))(KEY)


def layer_sizes(params) -> list[tuple[int, int]]:
    return sorted(tuple(x.shape) for x in jax.tree.leaves(params) if x.ndim == 2)


def test_paper_networks_have_the_published_sizes() -> None:
    config = preset("paper")
    net = LocalizationNet(config.localization)
    localization = jax.eval_shape(net.init, KEY, jnp.zeros((256, 2)), jnp.ones(256, bool))
    # Convolutions of three taps are matrices of three times the channels.
    convolutions = [(3 * 2, 64), (3 * 64, 128), (3 * 128, 1024)]
    assert layer_sizes(localization) == sorted([*convolutions, (1024, 512), (512, 256), (256, 3)])
    occupancy = jax.eval_shape(lambda key: init_map_net(config.occupancy, key=key), KEY)
    assert layer_sizes(occupancy) == sorted([(2, 64), (64, 512), (512, 512), (512, 256), (256, 128), (128, 1)])
    assert not config.localization.is_circular


def test_weights_start_xavier_uniform_with_the_gain_of_relu() -> None:
    params = init_map(OccupancyConfig())
    for weight in (x for x in jax.tree.leaves(params) if x.ndim == 2 and x.size > 10_000):
        limit = np.sqrt(2.0) * np.sqrt(6.0 / sum(weight.shape))
        assert 0.95 * limit < float(jnp.abs(weight).max()) <= limit
    assert all(not np.asarray(x).any() for x in jax.tree.leaves(params) if x.ndim == 1)


@pytest.mark.parametrize(("shape", "dilation"), [((20,), 2), ((20,), 3), ((6, 8), 3)], ids=str)
def test_convolution_is_that_of_the_textbook(shape: tuple[int, ...], dilation: int) -> None:
    axes = len(shape)
    config = LocalizationNetConfig(features=(5,), strides=(2,), dilation=dilation, hidden=())
    net, points, mask = LocalizationNet(config), jax.random.normal(KEY, (*shape, axes + 1)), jnp.ones(shape, bool)
    params = jax.jit(net.init)(KEY, points, mask)["params"]
    weight = np.asarray(params["DilatedConvolution_0"]["Dense_0"]["kernel"], np.float64)
    weight = weight.reshape(*[3] * axes, axes + 1, 5)
    padded = np.pad(np.asarray(points, np.float64), [(dilation, dilation)] * axes + [(0, 0)])
    places = np.stack(np.meshgrid(*(np.arange(0, num, 2) for num in shape), indexing="ij"), -1).reshape(-1, axes)
    taps = np.ndindex(*[3] * axes)
    features = sum(padded[tuple((places + dilation * np.array(tap)).T)] @ weight[tap] for tap in taps)
    expected = features.max(0) @ np.asarray(params["Dense_0"]["kernel"], np.float64)
    np.testing.assert_allclose(jax.jit(net.apply)({"params": params}, points, mask), expected, **ACCUMULATED)


@pytest.mark.parametrize("kind", ["conv", "point"])
def test_masked_beams_never_matter_and_no_beam_is_finite(kind) -> None:
    net = LocalizationNet(LocalizationNetConfig(kind=kind, features=(8, 16), strides=(1, 2), hidden=(8,)))
    points, mask = jax.random.normal(KEY, (32, 2)), jnp.arange(32) % 3 > 0
    params = jax.jit(net.init)(KEY, points, mask)
    filled = jnp.where(mask[:, None], points, jnp.nan)
    apply = jax.jit(net.apply)
    np.testing.assert_array_equal(apply(params, points, mask), apply(params, filled, mask))
    nothing = jnp.zeros(32, bool)
    assert np.isfinite(apply(params, filled, nothing)).all()
    gradient = jax.jit(jax.grad(lambda p: net.apply(p, filled, nothing).sum()))(params)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(gradient))


def test_pointnet_does_not_see_the_order() -> None:
    net = LocalizationNet(LocalizationNetConfig(kind="point", features=(8, 16), hidden=(8,)))
    points, mask = jax.random.normal(KEY, (32, 2)), jnp.arange(32) % 3 > 0
    params, order = jax.jit(net.init)(KEY, points, mask), np.random.default_rng(0).permutation(32)
    apply = jax.jit(net.apply)
    np.testing.assert_allclose(apply(params, points[order], mask[order]), apply(params, points, mask), **ACCUMULATED)


def test_circular_convolution_does_not_see_where_the_turn_begins() -> None:
    net = LocalizationNet(LocalizationNetConfig(features=(8, 16), strides=(1, 1), is_circular=True, hidden=(8,)))
    points, mask = jax.random.normal(KEY, (32, 2)), jnp.ones(32, bool)
    params, apply = jax.jit(net.init)(KEY, points, mask), jax.jit(net.apply)
    np.testing.assert_allclose(
        apply(params, jnp.roll(points, 5, axis=0), mask), apply(params, points, mask), **ACCUMULATED
    )


@pytest.mark.parametrize("dimensions", [2, 3])
def test_grid_is_exact_at_its_nodes_and_linear_between(dimensions: int) -> None:
    grid = jnp.asarray(np.random.default_rng(0).normal(size=(5,) * dimensions), jnp.float32)
    nodes = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * dimensions, indexing="ij"), -1).reshape(-1, dimensions)
    np.testing.assert_allclose(interpolate(grid, jnp.asarray(nodes, jnp.float32)), grid.reshape(-1), **ACCUMULATED)
    middle = interpolate(grid, jnp.full((1, dimensions), -0.75))[0]
    np.testing.assert_allclose(middle, grid[(slice(2),) * dimensions].mean(), **ACCUMULATED)
    outside = interpolate(grid, jnp.array([[-3.0, 9.0, 9.0][:dimensions]]))[0]
    np.testing.assert_allclose(outside, grid[(0, -1, -1)[:dimensions]], **ACCUMULATED)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_gradient_of_the_grid_is_that_of_finite_differences(dimensions: int) -> None:
    rng = np.random.default_rng(1)
    grid = jnp.asarray(rng.normal(size=(4,) * dimensions), jnp.float32)
    points = jnp.asarray(rng.uniform(-0.95, 0.95, size=(30, dimensions)), jnp.float32)

    def total(grid, points):
        return jnp.sum(jnp.sin(interpolate_grid(jnp.asarray(grid), jnp.asarray(points))))

    jax.test_util.check_grads(jax.jit(total), (grid, points), order=1, modes=("rev",), eps=1e-3, rtol=0.02, atol=0.02)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_doubled_resolution_is_the_same_function(dimensions: int) -> None:
    rng = np.random.default_rng(2)
    grid = jnp.asarray(rng.normal(size=(5,) * dimensions), jnp.float32)
    points = jnp.asarray(rng.uniform(-1.1, 1.1, size=(50, dimensions)), jnp.float32)
    doubled = jax.jit(double_resolution)(grid)
    assert doubled.shape == (9,) * dimensions
    np.testing.assert_allclose(interpolate(doubled, points), interpolate(grid, points), **ACCUMULATED)


def test_the_map_is_the_sum_of_its_levels() -> None:
    config = OccupancyConfig(kind="grid", resolutions=(4, 8, 16))
    start, rng = init_map(config), np.random.default_rng(3)
    assert not any(np.asarray(x).any() for x in jax.tree.leaves(start))
    params = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), start)
    points, weights = jnp.asarray(rng.uniform(-1.0, 1.0, size=(40, 2)), jnp.float32), jnp.array([1.0, 0.7, 0.0])
    levels = [interpolate(params["params"][f"level_{cells}"], points) for cells in config.resolutions]
    expected = sum(weight * level for weight, level in zip(weights, levels, strict=True))
    np.testing.assert_allclose(jax.jit(make_map_net(config).apply)(params, points, weights), expected, **ACCUMULATED)


@pytest.mark.parametrize("resolutions", [(4, 12), (8, 4), (3, 6), ()])
def test_levels_that_do_not_double_are_refused(resolutions) -> None:
    with pytest.raises(ValueError, match="resolutions"):
        OccupancyConfig(kind="grid", resolutions=resolutions)


def test_strides_belong_to_layers() -> None:
    with pytest.raises(ValueError, match="strides"):
        LocalizationNetConfig(strides=(1, 1))


@pytest.mark.parametrize(("make", "name"), [(OccupancyConfig, "gird"), (LocalizationNetConfig, "cnv")])
def test_an_unknown_kind_is_refused(as_user, make, name: str) -> None:
    with pytest.raises(ValueError, match=f"kind: .*{name}"):
        make(kind=name)
