"""Options of a command line: values of every kind, and errors of one line in plain words."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
from tyro.conf import Positional, arg

from dpmjax.cli.options import parse_options


@dataclass(frozen=True, kw_only=True)
class Config:
    data: Positional[Path]
    n_scans: Annotated[int | None, arg(aliases=["-n"], metavar="N")] = None
    hours: float | None = None
    length_m: float = 600.0
    device: Literal["cpu", "gpu"] | None = None
    world: Literal[0, 1, "grove"] = 0
    groups: tuple[int, ...] = ()

    def __post_init__(self):
        if self.n_scans == 0:
            raise ValueError("--n-scans: expected at least 1, got 0")


def parse(*arguments, default=None):
    details = {} if default is None else {"default": default}
    return parse_options(Config, arguments, prog="dpmjax toy", **details)


def test_values_of_every_kind_are_read():
    words = ["scans", "-n", "3", "--hours", "1e-1", "--device", "gpu", "--world", "grove", "--groups", "8", "16"]
    expected = Config(data=Path("scans"), n_scans=3, hours=0.1, device="gpu", world="grove", groups=(8, 16))
    assert parse(*words) == expected
    assert parse("scans") == Config(data=Path("scans"))
    assert parse("scans", "--world", "1").world == 1


def test_options_that_are_not_given_are_those_of_the_default():
    earlier = Config(data=Path("scans"), n_scans=3, hours=2.0, groups=(8,))
    assert parse("--hours", "3", default=earlier) == Config(data=Path("scans"), n_scans=3, hours=3.0, groups=(8,))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("a -n x", "-n/--n-scans: expected a whole number, got 'x'"),
        ("a -n 1.5", "-n/--n-scans: expected a whole number, got '1.5'"),
        ("a -n 0", "--n-scans: expected at least 1, got 0"),
        ("a --hours x", "--hours: expected a number, got 'x'"),
        ("a --device tpu", "--device: expected one of cpu, gpu, got 'tpu'"),
        ("a --device None", "--device: expected one of cpu, gpu, got 'None'"),
        ("a --world 9", "--world: expected one of 0, 1, grove, got '9'"),
        ("a --groups 8 x", "--groups: expected a whole number, got 'x'"),
        ("a --hours", "--hours: expected a value"),
        ("--nope", "missing arguments; --help describes them"),
        ("a --hour 3", "unknown options or too many arguments: --hour, 3; did you mean --hours?"),
        ("a b", "unknown options or too many arguments: b; --help lists the options"),
        ("", "missing: PATH; --help describes the options"),
    ],
)
@pytest.mark.parametrize("columns", ["30", "200"])
def test_an_error_is_one_line_in_plain_words(words, message, columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        parse(*words.split())
    assert capsys.readouterr().err == ""


def test_an_error_on_a_coloured_terminal_is_the_same(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    path = "/".join(["long"] * 60)
    with pytest.raises(ValueError, match=f"^unknown options or too many arguments: {path}; --help"):
        parse("a", path)


def test_help_names_choices_without_none(capsys):
    with pytest.raises(SystemExit) as done:
        parse("--help")
    output = capsys.readouterr().out
    assert not done.value.code
    assert "--device {cpu,gpu}" in output
    assert "{None" not in output
