"""Files by pattern, as a `jaxtrapolate.toml` describes them (`jaxtrapolate.files.description`)."""

import dataclasses
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxtrapolate.errors import InputError
from jaxtrapolate.files.alpha import without_empty
from jaxtrapolate.files.decoders import ImageHeader
from jaxtrapolate.files.description import FIELD, SETTINGS_NAME, Buffer, Settings, read_settings
from jaxtrapolate.files.exr import layer_channels, pick, quiet, read_exr
from jaxtrapolate.files.ids import color_ids
from jaxtrapolate.files.image import decode_srgb, image_header, read_image
from jaxtrapolate.files.listing import Files, collect, folder_name, frame_number, list_folder, some
from jaxtrapolate.files.reader import BUFFERS, GREY, FileSequence, Opened, is_exr, pick_channels
from jaxtrapolate.files.sequence import MotionConvention


class PatternSequence(FileSequence):
    """Files by pattern; see `jaxtrapolate.files.description` for the TOML file that describes them.

    Args:
        folder: that of the frames.
        settings: the TOML file, where it is not `jaxtrapolate.toml` in the folder, or its content.
        motion: how the motion vectors are stated; goes before what the TOML file says.
        strict: raise on reading a frame with a non-finite pixel.

    Raises:
        InputError: no such folder, a TOML file that cannot be used, no files of these names, a missing file, files of
            different sizes.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        settings: str | os.PathLike[str] | Settings | None = None,
        motion: MotionConvention | None = None,
        strict: bool = False,
    ) -> None:
        list_folder(folder)
        if not isinstance(settings, Settings):
            settings = read_settings(Path(folder) / SETTINGS_NAME if settings is None else settings)
        if not settings.buffers:
            raise InputError(f"{settings.path}: names no buffers; add a table [buffers]")
        self._buffers = settings.buffers
        self._path = settings.path
        color = settings.buffers.get("color")
        files, left_out = _find(Path(folder), settings)
        self._color_layer = "" if color is None else color.layer
        super().__init__(
            folder,
            files,
            name=settings.name or folder_name(folder),
            hdr=settings.hdr if settings.hdr is not None else _holds_values(Path(folder), files),
            depth=settings.depth,
            convention=motion or settings.convention(MotionConvention()),
            step=settings.step,
            static_ids=settings.static_ids,
            left_out=left_out,
            strict=strict,
        )

    def _read(self, path: Path, buffer: str, opened: Opened) -> np.ndarray:
        spec, name = self._buffers[buffer], str(path)
        if name not in opened:
            opened[name] = read_exr(path) if is_exr(name) else read_image(path)
        if is_exr(name):
            stored = opened[name]
            image = pick_channels(stored, path=path, buffer=buffer, **self._layer(buffer))
            if spec.valid:
                valid = pick(stored, path=path, count=1, layer=spec.layer, channels=[spec.valid])[..., 0]
                image = without_empty(image, valid)
            if buffer == "color":
                image = self._exr_color(path, image, stored)
            channels = len(layer_channels(tuple(stored), spec.layer))
        else:
            header, pixels = opened[name]
            image = _values(path, header, pixels, buffer, spec, self._path)
            channels = header.channels - header.alpha
        if buffer in GREY and spec.channels is None and channels == 1:
            self._note(f"{buffer} has one channel and is taken for grey")
        if spec.above is not None or spec.below is not None:
            return (_beyond(image, spec.above, spec.below)).astype(np.float32)
        nothing = _beyond(image, spec.nothing_above, spec.nothing_below)
        if (spec.scale, spec.offset) != (1.0, 0.0):
            with np.errstate(over="ignore"):
                image = image * np.float32(spec.scale) + np.float32(spec.offset)
        image = np.float32(1) - image if spec.invert else image
        if buffer == "depth":
            image = _positive(image) if self.depth == "ordinal" else image
            image = np.where(nothing, np.float32(np.inf), image) if nothing.any() else image
        return image

    def identity(self) -> dict[str, Any]:
        """Beside what all sequences of files have: how each buffer is read."""
        buffers = {name: dataclasses.asdict(spec) for name, spec in self._buffers.items()}
        return super().identity() | {"buffers": buffers}

    def _layer(self, buffer: str) -> dict[str, Any]:
        spec = self._buffers[buffer]
        return {"layer": spec.layer, "channels": spec.channels}

    def _hashed_ids(self) -> bool:
        spec = self._buffers["stencil"]
        return is_exr(spec.file) and "crypto" in f"{spec.layer}.{'.'.join(spec.channels or ())}".lower()

    def _sky_follows(self) -> bool:
        spec = self._buffers.get("depth")
        limits = spec is not None and (spec.nothing_above, spec.nothing_below) != (None, None)
        return self.depth == "metric" or (spec is not None and (limits or is_exr(spec.file)))


def _beyond(image: np.ndarray, above: float | int | None, below: float | int | None) -> np.ndarray:
    """Where the stored values are above or below the limits that are there."""
    out = np.zeros(image.shape, bool)
    if above is not None:
        out |= image > above
    if below is not None:
        out |= image < below
    return out


def _holds_values(folder: Path, files: Files) -> bool:
    """Whether the first colour there is holds values, not codes; true where there is none."""
    color = next((buffers["color"] for _, buffers in sorted(files.items()) if "color" in buffers), None)
    return color is None or is_exr(color) or not image_header(folder / color).codes


def _positive(ordinal: np.ndarray) -> np.ndarray:
    """Positive numbers in the same order, the same for all frames: v + 1/256, below 0 1 / (256 - 65536 v)."""
    below = (ordinal < 0) & (ordinal > -np.inf)
    return np.where(below, 1 / (256 - 65536 * np.where(below, ordinal, 0)), ordinal + 1 / 256).astype(np.float32)


def _values(
    path: Path, header: ImageHeader, pixels: np.ndarray, buffer: str, spec: Buffer, settings: Path
) -> np.ndarray:
    """The float32 values of an image that is no EXR, `[H, W, count]`; the ids of a stencil as they are stored."""
    count, names = BUFFERS[buffer], _names(header)
    if buffer == "stencil" and spec.channels is None and names[:3] == ["R", "G", "B"] and header.codes:
        if pixels.dtype != np.uint8:
            raise InputError(
                f"{path}: ids as colours of {pixels.dtype} do not fit into 24 bits; store them as 8-bit RGB"
            )
        return color_ids(pixels)
    wanted = spec.channels or tuple(names[: count if names[:1] != ["Y"] else 1])
    if buffer in GREY and spec.channels is None and names[:1] == ["Y"]:
        wanted = ("Y", "Y", "Y")
    places = [names.index(name) if name in names else -1 for name in (*wanted, *([spec.valid] if spec.valid else []))]
    if len(wanted) < count or min(places) < 0:
        text = f"needs {count} channels" + (f" ({', '.join(wanted)})" if spec.channels else "")
        remedy = f'name {count} of them, such as channels = "{names[0] * count}"'
        raise InputError(f"{path}: {buffer} {text}, has {', '.join(names)}; in {settings}, {remedy}")
    stored = pixels[..., places[: len(wanted)]]
    if buffer == "stencil":
        return stored
    if spec.codes or not header.codes:
        with np.errstate(over="ignore", invalid="ignore"):
            image = quiet(stored.astype(np.float32))
    elif spec.srgb:
        image = decode_srgb(stored)
    else:
        image = stored.astype(np.float32) / np.float32(np.iinfo(stored.dtype).max)
    if spec.valid:
        image = without_empty(image, pixels[..., places[-1]])
    return without_empty(image, pixels[..., -1]) if buffer == "color" and header.alpha else image


def _names(header: ImageHeader) -> list[str]:
    """The names of an image's channels; see `jaxtrapolate.files.description`."""
    if header.channels > 4:
        return [str(k) for k in range(header.channels)]
    return list("YA" if header.alpha and header.channels == 2 else (" Y", "Y", "RG", "RGB", "RGBA")[header.channels])


