"""Pictures: registered scans, the learned map, the course of a fit. NumPy in, `matplotlib` figures and PNG files out.

Nothing here needs a screen or touches `pyplot`; matplotlib itself is imported when the first picture is drawn.
"""

from dpmjax.viz.comparison import error_boxes_figure, success_grids_figure
from dpmjax.viz.figures import save_figure
from dpmjax.viz.history import History, history_figure
from dpmjax.viz.maps import Panel, make_panel, registered_scans_figure
from dpmjax.viz.occupancy import occupancy_figure
from dpmjax.viz.training import curves_figure, matches_figure

__all__ = [
    "History",
    "Panel",
    "curves_figure",
    "error_boxes_figure",
    "history_figure",
    "make_panel",
    "matches_figure",
    "occupancy_figure",
    "registered_scans_figure",
    "save_figure",
    "success_grids_figure",
]
