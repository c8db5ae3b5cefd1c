"""Inputs on which the product was once wrong, refused or silent: `make field`, where the data are there.

Each case prints its error, verdict, the right value, and whether it is right or not sure.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import dpmjax
from dpmjax.cli.program import main
from dpmjax.cli.run import EXIT_BAD_INPUT, EXIT_OK, load_json

pytestmark = [pytest.mark.field, pytest.mark.timeout(3600), pytest.mark.filterwarnings("default")]


class Case(NamedTuple):
    """A command, the metric that is measured, its largest right value, and the file of the true motion or poses."""

    command: str
    metric: str = "ate_m"
    largest: float = 0.0
    truth: str | None = None


CASES = (
    Case("register field_4/max_range_shell_pair/a.npz field_4/max_range_shell_pair/b.npz", "error_m", 0.5,
         "field_4/max_range_shell_pair/T_b_a.txt"),
    Case("slam field_4/max_range_shell_drive", "ate_m", 0.1),
    Case("slam field_4/gallery_wall", "ate_m", 0.05),
    Case("slam field_4/deskew_start --deskew", "ate_m", 0.042),
    Case("register field_4/scaled_pair/a_1.04.npz field_4/scaled_pair/b.npz", "unsure"),
    Case("register field_4/indoor_fragments/kitchen_a.npz field_4/indoor_fragments/kitchen_b.npz", "error_m", 0.3,
         "field_4/indoor_fragments/kitchen_T_b_a.txt"),
    Case("register field_4/indoor_fragments/home_a.npz field_4/indoor_fragments/home_b.npz", "error_m", 0.3,
         "field_4/indoor_fragments/home_T_b_a.txt"),
    Case("register field_4/far_submaps/0.npz field_4/far_submaps/4.npz", "error_m", 0.5,
         "field_4/far_submaps/T_4_0.txt"),
    Case("graph field_4/edge2_isam_order/graph.txt", "ate_m", 0.1, "field_4/edge2_isam_order/true_x_y_theta.txt"),
    Case("graph field_4/free_node/corridor_edge.g2o", "ends"),
    Case("register field_3d/corridor_pair/28.npy field_3d/corridor_pair/16.npy", "error_m", 1.0,
         "field_3d/corridor_pair/T_16_from_28.txt"),
    Case("register field_3d/corridor_pair/18.npy field_3d/corridor_pair/10.npy", "error_m", 1.0,
         "field_3d/corridor_pair/T_10_from_18.txt"),
    Case("slam field_3d/street_first_step", "ends"),
    Case("slam field_3d/os0_8_beams_slow", "ends"),
    Case("slam field_3d/tum_reference_of_another_rate", "ate_m", 0.2),
    Case("slam field_3d/pcd_padding_count_0", "ends"),
    Case("slam field_3d/pcd_binary_compressed", "ends"),
    Case("slam field_3d/nuscenes_5_columns", "ends"),
    Case("depth field_4/depth_turning", "ate_m", 0.1),
    *(Case(f"map2d field_4/{name}", "ate_m", largest) for name, largest in (
        ("silent_encoder.npz", 0.05), ("one_covered_scan.npz", 0.05), ("walk_48.npz", 0.01), ("sick_codes.npz", 0.01))),
    # Bags have no true poses: the table shows only how their runs end.
    *(Case(f"map2d field_4/{name}", "ends") for name in ("clock_back_10s", "empty_bag", "renamed_bag")),
    *(Case(f"map2d field_2d/{name}.npz", "ate_m", 0.3) for name in (
        "aca_corridor", "aca_degrees", "aca_dup", "aca_inf", "aca_maxwall", "aca_mirror80", "aca_odo_degrees",
        "johnhbell_scans")),
    *(Case(f"graph field_2d/{name}", "ends") for name in (
        "CSAIL.g2o", "cubicle_2edges.g2o", "g2o311_decimal_comma.g2o", "g2o311_prior.g2o", "g2o345_trackxyz.g2o",
        "landmark_xy.g2o", "maxmix.g2o", "sclio22_no_information.g2o", "switchable.g2o", "w100.graph")),
)  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.command.replace(" ", "_"))
def test_an_answer_is_right_or_not_sure(case: Case, real_data: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    if not (real_data / "field_4").is_dir():
        pytest.skip(f"no {real_data / 'field_4'}")
    monkeypatch.chdir(real_data)
    code = main([*case.command.split(), "-o", str(tmp_path / "out")])
    printed = capsys.readouterr()
    if code == EXIT_BAD_INPUT:
        lines = printed.err.strip().splitlines()
        status, error, verdict = "refused", None, lines[-1]
    else:
        numbers = load_json(tmp_path / "out" / "metrics.json")
        status, error, verdict = numbers["status"], numbers.get(case.metric), numbers["verdict"]
        if case.truth is not None and case.metric == "ate_m":
            found = dpmjax.read_g2o(tmp_path / "out" / "graph.g2o").poses
            error = float(dpmjax.absolute_trajectory_error(found[:, :2], np.loadtxt(case.truth)[:, :2]))
        elif case.truth is not None:
            T_true = np.loadtxt(case.truth).reshape(-1, 4)
            error = float(np.linalg.norm(np.array(numbers["T_target_source"])[:3, 3] - T_true[:3, 3]))
    is_right = case.metric == "ends" or (error is not None and error <= case.largest)
    is_sure = code == EXIT_OK and status == "done" and "DO NOT TRUST" not in verdict
    ok = is_right or not is_sure
    with capsys.disabled():
        shown = "-" if error is None else f"{error:.4f}"
        sys.stdout.write(f"\n| {case.command} | {shown} | {status}: {verdict[:150]} | {case.largest:g} | {ok} |\n")
    assert ok
