"""Pictures: registered scans, the learned map, the course of a fit. NumPy in, `matplotlib` figures and PNG files out.

Nothing here needs a screen or touches `pyplot`; matplotlib itself is imported when the first picture is drawn.
"""

from dpmjax.viz.comparison import error_boxes_figure, success_grids_figure
from dpmjax.viz.curves import History, history_figure, size_figure
from dpmjax.viz.figures import save_figure
from dpmjax.viz.maps import Panel, make_panel, registered_scans_figure
from dpmjax.viz.rasters import ErrorMap, error_maps_figure, from_above_figure, occupancy_figure
from dpmjax.viz.toy import endings_figure, toy_figure
from dpmjax.viz.training import MatchedScans, curves_figure, matches_figure

__all__ = [
    "ErrorMap",
    "History",
    "MatchedScans",
    "Panel",
    "curves_figure",
    "endings_figure",
    "error_boxes_figure",
    "error_maps_figure",
    "from_above_figure",
    "history_figure",
    "make_panel",
    "matches_figure",
    "occupancy_figure",
    "registered_scans_figure",
    "save_figure",
    "size_figure",
    "success_grids_figure",
    "toy_figure",
]
