"""PyTorch checkpoints (`.pth`, `.pth.tar`, the zip format), without PyTorch and without running anything in them."""

import math
import zipfile
from os import PathLike
from typing import Any, BinaryIO

import jax.numpy as jnp
import numpy as np

from jaxtrapolate.errors import printable
from jaxtrapolate.regular import open_regular
from jaxtrapolate.weights.pickled import Global, read_pickle

_DTYPES = {
    "torch.DoubleStorage": np.dtype(np.float64),
    "torch.FloatStorage": np.dtype(np.float32),
    "torch.HalfStorage": np.dtype(np.float16),
    "torch.BFloat16Storage": np.dtype(jnp.bfloat16),
    "torch.LongStorage": np.dtype(np.int64),
    "torch.IntStorage": np.dtype(np.int32),
    "torch.ShortStorage": np.dtype(np.int16),
    "torch.CharStorage": np.dtype(np.int8),
    "torch.ByteStorage": np.dtype(np.uint8),
    "torch.BoolStorage": np.dtype(np.bool_),
}


def read_torch(path: str | PathLike[str]) -> dict[str, Any]:
    """A PyTorch checkpoint as nested dictionaries of NumPy arrays; numbers, text and lists stay what they are.

    Read is the zip format, which PyTorch writes since 1.6. Nothing in the file is run: its pickle may name tensors,
    parameters, storages and OrderedDict, and nothing else. What an array claims to be is held against the bytes that
    are there, so that a small file cannot ask for much memory.

    Args:
        path: of the file.

    Returns:
        What `torch.save` was given, a dictionary, as a rule {"state_dict": {name: array}}. The arrays are read-only and
        in the layout of PyTorch; bfloat16 is that of JAX. Where they were stored ("cuda:0") does not matter.

    Raises:
        OSError: the file cannot be read.
        ValueError: one line that names the file: no checkpoint, damaged, in the format before 1.6, a global that is
            refused (which is named), or an array that does not fit its storage.
    """
    source = printable(path)
    with open_regular(path) as file:
        try:
            value = _Archive(file).read()
        except ValueError as error:
            raise ValueError(printable(f"{source}: {error}")) from error
        except Exception as error:  # what the parts of the standard library raise on damaged bytes is not documented
            old = "no zip file; what PyTorch before 1.6 saved has to be saved again by a newer one"
            reason = f"damaged: {' '.join(str(error).split())}" if zipfile.is_zipfile(file) else old
            raise ValueError(printable(f"{source}: not a PyTorch checkpoint: {reason}")) from error
    if not isinstance(value, dict):
        raise ValueError(f"{source}: expected a dictionary, got {type(value).__name__}")
    return value


class _Archive:
    """The records of a checkpoint; each is stored unchanged, so that all together are no more than the file."""

    def __init__(self, file: BinaryIO):
        self.archive, self.storages, self.left = zipfile.ZipFile(file), {}, file.seek(0, 2)
        members = set(self.archive.namelist())
        roots = [
            name.removesuffix("data.pkl") for name in members if name.count("/") == 1 and name.endswith("/data.pkl")
        ]
        if len(roots) != 1:
            raise ValueError("not a PyTorch checkpoint: no data.pkl in it")
        self.root = roots[0]
        stated = f"{self.root}byteorder" in members
        self.order = ">" if stated and self.record("byteorder") == b"big" else "<"

    def record(self, name: str) -> bytes:
        info = self.archive.getinfo(self.root + name)
        if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
            raise ValueError(f"{name} is compressed, which PyTorch does not do")
        self.left -= info.file_size
        if self.left < 0:
            raise ValueError(f"{name} and what was read before claim more bytes than the file has")
        return self.archive.read(info)

    def read(self) -> Any:
        calls = {
            "torch._utils._rebuild_tensor": _tensor,
            "torch._utils._rebuild_tensor_v2": _tensor,
            "torch._utils._rebuild_parameter": _parameter,
            "collections.OrderedDict": _ordered,
        }
        return read_pickle(
            self.record("data.pkl"),
            names=frozenset(_DTYPES),
            calls=calls,
            expected="tensors",
            build=_build,
            refer=self.storage,
        )

    def storage(self, reference: Any) -> "_Storage":
        kind, dtype, key, _, count = reference if isinstance(reference, tuple) and len(reference) == 5 else (None,) * 5
        if kind != "storage" or not isinstance(dtype, Global) or dtype.name not in _DTYPES or not isinstance(key, str):
            raise ValueError("refers to something outside the pickle that is no storage")
        if key not in self.storages:
            self.storages[key] = self.record(f"data/{key}")
        data, dtype = self.storages[key], _DTYPES[dtype.name]
        if type(count) is not int or len(data) != count * dtype.itemsize:
            raise ValueError(f"storage {key}: claims {count} of {dtype}, holds {len(data)} bytes")
        return _Storage(np.frombuffer(data, dtype.newbyteorder(self.order)).astype(dtype, copy=False))


class _Storage:
    """The values that tensors are views of."""

    def __init__(self, values: np.ndarray):
        self.values = values


def _sizes(name: str, value: Any) -> tuple[int, ...]:
    if not isinstance(value, tuple) or len(value) > 32 or not all(type(n) is int and 0 <= n < 2**48 for n in value):
        raise ValueError(f"a tensor's {name} is no tuple of sizes")
    return value


def _tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> np.ndarray:
    """The view of a storage that a tensor is; it may not be larger than the storage, nor reach beyond."""
    if not isinstance(storage, _Storage):
        raise ValueError(f"a tensor's storage is a {type(storage).__name__}")
    values = storage.values
    shape, strides, (offset,) = _sizes("shape", shape), _sizes("strides", strides), _sizes("offset", (offset,))
    if len(shape) != len(strides):
        raise ValueError(f"a tensor has the shape {list(shape)} and the strides {list(strides)}")
    last = offset + sum((n - 1) * step for n, step in zip(shape, strides, strict=True))
    if 0 in shape:
        return np.zeros(shape, values.dtype)
    if math.prod(shape) > values.size or last >= values.size:
        raise ValueError(f"a tensor {list(shape)}, strides {list(strides)}, offset {offset} exceeds its {values.size}")
    steps = tuple(step * values.itemsize for step in strides)
    return np.lib.stride_tricks.as_strided(values[offset:], shape, steps, writeable=False)


def _ordered() -> dict:
    return {}


def _parameter(tensor: Any, *_: Any) -> np.ndarray:
    if not isinstance(tensor, np.ndarray):
        raise ValueError(f"a parameter is a {type(tensor).__name__}")
    return tensor


def _build(value: Any, state: Any) -> None:
    """The attributes of a state_dict, which say by which version of PyTorch each module was created, are left out."""
    if type(value) is not dict:
        raise ValueError(f"sets the state of a {type(value).__name__}: refused")
