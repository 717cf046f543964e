"""The arguments that ask for a video of an evaluation."""

import argparse
import dataclasses
from pathlib import Path

from jaxtrapolate.errors import InputError
from jaxtrapolate.report import VIDEO_FORMATS, check_video_format
from jaxtrapolate.runtime.output import writable_folder


@dataclasses.dataclass(frozen=True)
class Video:
    """A video that was asked for.

    Attributes:
        path: of the file, or just its name where it goes into the folder of the results.
        fps: frames a second, generated ones included.
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
        parser.add_argument(
            "--fps", type=float, default=30.0, metavar="N", help="of the video, generated frames too (30)"
        )

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
