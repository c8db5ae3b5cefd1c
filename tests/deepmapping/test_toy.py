"""Laws of the one-dimensional example (supplement D)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.deepmapping.engine import fit
from dpmjax.deepmapping.toy import GLOBAL_MINIMUM, ScalarNet, ToyConfig, network_value, toy_loss, toy_problem
from experiments.toy_1d import minimize
from tests.tolerances import ACCUMULATED, ROUNDING

SHORT = ToyConfig(num_steps=20)
DIRECT = ToyConfig("direct", num_steps=20)
KEY = jax.random.key(0)


def loss64(x):
    return 0.5 * x**2 + 5.0 * np.sin(10.0 * x) + 20.0 * np.sin(x)


def test_global_minimum_is_where_brute_force_finds_it() -> None:
    x = np.linspace(-30.0, 30.0, 2_000_001)
    x_best, loss_best = GLOBAL_MINIMUM
    assert x_best == pytest.approx(x[np.argmin(loss64(x))], abs=1e-4)
    assert loss_best == pytest.approx(loss64(x).min(), abs=1e-6)
    assert (round(x_best, 3), round(loss_best, 3)) == (-1.417, -23.757)


def test_direct_form_is_plain_gradient_descent() -> None:
    run = fit(toy_problem(DIRECT), None, key=KEY)
    path = [float(run.report.terms[0])]
    for _ in range(DIRECT.num_steps):
        x = path[-1]
        path.append(x - DIRECT.learning_rate * (x + 50.0 * np.cos(10.0 * x) + 20.0 * np.cos(x)))
    np.testing.assert_allclose(run.report.terms, path[:-1], **ACCUMULATED)
    np.testing.assert_allclose(run.poses, path[-1], **ACCUMULATED)


@pytest.mark.slow
def test_both_forms_start_alike_and_the_first_network_step_is_descent_on_all_of_it() -> None:
    problem = toy_problem(SHORT)
    start = problem.init(SHORT, KEY, None)
    run, direct = fit(problem, None, key=KEY), fit(toy_problem(DIRECT), None, key=KEY)
    np.testing.assert_allclose(run.report.terms[0], direct.report.terms[0], **ROUNDING)
    gradient = jax.grad(lambda params: toy_loss(network_value(SHORT, params)))(start)
    moved = jax.tree.map(lambda value, slope: value - SHORT.learning_rate * slope, start, gradient)
    np.testing.assert_allclose(run.report.terms[1], network_value(SHORT, moved), **ROUNDING)
    assert run.state.params.z != start.z


def test_network_is_a_chain_of_linear_maps_and_elus() -> None:
    start = toy_problem(SHORT).init(SHORT, jax.random.key(1), None)
    layers = [start.net["params"][f"Dense_{k}"] for k in range(5)]
    x = np.array([start.z], np.float64)
    for k, layer in enumerate(layers):
        x = x @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)
        x = np.where(x > 0, x, np.expm1(x)) if k < 4 else x
    np.testing.assert_allclose(network_value(SHORT, start), x[0], **ROUNDING)
    assert [layer["kernel"].shape[1] for layer in layers] == [10, 20, 30, 40, 1]


@pytest.mark.parametrize("name", ["xavier-relu", "xavier", "he", "lecun", "pytorch"])
def test_initialisations_have_their_spread(name: str) -> None:
    net = ScalarNet(name, features=(400, 300))
    layer = net.init(jax.random.key(2), jnp.zeros(()))["params"]["Dense_1"]
    variance = {"xavier-relu": 4 / 700, "xavier": 2 / 700, "he": 2 / 400, "lecun": 1 / 400, "pytorch": 1 / 1200}[name]
    assert float(jnp.var(layer["kernel"])) == pytest.approx(variance, rel=0.03)
    assert bool(jnp.any(layer["bias"] != 0)) == (name == "pytorch")


@pytest.mark.slow
@pytest.mark.parametrize("method", ["gradient-descent", "lbfgs", "bfgs"])
def test_solvers_end_at_the_minimum_of_their_valley(method: str) -> None:
    x_best, _ = GLOBAL_MINIMUM
    x = minimize(jnp.float32(x_best + 0.05), solver=method, max_iterations=50)
    assert float(x) == pytest.approx(x_best, abs=1e-3)
