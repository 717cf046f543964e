"""Sequences of frames in files: finding the reader, gaps in the numbering, reading ahead, and writing.

Which image files are read, and what their numbers mean, is in `decoders` and `exr`; what alpha does in `alpha`. Files
are opened where they are regular ones (`regular`) and hold no more pixels than the environment variable
`JAXTRAPOLATE_MAX_PIXELS` allows, by default 40 million (`limits`).
"""

import itertools
import os
from pathlib import Path
from typing import Any

from jaxtrapolate.errors import InputError as InputError
from jaxtrapolate.files.description import SETTINGS_NAME as SETTINGS_NAME
from jaxtrapolate.files.description import Settings, read_settings
from jaxtrapolate.files.exr import read_exr as read_exr
from jaxtrapolate.files.exr import write_exr as write_exr
from jaxtrapolate.files.image import read_png as read_png
from jaxtrapolate.files.image import write_frame as write_frame
from jaxtrapolate.files.image import write_png as write_png
from jaxtrapolate.files.jitter import read_jitter
from jaxtrapolate.files.listing import list_folder
from jaxtrapolate.files.packed import CONVENTION as _PACKED
from jaxtrapolate.files.packed import PackedSequence as PackedSequence
from jaxtrapolate.files.packed import packed_folder
from jaxtrapolate.files.pattern import PatternSequence as PatternSequence
from jaxtrapolate.files.prefetch import prefetch as prefetch
from jaxtrapolate.files.reader import FileSequence
from jaxtrapolate.files.sequence import MotionConvention as MotionConvention
from jaxtrapolate.files.sequence import Sequence as Sequence
from jaxtrapolate.files.unreal import CONVENTION as _UNREAL
from jaxtrapolate.files.unreal import UnrealSequence as UnrealSequence
from jaxtrapolate.files.unreal import unreal_files
from jaxtrapolate.files.unreal import write_unreal_frame as write_unreal_frame


def open_sequence(
    path: str | os.PathLike[str],
    *,
    motion: str | MotionConvention | None = None,
    settings: str | os.PathLike[str] | None = None,
    strict: bool = False,
) -> Sequence:
    """The sequence in a folder, by whichever reader fits.

    In this order: a TOML file with `[buffers]` -> `PatternSequence`; names of an Unreal dump -> `UnrealSequence`;
    folders `color` or `motion` of PNG files -> `PackedSequence`.

    Args:
        path: a folder, or the TOML file in it.
        motion: how the motion vectors are stated, e.g. "current_minus_previous,pixels,up"; what a text does not say
            is the TOML file's, or the reader's default. Goes before the TOML file.
        settings: the TOML file, where it is not `jaxtrapolate.toml` in the folder.
        strict: refuse gaps in the numbering and files that are left out now, and a frame with a pixel that is not
            finite, or of alpha 0, when it is read.

    Raises:
        InputError: one line that names the file and the remedy: no such folder, a file, an empty folder, nothing that
            a reader knows, a missing file, files of different sizes, a TOML file or `motion` that cannot be used.
    """
    return _open(path, motion=motion, settings=settings, strict=strict)


def _open(
    path: str | os.PathLike[str],
    *,
    motion: str | MotionConvention | None = None,
    settings: str | os.PathLike[str] | None = None,
    strict: bool = False,
    alone: bool = False,
) -> FileSequence:
    """As `open_sequence`; `alone` does not look for larger frames, so that folders may name each other."""
    folder = Path(path)
    if settings is None and folder.suffix == ".toml" and not folder.is_dir():
        folder, settings = folder.parent, folder
    names = list_folder(folder)
    if not names:
        raise InputError(f"{folder}: is empty; give the folder that holds the frames")
    if settings is None and SETTINGS_NAME in names:
        settings = folder / SETTINGS_NAME
    stated = None if settings is None else read_settings(settings)

    def convention(base: MotionConvention) -> MotionConvention:
        base = base if stated is None else stated.convention(base)
        return MotionConvention.parse(motion, base=base) if isinstance(motion, str) else motion or base

    also: dict[str, Any] = {"strict": strict}
    sequence: FileSequence
    if stated is not None and stated.buffers:
        own = convention(MotionConvention())
        sequence = PatternSequence(folder, settings=stated, motion=own, **also)
        return _completed(sequence, stated, strict, alone)
    if stated is not None:
        also |= {"name": stated.name, "step": stated.step, "static_ids": stated.static_ids}
    if unreal_files(names):
        sequence = UnrealSequence(folder, motion=convention(_UNREAL), **also)
    elif packed_folder(folder) is not None:
        sequence = PackedSequence(folder, motion=convention(_PACKED), **also)
    else:
        kinds = "<Scene><Buffer>.<0000>.exr, or color/ and motion/ with NNNN.png"
        raise InputError(f"{folder}: no frames found ({kinds}); describe its files in a {SETTINGS_NAME}")
    return _completed(sequence, stated, strict, alone)


