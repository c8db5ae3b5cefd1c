"""Programs in processes of their own, on the code of this tree."""

import os
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
PYTHONPATH = os.pathsep.join([str(REPOSITORY / "src"), str(REPOSITORY)])


def start_python(*arguments: object, **options) -> subprocess.Popen[str]:
    """Starts Python in the repository; its output and its errors are read by `communicate`."""
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": PYTHONPATH} | options.pop("variables", {})
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    command = [sys.executable, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, **{"cwd": REPOSITORY, **pipes, **options})


def run_python(*arguments: object, timeout: float = 600, **options) -> subprocess.CompletedProcess[str]:
    process = start_python(*arguments, **options)
    try:
        output, errors = process.communicate(timeout=timeout)
    finally:
        process.kill()
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)
