"""Pipelines say in one sentence that they cannot be traced."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpmjax
from tests.deeppointmap import toy

SCAN, SCANS, POSES = jnp.ones((9, 3)), jnp.ones((2, 9, 2)), jnp.zeros((2, 3))
KEY = jax.random.key(0)
PIPELINES: dict[str, Callable[[Any], Any]] = {
    "register_scans": lambda x: dpmjax.register_scans(x * SCANS, key=KEY),
    "refine": lambda x: dpmjax.refine(SCANS, x * POSES),
    "fit_deepmapping": lambda x: dpmjax.fit_deepmapping(x * SCANS, key=KEY),
    "register_depth": lambda x: dpmjax.register_depth(x * jnp.ones((2, 4, 4)), key=KEY),
    "relocalize": lambda x: dpmjax.relocalize(None, x * SCANS),
    "encode": lambda x: dpmjax.encode(None, x * SCAN),
    "encode_scans": lambda x: dpmjax.encode_scans(None, [x * SCAN]),
    "register": lambda x: dpmjax.register(None, SCAN, x * SCAN),
    "register_pairs": lambda x: dpmjax.register_pairs(None, [SCAN], [x * SCAN]),
    "overlap": lambda x: dpmjax.overlap(None, SCAN, x * SCAN),
    "overlap_pairs": lambda x: dpmjax.overlap_pairs(None, [SCAN], [x * SCAN]),
    "registration_recall": lambda x: dpmjax.registration_recall(x * jnp.ones((2, 4, 4)), jnp.ones((2, 4, 4))),
    "run_slam": lambda x: dpmjax.run_slam(None, [x * SCAN]),
    "localize": lambda x: dpmjax.localize(None, None, x * SCAN),
    "run_agents": lambda x: dpmjax.run_agents(None, [[x * SCAN]]),
    "merge_maps": lambda x: dpmjax.merge_maps(dpmjax.Model({"x": x}, toy.MODEL)),
    "train": lambda x: dpmjax.train([], toy.TRAINING, start=dpmjax.Model({"x": x}, toy.MODEL)),
}


@pytest.mark.parametrize("name", PIPELINES)
def test_a_traced_argument_is_refused_in_one_sentence(name: str, as_user) -> None:
    call = PIPELINES[name]
    for traced, x in ((jax.jit(call), 1.0), (jax.vmap(call), np.ones(2)), (jax.grad(call), 1.0)):
        with pytest.raises(ValueError, match=f"^{name}: runs on the host and cannot be traced by jit, vmap or grad; "):
            traced(x)


def test_a_model_is_made_outside_of_programs(as_user) -> None:
    with pytest.raises(ValueError, match="^init_model: runs on the host and cannot be traced"):
        jax.jit(lambda key: dpmjax.init_model(key, toy.MODEL))(KEY)
