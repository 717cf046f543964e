"""Alpha of stored colour: where it is 0 there is no pixel.

Such a pixel is given NaN, so that it is counted, becomes a hole and is not scored, as every non-finite one
(`jaxtrapolate.files.repair`). Where alpha is between 0 and 1, the colour is taken as it is stored: premultiplied in an
EXR, straight in all other files; it is not put over anything. Many renderers write an EXR whose alpha is 0 everywhere;
that counts as not written. Notes of the sequence say so (`Sequence.notes`): of alpha when it is opened, of alpha that
is 0 everywhere when the first such frame is read.
"""

import os
from collections.abc import Mapping

import numpy as np

from jaxtrapolate.files.exr import exr_channels, layer_channels
from jaxtrapolate.files.image import image_header

EXR_NOTE = (
    "the colour has alpha: where it is 0 there is no pixel (counted with the non-finite ones: a hole, not scored), "
    "where it is partial the colour is taken as stored, premultiplied"
)
UNWRITTEN_NOTE = (
    "{name}: its alpha is 0 everywhere, which counts as not written: no pixel is left out (nor in others alike)"
)
IMAGE_NOTE = (
    "the colour has alpha: where it is 0 there is no pixel (counted with the non-finite ones: a hole, not scored), "
    "where it is partial the colour is taken as stored, straight, over nothing"
)


def alpha_note(path: str | os.PathLike[str], layer: str = "") -> str | None:
    """What is to be said about the alpha of a file of colour, from its header; `None` where it has none."""
    if os.fsdecode(path).lower().endswith(".exr"):
        return EXR_NOTE if _alpha_name(exr_channels(path), layer) else None
    return IMAGE_NOTE if image_header(path).alpha else None


def exr_alpha(stored: Mapping[str, np.ndarray], layer: str = "") -> np.ndarray | None:
    """The alpha `[H, W]` of a layer of an EXR; `None` where there is none."""
    name = _alpha_name(tuple(stored), layer)
    return stored[name] if name else None


def _alpha_name(names: tuple[str, ...], layer: str) -> str:
    return next((name for name in layer_channels(names, layer) if name.rpartition(".")[2].upper() == "A"), "")


def without_empty(color: np.ndarray, alpha: np.ndarray | None) -> np.ndarray:
    """Colour `[H, W, C]` with NaN where alpha `[H, W]` is 0; the colour itself where there is no such pixel."""
    if alpha is None or (alpha != 0).all():
        return color
    return np.where((alpha == 0)[..., None], np.float32(np.nan), color)
