"""Laws of the one door for scans and of NumPy files."""

import gzip

import numpy as np
import pytest

from dpmjax.io import InputError, ScanSequence, read_sequence
from dpmjax.sequences import has_angular_order
from tests.data_sets import write_deepmapping_folder
from tests.processes import run_python

NUM_BEAMS = 20
ANGLES = np.linspace(-2, 2, NUM_BEAMS)
POINTS = 3.0 * np.tile(np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1), (6, 1, 1)) * np.arange(1, 7)[:, None, None]
POSES = np.arange(18.0).reshape(6, 3) / 10
RANGES = "1 2 3" + 17 * " 1"
LOG = "".join(f"FLASER 20 {RANGES} {i} 0 0 {i} 1 0 {i} h {i}\n" for i in range(6))


def save(tmp_path, name="a.npy", **arrays):
    path = tmp_path / name
    if name.endswith(".npy"):
        np.save(path, arrays["points"])
    else:
        np.savez(path, **arrays)
    return path


def test_npy_and_npz_of_points_agree(tmp_path):
    deep = np.concatenate([POINTS, np.full((6, NUM_BEAMS, 1), 9.0)], axis=2)  # the third coordinate is ignored
    plain = read_sequence(save(tmp_path, points=deep))
    rich = read_sequence(save(tmp_path, "a.npz", points=POINTS, poses=POSES, odometry=POSES + 1, times=np.arange(6)))
    np.testing.assert_allclose(plain.points, POINTS, rtol=1e-6)
    np.testing.assert_array_equal(plain.points, rich.points)
    assert plain.points.dtype == np.float32
    assert plain.is_organised
    assert plain.reference_poses is None
    assert (rich.reference_poses == POSES).all()
    assert (rich.odometry_poses == POSES + 1).all()
    assert (rich.times == np.arange(6)).all()


def test_ranges_and_angles_make_the_points(tmp_path):
    ranges = np.linalg.norm(POINTS, axis=2)
    ranges[0, 1], ranges[1, 2], ranges[2, 3] = np.inf, 0.0, np.nan
    scans = read_sequence(save(tmp_path, "a.npz", ranges=ranges, angles=ANGLES))
    np.testing.assert_allclose(scans.points[3:], POINTS[3:], rtol=1e-6)
    assert (~scans.mask).sum() == 3
    assert not scans.mask[[0, 1, 2], [1, 2, 3]].any()


def test_matrices_and_triples_are_the_same_poses(tmp_path):
    matrices = np.tile(np.eye(3), (6, 1, 1))
    matrices[:, 0, 0] = matrices[:, 1, 1] = np.cos(POSES[:, 2])
    matrices[:, 1, 0], matrices[:, 0, 1] = np.sin(POSES[:, 2]), -np.sin(POSES[:, 2])
    matrices[:, :2, 2] = POSES[:, :2]
    scans = read_sequence(save(tmp_path, "a.npz", points=POINTS, poses=matrices))
    np.testing.assert_allclose(scans.reference_poses, POSES, atol=1e-12)


def test_nan_points_and_the_mask_are_invalid_beams(tmp_path):
    holed, mask = POINTS.copy(), np.ones((6, NUM_BEAMS), bool)
    holed[0, 1], holed[2, 3], holed[4, 0], mask[1, 2] = np.nan, 0.0, [np.inf, np.nan], False
    scans = read_sequence(save(tmp_path, "a.npz", points=holed, mask=mask))
    assert not scans.mask[[0, 1, 2, 4], [1, 2, 3, 0]].any()
    assert scans.mask.sum() == 6 * NUM_BEAMS - 4
    assert (scans.points[~scans.mask] == 0).all()


def with_value(index, value):
    points = POINTS.copy()
    points[index] = value
    return points


