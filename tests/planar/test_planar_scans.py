from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.scan import PlanarScans, planar_scans
from dpmjax.simulation import simulate_sequence
from dpmjax.types import ScanSet

NUM_BEAMS = 180
HALF_SIDES = np.array([120.0, 80.0])


def scan_of_room(position: tuple[float, float], noise: float = 0.0, seed: int = 0) -> tuple[ScanSet, np.ndarray]:
    """One scan of a rectangular room around the origin, and the true normal at every beam (float64 oracle)."""
    angle = np.arange(NUM_BEAMS) * 2 * np.pi / NUM_BEAMS + 0.003
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    reach = (np.sign(direction) * HALF_SIDES - position) / direction
    axis = reach.argmin(-1)
    normals = -np.sign(direction) * np.eye(2)[axis]
    ranges = reach.min(-1) + np.random.default_rng(seed).normal(scale=noise, size=NUM_BEAMS)
    points = (direction * ranges[:, None]).astype(np.float32)
    return ScanSet(jnp.asarray(points)[None], jnp.ones((1, NUM_BEAMS), bool)), normals


def angles_between(lines: PlanarScans, normals: np.ndarray) -> np.ndarray:
    """Degrees, of the beams that have a line."""
    cosine = (np.asarray(lines.normals[0], np.float64) * normals).sum(-1)[np.asarray(lines.is_on_line[0])]
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def test_normals_of_noise_free_walls_are_exact_also_beside_corners() -> None:
    scan, normals = scan_of_room((15.0, -20.0))
    lines = planar_scans(scan)
    # Every beam lies on a straight wall; but the outermost ones of the array, which have neighbours on one side.
    assert np.asarray(lines.is_on_line).mean() > 0.97
    assert angles_between(lines, normals).max() < 0.1
    offset = ((np.asarray(lines.centroids - lines.points)[0]) * normals).sum(-1)
    assert np.abs(offset[np.asarray(lines.is_on_line[0])]).max() < 0.01
    assert lines.noise < 1e-3


@pytest.mark.parametrize(("noise", "median_deg"), [(0.5, 2.0), (1.0, 3.0), (3.0, 8.0)])
def test_normals_are_honest_under_noise(noise: float, median_deg: float) -> None:
    scan, normals = scan_of_room((15.0, -20.0), noise)
    lines = planar_scans(scan)
    assert np.asarray(lines.is_on_line).mean() > 0.8
    # Two neighbouring beams alone would be off by more than twenty degrees.
    assert np.median(angles_between(lines, normals)) < median_deg
    towards_sensor = np.asarray((lines.normals * lines.points).sum(-1)) < 0
    assert towards_sensor[np.asarray(lines.is_on_line)].all()


@pytest.mark.parametrize("noise", [0.5, 1.0, 3.0])
def test_noise_is_measured_within_a_third(noise: float) -> None:
    sequence = simulate_sequence(0, 20, num_beams=256, range_noise_px=noise)
    assert planar_scans(sequence.points, sequence.mask).noise == pytest.approx(noise, rel=0.3)


@pytest.mark.parametrize("filling", [0.0, 1e6, np.nan])
def test_masked_beams_never_matter(filling: float) -> None:
    scan, _ = scan_of_room((15.0, -20.0), noise=0.5)
    mask = np.random.default_rng(3).uniform(size=(1, NUM_BEAMS)) < 0.9
    masked = ScanSet(jnp.where(jnp.asarray(mask)[..., None], scan.points, filling), jnp.asarray(mask))
    reference = ScanSet(jnp.where(jnp.asarray(mask)[..., None], scan.points, 1.0), jnp.asarray(mask))
    lines, expected = planar_scans(masked), planar_scans(reference)
    np.testing.assert_array_equal(lines.is_on_line, expected.is_on_line)
    assert not np.asarray(lines.is_on_line)[~mask].any()
    for name in ("normals", "centroids"):
        valid = np.asarray(lines.is_on_line)
        np.testing.assert_array_equal(
            np.asarray(getattr(lines, name))[valid], np.asarray(getattr(expected, name))[valid]
        )
    for name in ("points", "normals", "centroids"):
        assert np.isfinite(getattr(lines, name)).all()
    assert (lines.noise, lines.typical_range) == (expected.noise, expected.typical_range)


