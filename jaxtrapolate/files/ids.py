"""Ids of dynamic objects: kept apart exactly, however they are stored, in the float32 of `GBuffer.stencil`.

Files hold ids as integers of up to 32 bits (indices, hashes) or as floats whose bits are a hash (Cryptomatte). float32
holds the integers 0..2^24 exactly, so those stay what they are. Any other id is given the next free number from 1 on,
in ascending order of all ids of the sequence. That needs to know all of them: when the first id comes that is not such
a number, the stencils of all frames are read once (`FileSequence`), and the numbers are remembered. They follow from
the files alone, not from which frame was read first, nor in which process.

What a stored value means:

- 0 is static, and so is every id that is named as static (`static_ids` in `jaxtrapolate.toml`);
- an integer from 1 to 2^24 is that id;
- a sequence has *hashes* where a value has a magnitude above 2^24, or below 2^-20 without being 0, or is negative and
  no integer, or where its channel is called so ("crypto" in the name): then every other value is an id, to be numbered;
- in a sequence without hashes a negative integer is static ("no object"), and what lies between integers, as on the
  edges of a filtered mask, is rounded.

Why not a function of the id alone: 2^32 hashes do not fit into the 2^24 integers, nor into all positive integers that
float32 knows (8.8e8), without two of a thousand ids meeting once in some hundred sequences or so.
"""

import dataclasses
from collections.abc import Iterable

import numpy as np

LARGEST = 2**24
"""Integers from 0 to this one are exact in float32."""
_SMALLEST_INDEX = 2.0**-20

StaticId = int | str
"""An id as it is stored: a number, or for floats that are hashes their bits as hexadecimal digits."""


def plain(values: np.ndarray) -> np.ndarray:
    """Which values stay unchanged: integers from 0 to 2^24 (and NaN and infinities, which are invalid pixels)."""
    if values.dtype.kind in "ui":
        return (values >= 0) & (values <= LARGEST)
    return ~np.isfinite(values) | ((values >= 0) & (values <= LARGEST) & (values == np.rint(values)))


def distinct(values: np.ndarray) -> np.ndarray:
    """The different values of an image, float64, ascending; neighbours are mostly alike, so they are few to sort."""
    return np.unique(_starts(values.ravel())[0]).astype(np.float64)


def _starts(flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The values of the stretches of equal values, and how long each is."""
    places = np.flatnonzero(np.concatenate([np.ones(min(len(flat), 1), bool), flat[1:] != flat[:-1]]))
    return flat[places], np.diff(places, append=len(flat))


def hexadecimal(text: str) -> int:
    """The 32 bits that "9e3779b1" or "0x9E3779B1" states; ValueError where it is no such text."""
    value = int(text, 16)
    if not 0 <= value < 2**32:
        raise ValueError(text)
    return value


def clear_static(values: np.ndarray, static: Iterable[StaticId]) -> np.ndarray:
    """The stored values, 0 where they are an id that is named as static."""
    bits = values.dtype.kind == "f"
    named = [_value(hexadecimal(name), bits) if isinstance(name, str) else float(name) for name in static]
    starts, lengths = _starts(values.ravel())
    cleared = np.isin(starts.astype(np.float64), named)
    if not cleared.any():
        return values
    return np.where(cleared, 0, starts).astype(values.dtype).repeat(lengths).reshape(values.shape)


def _value(word: int, bits: bool) -> float:
    """What 32 bits stand for: a float32, or an integer."""
    return float(np.array(word, np.uint32).view(np.float32)) if bits else float(word)


def color_ids(codes: np.ndarray) -> np.ndarray:
    """One id for each colour of uint8 `[H, W, 3 or 4]`, `[H, W, 1]`: a grey's is its code, as if the picture were grey.

    Any other's is R G B as 24 bits, but that (0, 0, g) would be g again: it has the 24 bits of grey g instead.
    """
    red, green, blue = (codes[..., k].astype(np.int64) for k in range(3))
    grey, dark = (red == green) & (green == blue), (red == 0) & (green == 0)
    ids = np.where(grey, blue, np.where(dark, blue * 0x010101, red * 0x010000 + green * 0x0100 + blue))
    return ids[..., None]


@dataclasses.dataclass(frozen=True)
class Numbering:
    """The numbers of all ids of a sequence that cannot stay unchanged.

    stored: ascending, float64 (which holds every uint32 and every float32). given: the numbers, float32. hashes: as in
    the module's docstring. bits: whether the hashes are stored as floats.
    """

    stored: np.ndarray
    given: np.ndarray
    hashes: bool
    bits: bool

    @classmethod
    def of(cls, found: np.ndarray, *, crypto: bool = False, bits: bool = False) -> "Numbering":
        """From every value (float64) that the frames of a sequence hold, in any order, several times or once.

        Args:
            found: the values.
            crypto: whether the channel's name says that they are hashes.
            bits: whether they are stored as floats.

        Raises:
            ValueError: more than 2^24 ids.
        """
        found = np.unique(found[np.isfinite(found)])
        kept = plain(found)
        others, taken = found[~kept], found[kept]
        size = np.abs(others)
        odd = (size > LARGEST) | (size < _SMALLEST_INDEX) | ((others < 0) & (others != np.rint(others)))
        hashes = crypto or bool(odd.any())
        if not hashes:
            return cls(np.zeros(0), np.zeros(0, np.float32), False, bits)
        if len(found) > LARGEST:
            raise ValueError(f"the stencil has {len(found)} ids, more than 2^24; store one for each object, not pixel")
        free = np.setdiff1d(np.arange(1, len(found) + 1), taken.astype(np.int64), assume_unique=True)
        return cls(others, free[: len(others)].astype(np.float32), True, bits)

    def apply(self, values: np.ndarray) -> np.ndarray:
        """The ids float32 of stored values; NaN and infinities stay. ValueError where one is not among those stored."""
        starts, lengths = _starts(values.ravel())
        kept = plain(starts)
        out = np.where(kept, starts, 0).astype(np.float32)
        others = starts[~kept].astype(np.float64)
        if self.hashes and len(others):
            places = np.searchsorted(self.stored, others).clip(max=max(len(self.stored) - 1, 0))
            if not len(self.stored) or (self.stored[places] != others).any():
                raise ValueError(
                    "the stencil has an id that was not there when its frames were first read; open it again"
                )
            out[~kept] = self.given[places]
        else:
            out[~kept] = np.maximum(np.rint(others), 0)
        return out.repeat(lengths).reshape(values.shape)

    def stated(self, number: int) -> StaticId:
        """How `static_ids` names the id that was given a number: as it is stored."""
        (places,) = np.nonzero(self.given == number)
        if not len(places):
            return number
        value = self.stored[places[0]]
        return f"{np.float32(value).view(np.uint32):08x}" if self.bits else int(value)
