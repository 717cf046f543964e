"""Pictures side by side in an animated WebP or GIF, or in an MP4, with a label above each."""

import contextlib
import importlib
import importlib.util
import itertools
import math
import os
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.errors import InputError

VIDEO_FORMATS = ("webp", "gif", "mp4")
"""The kinds of files that `write_video` writes, which are their suffixes."""

_LARGEST = (1080, 1920)
_LEGIBLE = 160  # pixels a panel is wide, for a label; smaller ones are magnified
_STRIP, _GAP = 22, 2
_GROUND, _INK = (16, 19, 22), (232, 235, 238)


def check_video_format(path: str | os.PathLike[str]) -> None:
    """Raises InputError where `write_video` could not write such a file."""
    kind = Path(path).suffix.lower().removeprefix(".")
    if kind not in VIDEO_FORMATS:
        endings = ", ".join(f".{f}" for f in VIDEO_FORMATS)
        raise InputError(f"{path}: expected a name of a video that ends in one of {endings}")
    if kind == "mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise InputError(
            f'{path}: MP4 needs the package imageio-ffmpeg: pip install "jaxtrapolate[video]", or choose .webp'
        )


def side_by_side(pictures: Sequence[UInt8[np.ndarray, "h w 3"]], labels: Sequence[str]) -> Image.Image:
    """Pictures of one size in as many columns as keep them largest within 1920 x 1080, a label above each.

    Args:
        pictures: `[H, W, 3]`, uint8. Large ones are scaled down; ones too small for a label are magnified by a whole
            factor.
        labels: one each.

    Returns:
        An RGB image of even width and height.
    """
    height, width = pictures[0].shape[:2]
    zoom = max(1, math.ceil(_LEGIBLE / width))
    columns, scale = 1, 0.0
    for tried in range(1, len(pictures) + 1):
        rows = math.ceil(len(pictures) / tried)
        fitting = min(zoom, _LARGEST[1] / (tried * width), _LARGEST[0] / (rows * height))
        if fitting >= scale:
            columns, scale = tried, fitting
    panel = max(1, round(width * scale)), max(1, round(height * scale))
    step = panel[0] + _GAP, panel[1] + _STRIP
    rows = math.ceil(len(pictures) / columns)
    size = columns * step[0] - _GAP, rows * step[1]
    sheet = Image.new("RGB", (size[0] + size[0] % 2, size[1] + size[1] % 2), _GROUND)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    for index, (picture, label) in enumerate(zip(pictures, labels, strict=True)):
        x, y = index % columns * step[0], index // columns * step[1]
        while draw.textlength(label, font=font) > panel[0] - 8 and len(label) > 1:
            label = f"{label[:-2]}…"
        draw.text((x + 4, y + _STRIP // 2), label, _INK, font=font, anchor="lm")
        resampling = Image.Resampling.NEAREST if scale >= 1 else Image.Resampling.LANCZOS
        sheet.paste(Image.fromarray(picture).resize(panel, resampling), (x, y + _STRIP))
    return sheet


def write_video(path: str | os.PathLike[str], frames: Iterable[Image.Image], *, count: int, fps: float | int) -> None:
    """Writes frames as a video, in full or not at all; they are taken one by one and not kept.

    Args:
        path: ends in .webp, .gif (256 colours, a hundredth of a second at the least) or .mp4 (needs imageio-ffmpeg).
        frames: RGB images of one even size.
        count: how many they are, at least one.
        fps: frames a second.

    Raises:
        InputError: one line; see `check_video_format`, or the file cannot be written.
    """
    check_video_format(path)
    kind = Path(path).suffix.lower()
    frames = iter(frames)
    with atomic_path(path) as temporary:
        if kind == ".mp4":
            _write_mp4(path, temporary, frames, fps)
            return
        first, more = next(frames), [_Film(frames, count - 1)] if count > 1 else []
        options: dict[str, Any] = {"quality": 80, "method": 2} if kind == ".webp" else {}
        options |= {"save_all": True, "append_images": more, "duration": 1000 / fps, "loop": 0}
        first.save(temporary, format=kind[1:].upper(), **options)


class _Film:
    """Frames that come one by one, as an image of `n_frames` that Pillow may append; it is only asked forwards."""

    def __init__(self, frames: Iterator[Image.Image], count: int) -> None:
        self.frames, self.n_frames, self.at = frames, count, -1
        self.image: Image.Image | None = None

    def seek(self, index: int) -> None:
        if index >= self.n_frames:
            raise EOFError
        while self.at < index:
            self.image, self.at = next(self.frames), self.at + 1

    def __getattr__(self, name: str) -> Any:
        return getattr(self.image, name)


def _write_mp4(path: str | os.PathLike[str], temporary: Path, frames: Iterator[Image.Image], fps: float | int) -> None:
    """H.264 by the ffmpeg of imageio-ffmpeg."""
    first = next(frames)
    try:
        program = importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    except RuntimeError as error:  # none for this platform
        raise InputError(f"{path}: {error}; choose .webp") from error
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-video_size", f"{first.width}x{first.height}"]
    coding = ["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4"]
    command = [program, "-y", "-loglevel", "error", *source, "-framerate", str(fps), "-i", "-", *coding, str(temporary)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        with contextlib.suppress(BrokenPipeError):  # it has ended, and says why
            for image in itertools.chain([first], frames):
                cast(IO[bytes], process.stdin).write(image.tobytes())
        said = process.communicate()[1].decode(errors="replace").split("\n")
    if process.returncode:
        raise InputError(f"{path}: ffmpeg cannot write it ({said[0] or process.returncode}); choose .webp")
