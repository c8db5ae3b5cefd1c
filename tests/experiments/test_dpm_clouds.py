"""The table of registrations of descriptor clouds."""

from __future__ import annotations

import numpy as np

from dpmjax.types import DescriptorCloud
from experiments.dpm_clouds import first_elements, table


def test_a_row_tells_recall_and_error_of_each_number_of_elements() -> None:
    row = {"sequence": "street", "band": "near", "num_pairs": 20, "offset_r2": [0.0, None, 0.9]}
    row |= {"offset_rmse_m": [0.6, 0.5, 0.1], "recall_decoder": 0.85, "median_error_decoder_m": 0.5}
    row |= {"recall_elements_512": 0.0, "median_error_elements_512_m": None}
    lines = table(
        [row, {"sequence": "empty", "band": "near", "num_pairs": 0}], ["decoder", "elements_512"]
    ).splitlines()
    assert len(lines) == 3
    assert len({line.count("|") for line in lines}) == 1
    assert "| street | 2-10 m | 20 | 0.85, 0.500 m | 0.00, - |" in lines[2]
    assert lines[2].endswith("0.00 (0.60 m), - (0.50 m), 0.90 (0.10 m) |")


def test_first_elements_keep_the_descriptors() -> None:
    cloud = DescriptorCloud(
        np.ones((9, 3)), np.ones((4, 2)), np.ones(9, bool), normals=np.ones((9, 3)), planarity=np.ones(9)
    )
    assert first_elements(cloud, 6).elements.positions.shape == (6, 3)
    assert first_elements(cloud, 6).features.shape == (4, 2)
    assert first_elements(cloud, None).normals is None
