"""Finding the reader, bad folders, gaps, and reading ahead."""

import gc
import os
import threading
import time
import weakref

import numpy as np
import pytest

from jaxtrapolate.files import (
    InputError,
    MotionConvention,
    Sequence,
    UnrealSequence,
    gaps,
    open_sequence,
    prefetch,
    runs,
    write_exr,
    write_unreal_frame,
)
from jaxtrapolate.records import Frame


def dump(folder, numbers, size=(3, 4), scene="A"):
    for number in numbers:
        motion = np.zeros((*size, 2), np.float32)
        write_unreal_frame(folder, scene, number, Frame(np.full((*size, 3), number, np.float32), motion=motion))
    return folder


def fails(path, *words, **options):
    with pytest.raises(InputError) as error:
        open_sequence(path, **options)
    text = str(error.value)
    assert "\n" not in text
    for word in (str(path), *words):
        assert str(word) in text
    return text


def test_bad_folders(tmp_path):
    fails(tmp_path / "missing", "does not exist")
    fails(tmp_path, "is empty")
    (tmp_path / "notes.txt").write_text("no frames")
    fails(tmp_path / "notes.txt", "is a file", "give the folder")
    fails(tmp_path / "notes.txt" / "deeper", "is a file")
    fails(tmp_path, "no frames found", "jaxtrapolate.toml")
    fails(tmp_path / "other.toml", "does not exist")
    (tmp_path / "color").mkdir()
    fails(tmp_path, "hold no files named NNNN.png")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may do everything")
def test_folder_without_permission(tmp_path):
    (tmp_path / "a").mkdir(mode=0o000)
    fails(tmp_path / "a", "no permission to read")


def test_two_scenes(tmp_path):
    dump(tmp_path, [1], scene="Town")
    dump(tmp_path, [1], scene="Field")
    fails(tmp_path, "'Field', 'Town'", "folder of its own")
    assert UnrealSequence(tmp_path, scene="Town").name == f"{tmp_path.name} (Town)"
    with pytest.raises(InputError, match="of scene 'Lake'"):
        UnrealSequence(tmp_path, scene="Lake")


def test_buffers_of_different_sizes(tmp_path):
    dump(tmp_path, [1, 2])
    write_exr(tmp_path / "ASceneDepth.0001.exr", np.zeros((5, 5, 1)))
    write_exr(tmp_path / "ASceneDepth.0002.exr", np.zeros((5, 5, 1)))
    fails(tmp_path, "ASceneDepth.0001.exr: its size is 5x5", "APreTonemapHDRColor.0001.exr 4x3")


def test_frames_of_different_sizes(tmp_path):
    dump(tmp_path, [1, 2])
    dump(tmp_path, [3], size=(3, 5))
    fails(tmp_path, "APreTonemapHDRColor.0003.exr: its size is 5x3", "APreTonemapHDRColor.0001.exr 4x3")


def test_another_buffer_of_a_later_frame_differs(tmp_path):
    dump(tmp_path, [1, 2])
    write_exr(tmp_path / "AMotionVector.0002.exr", np.zeros((9, 9, 3)))
    sequence = open_sequence(tmp_path)
    sequence.frame(1)
    with pytest.raises(InputError, match=r"AMotionVector\.0002\.exr: its size is 9x9, that of .*0001\.exr 4x3"):
        sequence.frame(2)


def test_missing_and_truncated_files(tmp_path):
    dump(tmp_path, [1, 2, 3])
    sequence = open_sequence(tmp_path)
    path = tmp_path / "AMotionVector.0002.exr"
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError, match=r"AMotionVector\.0002\.exr: truncated"):
        sequence.frame(2)
    path.unlink()
    with pytest.raises(InputError, match=r"AMotionVector\.0002\.exr: does not exist"):
        sequence.frame(2)
    fails(tmp_path, "frame 2 has no motion", "AMotionVector.0003.exr")


def test_motion_option(tmp_path):
    dump(tmp_path, [1])
    assert open_sequence(tmp_path, motion="uv,down").convention == MotionConvention(
        "current_minus_previous", "uv", "down"
    )
    with pytest.raises(InputError, match="'left' is not one of"):
        open_sequence(tmp_path, motion="left")


