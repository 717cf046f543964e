"""The library's own files of weights, and checkpoints of its training: arrays, and how to use them."""

import dataclasses
import hashlib
import io
import json
import math
import os
import re
import stat
import sys
import warnings
import zipfile
from collections.abc import Callable, Mapping
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.errors import printable
from jaxtrapolate.files.text import check_values
from jaxtrapolate.regular import open_regular
from jaxtrapolate.weights.tree import named, nested

LARGEST_SHIPPED = 2_000_000
"""Bytes: no file of weights that comes with the package is larger."""
LARGEST = 1 << 28
"""Bytes: no file of weights is written or read that is larger, nor an Orbax checkpoint whose arrays or files are."""
_METADATA = "__metadata__"
_ORBAX = "_METADATA"  # the file that every pytree saved by Orbax has
_NAME = re.compile(r"(?P<stem>.+)-(?P<hash>[0-9a-f]{8})\.npz")
_STEP = re.compile("[0-9]{1,18}")
_SHIPPED = Path(__file__).parent


@dataclasses.dataclass(frozen=True)
class Weights:
    """The weights of a method.

    Attributes:
        method: the name that `jaxtrapolate.load` knows, `None` where the source does not say.
        config: what the method has to be built with, as in JSON; empty where the source does not say.
        note: one line on how they were trained.
        tree: nested dictionaries of arrays.
        source: the file, for messages.
    """

    method: str | None
    config: Mapping[str, Any]
    note: str
    tree: dict[str, Any]
    source: str