@pytest.mark.slow
def test_padded_equals_unpadded() -> None:
    scan, _ = scan_of_room((15.0, -20.0), noise=0.5)
    padded = ScanSet(jnp.pad(scan.points, ((0, 0), (0, 40), (0, 0))), jnp.pad(scan.mask, ((0, 0), (0, 40))))
    lines, expected = planar_scans(padded), planar_scans(scan)
    np.testing.assert_array_equal(lines.is_on_line[:, :NUM_BEAMS], expected.is_on_line)
    assert not np.asarray(lines.is_on_line[:, NUM_BEAMS:]).any()
    np.testing.assert_array_equal(
        lines.normals[:, :NUM_BEAMS][expected.is_on_line], expected.normals[expected.is_on_line]
    )


@pytest.mark.slow
@pytest.mark.parametrize("num_beams", [3, 5, 16])
def test_scans_of_few_beams_are_prepared(num_beams: int) -> None:
    angle = 2 * np.pi * np.arange(num_beams) / num_beams
    points = 10.0 * np.stack([np.cos(angle), np.sin(angle)], -1)
    scans = planar_scans(np.stack([points, points + 0.1]))
    assert scans.typical_range == pytest.approx(10.0, rel=0.05)
    assert np.isfinite(scans.normals).all()


def test_isolated_points_have_no_line_and_no_noise() -> None:
    scan, _ = scan_of_room((15.0, -20.0))
    lines = planar_scans(scan.points, (jnp.arange(NUM_BEAMS) % 3 == 0)[None])
    assert not np.asarray(lines.is_on_line).any()
    assert not np.asarray(lines.normals).any()
    assert lines.noise < 1e-3
    assert np.isfinite(lines.tolerances).all()


def test_shuffled_beams_are_sorted_by_angle_with_masked_ones_last() -> None:
    scan, _ = scan_of_room((15.0, -20.0))
    mask = scan.mask.at[0, ::7].set(False)
    order = np.random.default_rng(1).permutation(NUM_BEAMS)
    done = planar_scans(scan.points[:, order], mask[:, order])
    count = int(mask.sum())
    assert np.asarray(done.mask[0]).tolist() == [True] * count + [False] * (NUM_BEAMS - count)
    angle = np.arctan2(done.points[0, :count, 1], done.points[0, :count, 0])
    assert (np.diff(angle) > 0).all()
    kept = {tuple(p) for p in np.asarray(done.points[0, :count])}
    assert kept == {tuple(p) for p in np.asarray(scan.points[0])[np.asarray(mask[0])]}


def test_second_call_compiles_nothing(assert_compiles_nothing) -> None:
    one, _ = scan_of_room((15.0, -20.0))
    other, _ = scan_of_room((0.0, 5.0))
    planar_scans(one)
    with assert_compiles_nothing():
        planar_scans(other)


@pytest.mark.parametrize("start", [0, 50])
def test_ordered_beams_keep_their_places_wherever_the_scan_starts_and_either_way_round(start: int) -> None:
    scan, _ = scan_of_room((15.0, -20.0))
    points = np.roll(np.asarray(scan.points), start, axis=1)
    for some in (points, points[:, ::-1]):
        np.testing.assert_array_equal(planar_scans(some).points, some)


def test_lengths_grow_with_the_scans() -> None:
    scan, _ = scan_of_room((15.0, -20.0), noise=0.5)
    one, three = planar_scans(scan.points), planar_scans(3.0 * scan.points)
    ranges = np.linalg.norm(scan.points, axis=-1)[np.asarray(one.is_on_line)]
    assert one.typical_range == pytest.approx(np.percentile(ranges, 90), rel=1e-5)
    assert three.typical_range == pytest.approx(3 * one.typical_range, rel=1e-5)
    np.testing.assert_allclose(three.tolerances, 3 * np.array(one.tolerances), rtol=1e-3)


@pytest.mark.parametrize(
    ("points", "mask", "message"),
    [
        (np.zeros((3, 4)), None, "points: expected shape"),
        (np.zeros((3, 4, 3)), None, "points: expected shape"),
        (np.zeros((0, 4, 2)), None, "at least one scan"),
        (np.ones((3, 2, 2)), None, "three beams"),
        (np.full((3, 4, 2), np.nan), None, "points: expected finite"),
        (np.ones((3, 4, 2)), np.ones((3, 5), bool), "mask: expected bool of shape"),
        (np.ones((3, 4, 2)), np.ones((3, 4)), "mask: expected bool"),
        (np.ones((3, 4, 2)), np.zeros((3, 4), bool), "mask: expected at least one valid beam"),
    ],
)
def test_bad_input_is_named(as_user, points, mask, message) -> None:
    with pytest.raises(ValueError, match=message):
        planar_scans(points, mask)
