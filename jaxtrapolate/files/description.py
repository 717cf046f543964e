"""What a folder's files are: the small TOML file `jaxtrapolate.toml` in it, which says which file holds which buffer.

A full example, for a multi-layer render with PNG masks beside it:

    name = "courtyard"                # for reports; by default the folder's name
    hdr = true                        # colour is HDR; by default where the colour is an EXR or other values
    depth = "metric"                  # in the unit of position, or "ordinal": only larger = farther
    step = 1                          # from one frame's number to the next one's; by default it is found
    static_ids = [7, "9e3779b1"]      # ids of the stencil that do not move: walls that have an id, as they are stored
    cuts = [2]                        # frames that begin another shot

    [motion]                          # how motion vectors are stated; what is left out: the library's convention
    sign = "current_minus_previous"   # or "previous_minus_current"
    units = "pixels"                  # or "uv" (the frame is 0..1) or "ndc" (-1..1)
    y_axis = "up"                     # or "down"

    [jitter]                          # of frames whose samples are shifted by a fraction of a pixel, another one each
    file = "jitter.csv"               # lines of a frame's number, x and y (`jaxtrapolate.files.jitter`)
    units = "pixels"                  # or "uv" or "ndc"
    y_axis = "down"                   # or "up"
    shifts = "samples"                # pixel p shows the screen at p + jitter; or "image": at p - jitter, as where
                                      # it is added to the projection

    [buffers]
    color = "beauty.{frame:04d}.exr"
    depth = { file = "multi.{frame:04d}.exr", layer = "ViewLayer.Depth", channels = "Z", scale = 0.01 }
    sky = { file = "multi.{frame:04d}.exr", layer = "ViewLayer.Depth", channels = "Z", above = 1e9 }
    normal = { file = "multi.{frame:04d}.exr", layer = "ViewLayer.Normal" }
    motion = { file = "multi.{frame:04d}.exr", layer = "ViewLayer.Vector", channels = ["X", "Y"] }
    albedo = { file = "albedo/{frame}.png", srgb = true }
    stencil = "mask/{frame:04d}.png"
    shadow = { file = "light/{frame:04d}.png", invert = true }

A buffer is `color`, `motion`, a field of `GBuffer`, `forward_flow` or `backward_flow`; its value is a pattern or a
table with `file` and some of

- `layer`: of an EXR, or the end of its name; the part's name in a multi-part file. By default the unnamed layer.
- `channels`: their names in the layer, a list or a string of one-letter names. By default the first ones needed, in
  the order RGBA, XYZ, UVW, Y, Z; of colours (`color`, `albedo`, `sky_color`) that have only one channel that one, as
  grey, which a note says.
- `scale`, `offset`: the value is stored * scale + offset, e.g. 2 and -1 for normals in a PNG.
- `invert`: 1 - value, after scale and offset: masks of the other polarity, ordinal depth that is larger when nearer.
- `above`, `below`: for masks: 1 where the stored value is above (below) this number, else 0; scale, offset and invert
  do not apply.
- `nothing_above`, `nothing_below`: for depth: where the stored value is above (below) this number nothing was hit, and
  depth is +inf, as it is in any case where it is not positive or under the sky mask (`jaxtrapolate.files.repair`).
- `srgb`: decode codes of 8 or 16 bits to linear; by default for `color` alone.
- `codes`: take the codes of an image of 8 or 16 bits as they are stored, not as 0..1, before scale and offset.
- `valid`: a channel of the file that is 0 where it holds no value: there the buffer is not finite, so the pixel is
  counted and becomes a hole.

So this reads motion in the encoding of the KITTI benchmark, PNG files of 16 bits with u = (R - 2^15) / 64, v likewise
from G, and B = 0 where nothing was measured (`[motion]` says what u and v mean):

    motion = { file = "{frame:06d}_10.png", codes = true, scale = 0.015625, offset = -512, valid = "B" }

A pattern is a path relative to the folder with one `{frame}` in the file's name, with leading zeros as in
`{frame:04d}`; its folders are separated by forward slashes (in single quotes a backslash does as well). Frames may have
negative numbers where the sign cannot be taken for a hyphen, that is unless a letter or digit stands before `{frame}`.
A file that is left out, since another one is of the same frame (`1` and `0001`) or its number has too few digits, is
named in a note. With a step (0, 2, 4, ...), motion leads to the frame one step before; vectors that lead to the frame
with the number before need `scale = 2` there.

Codes of images (PNG and others, of 8 or 16 bits) become 0..1, save for a stencil's, which are ids; other numbers (TIFF
of 32 bits or floats, Radiance HDR, `.flo`, `.npy`) are values as they are stored, and never sRGB;
`jaxtrapolate.files.decoders` lists the files. Their channels are named Y, RG, RGB by their number, and A is alpha; more
than four are named "0", "1" and so on. Colour with alpha 0 is a hole (`jaxtrapolate.files.alpha`).

Codes of PNG files become 0..1, save for a stencil's, which are ids: of a picture in colour without `channels` the
three codes together, each colour an id. Ids in EXR files may be hashes, as integers or as floats (Cryptomatte's first
channel): they are numbered so that all stay apart (`jaxtrapolate.files.ids`); an antialiased mask is rounded. Most
renderers give walls an id too: without `static_ids` they count as moving objects. `jaxtrapolate check` finds them.

Flows are in the library's own convention, their third channel in the unit of position. Depth +inf is the sky. Ordinal
depth may have 0 for its nearest value, and less: it is moved to positive numbers in the same order, v + 1/256, and
below 0 to 1 / (256 - 65536 v).

`larger = "../1080p"` names a folder of the same frames, 2, 3, ... times as large: the truth of methods that super
sample.

For the other readers the same file may hold `[motion]`, `[jitter]`, `name`, `step`, `static_ids`, `cuts` and `larger`;
what `[motion]` leaves out keeps the reader's own default there.
"""

