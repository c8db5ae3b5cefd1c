"""Fixtures of the commands: runs without networks, and bad input."""

from collections.abc import Callable

import pytest

from dpmjax.cli.program import main
from dpmjax.cli.run import EXIT_BAD_INPUT


@pytest.fixture
def without_networks(monkeypatch) -> None:
    from tests.cli.test_slam_fuzz import leave_networks_out

    leave_networks_out(monkeypatch)


@pytest.fixture
def refused(tmp_path, capsys) -> Callable[..., str]:
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
