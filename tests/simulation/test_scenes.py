"""Scenes of a mixture: drawn by seed, of all kinds, scaled, and seen by a lidar that moves."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.simulation import (
    TRAINING_MIXTURE,
    BuildingConfig,
    DepthWalkConfig,
    DriveConfig,
    LidarSensor,
    SceneMixture,
    TownConfig,
    WalkConfig,
    draw_scene,
    make_apartment,
    make_building,
    make_town,
    make_world,
    simulate_depth_sequence,
    simulate_scene,
)  # fmt: skip
from dpmjax.simulation.town.cast import cast_turn, near_world
from dpmjax.simulation.town.kinds import KINDS
from dpmjax.simulation.town.primitives import SOFT, SOLID, pack_bodies
from dpmjax.simulation.town.scan import make_rays

SENSOR = LidarSensor("test", tuple(np.linspace(10.0, -20.0, 16)), 360, max_range_m=60.0)
SMALL = SceneMixture(sensors=((SENSOR, 1.0),), length_m=150.0)


def test_a_seed_draws_one_scene_and_the_mixture_is_met():
    mixture = SceneMixture()
    drawn = [draw_scene(seed) for seed in range(300)]
    assert drawn == [draw_scene(seed) for seed in range(300)]
    for kind, weight in mixture.kinds:
        assert np.mean([scene.place.kind == kind for scene in drawn]) == pytest.approx(weight, abs=0.09)
    for sensor, weight in mixture.sensors:
        assert np.mean([scene.sensor == sensor for scene in drawn]) == pytest.approx(weight, abs=0.09)
    assert np.mean([scene.is_moving for scene in drawn]) == pytest.approx(mixture.moving_rate, abs=0.09)


@pytest.mark.parametrize("kind", ["canyon", "wood", "hall"])
def test_a_scene_gives_scans_with_poses(kind):
    sequence = simulate_scene(draw_scene(4, replace(SMALL, kinds=((kind, 1.0),))))
    assert len(sequence) > 20
    first, again = sequence.read_scan(3), sequence.read_scan(3)
    np.testing.assert_array_equal(first, again)
    assert len(first) > 0.3 * SENSOR.num_rays
    assert kind in sequence.name


@pytest.mark.slow
def test_two_lidars_take_turns_along_one_way():
    other = replace(SENSOR, name="other", view_deg=90.0)
    mixture = replace(SMALL, kinds=(("suburb", 1.0),), sensors=((SENSOR, 1.0),))
    scene = draw_scene(4, mixture)
    alone, both = simulate_scene(scene), simulate_scene(replace(scene, other_sensor=other))
    np.testing.assert_array_equal(alone.T_world_lidar, both.T_world_lidar)
    np.testing.assert_array_equal(alone.read_scan(2), both.read_scan(2))
    narrow = both.read_scan(3)
    assert 0 < len(narrow) < 0.5 * len(alone.read_scan(3))
    # A column is a degree wide, and the turn begins anywhere in it.
    assert np.degrees(np.abs(np.arctan2(narrow[:, 1], narrow[:, 0]))).max() < 46


def test_the_training_mixture_is_a_third_indoors_and_mixes_lidars():
    drawn = [draw_scene(seed, TRAINING_MIXTURE) for seed in range(400)]
    assert np.mean([isinstance(scene.place, BuildingConfig) for scene in drawn]) == pytest.approx(1 / 3, abs=0.06)
    num_mixed = sum(scene.other_sensor is not None for scene in drawn)
    assert all(scene.other_sensor != scene.sensor for scene in drawn)
    assert num_mixed / 400 == pytest.approx(0.7 * (1 - sum(w**2 for _, w in TRAINING_MIXTURE.sensors)), abs=0.08)
    assert all(scene.other_sensor is None for scene in map(draw_scene, range(50)))


def test_scale_multiplies_points_and_poses():
    plain, double = (
        simulate_scene(draw_scene(7, replace(SMALL, kinds=(("flat", 1.0),), indoor_scale=(factor, factor))))
        for factor in (1.0, 2.0)
    )
    np.testing.assert_allclose(double.T_world_lidar[:, :3, 3], 2 * plain.T_world_lidar[:, :3, 3])
    np.testing.assert_array_equal(double.T_world_lidar[:, :3, :3], plain.T_world_lidar[:, :3, :3])
    np.testing.assert_allclose(double.read_scan(2), 2 * plain.read_scan(2))


@pytest.mark.parametrize(
    "kind", ["suburb", *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS if kind != "suburb")]
)
def test_nothing_solid_stands_in_the_lane_of_any_kind(kind):
    scene = draw_scene(11, replace(SMALL, kinds=((kind, 1.0),)))
    sequence, town = simulate_scene(scene), make_town(11, scene.place)
    for bodies in town.primitives[:2]:
        mask = np.asarray(bodies.mask)
        centres, half, turn = (np.asarray(x, np.float64)[mask] for x in bodies[:3])
        offset = sequence.T_world_lidar[:, None, :3, 3] - centres
        along = np.abs(offset[..., 0] * turn[:, 0] + offset[..., 1] * turn[:, 1]) - half[:, 0]
        across = np.abs(offset[..., 1] * turn[:, 0] - offset[..., 0] * turn[:, 1]) - half[:, 1]
        above = np.abs(offset[..., 2]) - half[:, 2]
        assert np.maximum(np.maximum(along, across), above).min() > 0.5


def soft_town(rows):
    town = make_town(0, TownConfig(route_length_m=100)).primitives
    empty = [bodies._replace(mask=jnp.zeros_like(bodies.mask)) for bodies in town[:3]]
    traffic = town.traffic._replace(mask=jnp.zeros_like(town.traffic.mask))
    boxes = pack_bodies(np.array(rows, np.float64), SOLID)
    return town._replace(boxes=boxes, cylinders=empty[1], spheroids=empty[2], traffic=traffic)


def cast(town, pose, motion=None, depths=None):
    rays = make_rays(SENSOR, jnp.float32(0.0), jnp.zeros(6) if motion is None else jnp.asarray(motion))
    if depths is not None:
        rays = rays._replace(depths=jax.random.exponential(depths, rays.depths.shape))
    pose = jnp.asarray(pose, jnp.float32)
    near = near_world(town, pose[:3, 3], jnp.float32(0.0), max_range=SENSOR.max_range_m)
    return cast_turn(near, pose, rays, max_range=SENSOR.max_range_m), rays


@pytest.mark.slow
def test_foliage_lets_through_what_beer_and_lambert_say():
    """exp(-thickness / softness), in one layer or in two."""
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.0, 30.0]
    one = [[5.0, 0, 30, 1.0, 20, 20, 0, 1.5, 0]]
    two = [[4.5, 0, 30, 0.5, 20, 20, 0, 1.5, 0], [8.5, 0, 30, 0.5, 20, 20, 0, 1.5, 0]]
    for rows in (one, two):
        hits, rays = cast(soft_town(rows), pose, depths=jax.random.key(3))
        directions = np.asarray(rays.directions)
        ahead = directions[..., 0] > 0.8
        is_met = np.asarray(hits.surfaces)[ahead] == SOFT
        wanted = 1 - np.exp(-2.0 / directions[ahead][:, 0] / 1.5)
        assert is_met.mean() == pytest.approx(wanted.mean(), abs=0.03)


@pytest.mark.slow
def test_a_moving_lidar_sees_the_same_walls_from_where_its_beam_left():
    rows = [[20.0, 0, 30, 1, 30, 30, 0, 0, 0], [-15.0, 0, 30, 1, 30, 30, 0, 0, 0], [0.0, 12, 30, 30, 1, 30, 0, 0, 0]]
    pose, town = np.eye(4), soft_town(rows)
    pose[:3, 3] = [0.0, 0.0, 30.0]
    motion = np.array([1.5, 0.2, 0.0, 0.0, 0.0, 0.05], np.float32)
    (still, _), (hits, rays) = cast(town, pose), cast(town, pose, motion)
    places = np.asarray(rays.T_lidar_sector, np.float64)
    points = np.nan_to_num(np.asarray(hits.ranges), posinf=0.0)[..., None] * np.asarray(rays.directions)
    world = np.einsum("sij,sgcbj->sgcbi", places[:, :3, :3], points) + places[:, None, None, None, :3, 3] + pose[:3, 3]
    is_wall = np.asarray(hits.surfaces) == SOLID
    on_wall = np.min([np.abs(world[..., 0] - 19), np.abs(world[..., 0] + 14), np.abs(world[..., 1] - 11)], axis=0)
    np.testing.assert_allclose(on_wall[is_wall], 0.0, atol=2e-3)
    assert is_wall.sum() == pytest.approx((np.asarray(still.surfaces) == SOLID).sum(), rel=0.02)
    both = is_wall & (np.asarray(still.surfaces) == SOLID)
    assert np.abs(np.asarray(hits.ranges)[both] - np.asarray(still.ranges)[both]).max() > 0.3


@pytest.mark.parametrize(
    "make",
    [
        lambda: draw_scene(-1),
        lambda: SceneMixture(kinds=(("moon", 1.0),)),
        lambda: SceneMixture(kinds=(("wood", 0.0),)),
        lambda: SceneMixture(length_m=0.0),
        *(lambda low=low: SceneMixture(indoor_scale=(low, 1.0)) for low in (2.0, 0.0)),
        lambda: BuildingConfig("tent"),
        lambda: BuildingConfig(route_length_m=0.0),
        lambda: make_building(-1),
        lambda: WalkConfig(rate_hz=0.0),
        lambda: TownConfig(kind="moon"),
        lambda: TownConfig(route="spiral"),
        lambda: TownConfig(route_length_m=0),
        lambda: LidarSensor("none", (), 100),
        lambda: LidarSensor("near", (0.0,), 100, min_range_m=5, max_range_m=4),
        *(lambda bad=bad: DriveConfig(**bad) for bad in ({"speed_m_s": 0}, {"max_turn_deg_s": 0}, {"rate_hz": np.nan})),
        lambda: make_town(-1),
        lambda: make_town(0, trajectory=np.zeros((5, 3))),
        lambda: make_town(0, trajectory=np.tile(np.eye(4), (5, 1, 1))),
        lambda: make_town(0, trajectory=np.linspace(np.eye(4), np.eye(4) + 458e3 * np.eye(4, k=3), 30)),
        lambda: simulate_depth_sequence(0, 1),
        lambda: simulate_depth_sequence(0, 2, config=DepthWalkConfig(min_spread_m=2.0)),
        lambda: make_apartment(-1),
        lambda: DepthWalkConfig(dropout_share=2.0),
        *(lambda bad=bad: make_world(bad) for bad in (-1, "forest", "grove-", "grove--1", "grove-1x", "")),
    ],
)
def test_senseless_wishes_are_refused(make):
    with pytest.raises(ValueError, match=r"must|needs|expected|no walk of 2 views"):
        make()
