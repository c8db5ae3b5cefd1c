"""Laws of `register` and `register_scans`: one name for scans of any sensor."""

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax import simulation
from dpmjax.geometry import rigid, se2
from dpmjax.scan.lidar.record import measure_scan
from dpmjax.simulation.walk2d import scan_world
from dpmjax.slam.unposed import PairMotion, join_scans, refine_jointly
from tests.deeppointmap import toy
from tests.deeppointmap.test_lookalikes import T_TRUE, room
from tests.scan.surface_scenes import motion, seen_from


@pytest.fixture(scope="module")
def pair() -> list[np.ndarray]:
    walk = simulation.simulate_sequence(0, 24, seed=4, range_noise_px=0.5)
    return [walk.points[row] for row in (3, 9)] + [se2.relative(*walk.reference_poses[[9, 3]])]


def test_planar_scans_of_any_size_are_registered_both_ways(pair) -> None:
    first, second, pose = pair
    there = dpmjax.register(None, first, second[::2])
    back = dpmjax.register(None, second[::2], first)
    assert (np.abs(se2.from_matrix(there.T_target_source) - pose) < [1.0, 1.0, 0.01]).all()
    np.testing.assert_allclose(there.T_target_source @ back.T_target_source, np.eye(3), atol=1.0)
    assert min(there.confidence, back.confidence) > 0.9
    assert np.linalg.eigvalsh(there.information).min() > 0


def test_confidence_does_not_hang_on_the_unit(pair) -> None:
    pixels, metres = (dpmjax.register(None, scale * pair[0], scale * pair[1]) for scale in (1.0, 0.05))
    assert metres.confidence == pytest.approx(pixels.confidence, abs=0.02)
    np.testing.assert_allclose(metres.T_target_source[:2, 2], 0.05 * pixels.T_target_source[:2, 2], atol=0.02)


def test_the_axis_of_a_corridor_is_weak_and_no_answer_is_sure() -> None:
    is_wall = np.ones((600, 1600), bool)
    is_wall[280:320] = False
    poses = np.array([[600.0, 300.0, 0.0], [640.0, 305.0, 0.0]])
    points, mask = scan_world(is_wall, poses, max_range=300.0)
    found = dpmjax.register(None, points[1][mask[1]], points[0][mask[0]])
    assert abs(found.weak_direction[0]) > 0.99
    assert found.weak_sigma > 10.0
    assert found.confidence < 0.5


def test_scans_of_two_places_are_not_sure() -> None:
    walks = [simulation.simulate_sequence(world, 8, seed=4) for world in (0, 3)]
    found = dpmjax.register(None, walks[0].points[2], walks[1].points[5])
    assert found.confidence < 0.5


def test_lidar_scans_are_registered_without_a_model() -> None:
    poses = motion(20, (-1.5, 0.4, 0.0)), motion(-75, (1.2, -0.8, 0.1))
    scans = [seen_from(room(np.random.default_rng(seed), has_niche=True), T) for seed, T in enumerate(poses)]
    found = dpmjax.register(None, *scans)
    assert np.linalg.norm(found.T_target_source[:3, 3] - T_TRUE[:3, 3]) < 0.05
    assert found.confidence > 0.5
    bare = [seen_from(room(np.random.default_rng(seed)), T) for seed, T in enumerate(poses)]
    assert dpmjax.register(None, *bare).confidence < 0.9  # a half-turn fits as well


@pytest.mark.slow
def test_depth_images_are_registered() -> None:
    config = simulation.DepthWalkConfig(height=18, width=32)
    walk = simulation.simulate_depth_sequence(0, 4, seed=3, config=config)
    points = np.where(walk.mask[..., None], walk.points, 0.0)
    found = dpmjax.register(None, points[1], points[0])
    T = np.linalg.inv(walk.T_world_camera[0]) @ walk.T_world_camera[1]
    assert np.linalg.norm(found.T_target_source[:3, 3] - T[:3, 3]) < 0.05
    assert 0.0 <= found.confidence <= 1.0


