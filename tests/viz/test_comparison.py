"""Pictures of comparisons: each number, box and name is where its method and setting say."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.viz import error_boxes_figure, save_figure, success_grids_figure
from dpmjax.viz.figures import ACCENT

ROWS, COLUMNS = {"scans used": ["1/2", "1/4", "1/8"]}, {"range noise, px": ["0", "10"]}


def test_each_success_rate_stands_in_its_cell_and_open_cells_are_empty():
    rates = np.array([[1.0, 0.25], [np.nan, 0.0], [0.5, np.nan]])
    figure = success_grids_figure({"icp": rates, "search": np.full((3, 2), np.nan)}, ROWS, COLUMNS)
    icp, search = figure.axes
    written = {(int(text.get_position()[1]), int(text.get_position()[0])): text.get_text() for text in icp.texts}
    assert written == {(0, 0): "100", (0, 1): "25", (1, 1): "0", (2, 0): "50"}
    assert not search.texts
    assert [icp.get_title(), search.get_title()] == ["icp", "search"]
    assert [label.get_text() for label in icp.get_yticklabels()] == ROWS["scans used"]
    assert [label.get_text() for label in icp.get_xticklabels()] == COLUMNS["range noise, px"]
    assert (icp.get_ylabel(), icp.get_xlabel()) == ("scans used", "range noise, px")


def test_many_grids_stand_in_lines_and_each_line_is_labelled():
    names = [f"method {number} with a long name" for number in range(7)]
    figure = success_grids_figure({name: np.ones((3, 2)) for name in names}, ROWS, COLUMNS)
    assert [ax.get_title().replace("\n", " ") for ax in figure.axes] == names
    assert [number for number, ax in enumerate(figure.axes) if ax.get_ylabel() == "scans used"] == [0, 4]
    assert [number for number, ax in enumerate(figure.axes) if len(ax.get_yticks())] == [0, 4]


def test_rates_can_be_read_on_their_ground():
    figure = success_grids_figure({"icp": np.array([[1.0, 0.0]])}, {"r": ["1"]}, {"c": ["a", "b"]})
    high, low = (text.get_color() for text in figure.axes[0].texts)
    assert (high != "white", low) == (True, "white")


def test_a_grid_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="icp: expected 3 rows and 2 columns"):
        success_grids_figure({"icp": np.ones((2, 2))}, ROWS, COLUMNS)


def test_boxes_show_the_median_of_each_method_and_the_threshold(tmp_path):
    panels = {"ATE, px": {"icp": [1.0, 2.0, 30.0], "search": [0.1, 0.2, 0.3]}, "point distance, px": {"icp": [5.0]}}
    figure = error_boxes_figure(panels, threshold=20.0)
    first, second = figure.axes
    assert [first.get_ylabel(), second.get_ylabel()] == list(panels)
    assert [label.get_text() for label in first.get_xticklabels()] == ["icp", "search"]
    medians = {
        line.get_ydata()[0] for line in first.lines if line.get_color() == ACCENT and line.get_linestyle() == "-"
    }
    np.testing.assert_allclose(sorted(medians), [0.2, 2.0])
    assert [line.get_ydata()[0] for line in first.lines if line.get_linestyle() == "--"] == [20.0]
    # Every error is a dot.
    dots = [sorted(line.get_ydata()) for line in first.lines if line.get_marker() == "."]
    assert dots == [[1.0, 2.0, 30.0], [0.1, 0.2, 0.3]]
    assert first.get_yscale() == "log"
    save_figure(figure, tmp_path / "boxes.png", dpi=50)
    assert (tmp_path / "boxes.png").stat().st_size > 1000
