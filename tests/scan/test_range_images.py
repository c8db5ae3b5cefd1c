from __future__ import annotations

import numpy as np
import pytest

from dpmjax.scan.lidar.surfaces import range_image, view_points


def sphere(radius: float, num: int = 20000) -> np.ndarray:
    directions = np.random.default_rng(0).normal(size=(num, 3))
    return radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("radius", "is_visible", "is_contradicted"), [(20.0, True, False), (10.0, True, True), (40.0, False, False)]
)
def test_points_before_on_and_behind_a_sphere(radius: float, is_visible: bool, is_contradicted: bool) -> None:
    visible, contradicted = view_points(range_image(sphere(20.0)), sphere(radius, 500))
    assert (visible == is_visible).all()
    assert (contradicted == is_contradicted).all()


def test_margin_grows_with_the_range() -> None:
    image = range_image(sphere(30.0))
    assert not view_points(image, sphere(27.5, 100))[1].any()
    assert view_points(image, sphere(26.5, 100))[1].all()


def test_nothing_is_known_where_nothing_was_measured() -> None:
    ahead = sphere(20.0)
    ahead = ahead[ahead[:, 0] > 10]
    visible, contradicted = view_points(range_image(ahead), np.array([[-5.0, 0, 0], [5.0, 0, 0]]))
    np.testing.assert_array_equal(visible, [False, True])
    np.testing.assert_array_equal(contradicted, [False, True])
    assert not np.any(view_points(range_image(np.zeros((0, 3))), ahead))


def test_the_image_has_no_seam_behind_the_lidar() -> None:
    """Azimuths just above -pi and just below pi are neighbours."""
    wall = np.array([[-20.0, 0.05, 0.0]])
    assert view_points(range_image(wall), np.array([[-5.0, -0.05, 0.0]]))[1].all()
