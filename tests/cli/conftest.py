"""A fixture that runs commands on bad input."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dpmjax.cli.program import main
from dpmjax.cli.run import EXIT_BAD_INPUT


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that must refuse its input: one line, exit code 2, and no folder. Returns the line."""

    def run(*arguments: object) -> str:
        out = tmp_path / "out"
        capsys.readouterr()
        folder = () if "-o" in arguments else ("-o", out)
        assert main([str(word) for word in (*arguments, *folder)]) == EXIT_BAD_INPUT
        error = capsys.readouterr().err
        assert error.startswith("dpmjax: error: ")
        assert error.count("\n") == 1, error
        assert not out.exists()
        return error

    return run
