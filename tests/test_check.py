"""What `check` says of an input is true: frames read, depth, static ids, motion vectors that cannot be told."""

import json

import numpy as np
import pytest
from synthetic import make_frame, static_scene

import jaxtrapolate as jx
from jaxtrapolate.commands.check import try_conventions
from jaxtrapolate.commands.inputs import progress, terminal
from jaxtrapolate.commands.main import main
from jaxtrapolate.files import open_sequence, write_exr, write_png, write_unreal_frame


@pytest.fixture
def check_motion(capsys, monkeypatch):
    """What the command prints of a folder, without the table of methods, which would have to read their weights."""
    monkeypatch.setattr("jaxtrapolate.commands.check._print_methods", lambda *_: None)

    def run(folder, *options):
        assert main(["check", str(folder), *options]) == 0
        return capsys.readouterr().out

    return run


@pytest.fixture
def check(check_motion, monkeypatch):
    """And without trying conventions."""
    monkeypatch.setattr("jaxtrapolate.commands.check.try_conventions", lambda *_: None)
    return check_motion


def write(folder, numbers, change=lambda frame, number: frame, size=(32, 48)):
    for time, number in enumerate(numbers):
        write_unreal_frame(folder, "Town", number, change(make_frame(time, size), number))


def test_the_frames_that_were_read_are_named(tmp_path, check):
    (tmp_path / "color").mkdir()
    for number in range(30):
        write_png(tmp_path / "color" / f"{number:04d}.png", np.zeros((2, 3, 3), np.uint8))
    out = check(tmp_path)
    assert "30 frames (0-29)" in out
    assert "read: 20 of 30 frames, evenly spaced: 0, 2, 3, 5, 6, 8, " in out
    assert "20/20" in out
    assert "buffers of the frames read" in out


def test_a_step_and_what_is_left_out(tmp_path, check):
    write(tmp_path, [0, 2, 4, 10], lambda frame, number: jx.replace(frame, color=None) if number == 2 else frame)
    write_exr(tmp_path / "TownBaseColor.4.exr", np.zeros((32, 48, 3)))
    out = check(tmp_path)
    assert "4 frames (0-10, step 2)" in out
    assert "gap: frames 6-8 are missing" in out
    assert "colour: in 3 of 4 frames" in out
    assert "note: step 2 found" in out
    assert "note: TownBaseColor.4.exr left out" in out


def test_pixels_without_depth_are_counted(tmp_path, check):
    def change(frame, number):
        depth = frame.gbuffer.depth.copy()
        depth[:2] = 0 if number == 1 else depth[:2]
        depth[0, :3] = np.inf
        return jx.replace(frame, gbuffer=jx.replace(frame.gbuffer, depth=-depth if number == 2 else depth))

    write(tmp_path, [0, 1, 2], change)
    out = check(tmp_path)
    counts = {"infinite": 3 + 3, "not positive": 2 * 48 - 3 + 32 * 48 - 3}
    total = sum(counts.values())
    assert f"no depth: {total} pixels ({total / (3 * 32 * 48):.1%}) in 3 of 3 frames read, taken for infinitely" in out
    assert f"{counts['infinite']} infinite, {counts['not positive']} not positive" in out
    assert "scale = -1" not in out  # frame 2: -inf is no depth but an invalid pixel
    write(tmp_path, [0, 1, 2], lambda f, _: jx.replace(f, gbuffer=jx.replace(f.gbuffer, depth=-f.gbuffer.depth)))
    assert (
        "no depth: nowhere in frames 0, 1, 2; distances that are stored as negative numbers need scale = -1"
        in check(tmp_path)
    )


@pytest.mark.parametrize("farthest, said", [((1e10, 1e10), True), ((1e10, 50), False)])
def test_a_largest_depth_that_may_stand_for_nothing(tmp_path, check, farthest, said):
    depth = np.random.default_rng(0).uniform(1, 20, (8, 10)).astype(np.float32)
    for number, far in enumerate(farthest):
        depth[:3] = far
        write_exr(tmp_path / f"{number}.exr", {"Z": depth}, half=False)
    settings = tmp_path / "jaxtrapolate.toml"
    settings.write_text('[buffers]\ndepth = "{frame}.exr"\n')
    text = (
        "depth: many pixels of 2 of 2 frames read have the same largest 1e+10; if nothing was hit there, nothing_above"
    )
    assert (text in check(tmp_path)) == said
    settings.write_text('[buffers]\ndepth = { file = "{frame}.exr", nothing_above = 1e9 }\n')
    assert text not in check(tmp_path)


def walls(folder, hashes=None, moving=(2, 3)):
    """Blocks that all have an id; the moving ones have a motion of their own."""
    for number in (1, 2):
        depth, motion, ids = static_scene(seed=number)
        motion = motion + np.where(np.isin(ids, moving), [1.5, -0.5], 0)
        stored = ids[..., 0].astype(np.uint32)
        stored = stored if hashes is None else np.array(hashes, np.uint32)[stored]
        depth, motion = depth[..., 0].astype(np.float32), motion.astype(np.float32)
        write_exr(folder / f"{number}.exr", {"Z": depth, "X": motion[..., 0], "Y": motion[..., 1]}, half=False)
        write_exr(folder / f"i{number}.exr", {"Y": stored})
    (folder / "jaxtrapolate.toml").write_text(
        '[buffers]\ndepth = { file = "{frame}.exr", channels = "Z" }\n'
        'motion = { file = "{frame}.exr", channels = "XY" }\nstencil = "i{frame}.exr"\n'
    )