class Numbers(Sequence):
    """A sequence that counts what is read and how many of its frames are alive."""

    name, size, hdr, convention, depth = "numbers", (2, 2), True, MotionConvention(), "absent"

    def __init__(self, numbers, wrong=None):
        self.numbers, self.wrong = tuple(numbers), wrong
        self.read, self.alive, self.most = [], 0, 0
        self.lock = threading.Lock()

    def frame(self, number):
        if number == self.wrong:
            raise InputError(f"frame {number} is broken")
        frame = Frame(np.full((2, 2, 3), number, np.float32))
        weakref.finalize(frame.color, self.gone).atexit = False
        with self.lock:
            self.read.append(number)
            self.alive += 1
            self.most = max(self.most, self.alive)
        return frame

    def gone(self):
        with self.lock:
            self.alive -= 1


def threads():
    return [t for t in threading.enumerate() if t.name == "jaxtrapolate-prefetch"]


def test_gaps_and_runs(tmp_path):
    sequence = Numbers([3, 4, 5, 9, 12, 13])
    assert runs(sequence) == (range(3, 6), range(9, 10), range(12, 14))
    assert gaps(sequence) == (range(6, 9), range(10, 12))
    assert runs(Numbers([])) == gaps(Numbers([])) == gaps(Numbers([5])) == ()
    dump(tmp_path, [1, 2, 6])
    assert open_sequence(tmp_path).numbers == (1, 2, 6)
    fails(tmp_path, "frames 3 to 5 missing", strict=True)
    dump(tmp_path, [3, 5])
    fails(tmp_path, "frame 4 missing", strict=True)


def test_prefetch_in_order():
    sequence = Numbers(range(50))
    got = [(number, float(frame.color[0, 0, 0])) for number, frame in prefetch(sequence, sequence.numbers)]
    assert got == [(n, float(n)) for n in range(50)]
    assert not threads()
    assert list(prefetch(sequence, [])) == []


def test_prefetch_reads_overlapping_windows_once():
    sequence = Numbers(range(100))
    windows = [n for first in range(0, 90) for n in range(first, first + 5)]
    got = [number for number, _ in prefetch(sequence, windows)]
    assert got == windows
    assert sequence.read == list(range(94))
    forgetful = Numbers(range(3))
    list(prefetch(forgetful, [0, 0, 1], keep=0))
    assert forgetful.read == [0, 0, 1]


@pytest.mark.parametrize("ahead, keep", [(1, 0), pytest.param(2, 6, marks=pytest.mark.slow), (4, 2)])
@pytest.mark.slow
def test_prefetch_in_bounded_memory(ahead, keep):
    sequence = Numbers(range(1000))
    for number, frame in prefetch(sequence, sequence.numbers, ahead=ahead, keep=keep):
        if number % 200 == 0:
            time.sleep(0.02)  # The thread has time to read as far ahead as it may.
            assert frame.color[0, 0, 0] == number
    assert sequence.most <= ahead + keep + 2  # And the consumer's own, before and after it takes the next one.
    del frame
    gc.collect()
    assert sequence.alive == 0


def test_prefetch_reads_ahead():
    sequence = Numbers(range(10))
    frames = prefetch(sequence, sequence.numbers, ahead=3)
    assert not threads()
    next(frames)
    deadline = time.monotonic() + 5
    while len(sequence.read) < 4 and time.monotonic() < deadline:
        time.sleep(0.001)
    time.sleep(0.02)
    assert sequence.read == [0, 1, 2, 3]
    frames.close()
    assert not threads()


def test_prefetch_stops_with_its_consumer():
    sequence = Numbers(range(1000))
    for number, _ in prefetch(sequence, sequence.numbers):
        if number == 3:
            break
    gc.collect()
    assert not threads()
    assert len(sequence.read) < 10


def test_prefetch_hands_errors_over_in_order():
    sequence, got = Numbers(range(10), wrong=5), []
    frames = prefetch(sequence, sequence.numbers)
    with pytest.raises(InputError, match="frame 5 is broken"):
        got.extend(number for number, _ in frames)
    assert got == [0, 1, 2, 3, 4]
    assert not threads()

    def numbers():
        yield 1
        raise RuntimeError("no more numbers")

    with pytest.raises(RuntimeError, match="no more numbers"):
        list(prefetch(sequence, numbers()))


def test_prefetch_options():
    for options in ({"ahead": 0}, {"keep": -1}):
        with pytest.raises(ValueError, match="ahead, keep"):
            prefetch(Numbers([1]), [1], **options)


def test_prefetch_of_files(tmp_path):
    dump(tmp_path, range(1, 9))
    sequence = open_sequence(tmp_path)
    got = {number: float(frame.color[0, 0, 0]) for number, frame in prefetch(sequence, sequence.numbers)}
    assert got == {n: float(n) for n in range(1, 9)}
