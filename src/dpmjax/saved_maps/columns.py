"""Records as columns: named tuples become arrays by name, ready for a file, and come back bit for bit."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

Arrays = dict[str, np.ndarray]


def to_columns(records: Sequence[Any], name: str, *, without: Collection[str] = ()) -> Arrays:
    """Turns records of one type into one array a field.

    Args:
        records: named tuples of numbers, texts, arrays of one shape, or None.
        name: what the names of the arrays begin with.
        without: fields that are left out.

    Returns:
        The arrays. What is None takes no room; a mask beside it says where.
    """
    columns = {name: np.array(len(records))}
    for field in [field for field in records[0]._fields if field not in without] if records else ():
        values = [getattr(record, field) for record in records]
        is_there = np.array([value is not None for value in values])
        if is_there.any():
            columns[f"{name}.{field}"] = np.array([value for value in values if value is not None])
        if not is_there.all():
            columns[f"{name}.{field}.is_there"] = is_there
    return columns


def from_columns(
    record_type: Any, columns: Mapping[str, np.ndarray], name: str, *, without: Collection[str] = ()
) -> list[Any]:
    """Turns columns back into records.

    Args:
        record_type: the named tuple.
        columns: from `to_columns`; others may be among them.
        name: as given there.
        without: as given there.

    Returns:
        The records: numbers and texts of Python, arrays of NumPy; None for a field that was left out.

    Raises:
        ValueError: if a field is missing.
    """
    num = int(columns[name])
    fields = []
    for field in record_type._fields:
        key, mask = f"{name}.{field}", f"{name}.{field}.is_there"
        if num and field not in without and key not in columns and mask not in columns:
            raise ValueError(f"{key} is missing")
        column = columns.get(key, np.zeros(0))
        found = iter(column.tolist() if column.ndim == 1 else column)
        is_there = columns.get(mask, np.full(num, key in columns))
        fields.append([next(found) if there else None for there in is_there])
    return [record_type(*values) for values in zip(*fields, strict=True)] if num else []


def part_of(columns: Mapping[str, np.ndarray], name: str) -> Arrays:
    """Returns the arrays whose names begin with `name` and a dot, without it."""
    return {key.removeprefix(f"{name}."): value for key, value in columns.items() if key.startswith(f"{name}.")}


def prefixed(columns: Mapping[str, np.ndarray], name: str) -> Arrays:
    """Returns the same arrays with `name` and a dot before their names."""
    return {f"{name}.{key}": value for key, value in columns.items()}