def test_ids_that_move_as_the_camera_does(tmp_path, check):
    walls(tmp_path)
    out = check(tmp_path)
    text = "objects: 12 ids above 0 in the stencil; 10 of them move as the camera does in frames 1, 2"
    assert text in out
    stated = "static_ids = [1, 4, 5, 6, 7, 8, 9, 10, 11, 12]"
    assert stated in out
    settings = tmp_path / "jaxtrapolate.toml"
    settings.write_text(f"{stated}\n{settings.read_text()}")
    assert set(np.unique(open_sequence(tmp_path).frame(1).gbuffer.stencil)) == {0, 2, 3}
    assert "objects: 2 ids above 0 in the stencil; none moves as the camera does, all are dynamic" in check(tmp_path)


def test_static_hashes_are_named_as_they_are_stored(tmp_path, check):
    hashes = [0, *(0x9E3779B0 + np.random.default_rng(0).permutation(12))]
    walls(tmp_path, hashes)
    out = check(tmp_path)
    stated = out.split("write static_ids = ")[1].split(" to jaxtrapolate.toml")[0]
    assert sorted(json.loads(stated)) == sorted(h for k, h in enumerate(hashes) if k not in (0, 2, 3))
    settings = tmp_path / "jaxtrapolate.toml"
    settings.write_text(f"static_ids = {stated}\n{settings.read_text()}")
    _, _, ids = static_scene(seed=2)
    np.testing.assert_array_equal(open_sequence(tmp_path).frame(2).gbuffer.stencil > 0, np.isin(ids, (2, 3)))


def trial(folder):
    sequence = open_sequence(folder)
    with progress(terminal(stderr=True)) as bar:
        return sequence, try_conventions(sequence, bar)


def test_frames_that_do_not_change_say_nothing(tmp_path, check_motion):
    """Every convention is exact, and infinitely good."""
    still = make_frame(0, (32, 48))
    write(tmp_path, [0, 1, 2], lambda *_: jx.replace(still, motion=np.zeros_like(still.motion)))
    assert all(decibels == np.inf for _, decibels in trial(tmp_path)[1].conventions)
    out = check_motion(tmp_path)
    assert "all conventions are alike" in out
    assert "nan" not in out


def test_conventions_that_cannot_be_told_apart(tmp_path, check_motion):
    """Without vertical motion the y axis may point either way: the one in use is not called wrong."""

    def change(frame, number):
        x = np.arange(48) + 2.0 * number
        color = np.sin(np.stack([0.3 * x, 0.2 * x + 1, 0.1 * x + 2], -1)) / 2 + 0.5
        motion = np.zeros((32, 48, 2), np.float32) + np.float32([2, 0])
        return jx.replace(frame, color=color[None].repeat(32, 0).astype(np.float32), motion=motion)

    write(tmp_path, range(4), change)
    for option in ((), ("--motion", "down")):
        out = " ".join(check_motion(tmp_path, *option).split())
        assert ", as in use;" in out
        other = "down" if not option else "up"
        assert f"current_minus_previous,pixels,{other} cannot be told from it here" in out


def test_vectors_that_are_none(tmp_path, check_motion):
    """Noise instead of motion: no convention is recommended."""
    noise = np.random.default_rng(0).uniform(-9, 9, (32, 48, 2)).astype(np.float32)
    write(tmp_path, range(4), lambda frame, _: jx.replace(frame, motion=noise))
    out = check_motion(tmp_path)
    assert "no convention is better than no motion at all" in " ".join(out.split())
    assert "run with --motion" not in out


def test_vectors_of_one_number_where_the_step_is_two(tmp_path, check_motion):
    write(tmp_path, [0, 2, 4, 6], lambda frame, _: jx.replace(frame, motion=frame.motion / 2))
    text = "2 times as long they are"
    assert text in check_motion(tmp_path)
    write(tmp_path, [0, 2, 4, 6])
    assert text not in check_motion(tmp_path)


def test_pixels_that_are_not_finite_have_no_part(tmp_path):
    """One vector that is NaN, and a colour, change nothing but their own pixels."""

    def spoil(frame, number):
        motion, color = frame.motion.copy(), frame.color.copy()
        if number == 2:
            motion[3, 4], color[5, 6] = np.nan, np.inf
        return jx.replace(frame, motion=motion, color=color)

    write(tmp_path / "a", range(3))
    write(tmp_path / "b", range(3), spoil)
    whole, spoilt = (dict(trial(tmp_path / name)[1].conventions) for name in "ab")
    assert all(np.isfinite(list(spoilt.values())))
    for convention, decibels in whole.items():
        assert spoilt[convention] == pytest.approx(decibels, abs=0.3)


def test_pairs_are_those_with_colour(tmp_path):
    """Colour in one stretch only: neighbours there are found."""
    write(tmp_path, range(20), lambda f, n: f if n in (7, 8) else jx.replace(f, color=None))
    sequence, found = trial(tmp_path)
    assert found is not None
    assert found.conventions[0][0] == sequence.convention
