"""The program `dpmjax`: loads and runs only the subcommand."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import NoReturn

COMMANDS = {
    "register": "two 3-D scans: their relative pose, its confidence, a picture",
    "map2d": "planar scans without poses: poses and a map",
    "depth": "depth images without poses: poses and a map",
    "slam": "a drive of 3-D scans: a pose for every scan, loops, a map",
    "localize": "scans in a saved map: where each was taken",
    "merge": "saved maps of several drives: one map",
    "graph": "a pose graph (g2o, TORO): optimised poses",
    "train": "drives with poses: trained weights",
    "evaluate": "weights and drives with poses: recall, errors, confidence",
    "info": "versions, devices, shipped weights",
}
"""Description of each subcommand, the module of this name beside this file."""

EXAMPLES = """examples:
  dpmjax map2d                          a simulated office, from its odometry
  dpmjax map2d robot.log.gz             a CARMEN log
  dpmjax register a.pcd b.pcd           where was a taken, seen from b?
  dpmjax slam path/to/drive -o out      KITTI, MulRan, or any folder of scans
  dpmjax localize out/map.npz scans     find scans in the map of an earlier run
  dpmjax COMMAND --help                 the options of a subcommand"""

# The last is added to the number of the signal.
EXIT_OK, EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_BY_SIGNAL = 0, 2, 130, 128


def run() -> NoReturn:
    """Runs the subcommand of the command line and ends the process."""
    end_process(main())


def end_process(exit_code: int) -> NoReturn:
    """Ends the process; after a signal at once.

    A stopped process may leave a compilation in a thread of XLA. Python's orderly end would wait for it and crash.

    Args:
        exit_code: exit code; after a stop, `EXIT_BY_SIGNAL` and the number of the signal.

    Raises:
        SystemExit: no signal has stopped the process.
    """
    if exit_code > EXIT_BY_SIGNAL:
        if "jax.distributed" in sys.modules:  # other processes of one training wait for this
            sys.modules["jax.distributed"].shutdown()
        with suppress(OSError):  # Ctrl-C has ended the reader of a pipe, too
            sys.stdout.flush()
        os._exit(exit_code)
    raise SystemExit(exit_code)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a subcommand.

    Args:
        arguments: the command line without the program; None takes that of the process.

    Returns:
        The exit code: 0 done, 1 failed on the way, 2 wrong usage or bad input, 130 or 143 stopped by a signal.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in COMMANDS:
        try:  # the imports take a second or two
            module = importlib.import_module(f"dpmjax.cli.{given[0]}")
            run = importlib.import_module("dpmjax.cli.run").run_command
        except KeyboardInterrupt:
            print("dpmjax: stopped by SIGINT", file=sys.stderr)
            return EXIT_INTERRUPTED
        return int(run(module.main, name=given[0], description=module.__doc__, args=given[1:]))
    if given and given[0] == "--version":
        print(f"dpmjax {importlib.metadata.version('dpmjax')}")
        return EXIT_OK
    if given and given[0] in ("-h", "--help"):
        print(usage())
        return EXIT_OK
    reason = f"no subcommand {given[0]!r}" if given else "give a subcommand"
    print(f"dpmjax: error: {reason}; expected one of {', '.join(COMMANDS)} (dpmjax --help)", file=sys.stderr)
    return EXIT_BAD_INPUT


def usage() -> str:
    """Returns the text of `dpmjax --help`."""
    lines = [f"  {name:9} {description}" for name, description in COMMANDS.items()]
    return "\n".join(["usage: dpmjax COMMAND [OPTIONS]\n", *lines, "", EXAMPLES])
