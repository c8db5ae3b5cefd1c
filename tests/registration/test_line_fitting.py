from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.registration.line_fitting import LineScans, fit_lines, range_noise, sort_by_angle
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


def scans_of_world(noise: float, num_scans: int = 20) -> ScanSet:
    sequence = simulate_sequence(0, num_scans, num_beams=256, range_noise_px=noise)
    return ScanSet(jnp.asarray(sequence.points), jnp.asarray(sequence.mask))


def angles_between(lines: LineScans, normals: np.ndarray) -> np.ndarray:
    """Degrees, of the beams that have a line."""
    cosine = (np.asarray(lines.normals[0], np.float64) * normals).sum(-1)[np.asarray(lines.mask[0])]
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def test_normals_of_noise_free_walls_are_exact_also_beside_corners() -> None:
    scan, normals = scan_of_room((15.0, -20.0))
    lines = fit_lines(scan)
    # Every beam lies on a straight wall; but the outermost ones of the array, which have neighbours on one side.
    assert np.asarray(lines.mask).mean() > 0.97
    assert angles_between(lines, normals).max() < 0.1


def test_lines_pass_through_their_walls() -> None:
    scan, normals = scan_of_room((15.0, -20.0))
    lines = fit_lines(scan)
    offset = ((np.asarray(lines.centroids - lines.points)[0]) * normals).sum(-1)
    assert np.abs(offset[np.asarray(lines.mask[0])]).max() < 0.01


def test_normals_are_turned_towards_the_sensor() -> None:
    scan, _ = scan_of_room((0.0, 0.0), noise=0.5)
    lines = fit_lines(scan)
    assert (np.asarray((lines.normals * lines.points).sum(-1))[np.asarray(lines.mask)] < 0).all()


@pytest.mark.parametrize(("noise", "median_deg"), [(0.5, 2.0), (1.0, 3.0), (3.0, 8.0)])
def test_normals_are_honest_under_noise(noise: float, median_deg: float) -> None:
    scan, normals = scan_of_room((15.0, -20.0), noise)
    lines = fit_lines(scan)
    assert np.asarray(lines.mask).mean() > 0.8
    # Two neighbouring beams alone would be off by more than twenty degrees.
    assert np.median(angles_between(lines, normals)) < median_deg


@pytest.mark.parametrize("noise", [0.5, 1.0, 3.0])
def test_noise_is_measured_within_a_third(noise: float) -> None:
    assert float(range_noise(scans_of_world(noise))) == pytest.approx(noise, rel=0.3)


def test_noise_of_noise_free_scans_is_rounding() -> None:
    assert float(range_noise(scan_of_room((15.0, -20.0))[0])) < 1e-3


@pytest.mark.parametrize("filling", [0.0, 1e6, np.nan])
def test_masked_beams_never_matter(filling: float) -> None:
    scan, _ = scan_of_room((15.0, -20.0), noise=0.5)
    mask = np.random.default_rng(3).uniform(size=(1, NUM_BEAMS)) < 0.9
    masked = ScanSet(jnp.where(jnp.asarray(mask)[..., None], scan.points, filling), jnp.asarray(mask))
    reference = ScanSet(jnp.where(jnp.asarray(mask)[..., None], scan.points, 1.0), jnp.asarray(mask))
    lines, expected = fit_lines(masked), fit_lines(reference)
    np.testing.assert_array_equal(lines.mask, expected.mask)
    assert not np.asarray(lines.mask)[~mask].any()
    for name in ("normals", "centroids"):
        valid = np.asarray(lines.mask)
        np.testing.assert_array_equal(
            np.asarray(getattr(lines, name))[valid], np.asarray(getattr(expected, name))[valid]
        )
    for name in ("points", "normals", "centroids"):
        assert np.isfinite(getattr(lines, name)).all()
    np.testing.assert_array_equal(lines.noise, expected.noise)


def test_padded_equals_unpadded() -> None:
    scan, _ = scan_of_room((15.0, -20.0), noise=0.5)
    padded = ScanSet(jnp.pad(scan.points, ((0, 0), (0, 40), (0, 0))), jnp.pad(scan.mask, ((0, 0), (0, 40))))
    lines, expected = fit_lines(padded), fit_lines(scan)
    np.testing.assert_array_equal(lines.mask[:, :NUM_BEAMS], expected.mask)
    assert not np.asarray(lines.mask[:, NUM_BEAMS:]).any()
    np.testing.assert_array_equal(lines.normals[:, :NUM_BEAMS][expected.mask], expected.normals[expected.mask])


def test_isolated_points_and_empty_scans_have_no_line_and_no_noise() -> None:
    scan, _ = scan_of_room((15.0, -20.0))
    every_third = jnp.arange(NUM_BEAMS) % 3 == 0
    for mask in (every_third[None], jnp.zeros((1, NUM_BEAMS), bool)):
        lines = fit_lines(ScanSet(scan.points, mask))
        assert not np.asarray(lines.mask).any()
        assert not np.asarray(lines.normals).any()
        assert np.isfinite(lines.noise).all()
        assert float(range_noise(ScanSet(scan.points, mask))) == 0.0


def test_sort_by_angle_restores_the_order_and_puts_masked_beams_last() -> None:
    scan, _ = scan_of_room((15.0, -20.0))
    mask = scan.mask.at[0, ::7].set(False)
    order = np.random.default_rng(1).permutation(NUM_BEAMS)
    done = sort_by_angle(ScanSet(scan.points[:, order], mask[:, order]))
    count = int(mask.sum())
    assert np.asarray(done.mask[0]).tolist() == [True] * count + [False] * (NUM_BEAMS - count)
    angle = np.arctan2(done.points[0, :count, 1], done.points[0, :count, 0])
    assert (np.diff(angle) > 0).all()
    kept = {tuple(p) for p in np.asarray(done.points[0, :count])}
    assert kept == {tuple(p) for p in np.asarray(scan.points[0])[np.asarray(mask[0])]}


def test_second_call_compiles_nothing(assert_compiles_nothing) -> None:
    one, _ = scan_of_room((15.0, -20.0))
    other, _ = scan_of_room((0.0, 5.0))
    fit_lines(one)
    with assert_compiles_nothing():
        fit_lines(other)
