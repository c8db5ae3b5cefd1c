"""Progress of the pipelines, as a bar with units."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from tqdm import tqdm

# A pipeline that ends sooner shows no bar.
_SILENT_S = 1.0


def progress_bar(
    description: str, items: Iterable[Any] | None = None, *, total: int | None = None, unit: str = "", is_shown: bool
) -> tqdm[Any]:
    """Makes a bar on the terminal or in a notebook; output that goes to a file or a pipe gets none.

    Args:
        description: name of the work, before the bar.
        items: objects that the bar hands out and counts; None where the caller counts.
        total: number of units; None: the number of items where they have one.
        unit: name of a unit of the work; "" counts the share of the work that is done, 0 to 1.
        is_shown: False makes a bar that shows nothing.

    Returns:
        The bar, a context manager.
    """
    is_read = sys.stderr.isatty() or "ipykernel" in sys.modules
    options: dict[str, Any] = {"desc": description, "delay": _SILENT_S, "disable": not (is_shown and is_read)}
    if not unit:
        return tqdm(total=1.0, bar_format="{desc} {percentage:3.0f}%|{bar}| [{elapsed}]", **options)
    return tqdm(items, total=total, unit=f" {unit}", dynamic_ncols=True, **options)
