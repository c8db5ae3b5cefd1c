"""The tolerances of all tests, each with its reason. float32 has a relative rounding of 6e-8."""

from typing import Any

# A handful of float32 operations on numbers of order one: a hundred roundings.
ROUNDING: dict[str, Any] = {"rtol": 1e-5, "atol": 1e-6}

# Sums over hundreds of float32 terms, and square roots of them.
ACCUMULATED: dict[str, Any] = {"rtol": 1e-4, "atol": 1e-5}

# A rotation from a float32 cross covariance: its rounding over the smallest sum of singular values.
ALIGNMENT: dict[str, Any] = {"rtol": 1e-4, "atol": 3e-5}

# A float32 derivative against central differences in float64 (step 1e-6, error about 1e-9).
GRADIENT: dict[str, Any] = {"rtol": 2e-3, "atol": 2e-4}

# float64 against float64, by another formula.
DOUBLE: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-9}
