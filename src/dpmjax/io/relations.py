"""Files of hand-checked relations between the scans of a log: `t1 t2 x y z roll pitch yaw` a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpmjax.io.files import read_table
from dpmjax.sequences import Relations, require

_ADVICE = "a line reads t1 t2 x y z roll pitch yaw: seconds, metres, radians"
_FLAT = 1e-3


def read_relations(path: str | Path) -> Relations:
    """Reads relations in the plane.

    Args:
        path: text of eight numbers a line; comments begin with #.

    Returns:
        The relations.

    Raises:
        InputError: the file is missing, has another number of columns, holds words that are no numbers, or relations
            that leave the plane.
    """
    table = read_table(path)
    require(table.shape[1] == 8, path, f"{table.shape[-1]} numbers a line, not 8", _ADVICE)
    require(bool(np.isfinite(table).all()), path, "NaN or infinite values", "remove the line")
    is_flat = bool((np.abs(table[:, 4:7]) < _FLAT).all())
    require(is_flat, path, "relations with a height or a tilt", "give those of a planar log")
    return Relations(table[:, 0], table[:, 1], table[:, [2, 3, 7]])