def _completed(sequence: FileSequence, stated: Settings | None, strict: bool, alone: bool) -> FileSequence:
    """The sequence with its cuts, its jitter and its larger frames, as the folder's description states them."""
    if stated is not None:
        if unknown := [n for n in stated.cuts if n not in sequence.numbers]:
            raise InputError(f"{stated.path}: cuts: there is no frame {unknown[0]}; name frames that are there")
        sequence.cuts = stated.cuts
        if stated.jitter is not None:
            path = stated.path.parent / stated.jitter.file
            sequence.jitter = read_jitter(path, stated.jitter, sequence.numbers, sequence.size)
        if stated.larger is not None and not alone:
            sequence.larger = _larger(sequence, stated.path, stated.path.parent / stated.larger, strict)
    return _without_gaps(sequence) if strict else sequence


def _larger(sequence: FileSequence, path: Path, folder: Path, strict: bool) -> Sequence:
    found = _open(folder, strict=strict, alone=True)
    (height, width), (high, wide) = sequence.size, found.size
    if high % height or wide % width or high // height != wide // width or high == height:
        text = f"expected frames a whole number of times as large as {width}x{height}, got {wide}x{high}"
        raise InputError(f"{path}: larger: {text}; name another folder")
    if missing := [n for n in sequence.numbers if n not in found.numbers]:
        raise InputError(f"{path}: larger: {folder} has no frame {missing[0]}; render it")
    if found.hdr != sequence.hdr:
        raise InputError(f"{path}: larger: {folder} holds {'HDR' if found.hdr else '8-bit'} colour, the others do not")
    return found


def _without_gaps(sequence: FileSequence) -> FileSequence:
    if missing := gaps(sequence):
        first = missing[0]
        span = f"frame {first[0]}" if len(first) == 1 else f"frames {first[0]} to {first[-1]}"
        remedy = "render what is missing, or read it without {argument}"
        raise InputError(f"{sequence.folder}: {span} missing; {remedy}", argument="strict")
    return sequence


def runs(sequence: Sequence) -> tuple[range, ...]:
    """The stretches of the numbering without a gap or a cut, in order; together they are all of `sequence.numbers`.

    A range has the sequence's step: `range(0, 6, 2)` is the frames 0, 2, 4. Neighbours are those next to each other in
    a run, `run[i]` and `run[i + 1]`; their numbers differ by the step.
    """
    out: list[range] = []
    for number in sequence.numbers:
        if out and number == out[-1].stop and number not in sequence.cuts:
            out[-1] = range(out[-1].start, number + sequence.step, sequence.step)
        else:
            out.append(range(number, number + sequence.step, sequence.step))
    return tuple(out)


def gaps(sequence: Sequence) -> tuple[range, ...]:
    """The missing numbers between the first and the last frame, a range for each gap; a gap resets the history."""
    stretches = runs(sequence)
    between = (range(a.stop, b.start, sequence.step) for a, b in itertools.pairwise(stretches))
    return tuple(gap for gap in between if gap)


def around(sequence: Sequence, number: int, *, before: int = 0, behind: int = 0) -> tuple[int, ...]:
    """The numbers of `before` frames before a frame, its own, and of `behind` frames behind it, without a gap.

    Raises:
        ValueError: the frame is not there, or there are not so many without a gap.
    """
    for run in runs(sequence):
        if number in run:
            i = run.index(number)
            if i >= before and i + behind < len(run):
                return tuple(run[i - before : i + behind + 1])
            text = f"expected {before} frames before and {behind} behind it without a gap, got {i} and"
            raise ValueError(f"number {number}: {text} {len(run) - i - 1}")
    raise ValueError(f"number: expected one of the sequence's frames, got {number}")
