"""Registration of two descriptor clouds without their scans, by the shipped network."""

import numpy as np
import pytest

import dpmjax
from dpmjax.deeppointmap import calibrated_probability, merge_clouds, register_clouds
from dpmjax.types import DescriptorCloud
from tests.scan.surface_scenes import motion, seen_from, street

T_WORLD_A, T_WORLD_B = motion(5, (1, -2, 0.1), 1), motion(40, (-2, 1, 0), -1)
T_B_A = np.linalg.inv(T_WORLD_B) @ T_WORLD_A


@pytest.fixture(scope="module")
def model() -> dpmjax.Model:
    return dpmjax.load_model("dpm_small")


@pytest.fixture(scope="module")
def clouds(model) -> tuple[DescriptorCloud, ...]:
    """Two views of the same surfaces that share no point."""
    views = [seen_from(street(seed, 30000), T) for seed, T in enumerate((T_WORLD_A, T_WORLD_B))]
    return tuple(dpmjax.encode(model, view, num_elements=1024) for view in views)


def error_m(match: dpmjax.types.Registration) -> float:
    return float(np.linalg.norm((np.linalg.inv(T_B_A) @ np.asarray(match.T_target_source, float))[:3, 3]))


@pytest.mark.slow
def test_elements_make_the_registration_of_clouds_exact(model, clouds) -> None:
    coarse, fine = (dpmjax.register(model, *clouds, refine=refine) for refine in (False, True))
    assert error_m(coarse) < 2
    assert error_m(fine) < 0.02
    assert fine.confidence > 0.85  # at most 0.88, because the walls of this street hold one direction
    assert fine.num_inliers == coarse.num_inliers
    T_target_source, evidence = register_clouds(model, *clouds)
    np.testing.assert_allclose(fine.T_target_source, T_target_source, atol=1e-5)
    assert evidence.of_elements is not None
    np.testing.assert_array_equal(evidence.of_elements[:4], evidence.of_clouds)
    assert float(fine.confidence) == pytest.approx(calibrated_probability(model.config.calibration, evidence))


@pytest.mark.slow
def test_a_scan_is_refined_against_a_cloud(model, clouds) -> None:
    points = seen_from(street(0, 30000), T_WORLD_A)
    match = dpmjax.register(model, points, clouds[1], refine=True)
    of_clouds = dpmjax.register(model, *clouds, refine=True)
    np.testing.assert_allclose(match.T_target_source, of_clouds.T_target_source, atol=1e-5)


@pytest.mark.slow
def test_a_merged_map_is_refined_like_a_scan(model, clouds) -> None:
    """The map holds the target alone, in another frame."""
    T_map_b = motion(70, (3, -4, 0.5))
    stacked = clouds[1].replace(**{name: value[None] for name, value in vars(clouds[1]).items()})
    merged = merge_clouds(stacked, T_map_b[None].astype(np.float32))
    match = dpmjax.register(model, clouds[0], merged, refine=True)
    difference = np.linalg.inv(T_map_b @ T_B_A) @ np.asarray(match.T_target_source, float)
    assert np.linalg.norm(difference[:3, 3]) < 0.02
