"""Progress on the console, for functions of the library that report it by a callback."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm


@contextmanager
def progress_bar(description: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Shows a bar while the block runs.

    Args:
        description: shown before the bar.
        unit: of the numbers, with a space before it.

    Yields:
        A callback that takes the number that is done and the number of all.
    """
    with tqdm(desc=description, unit=unit, dynamic_ncols=True) as bar:

        def on_progress(num_done: int, num_all: int) -> None:
            bar.total = num_all
            bar.update(num_done - bar.n)

        yield on_progress
