"""What a folder holds: names of files and of the folder, the frames' numbers, and the step between them."""

import itertools
import math
import os
import re
from collections.abc import Iterable
from pathlib import Path

from jaxtrapolate.atomic import os_input_error
from jaxtrapolate.errors import InputError

Files = dict[int, dict[str, str]]
"""For each frame the file of each buffer, relative to the sequence's folder."""

_GENERIC = re.compile(
    r"v?\d*|\d+[pk]|\d+x\d+|\d+fps|(ldr|hdr|exrs?|pngs?|tiffs?|frames?|images?|renders?|rendered|rendering|renderings|"
    r"outputs?|out|dumps?|clips?|seq|sequences?|data|raw|passes|layers|aovs?|input|src|source|tmp|temp|color|beauty)"
    r"[-_.]?\d*",
    re.IGNORECASE,
)


def frame_number(digits: str, name: str) -> int:
    """The number of a frame from the digits in a file's name; `InputError` where they are more than 15."""
    if len(digits.lstrip("-0")) > 15:
        raise InputError(f"{name}: a frame's number of {len(digits)} digits; rename the file, 15 are the most")
    return int(digits)


def list_folder(folder: str | os.PathLike[str]) -> list[str]:
    """The names of the files and folders in a folder that do not start with a dot, sorted.

    Raises:
        InputError: no such folder, a file, or no permission.
    """
    try:
        return sorted(name for name in os.listdir(folder) if not name.startswith("."))
    except NotADirectoryError as error:
        raise InputError(f"{folder}: is a file; give the folder that holds the frames") from error
    except OSError as error:
        raise os_input_error(folder, error) from error


def folder_name(folder: str | os.PathLike[str], prefix: str = "") -> str:
    """What an input is called: its folder's name, with its parents' before it where it says nothing by itself.

    "town", but "bunker/540p" and "town/take2/frames". A prefix of the files that is not the folder's name stands in
    brackets behind: "czest1dm (OpenArena)".
    """
    parts = [part for part in Path(folder).resolve().parts if part != os.sep]
    first = len(parts) - 1
    while first > 0 and len(parts) - first < 3 and _GENERIC.fullmatch(parts[first]):
        first -= 1
    name = "/".join(parts[max(first, 0) :]) or "frames"
    prefix = prefix.strip(" ._-")
    return f"{name} ({prefix})" if prefix and prefix.lower() != name.rpartition("/")[2].lower() else name


def collect(found: Iterable[tuple[int, str, str, bool]]) -> tuple[Files, list[str]]:
    """The files by frame and buffer, and a line for each that is left out because another is the same frame's.

    Args:
        found: for each file the frame's number, the buffer, the file, and whether its name is the usual one ("0001"
            rather than "1"); that one is taken, else the first by name.
    """
    files: Files = {}
    left_out: dict[str, str] = {}
    for number, buffer, name, _ in sorted(found, key=lambda f: (f[0], f[1], not f[3], f[2])):
        taken = files.setdefault(number, {}).setdefault(buffer, name)
        if taken != name:
            left_out.setdefault(name, f"{name} left out: {taken} is the {buffer} of frame {number} as well")
    return files, list(left_out.values())


def some(names: list[str]) -> str:
    """The first names of a list, for a message: "a, b and 7 more"."""
    return ", ".join(names) if len(names) <= 3 else f"{', '.join(names[:2])} and {len(names) - 2} more"


def find_step(folder: Path, numbers: tuple[int, ...], stated: int | None) -> tuple[int, str | None]:
    """How far apart the numbers of neighbouring frames are, and a note where that was found rather than stated.

    It is 1, unless all differences are multiples of a number above 1 and most are that number itself (a renderer's
    "every second frame"). Two frames alone say nothing: 0 and 2 are frames with a gap between them.

    Raises:
        InputError: a frame that the stated step does not come to.
    """
    differences = [later - earlier for earlier, later in itertools.pairwise(numbers)]
    if stated is not None:
        for number in numbers:
            if (number - numbers[0]) % stated:
                text = f"step = {stated} is stated, but there is a frame {number} besides {numbers[0]}"
                raise InputError(f"{folder}: {text}; correct the step, or remove the frames between")
        return stated, None
    step = math.gcd(*differences)
    if len(differences) < 2 or step < 2 or 2 * differences.count(step) <= len(differences):
        return 1, None
    listed = ", ".join(map(str, numbers[:3]))
    remedy = "if frames are missing between them, write step = 1 to jaxtrapolate.toml"
    return step, f"step {step} found: the frames {listed}, ... are taken for neighbours; {remedy}"
