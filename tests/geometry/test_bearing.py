import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax.geometry.bearing import directions_of, from_ray_frame, ray_directions, to_ray_frame, turned_directions
from dpmjax.types import DescriptorCloud
from tests.tolerances import ACCUMULATED


def vectors(seed: int, num: int = 20) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(num, 3)).astype(np.float32)


def motion(angles: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4, dtype=np.float32)
    T[:3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    T[:3, 3] = 1, 2, 3
    return T


def test_to_the_ray_frame_and_back_is_nothing() -> None:
    directions = ray_directions(vectors(0))
    np.testing.assert_allclose(from_ray_frame(to_ray_frame(vectors(1), directions), directions), vectors(1), atol=1e-6)


def test_a_tilted_direction_is_projected_and_has_unit_length() -> None:
    T = motion((0.7, 0.2, -0.1))
    directions = ray_directions(vectors(3))
    in_space = np.column_stack([directions, np.zeros(len(directions))]) @ T[:3, :3].T
    expected = in_space[:, :2] / np.linalg.norm(in_space[:, :2], axis=1, keepdims=True)
    np.testing.assert_allclose(turned_directions(directions, T), expected, **ACCUMULATED)


def test_directions_without_a_horizontal_part_are_forward() -> None:
    np.testing.assert_array_equal(ray_directions(np.array([[0.0, 0, 2]], np.float32)), [[1, 0]])
    upright = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]], np.float32)
    np.testing.assert_array_equal(turned_directions(np.array([[1.0, 0]], np.float32), upright), [[1, 0]])


def test_a_cloud_without_directions_is_one_scan() -> None:
    cloud = DescriptorCloud(jnp.asarray(vectors(4)), jnp.zeros((20, 1)), jnp.ones(20, bool))
    np.testing.assert_array_equal(directions_of(cloud), ray_directions(vectors(4)))
    given = ray_directions(vectors(5))
    np.testing.assert_array_equal(directions_of(cloud.replace(directions=given)), given)
