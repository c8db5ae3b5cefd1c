"""Converts a checkpoint: `python -m dpmjax.weights x.pth x.safetensors`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from dpmjax.weights.model_file import load_model, save_model


def main(args: Sequence[str] | None = None) -> int:
    """Converts a checkpoint; bad input ends in one line on stderr.

    Args:
        args: the command line; None takes that of the process.

    Returns:
        The exit code: 0, or 2 for bad input.
    """
    parser = argparse.ArgumentParser(prog="python -m dpmjax.weights", description=__doc__)
    parser.add_argument("source", help="a published .pth checkpoint, a .safetensors file, or a shipped model's name")
    parser.add_argument("target", help="the .safetensors file to write")
    parser.add_argument("--dtype", choices=["float32", "float16"], default="float32", help="how numbers are stored")
    parser.add_argument("--card", default="", help="a description of these weights")
    options = parser.parse_args(args)
    try:
        save_model(load_model(options.source), options.target, card=options.card, dtype=options.dtype)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"error: {' '.join(str(error).split())}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
