"""Optimisation of the parameters of a `Problem`: `init` a state, `step` it, `resume` it to the end.

A state is one pytree of arrays; a run that is resumed from a saved state equals an unbroken one. The data are arguments
of the compiled step, so that another set of the same shape compiles nothing. `init`, `begin_phase`, `step` and `solve`
are pure functions of arrays, for `jit` and `vmap`: several starts are a `vmap` of `solve` over their keys. `fit` and
`resume` run the same steps from the host, with progress and a stop.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from dpmjax.checks import as_key
from dpmjax.deepmapping.problem import Problem
from dpmjax.geometry.traced import typed_jit
from dpmjax.kept_programs import kept_jit, prepare_program
from dpmjax.types import with_short_repr


@flax.struct.dataclass
class FitState:
    """Complete state of a fit.

    Attributes:
        params: trained parameters of the problem.
        optimizer: state of the optimiser.
        key: key of the start; step k uses `fold_in(key, k)`, so that a resumed run equals an unbroken one.
        phase: index of the phase.
        phase_step: number of steps done in the phase.
        step: number of steps done in all phases.
    """

    params: Any
    optimizer: Any
    key: Array
    phase: Int[Array, ""]
    phase_step: Int[Array, ""]
    step: Int[Array, ""]


@with_short_repr
class Report(NamedTuple):
    """Result of one call of the step.

    Attributes:
        losses: losses of each step of the call.
        terms: parts of the loss before weighting, of each step.
        poses: poses of the whole data set after the call.
    """

    losses: Float[Array, " t"]
    terms: Any
    poses: Any

    @property
    def loss(self) -> float:
        """Mean loss of the call."""
        return float(np.asarray(self.losses).mean())


class Progress(NamedTuple):
    """Argument of `on_report`, after a call of the step.

    Attributes:
        phase: settings of the phase.
        state: state after the call.
        report: report of the call.
        share: share of all steps that are done, 0 to 1.
        run_s: seconds of stepping so far, of this `fit`.
        compile_s: seconds of compiling so far.
    """

    phase: Any
    state: FitState
    report: Report
    share: float
    run_s: float
    compile_s: float


@with_short_repr
class Fit(NamedTuple):
    """Result of `fit`.

    Attributes:
        state: state at the end, or where it was stopped.
        poses: poses of the whole data set at this state.
        report: report of the last call; None if no step was done.
        run_s: seconds of stepping.
        compile_s: seconds of compiling.
    """

    state: FitState
    poses: Any
    report: Report | None
    run_s: float
    compile_s: float


def init(problem: Problem, data: Any, *, key: jax.Array) -> FitState:
    """Makes a fresh state at the start of the first phase.

    Args:
        problem: problem to fit.
        data: data of the problem.
        key: key of the run.

    Returns:
        The state.

    Raises:
        ValueError: `key` is no key.
    """
    return _init(problem, data, as_key("key", key))


def step(problem: Problem, state: FitState, data: Any, *, phase: int | None = None) -> tuple[FitState, Report]:
    """Runs one call of steps.

    Args:
        problem: problem to fit; static under `jit`.
        state: state from `init` or from an earlier call.
        data: data of the problem.
        phase: index of the phase of the state, static under `jit`; `begin_phase` enters the next one. None: the
            index is read from the state on the host, and the next phase begins where the phase is over.

    Returns:
        The state after the call, and its report.

    Raises:
        ValueError: the state is traced, and no phase is given.
    """
    if phase is None:
        if isinstance(state.phase, jax.core.Tracer):
            raise ValueError("phase: expected the index of the phase, because the state is traced")
        state = _enter_phase(problem, state, data)
        phase = int(state.phase)
    return _advance(problem, phase, state, data)


@typed_jit("problem", "phase")
def begin_phase(problem: Problem, state: FitState, data: Any, *, phase: int) -> FitState:
    """Makes the state at the start of a phase from the state at the end of the phase before.

    Args:
        problem: problem to fit; static under `jit`.
        state: state at the end of phase `phase - 1`.
        data: data of the problem.
        phase: index of the phase that begins, from 1; static under `jit`.

    Returns:
        The state, with fresh moments of the optimiser.
    """
    params = problem.next_phase(problem.config, problem.phases[phase - 1], state.params, data)
    moments = problem.optimizer(problem.config, problem.phases[phase]).init(params)
    zero = jnp.zeros_like(state.phase_step)
    return replace(state, params=params, optimizer=moments, phase=state.phase + 1, phase_step=zero)


@typed_jit("problem")
def solve(problem: Problem, data: Any, *, key: jax.Array) -> tuple[FitState, Report]:
    """Runs all phases from a fresh state as one pure function.

    Several data sets of equal shapes: `jax.vmap(lambda data, key: solve(problem, data, key=key))(data, keys)`.

    Args:
        problem: problem to fit; static under `jit`.
        data: data of the problem.
        key: key of the run.

    Returns:
        The state at the end, and the report of the last call of the step.
    """
    state = init(problem, data, key=key)
    for phase in range(len(problem.phases)):
        if phase > 0:
            state = begin_phase(problem, state, data, phase=phase)

        def advance(state: FitState, _: None, phase: int = phase) -> tuple[FitState, Report]:
            return step(problem, state, data, phase=phase)

        state, reports = jax.lax.scan(advance, state, length=num_calls(problem, problem.phases[phase]))
    return state, jax.tree.map(lambda leaf: leaf[-1], reports)


def is_finished(problem: Problem, state: FitState) -> bool:
    """Returns True if all steps of the last phase are done.

    Args:
        problem: fitted problem.
        state: state of the fit.

    Returns:
        True if no step remains.
    """
    phase = int(state.phase)
    return phase == len(problem.phases) - 1 and int(state.phase_step) >= problem.phases[phase].num_steps


def fit(
    problem: Problem,
    data: Any,
    *,
    key: jax.Array,
    on_report: Callable[[Progress], None] = lambda _progress: None,
    stop: Callable[[], bool] = lambda: False,
) -> Fit:
    """Runs all phases from a fresh state.

    Args:
        problem: problem to fit.
        data: data of the problem, with initial poses where there are some.
        key: key of the run.
        on_report: called after each call of the step.
        stop: called before each call of the step; the fit ends where it returns True.

    Returns:
        Fit.
    """
    return resume(problem, init(problem, data, key=key), data, on_report=on_report, stop=stop)


def resume(
    problem: Problem,
    state: FitState,
    data: Any,
    *,
    on_report: Callable[[Progress], None] = lambda _progress: None,
    stop: Callable[[], bool] = lambda: False,
) -> Fit:
    """Runs the remaining phases of a state; a second fit of the same shapes compiles nothing.

    Args:
        problem: problem to fit.
        state: state from `init` or from an earlier fit.
        data: data of the problem.
        on_report: called after each call of the step.
        stop: called before each call of the step; the fit ends where it returns True.

    Returns:
        Fit.
    """
    total = sum(phase.num_steps for phase in problem.phases)
    run_s = compile_s = 0.0
    report = None
    while not is_finished(problem, state) and not stop():
        begun = time.perf_counter()
        state = _enter_phase(problem, state, data)
        # Compiled ahead, so that compile time is counted apart.
        advance = prepare_program(_advance, problem, int(state.phase), state, data)
        compiled = time.perf_counter()
        state, report = jax.block_until_ready(advance())
        compile_s, run_s = compile_s + compiled - begun, run_s + time.perf_counter() - compiled
        share = min(1.0, int(state.step) / total)
        on_report(Progress(problem.phases[int(state.phase)], state, report, share, run_s, compile_s))
    return Fit(state, _current_poses(problem, int(state.phase), state, data), report, run_s, compile_s)


def num_calls(problem: Problem, phase: Any) -> int:
    """Returns the number of calls of the step in a phase.

    Args:
        problem: fitted problem.
        phase: phase of the fit.

    Returns:
        The number of calls.
    """
    return -(-phase.num_steps // problem.steps_per_call)


def steps_per_call(problem: Problem, phase: Any) -> int:
    """Returns the steps of the phase divided by its number of calls, rounded up.

    Args:
        problem: fitted problem.
        phase: phase of the fit.

    Returns:
        The number of steps.
    """
    return -(-phase.num_steps // num_calls(problem, phase))


@partial(jax.jit, static_argnums=0)
def _init(problem: Problem, data: Any, key: Array) -> FitState:
    params = problem.init(problem.config, key, data)
    moments = problem.optimizer(problem.config, problem.phases[0]).init(params)
    zero = jnp.zeros((), jnp.int32)
    return FitState(params, moments, jax.random.key_data(key), zero, zero, zero)


def _enter_phase(problem: Problem, state: FitState, data: Any) -> FitState:
    """Returns the state at the start of the next phase if the phase is over and not the last; else the same state."""
    phase = int(state.phase)
    if phase + 1 == len(problem.phases) or int(state.phase_step) < problem.phases[phase].num_steps:
        return state
    return begin_phase(problem, state, data, phase=phase + 1)


@kept_jit("problem", "phase")
def _current_poses(problem: Problem, phase: int, state: FitState, data: Any) -> Any:
    return problem.poses(problem.config, problem.phases[phase], state.params, data)


@kept_jit("problem", "phase_index")
def _advance(problem: Problem, phase_index: int, state: FitState, data: Any) -> tuple[FitState, Report]:
    """Runs one call of steps of a phase."""
    phase = problem.phases[phase_index]
    optimizer = problem.optimizer(problem.config, phase)

    def one_step(state: FitState, _: None) -> tuple[FitState, tuple[Array, Any]]:
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.step)
        loss_of = jax.value_and_grad(partial(problem.loss, problem.config, phase), has_aux=True)
        (loss, terms), gradient = loss_of(state.params, data, state.phase_step, key)
        updates, moments = optimizer.update(gradient, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        counts = {"phase_step": state.phase_step + 1, "step": state.step + 1}
        return replace(state, params=params, optimizer=moments, **counts), (loss, terms)

    state, (losses, terms) = jax.lax.scan(one_step, state, length=steps_per_call(problem, phase))
    return state, Report(losses, terms, problem.poses(problem.config, phase, state.params, data))
