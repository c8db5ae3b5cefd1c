"""The table of inputs that once failed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from experiments.field_inputs import Config, main, table_of


@pytest.mark.slow
def test_a_row_has_the_message_of_a_refused_input(tmp_path) -> None:
    (tmp_path / "field_2d").mkdir()
    (tmp_path / "field_2d" / "landmark_xy.g2o").write_text("VERTEX_SE2 0 0 0 0\nVERTEX_XY 1 2 3\n")
    config = Config(data=tmp_path, output=tmp_path / "out", only=("landmark_xy.g2o",))
    (row,) = main(config)
    assert row["exit_code"] == 2
    assert "line 2" in row["message"]
    assert "line 2" in (tmp_path / "out" / "table.md").read_text()
    # What is done is not done again.
    (tmp_path / "field_2d" / "landmark_xy.g2o").unlink()
    assert main(replace(config, resume=True)) == [row]


def test_a_row_has_the_numbers_of_a_run() -> None:
    row = {"data": "a.npz", "command": "map2d {}", "before": "a", "right": "b", "exit_code": 0, "wall_s": 1.0}
    numbers = {"ate_m": 0.12345, "assessment.is_trusted": True}
    assert "| map2d | a | ate_m 0.123, is_trusted True | b | 1 |" in table_of([{**row, "numbers": numbers}])


def test_a_missing_folder_is_refused(tmp_path) -> None:
    with pytest.raises(ValueError, match="no such folder"):
        Config(data=tmp_path / "none")
