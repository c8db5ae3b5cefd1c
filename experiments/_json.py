"""Options and numbers as JSON and back; files appear whole or not at all."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

ConfigT = TypeVar("ConfigT")


def write_json(path: Path, value: Any) -> None:
    """Writes dataclasses, paths, NumPy values as JSON; the file appears whole or not at all."""
    text = json.dumps(as_json(value), indent=2, allow_nan=False) + "\n"
    unfinished = path.with_name(f".{path.name}.tmp")
    unfinished.write_text(text, encoding="utf-8")
    os.replace(unfinished, path)


def load_json(path: Path) -> dict[str, Any]:
    """Returns the JSON object in a file.

    Raises:
        ValueError: it is no JSON object.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path}: expected a JSON object, found {type(value).__name__}")
    return value


def as_json(value: Any) -> Any:
    """Returns the value in types of JSON; NaN and infinity become null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: as_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(name): as_json(entry) for name, entry in value.items()}
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic) or hasattr(value, "__array__"):
        return as_json(np.asarray(value).tolist())
    if isinstance(value, list | tuple):
        return [as_json(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def load_dataclass(path: Path, config_type: type[ConfigT], *, ignore: frozenset[str] = frozenset()) -> ConfigT:
    """Returns options from a JSON file; missing ones, and those in `ignore`, get their defaults.

    Raises:
        ValueError: it holds an option that `config_type` does not have, or is no JSON.
    """
    from dpmjax.weights.config_json import config_from_json

    kept = {name: value for name, value in load_json(path).items() if name not in ignore}
    try:
        return config_from_json(kept, config_type)
    except ValueError as error:
        raise ValueError(f"{path} holds options that this version does not know: {error}") from error
