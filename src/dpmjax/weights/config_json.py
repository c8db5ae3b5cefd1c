"""Configurations from the JSON of `dataclasses.asdict`; the commands use it too, before they load JAX."""

from __future__ import annotations

import dataclasses
import logging
import types
import typing
from pathlib import Path
from typing import Any, TypeVar

ConfigT = TypeVar("ConfigT")
log = logging.getLogger(__name__)


def config_from_json(value: Any, config_type: type[ConfigT], *, file: str | Path | None = None) -> ConfigT:
    """Reads a configuration back from the JSON of `dataclasses.asdict`.

    A `ValueError` names a field that has a value of another type, and a field that is unknown. Files of other versions
    may have settings that this version does not have.

    Args:
        value: the JSON value; missing fields get their defaults.
        config_type: the dataclass.
        file: the file of the JSON; its unknown fields are logged and ignored. None refuses them.

    Returns:
        The configuration.
    """
    return _restored(value, config_type, config_type.__name__, file)


def _restored(value: Any, expected: Any, name: str, file: str | Path | None) -> Any:
    if typing.get_origin(expected) in (types.UnionType, typing.Union):
        if value is None and type(None) in typing.get_args(expected):
            return None
        (expected,) = (choice for choice in typing.get_args(expected) if choice is not type(None))
    if expected is Path:
        return Path(value)
    if dataclasses.is_dataclass(expected) and isinstance(expected, type):
        if not isinstance(value, dict):
            raise ValueError(f"{name}: expected an object, got {value!r}")
        fields = typing.get_type_hints(expected)
        if unknown := sorted(value.keys() - fields.keys()):
            if file is None:
                raise ValueError(f"{name}: unknown field {unknown[0]!r}")
            log.info("%s: %s has no setting %s in this version; ignored", file, name, ", ".join(unknown))
        known = {key: item for key, item in value.items() if key in fields}
        return expected(**{key: _restored(item, fields[key], f"{name}.{key}", file) for key, item in known.items()})
    if typing.get_origin(expected) is tuple:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{name}: expected a list, got {value!r}")
        (item_type, _) = typing.get_args(expected)
        return tuple(_restored(item, item_type, f"{name}[{i}]", file) for i, item in enumerate(value))
    is_number = expected is float and isinstance(value, int) and not isinstance(value, bool)
    if isinstance(expected, type) and (type(value) is not expected) and not is_number:
        raise ValueError(f"{name}: expected {expected.__name__}, got {value!r}")
    return float(value) if is_number else value