@pytest.mark.parametrize(
    ("arrays", "found"),
    [
        ({"points": with_value((0, 1, 0), np.nan)}, r"scan, beam \[\[0, 1\]\]"),
        ({"points": with_value((slice(2, 5),), np.nan)}, r"3 of 6 scans .* \[2\]"),
        ({"points": with_value((), np.nan)}, "6 of 6 scans have no valid beam"),
        ({"points": POINTS[0]}, r"give points \(n, b, 2\)"),
        ({"points": np.concatenate([POINTS, POINTS[..., :1]], axis=2)}, "the third coordinates of the points differ"),
        ({"points": POINTS[..., :1]}, r"give points \(n, b, 2\)"),
        ({"points": POINTS.astype(str)}, "points are"),
        ({"points": np.ones((5, 10, 3))}, "scans of 10 beams"),
        ({"points": np.ones((5, 40, 2))}, "one and the same"),
        ({"points": POINTS[:1]}, "1 scan; give two or more"),
        ({"points": POINTS[:0]}, "0 scans; give two or more"),
        ({"points": POINTS[:0], "poses": POSES[:0]}, "0 scans; give two or more"),
        ({"ranges": np.ones((6, NUM_BEAMS), complex), "angles": np.ones(NUM_BEAMS)}, "complex128"),
        ({"points": POINTS * 1000}, "millimetres"),
        ({"points": POINTS / 1000}, "median range"),
        ({"points": POINTS, "poses": POSES[:4]}, "poses are"),
        ({"points": POINTS, "poses": POSES * np.nan}, "NaN"),
        ({"points": POINTS, "mask": np.ones(3, bool)}, "mask are"),
        ({"points": POINTS, "mask": np.zeros((6, NUM_BEAMS), bool)}, "no valid beam"),
        ({"points": POINTS, "times": np.ones(3)}, "times are"),
        ({"points": POINTS, "unit": "miles"}, "miles"),
        ({"ranges": np.ones((6, NUM_BEAMS)), "angles": np.ones(3)}, "angles"),
        ({"other": POSES}, "other"),
    ],
)
def test_bad_arrays_are_told_in_one_line(tmp_path, arrays, found):
    path = save(tmp_path, "bad.npz", **arrays)
    with pytest.raises(InputError, match=found) as caught:
        read_sequence(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.tar", "a.log", "a.log.gz", "a.clf", "a", "a.csv"])
@pytest.mark.parametrize("content", [None, b"", b"garbage garbage"])
def test_missing_empty_and_foreign_files_are_refused(tmp_path, name, content):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_sequence(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_single_scan_is_named(tmp_path):
    with pytest.raises(InputError, match="1 of 6 scans chosen; give two or more"):
        read_sequence(save(tmp_path, points=POINTS), selection=slice(1))


def test_contents_decide_where_the_ending_does_not(tmp_path, small):
    (tmp_path / "log").write_text(LOG)
    assert read_sequence(tmp_path / "log").unit == "m"
    save(tmp_path, points=POINTS).rename(tmp_path / "array")
    assert len(read_sequence(tmp_path / "array")) == 6
    assert len(read_sequence(write_deepmapping_folder(tmp_path / "folder", small))) == 3
    with pytest.raises(InputError, match="single scan"):
        read_sequence(tmp_path / "folder" / "000.pcd")
    with pytest.raises(InputError, match=r"without \.pcd"):
        read_sequence(tmp_path)


def test_sub_range_and_stride_take_poses_and_times_along(tmp_path):
    path = tmp_path / "a.log.gz"
    path.write_bytes(gzip.compress(LOG.encode()))
    part = read_sequence(path, selection=slice(1, 6, 2))
    for poses in (part.reference_poses, part.odometry_poses):
        np.testing.assert_array_equal(poses[:, 0], [1, 3, 5])
    np.testing.assert_array_equal(part.times, [1, 3, 5])
    assert part.points.shape == (3, NUM_BEAMS, 2)


@pytest.mark.parametrize("choice", [slice(99, None), slice(None, None, 0), slice(-1, None), slice(None, None, 6)])
def test_choices_that_leave_nothing_are_refused(tmp_path, choice):
    path = tmp_path / "a.log"
    path.write_text(LOG)
    with pytest.raises(InputError, match=r"a\.log"):
        read_sequence(path, selection=choice)


def test_log_with_every_beam_at_maximum_range_is_refused(tmp_path):
    (tmp_path / "a.log").write_text(LOG.replace(RANGES, 20 * " 81.91"))
    with pytest.raises(InputError, match="maximum range"):
        read_sequence(tmp_path / "a.log")
    with pytest.raises(InputError, match="metres"):
        read_sequence(tmp_path / "a.log", unit="px")


@pytest.mark.parametrize("turn", [1, -1])
def test_order_of_beams_is_seen(turn):
    points, mask = POINTS[:, ::turn].astype(np.float32), np.ones((6, NUM_BEAMS), bool)
    shuffled = points[:, np.random.default_rng(0).permutation(NUM_BEAMS)]
    assert has_angular_order(points, mask)
    assert not has_angular_order(shuffled, mask)
    assert not has_angular_order(points, np.zeros_like(mask))
    rolled = np.roll(points, 3, axis=1)
    assert has_angular_order(points, mask) == has_angular_order(rolled, mask)


@pytest.mark.parametrize(
    "change", [{"unit": "mm"}, {"mask": np.ones((6, 6), bool)}, {"points": POSES}, {"times": np.ones(2)}]
)
def test_sequence_refuses_shapes_that_do_not_belong_together(as_user, change):
    fields = {"name": "a", "points": POINTS.astype(np.float32), "mask": np.ones((6, NUM_BEAMS), bool), "unit": "m"}
    whole = ScanSequence(**fields)
    assert len(whole.take(slice(1, 4))) == 3
    with pytest.raises(ValueError, match=next(iter(change))):
        ScanSequence(**(fields | change))


def test_import_is_light():
    heavy = "('scipy', 'jax', 'matplotlib')"
    code = f"import sys, dpmjax.io as d; d.InputError; print(*[m for m in {heavy} if m in sys.modules])"
    done = run_python("-c", code)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


def test_the_largest_range_of_many_beams_is_no_echo(tmp_path, caplog):
    rng = np.random.default_rng(0)
    ranges = rng.uniform(1.0, 7.0, (6, NUM_BEAMS))
    is_blind = rng.random(ranges.shape) < 0.3
    read = read_sequence(save(tmp_path, "a.npz", ranges=np.where(is_blind, 8.0, ranges), angles=ANGLES))
    np.testing.assert_array_equal(read.mask, ~is_blind)
    assert "no echo" in read.notes[0].text
    # Other codes of no echo, and ranges of which the largest is but one.
    for code in (0.0, -1.0, np.inf, np.nan):
        read = read_sequence(save(tmp_path, "a.npz", ranges=np.where(is_blind, code, ranges), angles=ANGLES))
        np.testing.assert_array_equal(read.mask, ~is_blind)
        assert not read.notes


def test_angles_in_degrees_are_recognised(tmp_path):
    ranges = np.linalg.norm(POINTS, axis=2)
    degrees = read_sequence(save(tmp_path, "a.npz", ranges=ranges, angles=np.degrees(ANGLES)))
    np.testing.assert_allclose(degrees.points, POINTS, rtol=1e-5)
    assert "degrees" in degrees.notes[0].text
    assert degrees.notes[0].is_doubt


@pytest.mark.parametrize("is_constant", [True, False])
def test_odometry_of_one_pose_is_none(tmp_path, is_constant, caplog):
    ranges = np.random.default_rng(0).uniform(1, 5, (6, 40))
    odometry = np.tile([3.0, 1.0, 0.5], (6, 1)) + [[0.0 if is_constant else 0.01 * i, 0, 0] for i in range(6)]
    np.savez(tmp_path / "a.npz", ranges=ranges, angles=np.linspace(-2, 2, 40), odometry=odometry)
    assert (read_sequence(tmp_path / "a.npz").odometry_poses is None) == is_constant
    assert ("same pose at every scan" in caplog.text) == is_constant


def test_one_covered_scan_is_named_and_stays(tmp_path, caplog):
    ranges = np.random.default_rng(0).uniform(1, 5, (6, 40))
    ranges[3] = np.nan
    read = read_sequence(save(tmp_path, "a.npz", ranges=ranges, angles=np.linspace(-2, 2, 40)))
    assert len(read) == 6
    assert "no echo in scan 3; put between the scans before and after" in caplog.text