import dataclasses
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from jaxtrapolate.errors import InputError
from jaxtrapolate.files.ids import StaticId, hexadecimal
from jaxtrapolate.files.jitter import JitterFile, Shifted
from jaxtrapolate.files.reader import BUFFERS
from jaxtrapolate.files.sequence import MotionConvention
from jaxtrapolate.files.text import BACKSLASH, read_toml
from jaxtrapolate.records import DepthKind, Sign, Units, YAxis

SETTINGS_NAME = "jaxtrapolate.toml"
"""The name of the TOML file in a folder of frames."""

_LARGEST_NUMBER = float(np.finfo(np.float32).max)
_MOST_DIGITS = 15
FIELD = re.compile(r"\{frame(?::0?(\d*)d)?\}")
"""The number of a frame in a pattern."""


@dataclasses.dataclass(frozen=True)
class Buffer:
    """Where a buffer lies and how its values are to be read; the module's docstring explains the fields."""

    file: str
    layer: str = ""
    channels: tuple[str, ...] | None = None
    scale: float = 1.0
    offset: float = 0.0
    invert: bool = False
    above: float | None = None
    below: float | None = None
    nothing_above: float | None = None
    nothing_below: float | None = None
    srgb: bool = False
    codes: bool = False
    valid: str = ""


@dataclasses.dataclass(frozen=True)
class Settings:
    """The content of a `jaxtrapolate.toml`; `motion` holds the fields of `MotionConvention` that it states."""

    path: Path
    buffers: dict[str, Buffer]
    motion: dict[str, str]
    name: str | None = None
    hdr: bool | None = None
    depth: DepthKind = "metric"
    step: int | None = None
    static_ids: tuple[StaticId, ...] = ()
    cuts: tuple[int, ...] = ()
    larger: str | None = None
    jitter: JitterFile | None = None

    def convention(self, base: MotionConvention) -> MotionConvention:
        """`base` with what `[motion]` states."""
        return dataclasses.replace(base, **cast("dict[str, Any]", self.motion))


def read_settings(path: str | os.PathLike[str]) -> Settings:
    """Read and check a `jaxtrapolate.toml`.

    Raises:
        InputError: missing, not TOML, an unknown key or a value of the wrong kind, named.
    """
    path = Path(path)
    content = read_toml(path)
    kinds = {
        "name": _text,
        "hdr": _flag,
        "depth": _choice(*get_args(DepthKind)),
        "step": _step,
        "static_ids": _static,
        "cuts": _numbers,
        "larger": _path_text,
        "motion": _table,
        "jitter": _table,
        "buffers": _table,
    }
    content = _checked(path, "", content, kinds)
    motion = _checked(
        path,
        "motion.",
        content.pop("motion", {}),
        {"sign": _choice(*get_args(Sign)), "units": _choice(*get_args(Units)), "y_axis": _choice(*get_args(YAxis))},
    )
    if "jitter" in content:
        content["jitter"] = _jitter(path, content["jitter"])
    buffers = _checked(path, "buffers.", content.pop("buffers", {}), dict.fromkeys(BUFFERS, _text_or_table))
    if not buffers and (unused := [key for key in ("hdr", "depth") if key in content]):
        raise InputError(f"{path}: {unused[0]} is for files that [buffers] describes; remove it, or add that table")
    return Settings(path, {name: _buffer(path, name, value) for name, value in buffers.items()}, motion, **content)


Kind = Callable[[Any], Any]


def _checked(path: Path, prefix: str, table: dict[str, Any], kinds: dict[str, Kind]) -> dict[str, Any]:
    """The values of a table, after checking that each has a known key and a value of its kind."""
    out = {}
    for key, value in table.items():
        if key not in kinds:
            raise InputError(f"{path}: unknown key {prefix + key!r}; one of {', '.join(kinds)} is meant")
        try:
            out[key] = kinds[key](value)
        except ValueError as error:
            raise InputError(f"{path}: {prefix}{key}: expected {error}, got {value!r}; correct it") from error
    return out


