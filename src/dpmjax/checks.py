"""Checks at the public edge: shapes and types before anything is traced, with errors that name the argument."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, ParamSpec, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from dpmjax.compile_cache import keep_programs
from dpmjax.reading import read_path
from dpmjax.sequences import ScanSequence
from dpmjax.types import AnyArray, ScanSet

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
# Planar scans: beam end points (n, b, 2), with a mask or without, or the file or folder of a sequence.
Beams = ScanSet | ScanSequence | ArrayLike | Path


def runs_on_host(instead: str) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Makes a pipeline refuse traced arguments with one `ValueError`, at its first line, and keep compiled programs.

    Args:
        instead: what to do inside a transformation, for the message, such as "call icp there".

    Returns:
        A decorator.
    """

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        @functools.wraps(function)
        def checked(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((args, kwargs))):
                name = function.__qualname__
                raise ValueError(f"{name}: runs on the host and cannot be traced by jit, vmap or grad; {instead}")
            keep_programs()
            return function(*args, **kwargs)

        return checked

    return decorate


def as_float(name: str, value: AnyArray) -> jax.Array:
    """Makes a JAX float array; half precision becomes float32, integers the default float, others are kept.

    Args:
        name: name of the argument, for messages.
        value: the array.

    Returns:
        The array.

    Raises:
        ValueError: `value` is no array of real numbers.
    """
    if isinstance(value, np.ndarray):
        value = value.astype(value.dtype.newbyteorder("="), copy=False)  # JAX takes the processor's byte order only.
    try:
        array = jnp.asarray(value)
    except TypeError as error:
        raise ValueError(f"{name}: expected real numbers, got dtype {np.asarray(value).dtype}") from error
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array.astype(jnp.promote_types(array.dtype, jnp.float32))  # Decompositions need 32 bits.
    if jnp.issubdtype(array.dtype, jnp.integer):
        return array.astype(float)
    raise ValueError(f"{name}: expected real numbers, got dtype {array.dtype}")


def as_key(name: str, value: Any) -> jax.Array:
    """Makes a typed key of random numbers.

    Args:
        name: name of the argument, for messages.
        value: a key of `jax.random.key`, or of the older `jax.random.PRNGKey`.

    Returns:
        The key.

    Raises:
        ValueError: `value` is something else.
    """
    dtype = getattr(value, "dtype", None)
    if dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key):
        return cast(jax.Array, value)
    if dtype == jnp.uint32 and value.ndim == 1:
        return jax.random.wrap_key_data(value)
    raise ValueError(f"{name}: expected a key such as jax.random.key(0), got {type(value).__name__}")


def as_points(name: str, value: AnyArray, dimensions: tuple[int, ...] | None = None) -> jax.Array:
    """Makes float points.

    Args:
        name: name of the argument, for messages.
        value: the array.
        dimensions: allowed values of d; None allows any above 0.

    Returns:
        (n, d) points.

    Raises:
        ValueError: the shape is another one.
    """
    array = as_float(name, value)
    is_right = array.ndim == 2 and array.shape[1] > 0 and (dimensions is None or array.shape[1] in dimensions)
    if not is_right:
        wanted = "d" if dimensions is None else " or ".join(map(str, dimensions))
        raise ValueError(f"{name}: expected shape (n, {wanted}), got {array.shape}")
    return array


def as_host_points(name: str, value: ArrayLike | Path) -> np.ndarray:
    """Makes points in space, on the host; the dtype is kept.

    Args:
        name: name of the argument, for messages.
        value: the array, or the file of a scan.

    Returns:
        (n, 3) points, an array of NumPy.

    Raises:
        ValueError: the shape is another one, or the numbers are not real.
    """
    array = np.asarray(read_path(value, "io.read_lidar_file"))
    if array.ndim != 2 or array.shape[1] != 3:
        hint = "; pass points[:, :3] without the reflectance" if array.shape[1:] == (4,) else ""
        raise ValueError(f"{name}: expected shape (n, 3), got {array.shape}{hint}")
    if not (np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)):
        raise ValueError(f"{name}: expected real numbers, got dtype {array.dtype}")
    return array


def as_mask(name: str, value: AnyArray | None, shape: tuple[int, ...], xp: ModuleType = jnp) -> Any:
    """Makes a boolean mask.

    Args:
        name: name of the argument, for messages.
        value: the array; None stands for all True.
        shape: shape of the mask.
        xp: `numpy` or `jax.numpy`, the kind of the mask.

    Returns:
        The mask.

    Raises:
        ValueError: the shape is another one, or the dtype is not bool.
    """
    array = xp.ones(shape, bool) if value is None else xp.asarray(value)
    if array.dtype != bool or array.shape != shape:
        raise ValueError(f"{name}: expected bool of shape {shape}, got {array.dtype} of {array.shape}")
    return array


