"""The video of an evaluation: truth and methods side by side, rendered frames and made ones in turn."""

import argparse
import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from jaxtrapolate.checks import check_present
from jaxtrapolate.commands.inputs import Step
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.pictures import eight_bit
from jaxtrapolate.evaluation.score import display
from jaxtrapolate.evaluation.windows import arguments, windows
from jaxtrapolate.files import Sequence
from jaxtrapolate.methods import Method
from jaxtrapolate.report import VIDEO_FORMATS, check_video_format, side_by_side, write_video
from jaxtrapolate.runtime.output import writable_folder


@dataclasses.dataclass(frozen=True)
class Video:
    """A video that was asked for.

    Attributes:
        path: of the file, or just its name where it goes into the folder of the results.
        fps: frames a second, made ones included.
    """

    path: Path
    fps: float | int

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """Adds --video and --fps."""
        parser.add_argument(
            "--video",
            nargs="?",
            const=VIDEO_FORMATS[0],
            metavar="FILE",
            help="truth and methods side by side, at display rate: FILE.webp, .gif or .mp4; or just webp, gif or mp4 "
            "(webp) for DIR/video.webp, ...",
        )
        parser.add_argument("--fps", type=float, default=30.0, metavar="N", help="of the video, made frames too (30)")

    @classmethod
    def parse(cls, text: str | None, *, fps: float | int, several: bool) -> "Video | None":
        """From the arguments, before any work is done; `several` inputs have a video each in their folders."""
        if not 0 < fps <= 1000:
            raise InputError(f"--fps: expected a number above 0 and at most 1000, got {fps:g}")
        if text is None:
            return None
        named = text in VIDEO_FORMATS
        path = Path(f"video.{text}" if named else text)
        try:
            check_video_format(path)
        except InputError as error:
            raise InputError(f"--video: {error}") from None
        if not named and several:
            raise InputError(f"--video: several inputs have one each in their folders; give {', '.join(VIDEO_FORMATS)}")
        return cls(path if named else writable_folder(path.parent).resolve() / path.name, fps)

    def write(
        self,
        sequence: Sequence,
        numbers: list[int],
        methods: dict[str, Method],
        folder: Path,
        *,
        labels: Mapping[str, str],
        past: int,
        future: int,
        step: Step,
    ) -> Path:
        """Writes the video of the held-back frames `numbers` and the rendered frame before each.

        A made frame is made again here, as for its scores, from what a method may see. Returns the path.
        """
        path, count = folder / self.path, 2 * len(numbers)

        def frames() -> Iterator[Image.Image]:
            titles = ["truth", *(labels[name] for name in methods)]
            for index, pictures in enumerate(_shown(sequence, numbers, methods, past, future)):
                step("video", index, count)
                yield side_by_side(pictures, titles)

        write_video(path, frames(), count=count, fps=self.fps)
        return path


def _shown(sequence: Sequence, numbers: list[int], methods: dict[str, Method], past: int, future: int) -> Iterator[Any]:
    """What the display shows by truth and methods: rendered frame, made frame, rendered frame, ..."""

    def codes(color: Any) -> np.ndarray:
        return eight_bit(display(color, hdr=sequence.hdr))

    for window in windows(sequence, numbers, past=past, future=future):
        rendered = codes(check_present("history[-1].color", window.history[-1].color, needed_by="video"))
        yield [rendered] * (1 + len(methods))
        truth = codes(check_present("truth.color", window.truth.color, needed_by="video"))
        yield [truth, *(codes(method(*arguments(method, window))) for method in methods.values())]
