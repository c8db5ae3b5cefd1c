"""Options of commands: common options, the parser, and checks of ranges and names."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, get_type_hints

import tyro
from tyro.conf import FlagCreatePairsOff, arg


class Bound(NamedTuple):
    """The least value of a number option, or of each number of a list option; it stands in the option's type.

    Attributes:
        least: the value.
        is_allowed: False where the option must be larger.
    """

    least: float
    is_allowed: bool = True

    def check(self, name: str, values: Any) -> None:
        """Raises a ValueError for a value that is too small, or not finite; None passes."""
        for value in values if isinstance(values, tuple) else (values,):
            if value is not None and not (self.least < value < math.inf or (value == self.least and self.is_allowed)):
                expected = "at least" if self.is_allowed else "more than"
                raise ValueError(f"--{name.replace('_', '-')}: expected {expected} {self.least}, got {value}")


@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """Options of every command that writes results."""

    output: Annotated[Path | None, arg(aliases=["-o"], metavar="OUT")] = None
    """Folder for the results, instead of results/<command>/<time>."""
    force: FlagCreatePairsOff[bool] = False
    """Replace OUT and everything in it, if it holds an earlier run."""

    def __post_init__(self) -> None:
        """Checks the bounds of all options."""
        for name, kind in get_type_hints(type(self), include_extras=True).items():
            for bound in getattr(kind, "__metadata__", ()):
                if isinstance(bound, Bound):
                    bound.check(name, getattr(self, name))


@dataclass(frozen=True, kw_only=True)
class RunOptions(OutputOptions):
    """Options of every command that can be interrupted and resumed.

    Attributes:
        may_change: options that a resumed run may change, besides those that do not affect the computation.
    """

    may_change: ClassVar[frozenset[str]] = frozenset()

    seed: Annotated[int, Bound(0)] = 0
    """Seed of all random numbers."""
    resume: FlagCreatePairsOff[bool] = False
    """Continue the latest run, or the one in OUT. Options that you do not give keep their earlier values."""


@dataclass(frozen=True, kw_only=True)
class ScanOptions:
    """Options of every command that reads scans or images in a row."""

    n_scans: Annotated[int | None, arg(aliases=["-n"], metavar="N"), Bound(1)] = None
    """Use the first N scans, after --jump. Without it, all."""
    jump: Annotated[int, arg(aliases=["-j"], metavar="N"), Bound(1)] = 1
    """Use every Nth scan."""

    @property
    def selection(self) -> slice:
        """Returns the rows of the scans to use."""
        return slice(None, None if self.n_scans is None else self.n_scans * self.jump, self.jump)


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """Options of every command that uses trained weights."""

    weights: Annotated[str, arg(metavar="NAME|FILE")] = "dpm_small"
    """Name of a shipped model, or a .safetensors file. A saved map needs the weights that made it."""


def parse_options(options_type: Any, arguments: Sequence[str], **details: Any) -> Any:
    """Makes the options of a command line, or prints the help.

    Args:
        options_type: frozen dataclass of the options.
        arguments: the command line.
        **details: further arguments of `tyro.cli`, such as `prog` and `default`.

    Returns:
        The options.

    Raises:
        ValueError: an option is unknown, is missing, or has a wrong value.
        SystemExit: the help was printed.
    """
    width = os.environ.get("COLUMNS")
    if not {"-h", "--help"} & set(arguments):
        os.environ["COLUMNS"] = "10000"  # no line breaks within a message
    try:
        with redirect_stderr(StringIO()) as box:
            return tyro.cli(options_type, args=arguments, **details)
    except SystemExit as done:
        if not done.code:
            raise
    finally:
        os.environ.pop("COLUMNS", None) if width is None else os.environ.update(COLUMNS=width)
    # tyro draws a box: a line with the title, the message, a line across, and help.
    rows = re.sub("\x1b[^m]*m|│", "", box.getvalue()).partition("\n")[2]
    message = " ".join(re.split(r"\n[ ─-]*\n", rows.strip())[0].split())
    own = f"Error parsing {options_type.__name__}: "
    if message.startswith(own):  # a check of the options themselves
        raise ValueError(message.removeprefix(own))
    raise ValueError(f"{message.rstrip('.') or 'wrong options'}; --help describes the options")


def check_names(option: str, names: Sequence[str], allowed: Iterable[str]) -> None:
    """Raises a ValueError if a name is not allowed, or if no name is given."""
    unknown = [name for name in names if name not in allowed]
    if unknown or not names:
        raise ValueError(f"{option}: expected some of {', '.join(allowed)}, got {', '.join(unknown) or 'none'}")


def trust_words(is_trusted: bool) -> str:
    """Returns the beginning of a verdict on a map, the same for every sensor."""
    return "can be trusted" if is_trusted else "DO NOT TRUST this map"
