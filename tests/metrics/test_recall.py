"""Registration recall: which motions count as right."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.metrics import registration_recall


def motion(angle_deg: float, translation: tuple[float, float, float], axis=(0.0, 0.0, 1.0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(angle_deg) * np.asarray(axis)).as_matrix()
    T[:3, 3] = translation
    return T


def test_errors_are_told_and_limits_hold() -> None:
    true = np.stack([motion(170, (1, 2, 3), (0.6, 0.8, 0))] * 4)
    changes = [motion(0, (0, 0, 0)), motion(4.9, (0, 0, 0)), motion(5.1, (0, 0, 0)), motion(180, (0, 0, 0))]
    found = registration_recall(true @ np.stack(changes), true)
    np.testing.assert_allclose(found.rotation_errors_deg, [0, 4.9, 5.1, 180], atol=1e-6)
    np.testing.assert_array_equal(found.is_right, [True, True, False, False])
    assert found.recall == 0.5
    shifted = true.copy()
    shifted[:, 0, 3] += [0, 1.9, 2.1, np.nan]
    np.testing.assert_array_equal(registration_recall(shifted, true).is_right, [True, True, False, False])


def test_small_angles_keep_their_digits() -> None:
    found = registration_recall(motion(1e-6, (0, 0, 0))[None], np.eye(4)[None])
    np.testing.assert_allclose(found.rotation_errors_deg, 1e-6, rtol=1e-6)


def test_without_pairs_nothing_is_right() -> None:
    assert registration_recall(np.zeros((0, 4, 4)), np.zeros((0, 4, 4))).recall == 0


@pytest.mark.usefixtures("as_user")
def test_shapes_must_match() -> None:
    with pytest.raises(ValueError, match="T_estimated"):
        registration_recall(np.zeros((2, 4, 4)), np.zeros((3, 4, 4)))
