"""The largest image that is read: one limit on pixels, held against a file's header before any memory is asked for.

A file of a few hundred bytes can claim to be of any size. The limit is 40 million pixels (8192 x 4320 is 35 million);
the environment variable `JAXTRAPOLATE_MAX_PIXELS` sets another one, for the command line and for Python alike:

    JAXTRAPOLATE_MAX_PIXELS=200000000 jaxtrapolate check INPUT

It is looked up whenever a file is opened. All channels of a file together may have 32 times as many samples, which is
160 channels at 3840 x 2160, and a file may have 1024 channels.
"""

import os

from jaxtrapolate.errors import InputError

VARIABLE = "JAXTRAPOLATE_MAX_PIXELS"
MAX_PIXELS = 40_000_000
"""The limit where the environment does not state one."""
MAX_CHANNELS = 1024
_SAMPLES = 32
_SMALL, _STRONGEST = 1 << 26, 1 << 18


def max_pixels() -> int:
    """The limit in force: that of the environment, else `MAX_PIXELS`. `InputError` where it is no whole number."""
    text = os.environ.get(VARIABLE, "").strip()
    if not text:
        return MAX_PIXELS
    if not (text.isascii() and text.isdecimal() and len(text) <= 18 and int(text) > 0):
        raise InputError(f"{VARIABLE}: expected a whole number of pixels, got {text[:40]!r}; correct it or unset it")
    return int(text)


def check_pixels(path: str | os.PathLike[str], height: int, width: int, channels: int = 1) -> None:
    """Raise `InputError` where an image that a file claims to hold is larger than the limit, or has no pixels.

    Args:
        path: for the message.
        height: as its header states it.
        width: as its header states it.
        channels: all that would be decoded.
    """
    if height < 1 or width < 1 or channels < 1:
        raise InputError(f"{path}: its header states {width}x{height} pixels of {channels} channels; render it again")
    limit = max_pixels()
    remedy = f"render it smaller, or set the environment variable {VARIABLE} higher if you trust the file"
    if height * width > limit:
        raise InputError(f"{path}: {width}x{height} are more than {limit} pixels, the largest that is read; {remedy}")
    if channels > MAX_CHANNELS:
        raise InputError(f"{path}: {channels} channels are more than {MAX_CHANNELS}; store fewer in one file")
    if height * width * channels > _SAMPLES * limit:
        what = f"{channels} channels of {width}x{height} are more than {_SAMPLES} times {limit} samples"
        raise InputError(f"{path}: {what}, the most that is read; store fewer in one file, or {remedy}")


def check_claim(path: str | os.PathLike[str], claimed: int, length: int) -> None:
    """Raise `InputError` where a compressed file of `length` bytes claims far more bytes of pixels than it can hold.

    The strongest compression that is known, of frames of one colour, is 1 : 35000; refused are 1 : 262144 and beyond,
    from 64 MiB on.
    """
    if claimed > max(_SMALL, length * _STRONGEST):
        text = f"claims {claimed} bytes of pixels, which its {length} bytes cannot hold"
        raise InputError(f"{path}: {text}; render or copy it again")
