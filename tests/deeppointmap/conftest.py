"""The toy network, made once."""

from __future__ import annotations

import jax
import pytest

import dpmjax
from tests.deeppointmap import toy


@pytest.fixture(scope="session")
def model() -> dpmjax.Model:
    return dpmjax.init_model(jax.random.key(0), toy.MODEL)
