from __future__ import annotations

import numpy as np
from matplotlib.colors import to_rgb

from dpmjax import viz
from dpmjax.viz.figures import INK
from dpmjax.viz.scan_pairs import SOURCE, TARGET


def test_reliability_puts_each_bin_at_its_means() -> None:
    confidence = np.array([0.05, 0.05, 0.93, 0.97])
    figure = viz.reliability_figure(confidence, [False, True, True, True], title="t")
    x, y = figure.axes[0].lines[1].get_data()
    np.testing.assert_allclose(x, [0.05, 0.95])
    np.testing.assert_allclose(y, [0.5, 1.0])
    assert "4 pairs" in figure.axes[0].get_title()


def test_reliability_of_nothing_is_drawn() -> None:
    assert viz.reliability_figure([], [], title="t").axes


def test_pairs_are_drawn_under_both_motions() -> None:
    T = np.eye(4)
    T[0, 3] = 7
    pair = viz.RegisteredPair(
        "pair", np.zeros((1, 3), np.float32), np.ones((2, 3), np.float32), {"found": T, "true": np.eye(4)}
    )
    figure = viz.registered_pairs_figure([pair, pair])
    assert len(figure.axes) == 4
    lidars = [{line.get_label(): line.get_xdata()[0] for line in axes.lines} for axes in figure.axes[:2]]
    assert [of_panel["lidar of source"] for of_panel in lidars] == [7, 0]
    assert [of_panel["lidar of target"] for of_panel in lidars] == [0, 0]


def wall(num: int = 4000) -> np.ndarray:
    return np.random.default_rng(0).uniform([-20, 9, 0], [20, 9.05, 2], (num, 3)).astype(np.float32)


def colors_of(axes) -> set[tuple[int, ...]]:
    """Returns the colours of the cells."""
    (image,) = axes.images
    picture = np.round(255 * np.asarray(image.get_array())).astype(int).reshape(-1, 3)
    return {tuple(color) for color in np.unique(picture, axis=0)} - {(255, 255, 255)}


def test_scans_that_meet_are_black_and_apart_have_two_colours_whatever_their_order() -> None:
    apart = np.eye(4)
    apart[1, 3] = -5
    motions = {"apart": apart, "met": np.eye(4)}
    for names in (("a", "b"), ("b", "a")):
        figure = viz.registered_pairs_figure([viz.RegisteredPair("pair", wall(), wall(), motions, names)])
        two, both = map(colors_of, figure.axes)
        black = {tuple(np.round(255 * np.array(to_rgb(INK))).astype(int))}
        assert (len(two), both) == (2, black)
        assert not two & black


def test_colours_of_two_scans_differ_in_grey() -> None:
    grey = [np.dot(to_rgb(color), (0.299, 0.587, 0.114)) for color in (INK, SOURCE, TARGET, "white")]
    assert np.diff(grey).min() > 0.15


def test_the_legend_names_scans_lidars_and_the_cell_in_metres() -> None:
    pair = viz.RegisteredPair("pair", wall(), wall(), {"met": np.eye(4)}, ("a.bin", "b.bin"))
    (axes,) = viz.registered_pairs_figure([pair]).axes
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels[:2] == ["a.bin", "b.bin"]
    assert labels[3:] == ["lidar of a.bin", "lidar of b.bin"]
    assert labels[2].startswith("both")
    assert labels[2].endswith(" m")
    assert axes.get_aspect() == 1.0
    assert any(text.get_text().endswith(" m") for text in axes.texts)


def test_panels_of_a_row_have_the_same_limits_and_empty_scans_are_drawn() -> None:
    T = np.eye(4)
    T[:2, 3] = 30
    for source in (wall(), np.zeros((0, 3), np.float32)):
        pair = viz.RegisteredPair("pair", source, wall(), {"before": np.eye(4), "after": T})
        before, after = viz.registered_pairs_figure([pair]).axes
        assert (before.get_xlim(), before.get_ylim()) == (after.get_xlim(), after.get_ylim())
