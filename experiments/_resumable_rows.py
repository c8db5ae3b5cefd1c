"""Rows of results that survive a killed run: one JSON file each, written whole; what is there is not done again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments._json import load_json, write_json


def row_path(folder: Path, case: dict[str, Any]) -> Path:
    """The file of a case: a readable name that no other case has."""
    text = "_".join(f"{key}-{value}" for key, value in case.items())
    digest = hashlib.sha256(text.encode()).hexdigest()[:6]
    return folder / "rows" / f"{text.replace('.', 'p').replace('/', '-')[:120]}_{digest}.json"


def do_row(folder: Path, case: dict[str, Any], work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The row of a case, from its file or by doing the work.

    Args:
        folder: of the run.
        case: what identifies the row; becomes part of it.
        work: gives the rest of it.

    Returns:
        The row.
    """
    path = row_path(folder, case)
    if path.exists():
        return load_json(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    row = {**case, **work()}
    write_json(path, row)
    return row
