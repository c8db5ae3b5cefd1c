"""Optimisation of the parameters of a `Problem`: `init` a state, `step` it, `resume` it to the end.

A state is one pytree of arrays; a run that is resumed from a saved state equals an unbroken one. The data are arguments
of the compiled step, so that another set of the same shape compiles nothing. Several starts, with different keys, have
one more leading axis. `init`, `begin_phase`, `step` and `solve` are pure functions of arrays, for `jit` and `vmap`.
`fit` and `resume` run the same steps from the host, with progress and a stop.
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

from dpmjax.checks import as_key, require_count
from dpmjax.deepmapping.problem import Problem
from dpmjax.kept_programs import kept_jit, prepare_program
from dpmjax.types import with_short_repr


@flax.struct.dataclass
class FitState:
    """Complete state of a fit; for several starts every leaf has a leading axis.

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
    phase: Int[Array, "*starts"]
    phase_step: Int[Array, "*starts"]
    step: Int[Array, "*starts"]


@with_short_repr
class Report(NamedTuple):
    """Result of one call of the step; for several starts every leaf has a leading axis.

    Attributes:
        losses: losses of each step of the call.
        terms: parts of the loss before weighting, of each step.
        poses: poses of the whole data set after the call.
    """

    losses: Float[Array, "... t"]
    terms: Any
    poses: Any

    @property
    def loss(self) -> float:
        """Mean loss of the call, of the best start."""
        return float(np.asarray(self.losses).mean(axis=-1).min())


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


def init(problem: Problem, data: Any, *, key: jax.Array, num_starts: int = 1) -> FitState:
    """Makes a fresh state at the start of the first phase.

    Args:
        problem: problem to fit.
        data: data of the problem.
        key: key of the run.
        num_starts: number of starts that differ in their keys; with 1, there is no leading axis.

    Returns:
        The state.

    Raises:
        ValueError: there is no start, or `key` is no key.
    """
    require_count("num_starts", num_starts)
    key = as_key("key", key)
    return _init(problem, data, key if num_starts == 1 else jax.random.split(key, num_starts))


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
        phase = _scalar(state.phase)
    return _advance(problem, phase, state, data)


@partial(jax.jit, static_argnums=0, static_argnames="phase")
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

    def begin(state: FitState, data: Any) -> FitState:
        params = problem.next_phase(problem.config, problem.phases[phase - 1], state.params, data)
        moments = problem.optimizer(problem.config, problem.phases[phase]).init(params)
        return replace(
            state, params=params, optimizer=moments, phase=state.phase + 1, phase_step=jnp.zeros_like(state.phase_step)
        )

    return _over_starts(begin, state, data)


@partial(jax.jit, static_argnums=0)
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
        length = num_calls(problem, problem.phases[phase])
        state, reports = jax.lax.scan(partial(_scanned_step, problem, data, phase), state, length=length)
    return state, jax.tree.map(lambda leaf: leaf[-1], reports)


def _scanned_step(problem: Problem, data: Any, phase: int, state: FitState, _: None) -> tuple[FitState, Report]:
    return step(problem, state, data, phase=phase)


def is_finished(problem: Problem, state: FitState) -> bool:
    """Returns True if all steps of the last phase are done.

    Args:
        problem: fitted problem.
        state: state of the fit.

    Returns:
        True if no step remains.
    """
    phase = _scalar(state.phase)
    return phase == len(problem.phases) - 1 and _scalar(state.phase_step) >= problem.phases[phase].num_steps


def fit(
    problem: Problem,
    data: Any,
    *,
    key: jax.Array,
    num_starts: int = 1,
    on_report: Callable[[Progress], None] = lambda _progress: None,
    stop: Callable[[], bool] = lambda: False,
) -> Fit:
    """Runs all phases from a fresh state.

    Args:
        problem: problem to fit.
        data: data of the problem, with initial poses where there are some.
        key: key of the run.
        num_starts: number of starts that advance side by side.
        on_report: called after each call of the step.
        stop: called before each call of the step; the fit ends where it returns True.

    Returns:
        Fit.
    """
    state = init(problem, data, key=key, num_starts=num_starts)
    return resume(problem, state, data, on_report=on_report, stop=stop)


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
        advance = prepare_program(_advance, problem, _scalar(state.phase), state, data)
        compiled = time.perf_counter()
        state, report = jax.block_until_ready(advance())
        compile_s, run_s = compile_s + compiled - begun, run_s + time.perf_counter() - compiled
        share = min(1.0, _scalar(state.step) / total)
        on_report(Progress(problem.phases[_scalar(state.phase)], state, report, share, run_s, compile_s))
    return Fit(state, _current_poses(problem, _scalar(state.phase), state, data), report, run_s, compile_s)


def _scalar(count: Array) -> int:
    """Returns a counter, which is the same for all starts."""
    return int(np.asarray(count).reshape(-1)[0])


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
    """Makes a state, or one for each of several keys."""
    if key.ndim:
        return jax.vmap(lambda one: _init(problem, data, one))(key)
    params = problem.init(problem.config, key, data)
    moments = problem.optimizer(problem.config, problem.phases[0]).init(params)
    zero = jnp.zeros((), jnp.int32)
    return FitState(params, moments, jax.random.key_data(key), zero, zero, zero)


def _enter_phase(problem: Problem, state: FitState, data: Any) -> FitState:
    """Returns the state at the start of the next phase if the phase is over and not the last; else the same state."""
    phase = _scalar(state.phase)
    if phase + 1 == len(problem.phases) or _scalar(state.phase_step) < problem.phases[phase].num_steps:
        return state
    return begin_phase(problem, state, data, phase=phase + 1)


def _over_starts(function: Callable[..., Any], state: FitState, data: Any) -> Any:
    """Calls the function on one state, or on all starts side by side."""
    return jax.vmap(function, in_axes=(0, None))(state, data) if state.step.ndim else function(state, data)


@kept_jit("problem", "phase")
def _current_poses(problem: Problem, phase: int, state: FitState, data: Any) -> Any:
    return _over_starts(lambda s, d: problem.poses(problem.config, problem.phases[phase], s.params, d), state, data)


@kept_jit("problem", "phase_index")
def _advance(problem: Problem, phase_index: int, state: FitState, data: Any) -> tuple[FitState, Report]:
    """Runs one call of steps of a phase."""
    phase = problem.phases[phase_index]
    optimizer = problem.optimizer(problem.config, phase)

    def call(state: FitState, data: Any) -> tuple[FitState, Report]:
        def one_step(state: FitState, _: None) -> tuple[FitState, tuple[Array, Any]]:
            key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.step)
            loss_of = partial(problem.loss, problem.config, phase)
            (loss, terms), gradient = jax.value_and_grad(loss_of, has_aux=True)(
                state.params, data, state.phase_step, key
            )
            updates, moments = optimizer.update(gradient, state.optimizer, state.params)
            params = optax.apply_updates(state.params, updates)
            counts = {"phase_step": state.phase_step + 1, "step": state.step + 1}
            return replace(state, params=params, optimizer=moments, **counts), (loss, terms)

        state, (losses, terms) = jax.lax.scan(one_step, state, length=steps_per_call(problem, phase))
        return state, Report(losses, terms, problem.poses(problem.config, phase, state.params, data))

    return _over_starts(call, state, data)
