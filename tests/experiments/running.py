"""Runs an experiment as its command does, and reads its rows."""

import csv
from pathlib import Path
from types import ModuleType

from dpmjax.cli.run import run_command


def run(module: ModuleType, *options: object) -> int:
    name = module.__name__.rpartition(".")[2]
    return run_command(module.main, name=name, description=module.__doc__, args=list(map(str, options)))


def read_rows(folder: Path, name: str = "rows.csv") -> list[dict[str, str]]:
    return list(csv.DictReader((folder / name).read_text(encoding="utf-8").splitlines()))
