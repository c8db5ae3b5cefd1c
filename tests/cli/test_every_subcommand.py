"""Every subcommand on simulated input, on a copy of the files that are installed, away from the checkout."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest

from dpmjax.cli.program import COMMANDS

EXIT_OK = 0
REPOSITORY = Path(__file__).parents[2]

SIMULATED = {
    "register": ("a.npy", "b.npy", "-o", "registered"),
    "map2d": ("-n", "24", "--steps", "20", "-o", "mapped"),
    "depth": ("-n", "3", "-o", "images"),
    "slam": ("-n", "12", "-o", "first"),
    "localize": ("first/map.npz", "scans", "-o", "found"),
    "merge": ("first/map.npz", "second/map.npz", "-o", "merged"),
    "graph": ("first/graph.g2o", "-o", "optimised"),
    "evaluate": ("--pairs", "2", "-o", "evaluated"),
    "info": (),
}
"""Arguments in an order in which each finds what those before have written. A training compiles for minutes:
the tests of `dpmjax train` run it."""


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    options = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["setuptools"]
    patterns = ["*.py", *options["package-data"]["*"]]

    def left_out(folder: str, names: list[str]) -> set[str]:
        return {
            name
            for name in names
            if not (Path(folder) / name / "__init__.py").is_file()
            and not any(fnmatch(name, pattern) for pattern in patterns)
        }

    folder = tmp_path_factory.mktemp("installed")
    shutil.copytree(REPOSITORY / "src" / "dpmjax", folder / "dpmjax", ignore=left_out)
    return folder


def start(installed: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *(arguments if arguments[0] == "-c" else ("-m", "dpmjax", *arguments))]
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_every_subcommand_ends_well_on_simulated_input(installed, tmp_path) -> None:
    from dpmjax.simulation import SceneMixture, draw_scene, simulate_scene

    drive = simulate_scene(draw_scene(0, SceneMixture(length_m=100.0)))
    (tmp_path / "scans").mkdir()
    for number, name in enumerate(("a.npy", "b.npy", "scans/0.npy", "scans/1.npy")):
        np.save(tmp_path / name, drive.read_scan(number))
    assert SIMULATED.keys() == COMMANDS.keys() - {"train"}
    found = start(installed, tmp_path, "-c", "import dpmjax; print(dpmjax.__file__)")
    assert Path(found.stdout.strip()).is_relative_to(installed)
    for name, arguments in SIMULATED.items():
        if name == "merge":
            shutil.copytree(tmp_path / "first", tmp_path / "second")
        done = start(installed, tmp_path, name, *arguments)
        assert done.returncode == EXIT_OK, f"{name}: {done.stderr[-2000:]}"
        if "-o" in arguments:
            metrics = json.loads((tmp_path / arguments[-1] / "metrics.json").read_text())
            assert metrics["status"] in ("done", "uncertain"), name
            assert "is_interrupted" not in metrics, name
