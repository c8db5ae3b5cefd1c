"""The main command as a newcomer meets it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from experiments.deepmapping_2d import Config

REPOSITORY = Path(__file__).parents[2]


def test_help_needs_no_jax_and_shows_examples():
    code = (
        "import sys; from experiments._command import run_command; from experiments import deepmapping_2d as m;"
        "code = run_command(m.main, m.Config, experiment=m.EXPERIMENT, description=m.__doc__, args=['--help']);"
        "assert not {'jax', 'matplotlib', 'scipy'} & set(sys.modules), 'slow imports'; sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "    python -m experiments.deepmapping_2d --resume " in done.stdout
    for option in ("-o OUT", "-n N", "-j N", "--preset {fast,paper}", "--init", "--no-polish", "--seed", "--resume"):
        assert option in done.stdout


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"jump": 0}, "--jump"),
        ({"n_scans": 0}, "--n-scans"),
        ({"seconds": -1.0}, "--seconds"),
        ({"steps": 0}, "--steps"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Config(**options)