def as_beams(name: str, value: Beams) -> ScanSet:
    """Makes planar scans with a mask; beams with coordinates that are not finite, or both zero, measured nothing.

    Args:
        name: name of the argument, for messages.
        value: (n, b, 2) beam end points in the sensor frames; a ScanSet or ScanSequence, whose mask is kept; or
            the file or folder of a sequence.

    Returns:
        The scans, zeros where nothing was measured.

    Raises:
        ValueError: the shape is another one, or a valid beam of a ScanSet is not finite.
    """
    value = cast(Beams, read_path(value, "io.read_sequence"))
    try:
        points: Any = value.points if isinstance(value, ScanSet | ScanSequence) else value
        points = np.asarray(points, np.float32)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected numbers (n, b, 2), got {type(value).__name__}") from error
    if points.ndim != 3 or points.shape[-1] != 2:
        raise ValueError(f"{name}: expected shape (n, b, 2), got {points.shape}")
    if isinstance(value, ScanSet | ScanSequence):
        mask = np.asarray(value.mask, bool)
    else:
        mask = np.isfinite(points).all(-1) & (np.abs(points).sum(-1) > 0)
    require_shape(f"mask of {name}", mask, points.shape[:2])
    # On the host, because each operation would compile a program for each number of scans.
    clean = np.where(mask[..., None], points, np.float32(0.0))
    if not np.isfinite(clean).all():
        raise ValueError(f"{name}: expected finite coordinates where the mask is True")
    return ScanSet(points=jax.device_put(clean), mask=jax.device_put(mask))


def require_shape(name: str, array: AnyArray, shape: tuple[int, ...]) -> None:
    """Checks a shape.

    Args:
        name: name of the argument, for the message.
        array: the argument.
        shape: the shape it must have.

    Raises:
        ValueError: the shape is another one.
    """
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")


def require_value(is_right: Any, name: str, expected: str, got: Any) -> None:
    """Checks that an argument is as expected.

    Args:
        is_right: True where it is.
        name: name of the argument, for the message.
        expected: the expected values, for the message.
        got: the given value.

    Raises:
        ValueError: it is not; the message names all three.
    """
    if not is_right:
        raise ValueError(f"{name}: expected {expected}, got {got}")


def require_positive(name: str, value: Any) -> None:
    """Checks that a number is above zero; a traced number passes.

    Args:
        name: name of the argument, for the message.
        value: the argument.

    Raises:
        ValueError: it is no number, zero, negative or NaN.
    """
    if not isinstance(value, jax.core.Tracer) and (isinstance(value, str) or not value > 0):
        raise ValueError(f"{name}: expected a number above 0, got {value}")


def require_count(name: str, value: int) -> None:
    """Checks that an integer is at least one.

    Args:
        name: name of the argument, for the message.
        value: the argument.

    Raises:
        ValueError: the integer is below one.
    """
    if value < 1:
        raise ValueError(f"{name}: expected at least 1, got {value}")


def require_pairs(sources: Sequence[Any], targets: Sequence[Any]) -> None:
    """Checks that each source has a target, and that there is a pair.

    Args:
        sources: the argument `sources`.
        targets: the argument `targets`.

    Raises:
        ValueError: the lengths differ or are 0.
    """
    require_value(len(sources) > 0, "sources", "at least one", "none")
    if len(sources) != len(targets):
        raise ValueError(f"targets: expected {len(sources)}, one for each source, got {len(targets)}")


def require_fields(config: object, *names: str, low: float, high: float = math.inf) -> None:
    """Checks that fields of a configuration lie within bounds.

    Args:
        config: the configuration.
        *names: names of the fields.
        low: least value.
        high: largest value.

    Raises:
        ValueError: a field is out of bounds or NaN.
    """
    for name in names:
        if not low <= getattr(config, name) <= high:
            expected = f"at least {low}" if high == math.inf else f"from {low} to {high}"
            raise ValueError(f"{name}: expected {expected}, got {getattr(config, name)}")


def require_positive_fields(config: object, *names: str) -> None:
    """Checks that fields of a configuration are above zero; a `ValueError` names one that is not.

    Args:
        config: the configuration.
        *names: names of the fields.
    """
    for name in names:
        require_positive(name, getattr(config, name))


def require_one_of(name: str, value: str, options: Iterable[str]) -> None:
    """Checks that a word is one of the options.

    Args:
        name: name of the argument, for messages.
        value: the word.
        options: the allowed words.

    Raises:
        ValueError: `value` is another word.
    """
    if value not in options:
        raise ValueError(f"{name}: expected one of {', '.join(options)}, got {value!r}")


def require_type(name: str, value: object, expected: type, source: str) -> None:
    """Checks the type of an argument that another function makes.

    Args:
        name: name of the argument, for messages.
        value: the argument.
        expected: its type.
        source: the function or class that makes it.

    Raises:
        ValueError: `value` is something else, such as a path.
    """
    if not isinstance(value, expected):
        raise ValueError(f"{name}: expected one from {source}, got {type(value).__name__}")
