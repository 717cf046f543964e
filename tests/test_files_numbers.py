"""Which frames there are: negative numbers, steps, files of the same frame, what is left out; and inputs' names."""

import itertools

import numpy as np
import pytest
from synthetic import SyntheticSequence, make_frame, make_keyframe

from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.score import causes_of
from jaxtrapolate.evaluation.windows import held_back, windows
from jaxtrapolate.files import around, gaps, open_sequence, runs, write_exr, write_png, write_unreal_frame
from jaxtrapolate.files.listing import folder_name
from jaxtrapolate.records import Frame

SIZE = (3, 4)


def exr(path, value=0.0):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, np.full((*SIZE, 3), value, np.float32))


def unreal(folder, names, value=0.0):
    for name in names:
        exr(folder / f"TownPreTonemapHDRColor.{name}.exr", value)


def packed(folder, names):
    (folder / "color").mkdir(parents=True, exist_ok=True)
    for name in names:
        write_png(folder / "color" / f"{name}.png", np.zeros((*SIZE, 3), np.uint8))


def pattern(folder, names, value=0.0, *, file="b.{frame:04d}.exr", top=""):
    for name in names:
        exr(folder / file.replace("{frame:04d}", name).replace("{frame}", name), value)
    (folder / "jaxtrapolate.toml").write_text(f'{top}\n[buffers]\ncolor = "{file}"\n')


READERS = pytest.mark.parametrize("write", [unreal, packed, pattern])


@READERS
def test_negative_numbers(tmp_path, write):
    write(tmp_path, ["-003", "-002", "-0001", "0000", "0001"])
    sequence = open_sequence(tmp_path, strict=True)
    assert sequence.numbers == (-3, -2, -1, 0, 1)
    assert runs(sequence) == (range(-3, 2),)
    assert sequence.notes == ()
    assert sequence.frame(-2).time == -2


def test_what_is_written_with_a_negative_number_is_read(tmp_path):
    for number in (-1, 0):
        write_unreal_frame(tmp_path, "A", number, make_frame(number, SIZE))
    np.testing.assert_array_equal(open_sequence(tmp_path).frame(-1).motion, make_frame(-1, SIZE).motion)


def test_a_hyphen_is_no_sign(tmp_path):
    """Behind a letter or digit; files of that kind are named, for the pattern takes those without it."""
    pattern(tmp_path, ["-0001", "-0002", "0003"], file="beauty{frame}.exr")
    sequence = open_sequence(tmp_path)
    assert sequence.numbers == (3,)
    text = "beauty-0001.exr, beauty-0002.exr left out: not numbered as the pattern in jaxtrapolate.toml says"
    assert sequence.notes == (text,)
    with pytest.raises(
        InputError, match=r"left out: not numbered as .*; remove or rename its files, or read it without"
    ):
        open_sequence(tmp_path, strict=True)


@READERS
def test_two_files_of_one_frame(tmp_path, write):
    """The usual name is read, whichever was written last, and the other one is named."""
    write(tmp_path, ["1", "0001", "0002"])
    options = {"file": "b.{frame}.exr"} if write is pattern else {}
    write(tmp_path, ["1"], **options)
    sequence = open_sequence(tmp_path)
    assert sequence.numbers == (1, 2)
    (note,) = sequence.notes
    loser, winner = ("0001", "1") if write is pattern else ("1", "0001")  # {frame} states no zeros
    assert f"{loser}." in note.split(" left out: ")[0]
    assert f"{winner}." in note.split(" left out: ")[1]
    assert note.endswith("is the color of frame 1 as well")
    assert f"{winner}." in sequence.files(1)["color"].name
    with pytest.raises(InputError, match=f"^{tmp_path}: .*left out: ") as error:
        open_sequence(tmp_path, strict=True)
    assert "\n" not in str(error.value)


def test_too_few_digits_are_named(tmp_path):
    pattern(tmp_path, ["0001", "0002", "3"])
    sequence = open_sequence(tmp_path)
    assert sequence.numbers == (1, 2)
    assert sequence.notes == ("b.3.exr left out: not numbered as the pattern in jaxtrapolate.toml says",)


def test_packed_files_of_other_kinds_are_named(tmp_path):
    packed(tmp_path, ["0001", "frame2"])
    (tmp_path / "color" / "0003.jpg").write_bytes(b"")
    (tmp_path / "color" / "notes.txt").write_bytes(b"")
    (tmp_path / "albedo").mkdir()
    sequence = open_sequence(tmp_path)
    assert sequence.notes == (
        "color/0003.jpg, color/frame2.png left out: a packed clip's files are named NNNN.png",
        "albedo not read: a packed clip's folders are color, motion, depth, stencil, shadow",
    )


def test_unreal_buffers_of_other_names_are_named(tmp_path):
    """They are no part of a frame, so that strict reading goes on."""
    unreal(tmp_path, ["0001"])
    exr(tmp_path / "TownBaseColour.0001.exr")
    exr(tmp_path / "beauty.exr")
    sequence = open_sequence(tmp_path, strict=True)
    assert sequence.notes == ("TownBaseColour.0001.exr not read: the names are of no buffer of an Unreal dump",)


def test_a_first_frame_without_motion_is_refused_when_strict(tmp_path):
    unreal(tmp_path, ["0000", "0001"])
    exr(tmp_path / "TownMotionVector.0001.exr")
    assert open_sequence(tmp_path).notes == ("frame 0 left out: it has no motion vectors",)
    with pytest.raises(InputError, match="frame 0 left out: it has no motion vectors; remove"):
        open_sequence(tmp_path, strict=True)


