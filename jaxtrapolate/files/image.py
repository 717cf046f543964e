"""8-bit images (PNG), and one function that writes a frame as its input was: EXR for HDR, PNG for 8-bit."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from jaxtrapolate.files.atomic import atomic_path, os_input_error
from jaxtrapolate.files.exr import write_exr
from jaxtrapolate.files.sequence import InputError

_MODES = {1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}


def _curve() -> np.ndarray:
    """The linear value of every 8-bit sRGB code (IEC 61966-2-1), float32 `[256]`."""
    code = np.arange(256) / 255.0
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4).astype(np.float32)


_LINEAR = _curve()


def decode_srgb(codes: np.ndarray) -> np.ndarray:
    """Linear float32 values of 8-bit sRGB codes, by the exact curve; `encode_srgb` gives the codes back."""
    return _LINEAR[codes]


def encode_srgb(linear: Any) -> np.ndarray:
    """8-bit sRGB codes of linear values: clipped to 0..1, exact curve, rounded to the nearest; NaN becomes 0."""
    linear = np.clip(np.nan_to_num(np.asarray(linear, np.float64), nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    code = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(code * 255.0).astype(np.uint8)


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """`(H, W)` of a PNG (or any file that Pillow reads), from its header alone."""
    try:
        with Image.open(path) as image:
            return image.height, image.width
    except (OSError, SyntaxError, ValueError) as error:
        raise _read_error(path, error) from error


def read_png(path: str | os.PathLike[str]) -> np.ndarray:
    """The stored codes `[H, W, C]` of a PNG (or any file that Pillow reads): uint8, or uint16 where it has 16 bits.

    Palettes are resolved to RGB or RGBA; a black-and-white image becomes 0 and 255.

    Raises:
        InputError: missing, no permission, not an image, or truncated.
    """
    try:
        with Image.open(path) as image:
            if image.mode == "P":
                image = image.convert("RGBA" if "transparency" in image.info else "RGB")
            elif image.mode == "1":
                image = image.convert("L")
            codes = np.array(image)
    except (OSError, SyntaxError, ValueError) as error:
        raise _read_error(path, error) from error
    if codes.dtype == np.int32:  # Pillow's mode I, which it uses for some 16-bit files.
        codes = codes.astype(np.uint16)
    if codes.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: pixels of type {codes.dtype} cannot be read; store it as an 8-bit PNG or as EXR")
    return codes if codes.ndim == 3 else codes[..., None]


def _read_error(path: str | os.PathLike[str], error: Exception) -> InputError:
    if isinstance(error, OSError) and error.errno is not None:
        return os_input_error(path, error)
    if isinstance(error, UnidentifiedImageError):
        return InputError(f"{path}: not an image; render or copy it again")
    return InputError(f"{path}: truncated or damaged; render or copy it again")


def write_png(path: str | os.PathLike[str], codes: Any) -> None:
    """Write 8-bit codes `[H, W, C]` (C from 1 to 4) or `[H, W]` as a PNG, in full or not at all (`atomic_path`).

    Raises:
        InputError: no such folder, no permission, or disk full.
    """
    array = np.asarray(codes)
    array = array[..., None] if array.ndim == 2 else array
    if array.dtype != np.uint8:
        raise TypeError(f"codes: expected dtype uint8, got {array.dtype}")
    if array.ndim != 3 or array.shape[-1] not in _MODES or 0 in array.shape:
        raise ValueError(f"codes: expected [H, W, C] with C from 1 to 4, or [H, W], got {list(array.shape)}")
    array = np.ascontiguousarray(array[..., 0] if array.shape[-1] == 1 else array)
    with atomic_path(path) as temporary:
        Image.fromarray(array).save(temporary, format="PNG")


def write_frame(path: str | os.PathLike[str], color: Any, hdr: bool, *, half: bool = True) -> Path:
    """Write a frame's linear colour `[H, W, 3]` in the kind of file its input had.

    Args:
        path: where to; `.exr` or `.png` is appended, or exchanged for the other.
        color: linear radiance, a NumPy or JAX array.
        hdr: EXR as it is, else an 8-bit sRGB PNG, clipped to 0..1.
        half: 16-bit floats in the EXR, else 32-bit.

    Returns:
        The path of the file that was written.
    """
    path = Path(path)
    stem = path.stem if path.suffix.lower() in (".exr", ".png") else path.name
    path = path.with_name(stem + (".exr" if hdr else ".png"))
    color = np.asarray(color)
    if color.ndim != 3 or color.shape[-1] != 3:
        raise ValueError(f"color: expected shape [H, W, 3], got {list(color.shape)}")
    if hdr:
        write_exr(path, color, half=half)
    else:
        write_png(path, encode_srgb(color))
    return path