def _find(folder: Path, settings: Settings) -> tuple[Files, list[str]]:
    """For each frame the file of each buffer, from the patterns; and a line for what is left out."""
    found: list[tuple[int, str, str, bool]] = []
    short: dict[str, None] = {}
    listed: dict[str, list[str]] = {}
    for buffer, spec in settings.buffers.items():
        parent, base = os.path.split(spec.file)
        if parent not in listed:
            listed[parent] = list_folder(folder / parent)
        before, digits, after = FIELD.split(base)
        width = int(digits) if digits else 1
        sign = "" if before[-1:].isalnum() else rf"|-\d{{{max(width - 1, 1)},}}"
        number = re.compile(rf"\d{{{width},}}{sign}")
        pattern = re.compile(rf"{re.escape(before)}(-?\d+){re.escape(after)}")
        matches = [
            (match[1], os.path.join(parent, name)) for name in listed[parent] if (match := pattern.fullmatch(name))
        ]
        fit = [(text, frame_number(text, path), path) for text, path in matches if number.fullmatch(text)]
        if not fit:
            raise InputError(f"{folder}: no file for {buffer}, {spec.file}; correct the pattern in {settings.path}")
        found += [(frame, buffer, path, text == f"{frame:0{width}d}") for text, frame, path in fit]
        short |= {path: None for text, path in matches if not number.fullmatch(text)}
    files, left_out = collect(found)
    taken = {name for _, _, name, _ in found}
    if others := [name for name in short if name not in taken]:
        left_out.append(f"{some(others)} left out: not numbered as the pattern in {settings.path.name} says")
    return files, left_out
