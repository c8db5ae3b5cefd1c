"""One model in one `.safetensors` file: arrays by name; the header holds its configuration and a description."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from dpmjax.deeppointmap.model import Model, model_shapes
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.kept_programs import keep_result
from dpmjax.weights.config_json import config_from_json

SHIPPED = Path(__file__).parent
FORMAT, FORMAT_VERSION = "dpmjax model", "1"
TORCH_SUFFIXES = (".pth", ".pt")
SUFFIX = ".safetensors"


def load_model(path_or_name: str | Path) -> Model:
    """Loads a trained model.

    Args:
        path_or_name: the name of a shipped model; or a `.safetensors` file that `save_model` wrote; or a `.pth` file of
            the published PyTorch programs (see `import_torch_checkpoint`).

    Returns:
        The model, parameters in float32.

    Raises:
        ValueError: if no shipped model has this name, or the file is missing, broken, or of another layout.
    """
    from dpmjax.weights.torch_import import import_torch_checkpoint

    path = Path(path_or_name)
    if path.suffix in TORCH_SUFFIXES:
        return import_torch_checkpoint(_existing_model_file(path))
    if path.suffix == SUFFIX:
        return _load_safetensors(_existing_model_file(path))
    if path.name in shipped_models() and path == Path(path.name):
        return _load_safetensors(SHIPPED / (path.name + SUFFIX))
    shipped = ", ".join(shipped_models()) or "none yet"
    expected = f"give a {SUFFIX} or .pth file, or the name of a shipped model ({shipped})"
    raise ValueError(f"{path_or_name}: neither weights nor the name of a model; {expected}")


def shipped_models() -> tuple[str, ...]:
    """Lists the names of the models that come with this package.

    Returns:
        The names, sorted.
    """
    return tuple(sorted(path.stem for path in SHIPPED.glob(f"*{SUFFIX}")))


def save_model(
    model: Model, path: str | Path, *, card: str = "", dtype: Literal["float16", "float32"] = "float32"
) -> None:
    """Writes a model to a `.safetensors` file.

    Args:
        model: the model.
        path: must end in `.safetensors`.
        card: a description for users: data, steps, seed, results.
        dtype: type of the stored numbers; float16 halves the file and keeps three digits of each parameter.

    Raises:
        ValueError: if the path has another ending, or a parameter is not finite in that type.
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise ValueError(f"path: expected a file that ends in {SUFFIX}, got {str(path)!r}")
    params = flax.traverse_util.flatten_dict(jax.device_get(model.params), sep=".")
    with np.errstate(over="ignore"):  # overflow is reported below
        arrays = {name: np.ascontiguousarray(array, dtype) for name, array in params.items()}
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"model: {name} holds numbers that are not finite in {dtype}")
    config = json.dumps(dataclasses.asdict(model.config))
    header = {"format": FORMAT, "format_version": FORMAT_VERSION, "config": config, "card": card}
    path.write_bytes(save(arrays, metadata=header))  # `save_file` gives the owner alone the right to read.


def read_card(path_or_name: str | Path) -> str:
    """Reads the description of a model; raises a `ValueError` if the file is missing or no such model.

    Args:
        path_or_name: the name of a shipped model, or a `.safetensors` file that `save_model` wrote.

    Returns:
        The description that was given to `save_model`.
    """
    path = SHIPPED / f"{path_or_name}{SUFFIX}" if str(path_or_name) in shipped_models() else Path(path_or_name)
    return _read(_existing_model_file(path))[0].get("card", "")


def _load_safetensors(path: Path) -> Model:
    header, arrays = _read(path)
    try:
        config = config_from_json(json.loads(header["config"]), ModelConfig, file=path)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: its configuration cannot be read ({error})") from error
    return model_from_arrays(arrays, config, str(path))


def model_from_arrays(arrays: dict[str, np.ndarray], config: ModelConfig, source: str) -> Model:
    """Makes a model from arrays by name.

    Args:
        arrays: one array for each parameter, names joined by points.
        config: configuration of the model.
        source: name of the file, for errors.

    Returns:
        The model, parameters in float32.

    Raises:
        ValueError: if a parameter is missing, unknown, or has another shape.
    """

    def trace() -> dict[str, tuple[int, ...]]:
        shapes = flax.traverse_util.flatten_dict(model_shapes(config), sep=".")
        return {name: leaf.shape for name, leaf in shapes.items()}

    shapes = keep_result("weights.model_shapes", config, trace)
    for name in sorted(shapes.keys() | arrays.keys()):
        expected, found = shapes.get(name, "none"), getattr(arrays.get(name), "shape", "none")
        if expected != found:
            raise ValueError(f"{source}: parameter {name}: expected shape {expected}, got {found}")
    params = {name: jnp.asarray(array, jnp.float32) for name, array in arrays.items()}
    return Model(flax.traverse_util.unflatten_dict(params, sep="."), config)


def _read(path: Path) -> tuple[dict[str, str], dict[str, Any]]:
    try:
        with safe_open(path, framework="numpy") as file:
            header = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a whole safetensors file ({error})") from error
    if (header.get("format"), header.get("format_version")) != (FORMAT, FORMAT_VERSION):
        raise ValueError(f"{path}: not a model of dpmjax in format version {FORMAT_VERSION}")
    return header, arrays


def _existing_model_file(path: Path) -> Path:
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    return path