def save_weights(
    directory: str | PathLike[str],
    method: str,
    tree: Any,
    *,
    config: Mapping[str, Any],
    note: str,
    name: str | None = None,
) -> Path:
    """Writes weights to `directory/<name>-<hash>.npz`, in full or not at all.

    The hash is the first eight digits of the SHA-256 of the file's bytes, which are the same for the same arguments on
    every machine: members sorted by name, stored as they are, little-endian, without dates.

    Args:
        directory: exists.
        method: the name of the method.
        tree: a pytree of arrays of numbers; "path/of/param" are their names in the file.
        config: what the method has to be built with; goes through JSON.
        note: one line on how they were trained.
        name: the first part of the file's name, by default that of the method.

    Returns:
        The file's path.

    Raises:
        InputError: the folder does not exist or cannot be written to.
        ValueError: two arrays with one name, one that holds no numbers, a note of several lines, or more than 256 MB.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in named(tree).items()}
    nested(arrays)
    if "\n" in note:
        raise ValueError(f"note: expected one line, got {len(note.splitlines())}")
    for key, array in arrays.items():
        if array.dtype.kind not in "fiub":
            raise ValueError(f"weights: {key} is of {array.dtype}, which NumPy's files do not hold")
    metadata = json.dumps({"method": method, "config": dict(config), "note": note}, sort_keys=True)
    content = _packed({**arrays, _METADATA: np.array(metadata.encode())})
    if len(content) > LARGEST:
        raise ValueError(f"weights: {len(content)} bytes, expected at most {LARGEST}")
    path = Path(directory) / f"{method if name is None else name}-{_hash(content)}.npz"
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return path


def load_weights(path: str | PathLike[str]) -> Weights:
    """Weights that `save_weights` wrote, after checking that the file's bytes have the hash that its name states.

    Raises:
        OSError: the file cannot be read.
        ValueError: one line that names the file: a name without a hash, another hash, more than 256 MB, or no weights.
    """
    path, source = Path(path), printable(path)
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        match = _NAME.fullmatch(path.name)
        if match is None:
            raise ValueError(f"{source}: expected a name that ends in the file's hash, as in extranet-1a2b3c4d.npz")
        content = file.read(LARGEST + 1)
    if len(content) > LARGEST:
        raise ValueError(f"{source}: {size} bytes, expected at most {LARGEST}")
    if (found := _hash(content)) != match["hash"]:
        raise ValueError(f"{source}: damaged or changed: its hash is {found}, its name says {match['hash']}")
    try:
        arrays = _unpacked(content)
        metadata = json.loads(arrays.pop(_METADATA).item())
        check_values(metadata)
        return Weights(**_stated(metadata), tree=nested(arrays), source=source)
    except Exception as error:  # what the parsers of zip, JSON and NumPy raise on damaged bytes is not documented
        raise ValueError(printable(f"{source}: no weights of this library ({error})")) from error


def load_orbax(directory: str | PathLike[str]) -> Weights:
    """Weights from an Orbax checkpoint.

    Args:
        directory: of one of
            - a checkpoint with the items "weights" (the pytree) and "metadata" (JSON: method, config, note),
            - a `CheckpointManager`, whose latest step holds those,
            - a checkpoint that is nothing but the pytree; method, config and note are then not known.

    Raises:
        ValueError: one line that names the directory: none of these.
    """
    import orbax.checkpoint as ocp
    from etils import epath

    source = printable(directory)
    try:
        folder = Path(directory).resolve()
        steps = [child for child in folder.iterdir() if _STEP.fullmatch(child.name)] if folder.is_dir() else []
        folder = max(steps, key=lambda child: int(child.name)) if steps else folder
        item = folder if (folder / _ORBAX).is_file() else folder / "weights"
        if not (item / _ORBAX).is_file():
            raise ValueError(f"{source}: no Orbax checkpoint, or one without the item 'weights'")
        _check_files(folder, source)
    except (OSError, RuntimeError) as error:  # a link that leads back to itself is a RuntimeError
        raise ValueError(printable(f"{source}: no Orbax checkpoint ({error})")) from error
    metadata: dict[str, Any] = {"method": None, "config": {}, "note": ""}
    hook = sys.unraisablehook
    sys.unraisablehook = partial(_unraisable, hook)
    try:  # by handlers: a checkpointer warns of every item that is not asked for
        handler = ocp.PyTreeCheckpointHandler()
        stated = handler.metadata(epath.Path(item))
        sizes = [_bytes(leaf) for leaf in jax.tree.leaves(getattr(stated, "tree", stated))]
        if sum(sizes) > LARGEST:
            raise ValueError(f"claims arrays of {sum(sizes)} bytes, at most {LARGEST} are read")
        kinds = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), stated)
        tree = handler.restore(epath.Path(item), args=ocp.args.PyTreeRestore(restore_args=kinds))
        handler.close()
        if item != folder and (folder / "metadata").is_dir():
            metadata |= ocp.JsonCheckpointHandler().restore(
                epath.Path(folder / "metadata"), args=ocp.args.JsonRestore()
            )
        check_values(metadata)
        weights = Weights(**_stated(metadata), tree=nested(named(tree)), source=source)
        sys.unraisablehook = hook
        return weights
    except Exception as error:  # what Orbax raises on a damaged checkpoint is not documented
        warnings.filterwarnings("ignore", r"coroutine '\w*Handler\.\w+' was never awaited", RuntimeWarning)
        reason = " ".join(str(error).split())[:200]
        raise ValueError(printable(f"{source}: damaged Orbax checkpoint ({reason})")) from error


def _unraisable(otherwise: Callable[[Any], Any], raised: Any) -> None:
    """Says nothing of arrays that Orbax was still reading when one was damaged: they find their event loop closed.

    That may be after the refusal, so the hook stays then; everything else it passes on.
    """
    if not (isinstance(raised.exc_value, RuntimeError) and str(raised.exc_value) == "Event loop is closed"):
        otherwise(raised)


def _check_files(folder: Path, source: str) -> None:
    """Raise `ValueError` where a checkpoint holds a pipe, a device or a link to a folder, or too many bytes."""
    total = 0
    for parent, folders, names in os.walk(folder):
        for name in (*names, *folders):
            path = os.path.join(parent, name)
            mode = os.stat(path).st_mode
            if not stat.S_ISREG(mode) and (not stat.S_ISDIR(mode) or os.path.islink(path)):
                raise ValueError(printable(f"{source}: damaged Orbax checkpoint ({name} is no regular file)"))
            total += os.path.getsize(path) if stat.S_ISREG(mode) else 0
    if total > LARGEST:
        raise ValueError(f"{source}: an Orbax checkpoint of {total} bytes, at most {LARGEST} are read")


def _bytes(leaf: Any) -> int:
    """How many bytes an array takes by what its metadata state."""
    shape, dtype = getattr(leaf, "shape", None) or (), getattr(leaf, "dtype", None)
    return math.prod(int(n) for n in shape) * (8 if dtype is None else np.dtype(dtype).itemsize)


def read_weights(path: str | PathLike[str]) -> Weights:
    """Weights from a folder by `load_orbax`, from anything else by `load_weights`; errors are theirs."""
    return load_orbax(path) if Path(path).is_dir() else load_weights(path)


def default_weights(method: str) -> Path:
    """The file of a method's weights that is part of the package.

    Raises:
        ValueError: none is, or more than one.
    """
    found = [p for p in sorted(_SHIPPED.glob("*.npz")) if (m := _NAME.fullmatch(p.name)) and m["stem"] == method]
    if not found:
        raise ValueError(
            f"method {method!r}: no default weights come with this version; give a file of weights (weights=FILE)"
        )
    if len(found) > 1:
        raise ValueError(f"method {method!r}: several default weights: {', '.join(p.name for p in found)}")
    return found[0]


def _stated(metadata: Any) -> dict[str, Any]:
    """Method, config and note, each of its type."""
    for key, kinds in (("method", (str, type(None))), ("config", dict), ("note", str)):
        if not isinstance(metadata, dict) or not isinstance(metadata.get(key), kinds):
            raise ValueError(f"its metadata state no {key}")
    return {key: metadata[key] for key in ("method", "config", "note")}


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:8]


def _packed(arrays: Mapping[str, np.ndarray]) -> bytes:
    """A `.npz` with the same bytes whenever the arrays are the same."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(arrays):
            array = np.ascontiguousarray(arrays[name]).reshape(arrays[name].shape)  # a scalar stays one
            member = io.BytesIO()
            np.lib.format.write_array(member, array.astype(array.dtype.newbyteorder("<")), (1, 0), allow_pickle=False)
            info = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            info.create_system = 3  # else it tells the system
            archive.writestr(info, member.getvalue())
    return buffer.getvalue()


def _unpacked(content: bytes) -> dict[str, np.ndarray]:
    """The arrays of a `.npz`; sizes that it claims are held against the bytes that are there."""
    arrays = {}
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for info in archive.infolist():
            if info.compress_type != zipfile.ZIP_STORED or info.file_size > len(content):
                raise ValueError(f"{info.filename} is compressed")
            member = io.BytesIO(archive.read(info))
            if np.lib.format.read_magic(member) != (1, 0):
                raise ValueError(f"{info.filename} is in another version of the format")
            shape, fortran, dtype = np.lib.format.read_array_header_1_0(member)
            if dtype.kind not in "fiubS":
                raise ValueError(f"{info.filename} holds no numbers")
            data = np.frombuffer(member.read(), dtype)
            arrays[info.filename.removesuffix(".npy")] = data.reshape(shape, order="F" if fortran else "C")
    return arrays
