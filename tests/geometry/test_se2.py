import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from dpmjax.geometry import rigid, se2
from tests.tolerances import ACCUMULATED, DOUBLE, ROUNDING

KINDS = {"numpy": np.asarray, "jax": lambda x: jnp.asarray(x, jnp.float32)}
TOLERANCE = {"numpy": DOUBLE, "jax": ROUNDING}


def random_poses(seed: int, *shape: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(size=(*shape, 2)), rng.uniform(-3, 3, (*shape, 1))], -1)


def matrix_of(pose: np.ndarray) -> np.ndarray:
    """The oracle, one pose: rotation and translation written down."""
    x, y, heading = (float(value) for value in pose)
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


@pytest.fixture(params=sorted(KINDS))
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


def test_matrix_and_pose_are_inverse_to_each_other(kind: str) -> None:
    pose = random_poses(0, 4, 5)
    matrix = se2.to_matrix(KINDS[kind](pose))
    np.testing.assert_allclose(matrix[2, 3], matrix_of(pose[2, 3]), **TOLERANCE[kind])
    np.testing.assert_allclose(se2.from_matrix(matrix), pose, **TOLERANCE[kind])


def test_compose_inverse_and_relative_are_those_of_matrices(kind: str) -> None:
    a, b = random_poses(1, 20), random_poses(2, 20)
    one, other = KINDS[kind](a), KINDS[kind](b)
    for row in range(20):
        A, B = matrix_of(a[row]), matrix_of(b[row])
        for found, expected in (
            (se2.compose(one, other), A @ B),
            (se2.inverse(one), np.linalg.inv(A)),
            (se2.relative(one, other), np.linalg.inv(A) @ B),
        ):
            np.testing.assert_allclose(matrix_of(found[row]), expected, **TOLERANCE[kind])


def test_kind_and_dtype_are_kept() -> None:
    pose = random_poses(7, 3)
    assert isinstance(se2.compose(pose, pose), np.ndarray)
    assert se2.inverse(pose).dtype == np.float64
    traced = se2.relative(jnp.asarray(pose, jnp.float32), pose.astype(np.float32))
    assert isinstance(traced, jax.Array)
    assert traced.dtype == jnp.float32


def test_a_path_is_as_long_as_its_steps() -> None:
    poses = np.array([[1.0, 1.0, 0.5], [4.0, 5.0, -2.0], [4.0, 5.0, 3.0], [4.0, 3.0, 0.0]])
    np.testing.assert_allclose(se2.driven_lengths(poses), [0.0, 5.0, 5.0, 7.0], **DOUBLE)
    np.testing.assert_array_equal(se2.driven_lengths(poses[:1]), [0.0])


def test_motions_are_within_both_limits(kind: str) -> None:
    motions = KINDS[kind](np.array([[0.3, 0.3, 0.1], [0.3, 0.3, 2 * np.pi - 0.1], [0.4, -0.4, 0.0], [0.0, 0.0, -0.3]]))
    np.testing.assert_array_equal(se2.is_within(motions, 0.5, 0.2), [True, True, False, False])


def test_chain_multiplies_the_steps() -> None:
    steps = random_poses(8, 6)
    T = np.eye(3)
    poses = se2.chain(steps)
    np.testing.assert_array_equal(poses[0], np.zeros(3))
    for step, pose in zip(steps, poses[1:], strict=True):
        T = T @ matrix_of(step)
        np.testing.assert_allclose(matrix_of(pose), T, **DOUBLE)


def test_transform_is_the_homogeneous_product(kind: str) -> None:
    pose, points = random_poses(9, 3), np.random.default_rng(10).normal(size=(3, 7, 2))
    moved = se2.transform_points(KINDS[kind](pose), KINDS[kind](points))
    for row in range(3):
        homogeneous = np.concatenate([points[row], np.ones((7, 1))], -1)
        np.testing.assert_allclose(moved[row], (homogeneous @ matrix_of(pose[row]).T)[:, :2], **TOLERANCE[kind])


def test_adjoint_moves_a_tangent_through_a_pose() -> None:
    pose, tangent = random_poses(11), np.random.default_rng(12).normal(size=3)

    def hat(v: np.ndarray) -> np.ndarray:
        return np.array([[0.0, -v[2], v[0]], [v[2], 0.0, v[1]], [0.0, 0.0, 0.0]])

    T = matrix_of(pose)
    moved = expm(hat(se2.adjoint(pose) @ tangent))
    np.testing.assert_allclose(moved, T @ expm(hat(tangent)) @ np.linalg.inv(T), **DOUBLE)


def test_wrap_angle_keeps_the_direction_and_small_angles(kind: str) -> None:
    angle = KINDS[kind](np.linspace(-20, 20, 401))
    wrapped = np.asarray(se2.wrap_angle(angle))
    assert np.all(np.abs(wrapped) <= np.pi + 1e-6)
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * np.asarray(angle)), **ACCUMULATED)
    assert float(se2.wrap_angle(angle[:1] * 0 + 1e-9)[0]) == float(KINDS[kind](1e-9))


def test_wrap_angle_has_slope_one_everywhere() -> None:
    angle = jnp.array([-9.0, -jnp.pi, 0.0, jnp.pi, 5.0])
    np.testing.assert_array_equal(jax.vmap(jax.grad(se2.wrap_angle))(angle), np.ones(5))


@pytest.mark.parametrize("turn", [0.0, 1e-5, 0.5, -3.0])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_share_of_a_motion_is_that_of_its_twist(turn: float, share: float) -> None:
    twist = np.array([20.0, -30.0, turn], np.float32)
    whole, part = (np.asarray(se2.from_matrix(rigid.exp(np.float32(x) * twist)), np.float64) for x in (1.0, share))
    np.testing.assert_allclose(se2.share_of(whole, share), part, rtol=1e-5, atol=1e-5)
