"""Rays against slow float64 NumPy: each primitive alone, then all of them through the sectors of a turn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.simulation import LidarSensor
from dpmjax.simulation.town import primitives
from dpmjax.simulation.town.cast import cast_turn, near_world
from dpmjax.simulation.town.intersect import cross_box, cross_cylinder, cross_ground, cross_spheroid, ground_height
from dpmjax.simulation.town.scan import make_rays
from tests.tolerances import ACCUMULATED

SENSOR = LidarSensor("test", tuple(np.linspace(20.0, -30.0, 9)), 72, max_range_m=60.0)


def directions(rng, count):
    rays = rng.normal(size=(count, 3)) * [1, 1, 0.3]
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def nearest_surface(candidates, is_inside):
    """The first candidate distance whose point is on the body: the slow way, plane by plane and root by root."""
    good = sorted(t for t in candidates if t > 0 and is_inside(t))
    return good[0] if good else np.inf


def box_oracle(ray, centre, half, heading):
    turn = np.array([[np.cos(heading), np.sin(heading), 0], [-np.sin(heading), np.cos(heading), 0], [0, 0, 1]])
    start, along = turn @ -centre, turn @ ray
    planes = [(side * half[axis] - start[axis]) / along[axis] for axis in range(3) for side in (-1, 1)]
    return nearest_surface(planes, lambda t: (np.abs(start + t * along) <= half + 1e-9).all())


def cylinder_oracle(ray, centre, radius, half_height):
    roots = np.roots([ray[0] ** 2 + ray[1] ** 2, -2 * ray[:2] @ centre[:2], centre[:2] @ centre[:2] - radius**2])
    lids = [(centre[2] + side * half_height) / ray[2] for side in (-1, 1)]

    def is_inside(t):
        off = t * ray - centre
        return np.hypot(*off[:2]) <= radius + 1e-9 and abs(off[2]) <= half_height + 1e-9

    return nearest_surface([*(r.real for r in roots if abs(r.imag) < 1e-12), *lids], is_inside)


def spheroid_oracle(ray, centre, radius, half_height):
    scale = np.array([radius, radius, half_height])
    d, c = ray / scale, centre / scale
    roots = np.roots([d @ d, -2 * d @ c, c @ c - 1])
    return nearest_surface([r.real for r in roots if abs(r.imag) < 1e-12], lambda t: True)


def ground_oracle(heights, origin, cell, start, ray, max_range):
    """Steps of a centimetre."""
    t = np.arange(0.0, max_range, 0.01)
    at = (start[:2] + t[:, None] * ray[:2] - origin) / cell
    at = np.clip(at, 0, np.array(heights.shape)[::-1] - 1.001)
    j, i = np.floor(at).astype(int).T
    u, v = (at - np.floor(at)).T
    z = (heights[i, j] * (1 - u) + heights[i, j + 1] * u) * (1 - v)
    z = z + (heights[i + 1, j] * (1 - u) + heights[i + 1, j + 1] * u) * v
    below = start[2] + t * ray[2] < z
    return t[np.argmax(below)] if below.any() else np.inf


def hull(centre, half_size, heading):
    shape = [np.atleast_2d(np.asarray(x, np.float32)) for x in (centre, half_size, heading)]
    zero = jnp.zeros(len(shape[0]))
    return primitives.Bodies(
        *map(jnp.asarray, shape), zero, zero, jnp.full(len(zero), primitives.SOLID), jnp.ones(len(zero), bool)
    )


def first_hit(crossing):
    return np.where((crossing.entry > 0) & (crossing.entry <= crossing.exit), crossing.entry, np.inf)


@pytest.mark.parametrize("seed", range(3))
def test_boxes_are_met_where_their_planes_are(seed):
    rng = np.random.default_rng(seed)
    rays = directions(rng, 200)
    centre = rays * rng.uniform(4, 40, (200, 1)) + rng.normal(size=(200, 3))
    half, heading = rng.uniform(0.2, 3, (200, 3)), rng.uniform(-np.pi, np.pi, 200)
    turned = np.column_stack([np.cos(heading), np.sin(heading)])
    found = first_hit(cross_box(jnp.asarray(rays, jnp.float32), hull(centre, half, turned)))
    wanted = np.array([box_oracle(*row) for row in zip(rays, centre, half, heading, strict=True)])
    outside = ~np.array([(np.abs(c) < h.max() * 1.8).all() for c, h in zip(centre, half, strict=True)])
    assert np.isfinite(wanted).mean() > 0.5
    both = np.isfinite(found) == np.isfinite(wanted)
    assert both[outside].mean() > 0.99, "only rays that touch an edge may differ"
    np.testing.assert_allclose(found[both & outside], wanted[both & outside], **ACCUMULATED)


@pytest.mark.parametrize(("cross", "oracle"), [(cross_cylinder, cylinder_oracle), (cross_spheroid, spheroid_oracle)])
def test_round_bodies_are_met_where_their_roots_are(cross, oracle):
    rng = np.random.default_rng(7)
    rays = directions(rng, 300)
    centre = rays * rng.uniform(6, 60, (300, 1)) + rng.normal(size=(300, 3))
    radius, half_height = rng.uniform(0.1, 2, 300), rng.uniform(0.3, 3, 300)
    sizes = np.column_stack([radius, radius, half_height])
    found = first_hit(cross(jnp.asarray(rays, jnp.float32), hull(centre, sizes, np.tile([1.0, 0.0], (300, 1)))))
    wanted = np.array([oracle(*row) for row in zip(rays, centre, radius, half_height, strict=True)])
    both = np.isfinite(found) == np.isfinite(wanted)
    assert np.isfinite(wanted).mean() > 0.3
    assert both.mean() > 0.99
    # Near a tangent the root of a float32 rounding is a millimetre.
    np.testing.assert_allclose(found[both], wanted[both], rtol=1e-4, atol=5e-3)


@pytest.fixture(scope="module")
def land():
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:80, 0:90] * 1.0
    heights = 2 * np.sin(x / 11) * np.cos(y / 17) + 0.02 * rng.normal(size=x.shape)
    return heights, np.array([-40.0, -35.0])


def ground_of(heights, origin):
    return primitives.Ground(jnp.asarray(heights, jnp.float32), jnp.asarray(origin, jnp.float32), jnp.float32(1.0))


def test_ground_is_met_where_a_ray_first_goes_below_it(land):
    heights, origin = land
    ground = ground_of(heights, origin)
    rays = directions(np.random.default_rng(5), 150)
    start = np.array([1.0, 2.0, float(ground_height(ground, jnp.array([1.0, 2.0]))) + 1.73])
    found = cross_ground(ground, jnp.asarray(start, jnp.float32), jnp.asarray(rays, jnp.float32)[:, None], 40.0)[:, 0]
    wanted = np.array([ground_oracle(heights, origin, 1.0, start, ray, 40.0) for ray in rays])
    same = np.isclose(found, wanted, rtol=0, atol=0.05)
    assert np.isfinite(wanted).sum() > 50
    assert same.mean() > 0.97, "only a ray that grazes a ridge may pass between two steps"


def small_town(land, rng):
    heights, origin = land
    place = np.column_stack([rng.uniform(-35, 35, (40, 2)), rng.uniform(-1, 3, 40)])
    place = place[np.linalg.norm(place[:, :2], axis=1) > 5]
    sizes = rng.uniform(0.3, 2.5, (len(place), 3))
    boxes = np.column_stack([place, sizes, rng.uniform(-3, 3, len(place)), np.zeros((len(place), 2))])
    zero = np.zeros((len(place), 3))
    thickness = rng.uniform(0.05, 0.4, len(place))
    poles = np.column_stack([place + np.array([3, -2, 0]), thickness, thickness, sizes[:, 2] + 1, zero])
    tufts = np.column_stack([place + np.array([-2, 3, 1]), sizes[:, [0, 0, 1]] * 0.5, zero])
    lanes = jnp.zeros((2, 64, 3)), jnp.ones(2), jnp.zeros(4, jnp.int32)
    traffic = primitives.RoadUsers(*lanes, *[jnp.zeros(4)] * 3, half_sizes=jnp.ones((4, 3)), mask=jnp.zeros(4, bool))
    bodies = (
        primitives.pack_bodies(boxes, primitives.SOLID),
        primitives.pack_bodies(poles, primitives.POLE),
        primitives.pack_bodies(tufts, primitives.SOFT),
    )
    return primitives.TownPrimitives(*bodies, ground_of(heights, origin), traffic), boxes, poles, tufts


def tilted_pose():
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("zyx", [2.0, 0.06, -0.05]).as_matrix()
    pose[:3, 3] = [0.5, -0.3, 2.2]
    return pose


@pytest.fixture(scope="module")
def turn(land):
    town, *tables = small_town(land, np.random.default_rng(11))
    rays = make_rays(SENSOR, jnp.float32(0.01), jnp.zeros(6))

    @jax.jit
    def look(town, pose):
        near = near_world(town, pose[:3, 3], jnp.float32(0.0), max_range=SENSOR.max_range_m)
        return cast_turn(near, pose, rays, max_range=SENSOR.max_range_m)

    return look, town, tables, np.asarray(rays.directions, np.float64)


@pytest.mark.slow
def test_a_turn_meets_the_nearest_of_all_bodies(turn, land):
    look, town, (boxes, poles, tufts), rays = turn
    pose = tilted_pose()
    hits = look(town, jnp.asarray(pose, jnp.float32))
    # The oracle is slow: it sees every third ray.
    found, surfaces = np.asarray(hits.ranges).ravel()[::3], np.asarray(hits.surfaces).ravel()[::3]
    world = rays.reshape(-1, 3)[::3] @ pose[:3, :3].T
    start = pose[:3, 3]
    wanted, kinds = [], []
    for ray in world:
        options = {
            primitives.SOLID: min(box_oracle(ray, b[:3] - start, b[3:6], b[6]) for b in boxes),
            primitives.POLE: min(cylinder_oracle(ray, p[:3] - start, p[3], p[5]) for p in poles),
            primitives.SOFT: min(spheroid_oracle(ray, s[:3] - start, s[3], s[5]) for s in tufts),
            primitives.GROUND: ground_oracle(land[0], land[1], 1.0, start, ray, SENSOR.max_range_m),
        }
        kind = min(options, key=options.get)
        wanted.append(min(options[kind], np.inf) if options[kind] <= SENSOR.max_range_m else np.inf)
        kinds.append(kind if np.isfinite(wanted[-1]) else primitives.NOTHING)
    wanted, kinds = np.array(wanted), np.array(kinds)
    same = np.isclose(found, wanted, rtol=0, atol=0.03)
    assert same.mean() > 0.985
    assert (surfaces == kinds)[same].mean() > 0.98
    assert {primitives.SOLID, primitives.POLE, primitives.SOFT, primitives.GROUND} <= set(surfaces.tolist())


@pytest.mark.slow
def test_padding_takes_no_part(turn):
    look, town, _, _ = turn
    pose = jnp.asarray(tilted_pose(), jnp.float32)
    full = np.asarray(town.boxes.mask)
    centres = np.asarray(town.boxes.centres).copy()
    centres[~full] = pose[:3, 3] + np.array([3.0, 0, 0], np.float32)
    sizes = np.asarray(town.boxes.half_sizes).copy()
    sizes[~full] = 2.0
    boxes = town.boxes._replace(centres=jnp.asarray(centres), half_sizes=jnp.asarray(sizes))
    garbage = town._replace(boxes=boxes)
    np.testing.assert_array_equal(look(town, pose).ranges, look(garbage, pose).ranges)


def test_windows_lie_behind_their_wall(turn):
    look, town, _, _ = turn
    pose = jnp.asarray(tilted_pose(), jnp.float32)
    walls = look(town, pose)
    depth = 0.3
    boxes = town.boxes._replace(window_depth=jnp.full_like(town.boxes.window_depth, depth))
    fronts = look(town._replace(boxes=boxes), pose)
    is_wall = np.asarray(walls.surfaces) == primitives.SOLID
    deeper = np.asarray(fronts.ranges)[is_wall] - np.asarray(walls.ranges)[is_wall]
    cosines = np.asarray(walls.cosines)[is_wall]
    assert (deeper >= 0).all()
    assert (deeper * cosines <= depth + 1e-3).all()
    assert 0.05 < (deeper > 0).mean() < 0.6
    glass = np.asarray(fronts.is_glass)[is_wall]
    np.testing.assert_allclose((deeper * cosines)[glass], depth, atol=1e-3)
