"""Pictures of the one-dimensional example: what is marked where, and how many seeds end where."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.viz import endings_figure, toy_figure

X = np.linspace(-6.0, 6.0, 101)


def test_figure_14_marks_the_ends_of_both_forms():
    visited = np.array([3.0, 1.0, -1.4]), np.array([5.0, 2.0, -23.0])
    figure = toy_figure((X, X**2), (X, np.cos(X)), visited=visited, direct_end=(3.4, 1.0), network_end_z=0.7)
    (axes,) = figure.axes
    drawn = {line.get_label(): line.get_xydata() for line in axes.lines}
    np.testing.assert_array_equal(drawn["L(x)"], np.stack([X, X**2], -1))
    np.testing.assert_array_equal(drawn["x visited by the network"], np.stack(visited, -1))
    np.testing.assert_array_equal(drawn["direct descent ends"], [[3.4, 1.0]])
    np.testing.assert_array_equal(drawn["x* = f(z*)"], [[-1.4, -23.0]])
    np.testing.assert_array_equal(drawn["z* of the network"], [[0.7, -23.0]])
    assert [text.get_text() for text in axes.get_legend().get_texts()] == list(drawn)
    assert axes.get_xlim() == (-6.0, 6.0)


def test_histograms_count_all_finite_ends_and_name_the_share():
    ends = {"network form": np.array([-1.4, -1.4, 2.0, np.nan]), "direct form": np.array([99.0, 0.0, 1.0, 2.0])}
    top, network, direct = endings_figure(X, X**2, ends, {"network form": 0.5, "direct form": 0.0}).axes
    assert top.get_ylabel() == "L(x)"
    assert sum(bar.get_height() for bar in network.patches) == 3
    # An end outside of the picture counts in the last bar.
    assert sum(bar.get_height() for bar in direct.patches) == 4
    assert direct.patches[-1].get_height() == 1
    assert network.texts[0].get_text() == "network form: 50.0 % at the global minimum"
    with pytest.raises(ValueError, match="same methods"):
        endings_figure(X, X**2, ends, {"network form": 0.5})
