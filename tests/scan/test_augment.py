from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.geometry import rigid
from dpmjax.scan import AugmentConfig, augment_scan
from dpmjax.scan.lidar import augment
from dpmjax.scan.lidar.augment import (
    BOX_GAP_M,
    JITTER_CLIP_SIGMAS,
    is_behind_box,
    is_behind_boxes,
    is_behind_sectors,
    random_motion,
    random_motions_on_host,
)
from dpmjax.types import PointCloud
from tests.tolerances import ACCUMULATED

NOTHING = AugmentConfig(
    max_drop_ratio=0.0,
    sector_probability=0.0,
    box_probability=0.0,
    max_yaw_rad=0.0,
    max_tilt_rad=0.0,
    translation_sigma_m=0.0,
    jitter_sigma_m=0.0,
)
KEYS = [jax.random.key(seed) for seed in range(40)]
behind_box = jax.jit(is_behind_box)
motions = jax.jit(jax.vmap(lambda key: random_motion(AugmentConfig(), key=key)))


def cloud(n: int = 300, num_valid: int = 250) -> PointCloud:
    points = (10 * np.random.default_rng(0).normal(size=(n, 3))).astype(np.float32)
    return PointCloud(jnp.asarray(points), jnp.arange(n) < num_valid)


def augment_all(config: AugmentConfig, scan: PointCloud):
    return jax.device_get(jax.jit(jax.vmap(lambda key: augment_scan(scan, config, key=key)))(jnp.stack(KEYS)))


def test_nothing_asked_for_nothing_done() -> None:
    scan = cloud()
    augmented = jax.tree.map(lambda leaf: leaf[0], augment_all(NOTHING, scan))
    np.testing.assert_array_equal(augmented.T_augmented_lidar, np.eye(4))
    valid = augmented.cloud.points[augmented.cloud.mask]
    np.testing.assert_array_equal(np.sort(valid, axis=0), np.sort(np.asarray(scan.points)[:250], axis=0))
    assert np.argmax(np.linalg.norm(valid, axis=1)) == 0


def test_motion_is_the_one_that_is_told() -> None:
    config, scan = replace(NOTHING, max_yaw_rad=3.0, max_tilt_rad=0.3, translation_sigma_m=3.0), cloud()
    many = augment_all(config, scan)
    for T, points, mask in zip(many.T_augmented_lidar, many.cloud.points, many.cloud.mask, strict=True):
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), **ACCUMULATED)
        assert np.linalg.det(T[:3, :3]) > 0
        back = rigid.transform_points(rigid.inverse(T), points[mask])
        order, expected = (np.lexsort(np.round(p, 2).T) for p in (np.asarray(back), np.asarray(scan.points)[:250]))
        np.testing.assert_allclose(np.asarray(back)[order], np.asarray(scan.points)[:250][expected], atol=1e-4)


def test_drop_ratio_is_uniform() -> None:
    many = augment_all(replace(NOTHING, max_drop_ratio=0.5), cloud())
    ratio = 1 - many.cloud.mask.sum(axis=1) / 250
    assert ratio.min() < 0.1
    assert 0.4 < ratio.max() < 0.62
    assert 0.15 < ratio.mean() < 0.35


def test_sectors_hide_a_wedge_from_some_range_on(monkeypatch) -> None:
    angle, radius = np.meshgrid(np.linspace(-np.pi, np.pi, 720, endpoint=False), [1.0, 4.9, 5.1, 40.0])
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=-1).astype(np.float32)
    for name, value in (("MAX_SECTORS", 1), ("SECTOR_WIDTH_DEG", (60.0, 60.0)), ("SECTOR_MIN_RANGE_M", (5.0, 5.0))):
        monkeypatch.setattr(augment, name, value)
    hide = jax.jit(lambda key: is_behind_sectors(points.reshape(-1, 3), key=key))
    for key in KEYS[:5]:
        hidden = np.asarray(hide(key)).reshape(radius.shape)
        assert not hidden[:2].any()
        np.testing.assert_allclose(hidden[2:].sum(axis=1), 120, atol=2)
        assert np.count_nonzero(hidden[3] != np.roll(hidden[3], 1)) == 2  # one piece


@pytest.mark.parametrize("seed", range(3))
def test_box_shadow_is_that_of_dense_samples_on_the_beam(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = (6 * rng.normal(size=(200, 3))).astype(np.float32)
    centre, size, heading = rng.normal(size=3) * 3, rng.uniform(0.5, 3, 3), rng.uniform(-3, 3)
    hidden = behind_box(points, *(jnp.asarray(x, jnp.float32) for x in (centre, size, heading)))
    samples = points[:, None] * np.linspace(0, 1, 4001)[:, None] - centre
    cos, sin = np.cos(heading), np.sin(heading)
    turned = samples @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]).T
    depth = (np.abs(turned) - size / 2).max(axis=-1).min(axis=1)
    np.testing.assert_array_equal(np.asarray(hidden)[np.abs(depth) > 1e-2], (depth < 0)[np.abs(depth) > 1e-2])


