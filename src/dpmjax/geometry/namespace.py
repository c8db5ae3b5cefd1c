"""One implementation for both kinds of arrays: NumPy's (float64 on the host) and JAX's (traced, differentiable)."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def namespace_of(*arrays: Any) -> ModuleType:
    """Returns `jax.numpy` if one array or more is JAX's, else `numpy`."""
    return jnp if any(isinstance(array, jax.Array) for array in arrays) else np


def matmul(a: Any, b: Any) -> Any:
    """Multiplies matrices at full precision on every device.

    Args:
        a: (..., n, k), of NumPy or of JAX.
        b: (..., k, m).

    Returns:
        (..., n, m), of JAX if one of the two is.
    """
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST) if namespace_of(a, b) is jnp else np.matmul(a, b)


def safe_sqrt(squared: Any) -> Any:
    """Computes square roots whose derivative at 0 is 0.

    Args:
        squared: any shape, of NumPy or of JAX; numbers below 0 count as 0.

    Returns:
        The roots, same shape.
    """
    xp = namespace_of(squared)
    # The slope of the square root is infinite at zero: guard its input, then its output.
    is_zero = squared <= 0
    return xp.where(is_zero, 0, xp.sqrt(xp.where(is_zero, 1, squared)))
