"""Runs examples and keeps their output for the page of the examples: python docs/run_examples.py [NUMBER ...]."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("[0-9]*.py"))
OUTPUTS = Path(__file__).with_name("example_outputs.json")


def fingerprint(path: Path) -> str:
    """Returns a number of the code of an example; another one means that its output is of another version."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def outputs() -> dict[str, dict[str, str]]:
    """Returns fingerprint and output of each example that was run."""
    return json.loads(OUTPUTS.read_text(encoding="utf-8")) if OUTPUTS.exists() else {}


def main(numbers: list[str]) -> None:
    """Runs examples one by one, and keeps the output of each at once."""
    for path in EXAMPLES:
        if not numbers or path.name[:2] in numbers:
            with tempfile.TemporaryDirectory() as folder:
                done = subprocess.run([sys.executable, path], cwd=folder, stdout=subprocess.PIPE, text=True, check=True)
            kept = outputs() | {path.name: {"code": fingerprint(path), "output": done.stdout}}
            OUTPUTS.write_text(json.dumps(dict(sorted(kept.items())), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
