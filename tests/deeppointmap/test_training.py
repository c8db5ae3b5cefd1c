"""The step of training: what it changes, what it does not, how often it compiles, on how many devices."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from dpmjax.deeppointmap import SampleMaker, ScanStore, init_training, make_step
from dpmjax.deeppointmap.inference import pyramid_of_scan
from dpmjax.deeppointmap.sampling import RegistrationSample, arrange_groups, draw_groups, stack
from dpmjax.deeppointmap.training import TrainingState, batch_loss
from tests.deeppointmap import toy
from tests.tolerances import ACCUMULATED

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def maker() -> SampleMaker:
    return SampleMaker(ScanStore([toy.drive()], toy.MODEL.preprocess), toy.TRAINING, seed=0)


@pytest.fixture(scope="module")
def step():
    return make_step(toy.TRAINING)


@pytest.fixture(scope="module")
def start() -> TrainingState:
    return init_training(jax.random.key(0), toy.TRAINING)


def changed(before: TrainingState, after: TrainingState) -> dict[str, bool]:
    """For each part of the network, whether any parameter in it moved."""
    parts = {"encoder": lambda p: p["encoder"]} | {
        name: lambda p, name=name: p["decoder"][name] for name in before.params["decoder"]
    }
    return {
        name: any(
            bool(np.any(np.asarray(a) != np.asarray(b)))
            for a, b in zip(jax.tree.leaves(part(before.params)), jax.tree.leaves(part(after.params)), strict=True)
        )
        for name, part in parts.items()
    }


@pytest.mark.slow
def test_loss_falls_on_one_batch_and_all_parts_but_the_overlap_head_learn(maker, step, start) -> None:
    batch, state, losses = maker(0), start, []
    for _ in range(15):
        state, report = step(state, batch)
        losses.append(float(report.loss))
    assert losses[-1] < losses[0] - 0.2
    assert report.terms.num_positives > 0
    moved = changed(start, state)
    del moved["overlap_head"]  # by weight decay alone
    assert all(moved.values()), moved


def test_the_overlap_part_changes_the_overlap_head_alone(maker, step, start) -> None:
    batch = maker(toy.TRAINING.registration_steps)
    state, report = step(start, batch)
    assert changed(start, state) == {name: name == "overlap_head" for name in changed(start, state)}
    assert 0 <= report.overlap_accuracy <= 1
    assert np.isnan(report.terms.pairing)


@pytest.mark.slow
def test_a_step_compiles_once_for_each_stage(maker, start, assert_compiles_nothing) -> None:
    step = make_step(toy.TRAINING)
    state = start
    for first in (0, 3, 5):
        state, _ = step(state, maker(first))
        following = maker(first + 1)
        with assert_compiles_nothing():
            state, _ = step(state, following)


@pytest.mark.slow
def test_spare_places_change_nothing(maker, start) -> None:
    config = toy.TRAINING.sampling
    roomy = replace(config, num_scans=9)
    table = maker._store.table
    groups = draw_groups(table, 3, 2, config, np.random.default_rng(1))
    rows = np.concatenate([side for group in groups for side in group])
    drive = toy.drive()
    pyramids = [pyramid_of_scan(drive.read_scan(int(row)), toy.MODEL) for row in rows]
    tight, loose = (stack([arrange_groups(groups, pyramids, table.T_world_lidar[rows], 2, c)]) for c in (config, roomy))
    assert loose.mask.shape[1] > tight.mask.shape[1]
    # That what is masked reaches no gradient either is a law of each term (test_objective).
    loss = jax.jit(lambda params, batch: batch_loss(params, batch, toy.TRAINING)[0])
    np.testing.assert_allclose(loss(start.params, tight), loss(start.params, loose), **ACCUMULATED)


def test_a_batch_of_empty_scans_has_no_loss_and_a_finite_gradient(maker, step, start) -> None:
    batch: RegistrationSample = maker(0)
    levels = tuple(replace(level, mask=np.zeros_like(level.mask)) for level in batch.pyramids.levels)
    state, report = step(start, replace(batch, pyramids=replace(batch.pyramids, levels=levels)))
    assert report.loss == 0
    assert np.isfinite(report.gradient_norm)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.params))


def test_a_sample_depends_on_seed_and_step_alone(maker) -> None:
    fresh = SampleMaker(ScanStore([toy.drive()], toy.MODEL.preprocess), toy.TRAINING, seed=0)
    toy.assert_trees_equal(fresh(4), maker(4))
    assert np.any(fresh(4).pyramids.levels[0].positions != fresh(3).pyramids.levels[0].positions)


EIGHT_DEVICES = """
import jax, numpy as np
from dpmjax.deeppointmap import SampleMaker, ScanStore, init_training
from dpmjax.deeppointmap.processes import BATCH_AXIS, device_mesh, place
from dpmjax.deeppointmap.training import batch_loss
from tests.deeppointmap import toy
assert jax.device_count() == 8
maker = SampleMaker(ScanStore([toy.drive()], toy.MODEL.preprocess), toy.TRAINING, seed=0, num_samples=8)
batch, params = maker(0), init_training(jax.random.key(0), toy.TRAINING).params
gradient = jax.jit(jax.grad(lambda params, batch: batch_loss(params, batch, toy.TRAINING)[0]))
alone = gradient(params, batch)
mesh = device_mesh()
spread = place(batch, mesh, BATCH_AXIS)
assert len(spread.mask.sharding.device_set) == 8 and spread.mask.addressable_shards[0].data.shape[0] == 1
together = gradient(place(params, mesh), spread)
for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
"""


@pytest.mark.slow
def test_eight_devices_find_the_gradient_of_one() -> None:
    flags = "--xla_force_host_platform_device_count=8 --xla_backend_optimization_level=0"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    environment["PYTHONPATH"] = os.pathsep.join([str(REPOSITORY / "src"), str(REPOSITORY)])
    done = subprocess.run(
        [sys.executable, "-c", EIGHT_DEVICES], cwd=REPOSITORY, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