def test_boxes_never_hide_what_is_nearer_than_their_gap() -> None:
    directions = np.random.default_rng(0).normal(size=(500, 3))
    near = (0.97 * BOX_GAP_M[0] * directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    far = 60 * near
    hide = jax.jit(jax.vmap(lambda key, points: is_behind_boxes(points, key=key), (0, None)))
    assert not np.any(hide(jnp.stack(KEYS), near))
    assert np.any(hide(jnp.stack(KEYS), far))


def test_masked_points_reach_neither_value_nor_gradient() -> None:
    config = AugmentConfig(sector_probability=0.5, box_probability=0.5)

    @jax.jit
    @jax.value_and_grad
    def loss(points: jax.Array, mask: jax.Array) -> jax.Array:
        return jnp.sum(augment_scan(PointCloud(points, mask), config, key=KEYS[0]).cloud.points ** 2)

    for num_valid in (0, 1, 250):
        scan = cloud(300, num_valid)
        poisoned = jnp.where(scan.mask[:, None], scan.points, jnp.nan)
        (value, gradient), (expected, _) = loss(poisoned, scan.mask), loss(scan.points, scan.mask)
        assert np.isfinite(gradient).all()
        np.testing.assert_array_equal(value, expected)
        assert not np.any(gradient[num_valid:])


def test_sparse_scans_keep_as_many_points_as_is_drawn() -> None:
    config = replace(NOTHING, sparse_probability=1.0)
    kept = augment_all(config, cloud(5000, 4000)).cloud.mask.sum(axis=1)
    # From 300 to 20,000, uniform in the logarithm: 62 % of the draws are below the 4,000 points that there are.
    assert 240 <= kept.min() < 480
    assert 0.4 < (kept < 4000).mean() < 0.85
    assert (augment_all(NOTHING, cloud()).cloud.mask.sum(axis=1) == 250).all()


def test_a_power_lets_most_scans_stand_upright() -> None:
    config = AugmentConfig(max_tilt_rad=0.26, tilt_power=3.0)
    T = random_motions_on_host(config, 4000, np.random.default_rng(0))
    tilt = np.abs(np.arcsin(T[:, 0, 2]))
    assert 0.25 < tilt.max() <= 0.26
    assert np.median(tilt) == pytest.approx(0.26 / 8, rel=0.1)


@pytest.mark.slow
def test_one_scan_in_ten_is_occluded_as_the_paper_says() -> None:
    angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    ring = jnp.asarray(np.stack([40 * np.cos(angles), 40 * np.sin(angles), np.full(720, -1.0)], 1), jnp.float32)
    config = replace(NOTHING, sector_probability=0.05, box_probability=0.05)
    assert (AugmentConfig().sector_probability, AugmentConfig().box_probability) == (0.0, 0.1)
    scan = PointCloud(ring, jnp.ones(720, bool))
    kept = jax.jit(jax.vmap(lambda key: augment_scan(scan, config, key=key).cloud.mask.all()))
    share = 1 - np.mean(kept(jax.random.split(jax.random.key(7), 2000)))
    assert abs(share - 0.1) < 0.03


MANY_MOTIONS = {
    "device": lambda: np.asarray(motions(jax.random.split(jax.random.key(1), 4000))),
    "host": lambda: random_motions_on_host(AugmentConfig(), 4000, np.random.default_rng(0)),
}


@pytest.mark.parametrize("where", MANY_MOTIONS)
def test_motions_have_the_spread_that_is_asked_for(where: str) -> None:
    T = MANY_MOTIONS[where]()
    np.testing.assert_allclose(T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2) - np.eye(3), 0, atol=1e-6)
    np.testing.assert_allclose(T[:, :3, 3].std(axis=0), [3, 3, 1.5], rtol=0.05)
    assert np.abs(np.arcsin(T[:, 0, 2])).max() <= np.pi / 10
    assert np.histogram(np.arctan2(-T[:, 0, 1], T[:, 0, 0]), 8, (-np.pi, np.pi))[0].min() > 400


def test_jitter_is_clipped() -> None:
    scan = cloud(300, 300)
    many = augment_all(replace(NOTHING, jitter_sigma_m=0.1), scan)
    nearest = np.linalg.norm(many.cloud.points[0][:, None] - np.asarray(scan.points), axis=-1).min(axis=1)
    assert 0 < nearest.max() <= 0.1 * JITTER_CLIP_SIGMAS * np.sqrt(3) + 1e-5