@pytest.mark.parametrize(
    ("source", "target", "words"),
    [
        (np.ones((9, 2)), np.ones((9, 3)), "one sensor"),
        (np.ones((9, 2)), np.ones((4, 5, 3)), "one sensor"),
        (np.ones((4, 5, 3)), np.ones((5, 5, 3)), "of one size"),
        (np.zeros((9, 2)), np.ones((9, 2)), "source: expected 8 valid beams"),
    ],
)
def test_wrong_scans_are_refused(source, target, words) -> None:
    with pytest.raises(ValueError, match=words):
        dpmjax.register(None, source, target)


def test_ordered_lidar_scans_are_sent_to_slam() -> None:
    model = dpmjax.init_model(jax.random.key(0), toy.MODEL)
    with pytest.raises(ValueError, match="run_slam"):
        dpmjax.register_scans(model, [np.ones((9, 3))] * 2, is_ordered=True)


def motions_of(T_world: np.ndarray, *pairs: tuple[int, int, float]) -> list[PairMotion]:
    return [PairMotion(a, b, rigid.inverse(T_world[b]) @ T_world[a], confidence) for a, b, confidence in pairs]


@pytest.fixture(scope="module")
def T_world() -> np.ndarray:
    return np.stack([motion(17.0 * k, (3.0 * k, (-1.0) ** k, 0.1 * k)) for k in range(6)])


def test_unsure_motions_join_parts_only_together(T_world) -> None:
    sure = motions_of(T_world, (1, 0, 0.99), (2, 1, 0.95), (4, 3, 0.97))
    one, two = motions_of(T_world, (3, 2, 0.6)), motions_of(T_world, (3, 2, 0.6), (0, 4, 0.5))
    assert join_scans(sure + one, 6)[1].tolist() == [0, 0, 0, 1, 1, 2]
    T, part = join_scans(sure + two, 6)
    assert part.tolist() == [0, 0, 0, 0, 0, 1]
    np.testing.assert_allclose(rigid.inverse(T[0]) @ T[4], rigid.inverse(T_world[0]) @ T_world[4], atol=1e-9)


def test_a_contradicting_answer_of_equal_support_joins_nothing(T_world) -> None:
    right = motions_of(T_world, (1, 0, 0.95))
    rival = [PairMotion(1, 0, motion(90, (5.0, 5.0, 0.0)), 0.94)]
    assert join_scans(right + rival, 2)[1].tolist() == [0, 1]
    assert join_scans(right, 2)[1].tolist() == [0, 0]


def test_joint_refinement_recovers_the_poses() -> None:
    rng = np.random.default_rng(1)
    T_true = np.stack([motion(30.0 * k, (0.4 * k - 0.6, 0.3 * (-1) ** k, 0.0)) for k in range(4)])
    surfaces = [
        measure_scan(seen_from(room(np.random.default_rng(k), has_niche=True), T)).surface for k, T in enumerate(T_true)
    ]
    noise = [motion(float(rng.normal(0, 1.0)), rng.normal(0, 0.08, 3)) for _ in T_true]
    T = np.stack([T_true[0], *(pose @ off for pose, off in zip(T_true[1:], noise[1:], strict=True))])
    pairs = np.array([[1, 0], [2, 0], [3, 0], [2, 1], [3, 1], [3, 2]])
    refined = refine_jointly(surfaces, T, pairs)
    np.testing.assert_allclose(refined[0], T_true[0], atol=1e-9)
    assert np.abs(refined - T_true).max() < 0.01 < np.abs(T - T_true).max()


@pytest.mark.slow
def test_shuffled_scans_of_two_towns_become_two_parts() -> None:
    drives = [simulation.simulate_drive(seed, length_m=30.0) for seed in (21, 22)]
    rows = [(drive, row) for drive in range(2) for row in (0, 2, 4, 6)]
    order = np.random.default_rng(0).permutation(len(rows))
    shuffled = [rows[k] for k in order]
    found = dpmjax.register_scans(dpmjax.load_model("dpm_small"), [drives[a][b] for a, b in shuffled], is_ordered=False)
    assert len(np.unique(found.part)) == 2
    for drive in range(2):
        own = [k for k, (number, _) in enumerate(shuffled) if number == drive]
        assert len(np.unique(found.part[own])) == 1
        T_true = np.stack([drives[drive].T_world_lidar[shuffled[k][1]] for k in own])
        ate = dpmjax.absolute_trajectory_error(found.T_world_scan[own, :3, 3], T_true[:, :3, 3])
        assert ate < 0.1
