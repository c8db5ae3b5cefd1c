"""Converts a checkpoint: `python -m dpmjax.weights x.pth x.safetensors`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from dpmjax.weights.checkpoint import load_model, save_model

EXIT_OK, EXIT_BAD_INPUT = 0, 2


def main(args: Sequence[str] | None = None) -> int:
    """Converts, and returns the exit code: 0, or 2 after one line on stderr where the input is bad."""
    parser = argparse.ArgumentParser(prog="python -m dpmjax.weights", description=__doc__)
    parser.add_argument("source", help="a published .pth checkpoint, a .safetensors file, or a shipped model's name")
    parser.add_argument("target", help="the .safetensors file to write")
    parser.add_argument("--dtype", choices=["float32", "float16"], default="float32", help="how numbers are stored")
    parser.add_argument("--card", default="", help="what people should know of these weights")
    options = parser.parse_args(args)
    try:
        save_model(load_model(options.source), options.target, card=options.card, dtype=options.dtype)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"error: {' '.join(str(error).split())}\n")
        return EXIT_BAD_INPUT
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(main())
