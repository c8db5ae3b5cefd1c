"""Arrays from a file that PyTorch saved, without PyTorch and without running what is in the file.

Such a file is a ZIP archive of raw storages and one pickle that says which tensor is which part of which storage. The
pickle may name only what tensors and dictionaries are made of; anything else is refused. Files from before PyTorch 1.6
are no archives; for those PyTorch itself is needed.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

STORAGE_DTYPES: dict[str, np.dtype] = {
    "DoubleStorage": np.dtype("<f8"),
    "FloatStorage": np.dtype("<f4"),
    "HalfStorage": np.dtype("<f2"),
    "BFloat16Storage": np.dtype(jnp.bfloat16),
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
    "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"),
    "BoolStorage": np.dtype("?"),
}


def read_torch_file(path: str | Path) -> Any:
    """What `torch.save` wrote: dictionaries, lists and numbers, with NumPy arrays for tensors.

    Raises:
        ValueError: the file is missing, broken, or holds objects other than these; or it is of the old format, and
            PyTorch is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    if not zipfile.is_zipfile(path):
        return _read_with_torch(path)
    try:
        with zipfile.ZipFile(path) as archive:
            return _read_archive(archive)
    except Exception as error:  # a broken pickle raises anything at all
        raise ValueError(f"{path}: not a PyTorch checkpoint that can be read ({error})") from error


def _read_archive(archive: zipfile.ZipFile) -> Any:
    pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
    if len(pickles) != 1:
        raise ValueError("no data.pkl in the archive")
    root = pickles[0].removesuffix("data.pkl")
    if f"{root}byteorder" in archive.namelist() and archive.read(f"{root}byteorder") != b"little":
        raise ValueError("numbers are stored in big-endian order")
    return _TensorUnpickler(archive, root).load()


class _TensorUnpickler(pickle.Unpickler):
    """Knows tensors and dictionaries, and no other class or function."""

    def __init__(self, archive: zipfile.ZipFile, root: str) -> None:
        super().__init__(io.BytesIO(archive.read(f"{root}data.pkl")))
        self._archive, self._root = archive, root

    def find_class(self, module: str, name: str) -> Any:
        if module == "torch" and name in STORAGE_DTYPES:
            return name
        known = {
            ("collections", "OrderedDict"): OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2"): _tensor,
            ("torch._utils", "_rebuild_parameter"): _parameter,
        }
        if (module, name) not in known:
            raise pickle.UnpicklingError(f"it holds a {module}.{name}, which is no tensor")
        return known[module, name]

    def persistent_load(self, pid: Any) -> _Storage:
        kind, storage_class, key, _, num_numbers = pid
        if kind != "storage" or storage_class not in STORAGE_DTYPES or not str(key).isalnum():
            raise pickle.UnpicklingError("a storage of an unknown kind")
        dtype = STORAGE_DTYPES[storage_class]
        content = self._archive.read(f"{self._root}data/{key}")
        if len(content) != num_numbers * dtype.itemsize:
            raise pickle.UnpicklingError(f"storage {key} has {len(content)} bytes for {num_numbers} numbers")
        return _Storage(np.frombuffer(content, dtype))


class _Storage(NamedTuple):
    numbers: np.ndarray


def _tensor(storage: Any, offset: int, shape: tuple[int, ...], strides: tuple[int, ...], *_: Any) -> np.ndarray:
    """The part of a storage that a tensor is; only what lies within the storage."""
    if not isinstance(storage, _Storage) or len(shape) != len(strides) or min((offset, *shape, *strides)) < 0:
        raise pickle.UnpicklingError("a tensor that is not part of a storage")
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    if math.prod(shape) == 0:
        return np.zeros(shape, storage.numbers.dtype)
    if last >= storage.numbers.size:
        raise pickle.UnpicklingError("a tensor that reaches beyond its storage")
    byte_strides = tuple(stride * storage.numbers.itemsize for stride in strides)
    return np.lib.stride_tricks.as_strided(storage.numbers[offset:], shape, byte_strides).copy()


def _parameter(tensor: Any, *_: Any) -> Any:
    return tensor


def _read_with_torch(path: Path) -> Any:
    try:
        import torch
    except ImportError:
        needed = "PyTorch is needed to read it: pip install dpmjax[torch]"
        raise ValueError(f"{path}: no ZIP archive, so at best a checkpoint of PyTorch before 1.6; {needed}") from None
    try:
        return _as_numpy(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # whatever a broken file makes of it
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path}: not a PyTorch checkpoint that can be read ({reason})") from error


def _as_numpy(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _as_numpy(item) for key, item in value.items()}
    return value.detach().float().numpy() if hasattr(value, "detach") else value
