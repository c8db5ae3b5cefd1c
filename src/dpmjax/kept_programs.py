"""Traced programs kept on disk, so that a later process does not trace them again (`jax.export`).

JAX's own cache keeps compiled programs, but each process traces its functions before it looks there. Tracing takes 2 s
for the matching of descriptors, and 5 s for a fit of DeepMapping. With `enable_compile_cache`, functions of `kept_jit`
are traced only once. They are traced again for other shapes, other static arguments, or another version of this
package.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import logging
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import jax
import numpy as np
from jax import export

from dpmjax.compile_cache import TRACED_FOLDER

Result = TypeVar("Result")
_log = logging.getLogger(__name__)


# A program on flat arrays, and the structure of its result.
_Program = tuple[Any, Any]


class KeptProgram:
    """A compiled function whose traced programs are kept; see `kept_jit`."""

    def __init__(self, function: Callable[..., Any], static_argnames: tuple[str, ...]) -> None:
        functools.update_wrapper(self, function)
        self._jitted: Any = jax.jit(function, static_argnames=static_argnames)
        self._signature, self._static = inspect.signature(function), static_argnames
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._programs: dict[Any, _Program | None] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Calls the function."""
        program, leaves = self._find(args, kwargs)
        if program is None:
            return self._jitted(*args, **kwargs)
        call, tree = program
        return jax.tree.unflatten(tree, call(*leaves))

    def prepare(self, *args: Any, **kwargs: Any) -> Callable[[], Any]:
        """Compiles the program of these arguments; the result calls it with them."""
        program, leaves = self._find(args, kwargs)
        options: Any = jax.config
        if options.jax_disable_jit:
            return functools.partial(self._jitted, *args, **kwargs)
        if program is None:
            self._jitted.lower(*args, **kwargs).compile()
            return functools.partial(self._jitted, *args, **kwargs)
        call, tree = program
        compiled = call.lower(*leaves).compile()
        return lambda: jax.tree.unflatten(tree, compiled(*leaves))

    def _find(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[_Program | None, list[Any]]:
        """Returns the program of these arguments and its input; None where nothing is kept."""
        folder, settings = os.environ.get(TRACED_FOLDER), cast(Any, jax.config)
        if not folder or settings.jax_disable_jit or jax.device_count() > 1:
            return None, []
        bound = self._signature.bind(*args, **kwargs)
        bound.apply_defaults()
        static = {name: bound.arguments.pop(name) for name in self._static}
        leaves, tree = jax.tree.flatten(dict(bound.arguments))
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return None, []
        # `jax.typeof` takes several times as long, and small programs are called thousands of times.
        shapes = tuple(
            (np.shape(leaf), getattr(leaf, "dtype", type(leaf)), getattr(leaf, "weak_type", False)) for leaf in leaves
        )
        key = (*static.values(), tree, shapes, settings.jax_enable_x64)
        if key not in self._programs:
            self._programs[key] = self._load(static, leaves, tree)
        return self._programs[key], leaves

    def _load(self, static: dict[str, Any], leaves: list[Any], tree: Any) -> _Program | None:
        """Reads a program from its file, or makes the file; None for a function that cannot be exported."""

        def trace() -> tuple[Any, bytearray]:
            trees = []

            def flat(*leaves: Any) -> list[Any]:
                found, result = jax.tree.flatten(self._jitted(**jax.tree.unflatten(tree, leaves), **static))
                trees.append(result)
                return found

            program = export.export(jax.jit(flat))(*leaves).serialize()
            return trees[0], program

        shapes = [str(jax.typeof(leaf)) for leaf in leaves]
        try:
            result, program = keep_result(self._name, (static, tree, shapes, jax.default_backend()), trace)
            return jax.jit(export.deserialize(program).call), result
        except Exception as error:
            _log.info("%s is traced by each process: %s", self._name, error)
            return None


def kept_jit(*static_argnames: str) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Compiles a function as `jax.jit` does, and keeps its traced programs where `enable_compile_cache` keeps programs.

    Inside other traced functions it is `jax.jit`.

    Args:
        *static_argnames: names of the static arguments, which can be pickled.

    Returns:
        The decorator.
    """
    return lambda function: KeptProgram(function, static_argnames)


def prepare_program(function: Callable[..., Any], *args: Any) -> Callable[[], Any]:
    """Compiles the program of these arguments ahead, once.

    Args:
        function: function of `kept_jit`.
        *args: its arguments.

    Returns:
        The call of the function with them.
    """
    return cast(KeptProgram, function).prepare(*args)


def keep_result(name: str, key: Any, compute: Callable[[], Result]) -> Result:
    """Returns what a function computes, from its file where `enable_compile_cache` keeps programs.

    Args:
        name: name of the result.
        key: everything that the result depends on except the source of this package; can be pickled.
        compute: computes the result, which can be pickled.

    Returns:
        The result.
    """
    folder = os.environ.get(TRACED_FOLDER)
    if not folder:
        return compute()
    enables_x64 = cast(Any, jax.config).jax_enable_x64
    identity = pickle.dumps((name, key, jax.__version__, enables_x64, source_version()))
    path = Path(folder) / f"{name.removeprefix('dpmjax.')}-{hashlib.sha256(identity).hexdigest()[:24]}"
    try:
        return cast(Result, pickle.loads(path.read_bytes()))
    except Exception:
        result = compute()
    part = path.with_name(f"{path.name}.{os.getpid()}")
    with contextlib.suppress(OSError):  # a full disk costs time, not results
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(pickle.dumps(result))
        part.replace(path)
    return result


@functools.cache
def source_version() -> str:
    """Returns a digest of the files of this package, so that a changed function is traced again."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        state = path.stat()
        digest.update(f"{path} {state.st_size} {state.st_mtime_ns}".encode())
    return digest.hexdigest()
