"""The whole registration by one call: it is the chain of its steps, and fails early where it must."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import numpy as np
import pytest

from dpmjax.deepmapping import (
    DeepMappingConfig,
    Fit,
    FitState,
    MappingData,
    Problem,
    fit_deepmapping,
    preset,
    with_steps,
)
from dpmjax.geometry import se2
from dpmjax.scan import planar_scans
from dpmjax.sequences import ScanSequence
from dpmjax.simulation import simulate_sequence
from dpmjax.slam import (
    DEEPMAPPING,
    GIVEN_POSES,
    START_NAMES,
    RegisteredScans,
    RegistrationConfig,
    RegistrationHooks,
    assess_trajectory,
    choose_trajectory,
    fit_in_order,
    incremental_icp,
    refine,
    register_globally,
    register_scans,
)
from dpmjax.slam.planar import pipeline
from dpmjax.types import ScanSet
from tests.planar.conftest import ate

KEY = jax.random.key(0)
SHORT = RegistrationConfig(fit=with_steps(preset("fast"), 2))
ICP, GLOBAL = START_NAMES["icp-plane"], START_NAMES["global"]


def scan_set(sequence: ScanSequence) -> ScanSet:
    return ScanSet(np.asarray(sequence.points), np.asarray(sequence.mask))


class Untrained:
    """Makes an engine that returns its start; records the rows and the arguments of the engine."""

    def __init__(self, num_steps: int = 1) -> None:
        self.num_steps = num_steps
        self.rows: np.ndarray = np.zeros(0, int)
        self.start: np.ndarray | None = None
        self.config: DeepMappingConfig | None = None

    def __call__(self, rows: np.ndarray) -> Callable[..., Fit]:
        self.rows = rows
        return self.train

    def train(self, problem: Problem, data: MappingData, *, key: jax.Array) -> Fit:
        self.start, self.config = None if data.start is None else np.asarray(data.start), problem.config
        np.testing.assert_array_equal(jax.random.key_data(key), jax.random.key_data(KEY))
        phase, count = np.int32(0), np.int32(self.num_steps)
        poses = np.zeros((len(self.rows), 3)) if data.start is None else data.start
        return Fit(FitState(None, None, key, phase, count, count), poses, None, 0.0, 0.0)  # type: ignore[arg-type]


def register(sequence: ScanSequence, config: RegistrationConfig = SHORT, **options) -> RegisteredScans:
    """The registration without a trained fit."""
    options.setdefault("hooks", RegistrationHooks(engine=Untrained()))
    return register_scans(scan_set(sequence), config, key=KEY, **options)


@pytest.fixture(scope="module")
def few(walk) -> ScanSequence:
    return walk.take(slice(0, 10))


@pytest.mark.slow
def test_the_poses_are_those_of_the_steps_one_after_the_other(few) -> None:
    found = register_scans(scan_set(few), SHORT, key=KEY)
    lines = planar_scans(few.points, few.mask)
    start = incremental_icp(lines).poses
    fitted = fit_deepmapping(scan_set(few), SHORT.fit, key=KEY, start=start).poses
    steps = {ICP: start, DEEPMAPPING: fitted, f"{ICP}, refined": refine(lines, start).poses}
    if f"{DEEPMAPPING}, refined" in found.candidates:
        steps[f"{DEEPMAPPING}, refined"] = refine(lines, fitted).poses
    kept, scores = choose_trajectory(lines, steps)
    assert (found.start, found.kept) == (ICP, kept)
    assert {name: candidate.score for name, candidate in found.candidates.items()} == scores
    for name, poses in steps.items():
        np.testing.assert_array_equal(found.candidates[name].poses, poses)
    np.testing.assert_array_equal(found.poses, steps[kept])
    np.testing.assert_array_equal(found.fitted.poses, fitted)
    np.testing.assert_array_equal(found.T_world_scan, se2.to_matrix(found.poses))
    assert found.assessment == assess_trajectory(lines, steps[kept])
    assert ate(found.poses, few.reference_poses) < 0.1


@pytest.mark.slow
def test_a_shuffled_set_is_registered_without_its_order(walk) -> None:
    order = np.random.default_rng(1).permutation(12)
    shuffled, engine = walk.take(order), Untrained()
    config = replace(SHORT, is_ordered=False)
    found = register(shuffled, config, hooks=RegistrationHooks(engine=engine))
    assert found.start == GLOBAL
    assert ate(found.poses, shuffled.reference_poses) < 0.1
    # The fit gets all scans once, and neighbours in space follow each other.
    assert engine.config == SHORT.fit
    assert sorted(engine.rows) == list(range(12))
    assert np.abs(np.diff(order[engine.rows])).mean() < np.abs(np.diff(order)).mean()
    start, unit = found.candidates[GLOBAL].poses, found.fitted.unit
    np.testing.assert_allclose(engine.start * [unit, unit, 1.0], start[engine.rows], atol=1e-4)
    np.testing.assert_allclose(found.fitted.poses, start, atol=1e-4)


@pytest.mark.slow
def test_untrusted_odometry_leads_to_a_registration_without_it(walk) -> None:
    astray = np.random.default_rng(0).normal(size=(len(walk), 3)) * [200.0, 200.0, 1.0]
    found = register(walk, odometry=astray)
    assert found.start == "odometry"
    assert found.kept == f"{ICP}, refined"
    assert found.assessment.is_trusted
    assert ate(found.poses, walk.reference_poses) < 0.1
    # Who names the odometry gets no other start.
    assert ICP not in " ".join(register(walk, odometry=astray, start="odometry").candidates)


@pytest.mark.slow
def test_a_resumed_fit_that_is_over_is_a_candidate_and_one_without_a_step_is_not(few) -> None:
    start = few.reference_poses
    for num_steps, names in ((0, [GIVEN_POSES]), (20, [GIVEN_POSES, DEEPMAPPING])):
        hooks = RegistrationHooks(engine=Untrained(num_steps))
        found = register(few, start=start, hooks=hooks)
        assert found.fitted.report is None
        # The engine returns its start, so the refined fit would be the refined start.
        assert list(found.candidates) == [*names, f"{GIVEN_POSES}, refined"]


def test_a_fit_in_another_order_returns_poses_in_that_of_the_scans(few) -> None:
    along = np.random.default_rng(0).permutation(10)
    start = np.column_stack([along.astype(float), np.zeros((10, 2))])
    for is_ordered in (True, False):
        engine = Untrained()
        fitted = fit_in_order(scan_set(few), SHORT.fit, key=KEY, start=start, is_ordered=is_ordered, engine_of=engine)
        np.testing.assert_allclose(fitted.poses, start, atol=1e-4)
        # Along a line, a tour has one long step at most.
        steps = np.sort(np.abs(np.diff(along[engine.rows])))
        assert (steps[-2] == 1) == (not is_ordered)


@pytest.mark.slow
def test_stop_ends_the_fit_between_calls_of_its_step(few) -> None:
    shares: list[float] = []

    def note(stage: str, share: float) -> None:
        if stage == DEEPMAPPING:
            shares.append(share)

    config = RegistrationConfig(fit=with_steps(replace(preset("fast"), steps_per_call=2), 20))
    hooks = RegistrationHooks(note, stop=lambda: len(shares) > 2)
    found = register(few, config, start=few.reference_poses, hooks=hooks)
    assert len(shares) == 3
    assert 0.0 == shares[0] < shares[1] < shares[2] < 1.0
    assert list(found.candidates) == [GIVEN_POSES, DEEPMAPPING]
    assert found.fitted.report is not None


@pytest.mark.slow
def test_a_cold_start_has_no_poses_and_is_not_refined(few) -> None:
    engine = Untrained()
    found = register(few, replace(SHORT, refine=False), start="zero", hooks=RegistrationHooks(engine=engine))
    assert engine.start is None
    assert list(found.candidates) == [START_NAMES["zero"], DEEPMAPPING]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda points: {"scans": points[:, :, 0]}, r"scans: expected shape \(n, b, 2\)"),
        (lambda points: {"scans": points[:1]}, "scans: expected at least 2"),
        (lambda points: {"scans": points[[0, 0, 0]]}, "scans: expected two different ones, got 3"),
        (lambda points: {"scans": points * [*[[[0.0]]] * 6, *[[[1.0]]] * 4]}, "scans: scan 0 has no valid beam"),
        (lambda points: {"start": np.zeros((3, 3))}, "start: expected shape"),
        (lambda points: {"start": np.full((10, 3), np.nan)}, "start: expected finite"),
        (lambda points: {"start": "guess"}, "start: expected one of auto"),
        (lambda points: {"start": "odometry"}, "start: .*odometry"),
        (lambda points: {"odometry": np.zeros((9, 3))}, "odometry: expected shape"),
        (lambda points: {"odometry": np.full((10, 3), np.inf)}, "odometry: expected finite"),
    ],
)
def test_bad_input_is_named_before_any_work(few, change: Callable, message: str) -> None:
    points = np.where(few.mask[..., None], few.points, 0.0)
    stages: list[str] = []
    hooks = RegistrationHooks(on_progress=lambda stage, _: stages.append(stage))
    with pytest.raises(ValueError, match=f"^{message}"):
        register_scans(**{"scans": points, "config": SHORT, "key": KEY, "hooks": hooks, **change(points)})
    assert not stages
    with pytest.raises(ValueError, match="^min_distance: "):
        RegistrationConfig(min_distance=0.0)


@pytest.mark.parametrize("start", ["odometry", "icp-plane", "icp-point", "zero"])
def test_scans_without_an_order_refuse_starts_that_need_one(few, start: str) -> None:
    unordered = replace(SHORT, is_ordered=False)
    with pytest.raises(ValueError, match="^start: "):
        register(few, unordered, start=start)
    with pytest.raises(ValueError, match="^odometry: "):
        register(few, unordered, odometry=few.reference_poses)


@pytest.mark.slow
def test_the_registration_is_the_same_where_jax_has_64_bits(few, float64) -> None:
    def poses() -> list[np.ndarray]:
        lines = planar_scans(scan_set(few))
        refined = refine(lines, incremental_icp(lines).poses)
        return [register_scans(few.points, SHORT, key=KEY).poses, refined.poses, register_globally(lines)]

    with jax.enable_x64(False):
        expected = poses()
    for found, same in zip(poses(), expected, strict=True):
        np.testing.assert_array_equal(found, same)


METRES_A_PX = 0.02
APART = replace(SHORT, refine=False, min_distance=0.5)


@pytest.fixture(scope="module")
def whole() -> ScanSequence:
    """Forty scans about 15 cm apart."""
    walk = simulate_sequence(0, 40, seed=3, num_beams=128)
    poses = np.asarray(walk.reference_poses) * [METRES_A_PX, METRES_A_PX, 1.0]
    return replace(walk, points=(walk.points * METRES_A_PX).astype(np.float32), unit="m", reference_poses=poses)


@pytest.mark.slow
def test_the_scans_alone_tell_which_lie_apart(whole, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "_MAX_WHOLE", 20)
    # The odometry tells nonsense, and is not used.
    found, truth = (
        register(whole, APART, start="icp-plane", odometry=whole.reference_poses[::-1]),
        whole.reference_poses,
    )
    chosen = found.recording.chosen
    assert (chosen[0], chosen[-1]) == (0, 39)
    assert 5 < len(chosen) < 20
    steps = se2.relative(truth[chosen[:-2]], truth[chosen[1:-1]])
    is_apart = np.hypot(steps[:, 0], steps[:, 1]) > 0.9 * 0.5
    assert (is_apart | (np.abs(steps[:, 2]) > 0.9 * APART.min_turn)).all()
    filled = found.recording.between(truth[chosen])
    assert np.hypot(*(filled - truth)[:, :2].T).max() < 0.05
    assert len(found.poses) == 40
    assert ate(found.poses, truth) < 0.05
    without = register(whole, APART)
    np.testing.assert_array_equal(without.recording.chosen, chosen)


@pytest.mark.slow
def test_few_scans_without_odometry_and_scans_without_limit_are_all_registered(whole) -> None:
    start, wheels = whole.reference_poses, 1e-6 * np.arange(40.0)[:, None] * np.ones(3)
    assert len(register(whole, APART, start=start).recording.chosen) == 40
    everyone = replace(APART, min_distance=None)
    assert len(register(whole, everyone, start=start, odometry=wheels).recording.chosen) == 40
    # Odometry that hardly moves: the first and the last scan.
    assert len(register(whole, APART, start=start, odometry=wheels).recording.chosen) == 2
