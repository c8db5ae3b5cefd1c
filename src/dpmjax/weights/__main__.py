"""Converts a checkpoint: `python -m dpmjax.weights x.pth x.safetensors`.

Or makes the mean of two: `python -m dpmjax.weights before.safetensors mean.safetensors --mean-with tuned.safetensors`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp

from dpmjax.deeppointmap.model import Model
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
    parser.add_argument("--mean-with", metavar="MODEL", help="take the mean with weights that were tuned from these")
    options = parser.parse_args(args)
    try:
        model = load_model(options.source)
        if options.mean_with is not None:
            model = _mean(model, load_model(options.mean_with))
        save_model(model, options.target, card=options.card, dtype=options.dtype)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"error: {' '.join(str(error).split())}\n")
        return 2
    return 0


def _mean(model: Model, other: Model) -> Model:
    """Returns the model with the mean of both parameters."""
    if jax.tree.map(jnp.shape, model.params) != jax.tree.map(jnp.shape, other.params):
        raise ValueError("--mean-with: expected a network of the same shapes")
    # Regressions belong to the parameters that they were fitted for.
    trained = tuple(stage for stage in model.config.trained if stage in other.config.trained)
    config = replace(model.config, calibration=None, overlap=None, trained=trained)
    return Model(jax.tree.map(lambda one, two: (one + two) / 2, model.params, other.params), config)


if __name__ == "__main__":
    sys.exit(main())