def _choice(*choices: str) -> Kind:
    def check(value: Any) -> str:
        if value not in choices:
            raise ValueError(f"one of {', '.join(choices)}")
        return value

    return check


def _instance(kind: type | tuple[type, ...], words: str) -> Kind:
    def check(value: Any) -> Any:
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise ValueError(words)
        return value

    return check


_text = _instance(str, "a text")
_flag = _instance(bool, "true or false")
_table = _instance(dict, "a table")
_text_or_table = _instance((str, dict), "a pattern or a table")
_any_number = _instance((int, float), "a number")


def _number(value: Any) -> Any:
    if not abs(_any_number(value)) <= _LARGEST_NUMBER:  # no NaN either
        raise ValueError("a finite number that 32 bits hold")
    return value


def _channels(value: Any) -> tuple[str, ...]:
    if not isinstance(value, str | list) or not value or not all(isinstance(c, str) for c in value):
        raise ValueError("a list of names or a string of one-letter names")
    return tuple(value)


def _path_text(value: Any) -> str:
    value = _text(value)
    if any(ord(character) < 32 for character in value):
        raise ValueError(BACKSLASH)
    return value.replace("\\", "/")


def _static(value: Any) -> tuple[StaticId, ...]:
    numbers = [v for v in value if isinstance(v, int) and not isinstance(v, bool)] if isinstance(value, list) else []
    texts = [v for v in value if isinstance(v, str)] if isinstance(value, list) else []
    if not isinstance(value, list) or len(numbers) + len(texts) != len(value):
        raise ValueError('a list of ids, as numbers or as the hexadecimal digits of hashes, such as [7, "9e3779b1"]')
    for text in texts:
        try:
            hexadecimal(text)
        except ValueError:
            raise ValueError(f"eight hexadecimal digits in each text, not {text!r}") from None
    return tuple(value)


def _numbers(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(isinstance(v, int) and not isinstance(v, bool) for v in value):
        raise ValueError("a list of whole numbers, such as [12, 40]")
    return tuple(sorted(set(value)))


def _step(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ValueError("a whole number, 1 or more")
    return value


def _pattern(value: Any) -> str:
    value = _path_text(value) if isinstance(value, str) else value
    if not isinstance(value, str) or len(FIELD.findall(value)) != 1 or not FIELD.search(os.path.basename(value)):
        raise ValueError("a path with one {frame} or {frame:04d} in the file's name")
    digits = FIELD.findall(value)[0].lstrip("0")
    if len(digits) > 2 or int(digits or 0) > _MOST_DIGITS:
        raise ValueError(f"a frame's number of at most {_MOST_DIGITS} digits")
    return value


def _jitter(path: Path, table: dict[str, Any]) -> JitterFile:
    kinds = {"units": _choice(*get_args(Units)), "y_axis": _choice(*get_args(YAxis))}
    kinds |= {"file": _path_text, "shifts": _choice(*get_args(Shifted))}
    table = _checked(path, "jitter.", table, kinds)
    if "file" not in table:
        raise InputError(f'{path}: jitter: no file; add one such as file = "jitter.csv"')
    return JitterFile(**table)


def _buffer(path: Path, name: str, value: str | dict[str, Any]) -> Buffer:
    kinds = {
        "file": _pattern,
        "layer": _path_text,
        "channels": _channels,
        "scale": _number,
        "offset": _number,
        "invert": _flag,
        "above": _number,
        "below": _number,
        "nothing_above": _number,
        "nothing_below": _number,
        "srgb": _flag,
        "codes": _flag,
        "valid": _text,
    }
    table = _checked(path, f"buffers.{name}.", {"file": value} if isinstance(value, str) else value, kinds)
    if "file" not in table:
        raise InputError(f'{path}: buffers.{name}: no file; add one such as file = "{name}.{{frame:04d}}.exr"')
    if len(table.get("channels", ())) not in (0, BUFFERS[name]):
        raise InputError(f"{path}: buffers.{name}.channels: expected {BUFFERS[name]}, got {len(table['channels'])}")
    for key in ("above", "below"):
        if name == "depth" and key in table:
            text = f"makes a mask; where depth {key} a number is nothing, write nothing_{key}"
            raise InputError(f"{path}: buffers.depth.{key}: {text} = {table[key]}")
        if name != "depth" and f"nothing_{key}" in table:
            text = f"is for depth; for a mask of what is {key} a number, write {key}"
            raise InputError(f"{path}: buffers.{name}.nothing_{key}: {text} = {table[f'nothing_{key}']}")
    return Buffer(**{"srgb": name == "color", **table})
