"""Options from the command line by tyro; a wrong one is a `ValueError` of one line."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import fields, replace
from io import StringIO
from itertools import dropwhile, takewhile
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

ConfigT = TypeVar("ConfigT")
_REGISTRY = ConstructorRegistry()
_NUMBERS = {int: "a whole number", float: "a number"}


def parse_options(config_type: type[ConfigT], arguments: Sequence[str], **details: Any) -> ConfigT:
    """Makes the options of a command line, or prints the help.

    Args:
        config_type: frozen dataclass of the options.
        arguments: the command line.
        **details: further arguments of `tyro.cli`, such as `prog` and `default`.

    Returns:
        The options.

    Raises:
        ValueError: an option is unknown, is missing, or has a wrong value.
        SystemExit: the help was printed.
    """
    if {"-h", "--help"} & set(arguments):
        return tyro.cli(config_type, args=arguments, registry=_REGISTRY, **details)
    try:
        with _wide_terminal(), redirect_stderr(StringIO()) as box:
            return tyro.cli(config_type, args=arguments, registry=_REGISTRY, **details)
    except SystemExit as error:
        if not error.code:
            raise
        message = _message_in(box.getvalue()).removeprefix(f"{config_type.__name__}: ")
    raise ValueError(message)


def _message_in(box: str) -> str:
    """Returns the message in a box that tyro prints, without its frame and title and the help below the message."""
    text = re.sub("\x1b[^m]*m", "", box)
    rows = (row[2:].rstrip("│ ") for row in text.splitlines()[1:])
    # Without UTF-8 the frame is blanks, and a line is below the title too.
    first, *others = takewhile(_is_text, dropwhile(lambda row: not _is_text(row), rows))
    if first.startswith("Missing from"):
        # The names of missing arguments are indented by four blanks, their descriptions by eight.
        names = (row.split()[0] for row in others if re.match(r" {4}\S", row))
        return f"missing: {', '.join(names)}; --help describes the options"
    message = " ".join(row.strip() for row in (first, *others)).removeprefix("Error parsing ")
    if valueless := re.match(r"Missing value for argument '(.*)'\. Expected", message):
        # A positional argument has the name of its field here, which the help does not show.
        is_option = valueless[1].startswith("-")
        return f"{valueless[1]}: expected a value" if is_option else "missing arguments; --help describes them"
    if message.startswith("Unrecognized"):
        known = re.search(r"Perhaps you meant:\W*?(-[\w/-]+)", text)
        message = message.replace("Unrecognized options", "unknown options or too many arguments")
        message += f"; did you mean {known[1]}?" if known else "; --help lists the options"
    return message


def _is_text(row: str) -> bool:
    """Returns False for an empty row and for a line across the box."""
    return bool(row.strip(" ─-"))


@contextmanager
def _wide_terminal() -> Iterator[None]:
    """Prevents line breaks within words of messages."""
    earlier = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if earlier is not None:
            os.environ["COLUMNS"] = earlier


@_REGISTRY.primitive_rule
def _number_rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Reads numbers, with an error in plain words."""
    kind = info.type
    if kind not in _NUMBERS:
        return None

    def read(words: list[str]) -> Any:
        try:
            return kind(words[0])
        except ValueError:
            raise ValueError(f"expected {_NUMBERS[kind]}, got {words[0]!r}") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, int | kind),
        str_from_instance=lambda value: [str(value)],
    )


@_REGISTRY.primitive_rule
def _choice_rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Reads one of several words, which the error lists in their order."""
    origin: Any = info.type_origin
    if origin is not Literal:
        return None
    values = {str(value): value for value in get_args(info.type)}

    def read(words: list[str]) -> Any:
        if words[0] not in values:
            raise ValueError(f"expected one of {', '.join(values)}, got {words[0]!r}")
        return values[words[0]]

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(values)}}}",
        instance_from_str=read,
        is_instance=lambda value: value in values.values(),
        str_from_instance=lambda value: [str(value)],
    )


@_REGISTRY.primitive_rule
def _optional_rule(info: PrimitiveTypeInfo) -> Any:
    """Reads `X | None` as X; an option that is not given is None."""
    origin: Any = info.type_origin
    kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
    if origin not in (Union, UnionType) or len(kinds) != 1:
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec):
        return spec
    return replace(
        spec,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else spec.str_from_instance(value),
    )


@_REGISTRY.primitive_rule
def _tuple_rule(info: PrimitiveTypeInfo) -> Any:
    """Reads any number of values, so that the error of one is not lost."""
    kinds = get_args(info.type)
    if info.type_origin is not tuple or kinds[1:] != (...,):
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec):
        return spec
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar=f"[{spec.metavar} [{spec.metavar} ...]]",
        instance_from_str=lambda words: tuple(spec.instance_from_str([word]) for word in words),
        is_instance=lambda value: isinstance(value, tuple) and all(map(spec.is_instance, value)),
        str_from_instance=lambda value: [word for item in value for word in spec.str_from_instance(item)],
    )


def without_latest(config: ConfigT) -> ConfigT:
    """Replaces the link `latest` in paths by the run that it points to: the next run moves it.

    Args:
        config: options, a dataclass.

    Returns:
        The options.
    """
    values = {field.name: getattr(config, field.name) for field in fields(config)}  # type: ignore[arg-type]
    fixed = {name: _pinned(value) for name, value in values.items() if name != "output"}
    changed = {name: value for name, value in fixed.items() if value != values[name]}
    return replace(config, **changed) if changed else config  # type: ignore[type-var]


def _pinned(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_pinned, value))
    if not isinstance(value, str | Path) or "latest" not in Path(value).parts:
        return value
    parts = Path(value).parts
    below = parts.index("latest") + 1
    link = Path(*parts[:below])
    return type(value)(link.parent / os.readlink(link) / Path(*parts[below:])) if link.is_symlink() else value
