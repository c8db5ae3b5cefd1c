"""Evaluation of registrations: each row has the descriptors of its scan."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dpmjax.deeppointmap import draw_evaluation_pairs, evaluate_registration
from dpmjax.deeppointmap.model import encode_pyramid
from tests.deeppointmap import toy
from tests.tolerances import ACCUMULATED


@pytest.mark.slow
def test_each_scan_of_an_evaluation_is_encoded_in_its_row(model) -> None:
    pairs = draw_evaluation_pairs([toy.drive(num_scans=4)], 2, toy.MODEL)
    clouds = evaluate_registration(model, pairs).clouds
    for row, pyramid in enumerate(pairs.pyramids):
        expected = encode_pyramid(model, pyramid)
        np.testing.assert_array_equal(clouds.mask[row], expected.mask)
        np.testing.assert_allclose(clouds.positions[row], expected.positions, atol=1e-4)
        np.testing.assert_allclose(clouds.features[row], expected.features, **ACCUMULATED)


@pytest.mark.slow
def test_an_evaluation_of_other_numbers_of_scans_and_pairs_compiles_nothing(model, assert_compiles_nothing) -> None:
    few, many = (
        draw_evaluation_pairs([toy.drive(num_scans=num_scans)], num_pairs, toy.MODEL)
        for num_scans, num_pairs in ((6, 3), (24, 13))
    )
    evaluate_registration(model, few)
    with assert_compiles_nothing():
        found = evaluate_registration(model, many)
    assert [len(recall.translation_errors_m) for recall in found.recalls.values()] == [13, 13]
    assert found.clouds.positions.shape[0] == 24


def test_scans_are_turned_with_their_poses() -> None:
    drive = toy.drive(num_scans=4)
    pairs = draw_evaluation_pairs([drive], 2, toy.MODEL)
    for row, (scan, T) in enumerate(zip(pairs.scans, pairs.T_world_scan, strict=True)):
        T_lidar_scan = np.linalg.inv(drive.T_world_lidar[row]) @ T
        points = np.asarray(scan.points)[np.asarray(scan.mask)]
        back = points @ T_lidar_scan[:3, :3].T + T_lidar_scan[:3, 3]
        assert cKDTree(drive.read_scan(row)).query(back)[0].max() < 1e-3
        assert abs(Rotation.from_matrix(T_lidar_scan[:3, :3]).as_rotvec()[:2]).max() < 1e-6