@READERS
def test_a_step_is_found(tmp_path, write):
    write(tmp_path, ["0000", "0002", "0004", "0006"])
    sequence = open_sequence(tmp_path, strict=True)
    assert (sequence.numbers, sequence.step) == ((0, 2, 4, 6), 2)
    assert runs(sequence) == (range(0, 8, 2),)
    assert gaps(sequence) == ()
    (note,) = sequence.notes
    assert note.startswith("step 2 found: the frames 0, 2, 4, ... are taken for neighbours")
    assert "write step = 1" in note
    with pytest.raises(InputError, match="no frame 3; there are 0 to 6, step 2"):
        sequence.frame(3)
    if write is not pattern:
        (tmp_path / "jaxtrapolate.toml").write_text("step = 1")
        alone = open_sequence(tmp_path)
        assert (alone.step, alone.notes) == (1, ())
        assert gaps(alone) == (range(1, 2), range(3, 4), range(5, 6))
        with pytest.raises(InputError, match="frame 1 missing"):
            open_sequence(tmp_path, strict=True)


@pytest.mark.parametrize(
    "numbers, step, missing",
    [
        ([-4, 0, 4, 12, 16], 4, [[8]]),
        ([10, 15, 20, 35, 40], 5, [[25, 30]]),
        ([0, 2], 1, [[1]]),  # two frames say nothing
        ([0, 1, 2, 4], 1, [[3]]),
        ([0, 2, 6, 10, 14, 20], 1, None),  # multiples of 2, but most are not 2 apart
        ([0, 2, 4, 5], 1, None),
        ([3], 1, []),
    ],
)
def test_step_and_gaps(tmp_path, numbers, step, missing):
    unreal(tmp_path, [f"{n:04d}" for n in numbers])
    sequence = open_sequence(tmp_path)
    assert sequence.step == step
    if missing is not None:
        assert [list(gap) for gap in gaps(sequence)] == missing
    assert [n for run in runs(sequence) for n in run] == numbers


def test_a_stated_step(tmp_path):
    pattern(tmp_path, ["0000", "0003", "0009"], top="step = 3")
    sequence = open_sequence(tmp_path)
    assert (sequence.step, sequence.notes) == (3, ())
    assert runs(sequence) == (range(0, 6, 3), range(9, 12, 3))
    assert gaps(sequence) == (range(6, 9, 3),)
    pattern(tmp_path, ["0004"], top="step = 3")
    with pytest.raises(InputError, match="step = 3 is stated, but there is a frame 4 besides 0"):
        open_sequence(tmp_path)


class Stepped(SyntheticSequence):
    """The frames 0, 1, 2, ... numbered 5, 8, 11, ..."""

    step = 3

    def __init__(self, numbers):
        super().__init__(numbers)
        self.asked = []

    def frame(self, number):
        assert number in self.numbers
        return Frame(**vars(make_frame((number - 5) // 3, self.size)) | {"time": float(number)})

    def keyframe(self, number):
        self.asked.append(number)
        return make_keyframe((number - 5) // 3, self.size)


@pytest.mark.slow
def test_windows_go_by_position():
    sequence = Stepped([5, 8, 11, 14, 17, 20, 29, 32])
    assert held_back(sequence, past=1) == [8, 14, 20, 32]
    assert held_back(sequence, past=2, future=1) == [14]
    (w,) = windows(sequence, [14], past=2, future=1)
    assert [float(f.time) for f in (*w.history, w.target, *w.future)] == [5, 8, 11, 14, 17]
    assert [f.color is None for f in (*w.history, w.target, *w.future)] == [False, True, False, True, False]
    assert float(w.truth.time) == 14
    assert causes_of(sequence, w) is not None
    assert sequence.asked == [14, 11]
    for (plain,), (stepped,) in itertools.pairwise(
        [list(windows(SyntheticSequence(), [3], past=2)), list(windows(sequence, [14], past=2))]
    ):
        np.testing.assert_array_equal(plain.truth.color, stepped.truth.color)


def test_around():
    sequence = Stepped([5, 8, 11, 20, 23])
    assert around(sequence, 8, before=1, behind=1) == (5, 8, 11)
    assert around(sequence, 20) == (20,)
    with pytest.raises(ValueError, match="expected 1 frames before and 0 behind it without a gap, got 0 and 1"):
        around(sequence, 20, before=1)
    with pytest.raises(ValueError, match="got 6"):
        around(sequence, 6)


@pytest.mark.parametrize(
    "path, prefix, name",
    [
        ("bunker/540p", "", "bunker/540p"),
        ("hall/take2", "", "take2"),
        ("hall/take2/frames", "", "take2/frames"),
        ("hall/shot/renders/0001", "", "shot/renders/0001"),
        ("czest1dm", "OpenArena", "czest1dm (OpenArena)"),
        ("town", "Town_", "town"),
        ("town/exr", "Town", "town/exr (Town)"),
    ],
)
def test_names_of_inputs(tmp_path, path, prefix, name):
    assert folder_name(tmp_path / path, prefix) == name


def test_two_clips_do_not_look_alike(tmp_path):
    names = []
    for parent in ("bunker", "hall"):
        packed(tmp_path / parent / "540p", ["0001"])
        unreal(tmp_path / parent / "exr", ["0001"])
        pattern(tmp_path / parent / "passes", ["0001"])
        names += [open_sequence(tmp_path / parent / kind).name for kind in ("540p", "exr", "passes")]
    assert names[:3] == ["bunker/540p", "bunker/exr (Town)", "bunker/passes"]
    assert len(set(names)) == 6
