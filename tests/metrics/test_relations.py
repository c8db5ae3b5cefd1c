"""Errors against hand-checked relations, and their files."""

from pathlib import Path

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.io import InputError, read_relations
from dpmjax.metrics import relation_errors
from dpmjax.sequences import Relations

TIMES = 100.0 + 0.5 * np.arange(20)
RNG = np.random.default_rng(0)
POSES = se2.chain(np.column_stack([RNG.uniform(0.1, 0.5, 19), RNG.normal(0, 0.1, 19), RNG.normal(0, 0.3, 19)]))
FROM, TO = np.array([0, 3, 17]), np.array([5, 2, 18])
RELATIONS = Relations(TIMES[FROM], TIMES[TO], np.asarray(se2.relative(POSES[FROM], POSES[TO])))


def test_right_poses_have_no_error_in_any_world_frame() -> None:
    found = relation_errors(RELATIONS, TIMES, np.asarray(se2.compose(np.array([50.0, -9.0, 3.0]), POSES)))
    np.testing.assert_allclose(found.translation_m, 0, atol=1e-9)
    np.testing.assert_allclose(found.rotation_deg, 0, atol=1e-9)
    assert found.is_used.all()


def test_the_order_of_the_scans_does_not_matter() -> None:
    wrong = POSES + RNG.normal(size=POSES.shape)
    order = RNG.permutation(20)
    one, other = relation_errors(RELATIONS, TIMES, wrong), relation_errors(RELATIONS, TIMES[order], wrong[order])
    np.testing.assert_allclose(one.translation_m, other.translation_m)
    np.testing.assert_allclose(one.rotation_deg, other.rotation_deg)


def test_a_scan_that_is_off_is_off_by_that() -> None:
    poses = POSES.copy()
    poses[5] = se2.compose(poses[5], np.array([0.3, -0.4, 0.1]))
    found = relation_errors(RELATIONS, TIMES, poses)
    np.testing.assert_allclose(found.translation_m, [0.5, 0, 0], atol=1e-9)
    np.testing.assert_allclose(found.rotation_deg, [np.degrees(0.1), 0, 0], atol=1e-9)


def test_relations_without_scans_are_left_out() -> None:
    is_kept = np.arange(20) != 2
    found = relation_errors(RELATIONS, TIMES[is_kept], POSES[is_kept])
    np.testing.assert_array_equal(found.is_used, [True, False, True])
    assert len(found.translation_m) == 2
    with pytest.raises(ValueError, match="no relation has both"):
        relation_errors(RELATIONS, TIMES + 0.1, POSES)


def test_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.relations"
    path.write_text("# t1 t2 ...\n1.5 2.5 0.4 -0.1 0 0 0 0.25\n1.5 3 1 2 0 0 0 -3\n")
    found = read_relations(path)
    np.testing.assert_array_equal(found.times_to, [2.5, 3])
    np.testing.assert_array_equal(found.T_from_to, [[0.4, -0.1, 0.25], [1, 2, -3]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n", "some not finite"),
        ("", "no row"),
        ("1 2 3 4 5 0 0 0\n", "a height or a tilt"),
        ("1 2 nan 4 0 0 0 0\n", "some not finite"),
        ("1 2 x 4 0 0 0 0\n", "row 1 is not 8 numbers"),
    ],
)
def test_files_that_are_none_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.relations"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_relations(path)


def test_the_published_relations_belong_to_the_recorded_log(real_data: Path) -> None:
    from dpmjax.io import read_sequence

    log = read_sequence(real_data / "carmen_raw" / "aces.clf.gz")
    found = relation_errors(read_relations(real_data / "carmen_raw" / "aces.relations"), log.times, log.odometry_poses)
    assert found.is_used.all()
    assert len(found.is_used) == 1279
    assert np.median(found.translation_m) < 0.1  # most of them are short
    assert 0.2 < found.translation_m.mean() < 1.0
