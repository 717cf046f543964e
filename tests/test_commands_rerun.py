"""Commands run again: into folders that hold something, on inputs that have changed, with frames missing in a row."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from synthetic import make_frame, make_keyframe

import jaxtrapolate as jx
import jaxtrapolate.commands.evaluate as command
import jaxtrapolate.evaluation.evaluate as module
from jaxtrapolate.commands.main import main
from jaxtrapolate.evaluation.runnable import history_costs
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.files import open_sequence, read_exr, write_exr, write_unreal_frame

SIZE = (32, 48)


def dumped(folder, times=range(6), colored=None):
    """An Unreal-style dump, with colour where `colored` says."""
    folder.mkdir(parents=True, exist_ok=True)
    for time in times:
        frame = make_frame(time, SIZE)
        frame = frame if colored is None or time in colored else hide(frame)
        write_unreal_frame(folder, "Wall", time, frame, keyframe=make_keyframe(time, SIZE), half=False)
    return folder


@pytest.fixture
def dump(tmp_path):
    return dumped(tmp_path / "dump")


@pytest.fixture(scope="module")
def still_dump(tmp_path_factory):
    """For tests that do not change it."""
    return dumped(tmp_path_factory.mktemp("dumps") / "dump")


def run(capsys, *arguments):
    code = main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return code, out, err


def refused(capsys, *arguments):
    """The one line on stderr of a command that ends with status 2."""
    code, _, err = run(capsys, *arguments)
    assert code == 2
    assert err.startswith("jaxtrapolate: ")
    assert err.count("\n") == 1
    return err


def color(path):
    channels = read_exr(path)
    return np.stack([channels[c] for c in "RGB"], -1)


@pytest.mark.slow
def test_generate_never_passes_off_another_methods_frames(capsys, still_dump, tmp_path):
    output, apart = tmp_path / "g", tmp_path / "apart"
    common = ("generate", still_dump, "--output", output)
    assert run(capsys, *common, "--method", "warp")[0] == 0
    first = color(output / "0002.5.exr")
    err = refused(capsys, *common, "--method", "occlusion_warp")
    assert 'method was "warp", is now "occlusion_warp"' in err
    assert "--fresh" in err
    assert "factor was 2, is now 3" in refused(capsys, *common, "--method", "warp", "--factor", 3)
    assert "motion was " in refused(capsys, *common, "--method", "warp", "--motion", "down")
    assert json.loads((output / "generate.json").read_text())["method"] == "warp"
    np.testing.assert_array_equal(color(output / "0002.5.exr"), first)
    assert run(capsys, *common, "--method", "occlusion_warp", "--fresh")[0] == 0
    assert run(capsys, "generate", still_dump, "--output", apart, "--method", "occlusion_warp")[0] == 0
    np.testing.assert_array_equal(color(output / "0002.5.exr"), color(apart / "0002.5.exr"))
    assert np.abs(color(output / "0002.5.exr") - first).max() > 0


def test_generate_writes_damaged_frames_again(capsys, still_dump, tmp_path):
    common = ("generate", still_dump, "--output", tmp_path, "--method", "warp")
    assert run(capsys, *common)[0] == 0
    first = {p.name: color(p) for p in sorted(tmp_path.glob("*.exr"))}
    (tmp_path / "0001.5.exr").write_bytes(b"")
    whole = (tmp_path / "0002.5.exr").read_bytes()
    (tmp_path / "0002.5.exr").write_bytes(whole[: len(whole) // 2])
    write_exr(tmp_path / "0003.5.exr", np.zeros((4, 4, 3), np.float32))
    _, _, err = run(capsys, *common)
    assert "3 frames generated with warp" in err
    assert "3 were there already" in err
    for name, image in first.items():
        np.testing.assert_array_equal(color(tmp_path / name), image)


def test_generate_knows_its_input(capsys, dump, tmp_path):
    common = ("generate", dump, "--output", tmp_path / "g", "--method", "warp")
    assert run(capsys, *common)[0] == 0
    write_exr(dump / "WallPreTonemapHDRColor.0003.exr", np.zeros((*SIZE, 3), np.float32))
    assert "WallPreTonemapHDRColor.0003.exr (frame 3 of the input) has changed" in refused(capsys, *common)
    dumped(dump, [6])  # rendered since: no frame that is there depends on it
    shutil.copy(dump / "WallPreTonemapHDRColor.0003.exr", tmp_path / "black.exr")
    dumped(dump, [3])
    code, _, err = run(capsys, *common)
    assert code == 0
    assert "1 frames generated with warp" in err


def test_render_never_mixes_seeds(capsys, tmp_path, monkeypatch):
    from test_commands_many import Scene

    monkeypatch.setattr("jaxtrapolate.scenes.SceneSequence", Scene)
    common = ("render", "demo", "--frames", 2, "--size", "48x32", "--output", tmp_path / "dump")
    assert run(capsys, *common)[0] == 0
    assert 'input was "demo-0", is now "demo-1"' in refused(capsys, *common, "--seed", 1)
    assert "size was [32, 48], is now [16, 24]" in refused(capsys, *common, "--size", "24x16")
    path = tmp_path / "dump" / "DemoBaseColor.0001.exr"
    path.write_bytes(b"")
    _, _, err = run(capsys, *common, "--frames", 3)
    assert "1 were there already" in err
    assert color(path).shape == (*SIZE, 3)
    assert open_sequence(tmp_path / "dump").numbers == (0, 1, 2)


@pytest.mark.slow
def test_evaluate_knows_its_input(capsys, dump, tmp_path):
    common = ("evaluate", dump, "--methods", "repeat", "--pictures", 0, "--output")
    assert run(capsys, *common, tmp_path / "a")[0] == 0
    black = np.zeros((*SIZE, 3), np.float32)
    write_exr(dump / "WallPreTonemapHDRColor.0004.exr", black)
    assert "WallPreTonemapHDRColor.0004.exr (frame 4 of the input) has changed" in refused(
        capsys, *common, tmp_path / "a"
    )
    assert run(capsys, *common, tmp_path / "a", "--fresh")[0] == 0
    assert run(capsys, *common, tmp_path / "b")[0] == 0
    frames = [json.loads((tmp_path / n / "results.json").read_text())["methods"]["repeat"]["frames"] for n in "ab"]
    assert [f["psnr"] for f in frames[0]] == [f["psnr"] for f in frames[1]]


def test_a_copied_input_is_the_same(capsys, still_dump, tmp_path, monkeypatch):
    output = tmp_path / "out"
    arguments = ("--methods", "repeat", "--pictures", 0, "--output", output)
    assert run(capsys, "evaluate", still_dump, *arguments)[0] == 0
    copy = tmp_path / "copy"
    shutil.copytree(still_dump, copy, copy_function=shutil.copy)
    monkeypatch.setattr(module, "score_window", None)  # nothing is scored anew
    assert run(capsys, "evaluate", copy, *arguments)[0] == 0


@pytest.mark.slow
def test_one_method_more_keeps_the_scores_of_the_others(capsys, still_dump, tmp_path, monkeypatch):
    asked, real = [], module.score_window

    def counted(sequence, slot, window, generated, *rest):
        asked.append((slot.number, *generated))
        return real(sequence, slot, window, generated, *rest)

    monkeypatch.setattr(module, "score_window", counted)
    common = ("evaluate", still_dump, "--pictures", 0, "--output", tmp_path, "--methods")
    assert run(capsys, *common, "repeat")[0] == 0
    assert run(capsys, *common, "repeat,warp")[0] == 0
    assert asked == [(n, m) for m in ("repeat", "warp") for n in (1, 3, 5)]
    results = json.loads((tmp_path / "results.json").read_text())
    assert list(results["methods"]) == ["repeat", "warp"]
    assert all(m["stages"] and m["ms"]["compile"] is not None for m in results["methods"].values())
    asked.clear()
    assert run(capsys, *common, "warp", "--frames", "3")[0] == 0
    assert run(capsys, *common, "warp,repeat")[0] == 0
    assert asked == []
    assert run(capsys, *common, "warp", "--metrics", "psnr")[0] == 0
    assert asked == []


def test_figures_of_two_machines_do_not_mix(capsys, still_dump, tmp_path, monkeypatch):
    common = ("evaluate", still_dump, "--methods", "repeat", "--pictures", 0, "--output", tmp_path)
    assert run(capsys, *common)[0] == 0
    other = command.machine() | {"cpu": "Abacus 9"}
    monkeypatch.setattr(command, "machine", lambda: other)
    assert 'is now "Abacus 9"' in refused(capsys, *common)


LONGER = [pytest.param(content, marks=pytest.mark.slow) for content in ("[]", '{"repeat": 5}', "[" * 100_000)]


@pytest.mark.parametrize("content", ["{", '{"repeat": {"number": 1}}', *LONGER])
@pytest.mark.slow
def test_kept_scores_of_another_shape_are_computed_again(capsys, still_dump, tmp_path, content):
    common = ("evaluate", still_dump, "--methods", "repeat", "--pictures", 0, "--frames", "1", "--output", tmp_path)
    assert run(capsys, *common)[0] == 0
    before = json.loads((tmp_path / "results.json").read_text())["methods"]["repeat"]["psnr"]
    for name in ("0001", "compile", "stages"):
        (tmp_path / "scores" / f"{name}.json").write_text(content)
    assert run(capsys, *common)[0] == 0
    assert json.loads((tmp_path / "results.json").read_text())["methods"]["repeat"]["psnr"] == before
    (tmp_path / "scores" / "0001.json").unlink()
    (tmp_path / "scores" / "0001.json").mkdir()
    assert "0001.json: is a folder" in refused(capsys, *common)


@pytest.mark.slow
@pytest.mark.parametrize("last", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_several_frames_missing_in_a_row(capsys, tmp_path, last):
    """Motion leads from frame to frame: all of them are handed over, as in Python."""
    folder = dumped(tmp_path / "dump", range(last + 1), colored=(0, last))
    assert run(capsys, "generate", folder, "--method", "bidirectional_image", "--output", tmp_path / "out")[0] == 0
    frames = [open_sequence(folder).frame(n) for n in range(last + 1)]
    method = jx.load("bidirectional_image")
    for n in range(1, last):
        right = np.asarray(method(tuple(frames[:n]), frames[n], tuple(frames[n + 1 :])))
        np.testing.assert_allclose(color(tmp_path / "out" / f"{n:04d}.exr"), right.astype(np.float16), atol=1e-3)


def test_no_interpolation_across_a_gap(capsys, tmp_path):
    folder = dumped(tmp_path / "dump", (0, 1, 8), colored=(0, 8))
    arguments = ("generate", folder, "--output", tmp_path / "out", "--method")
    assert "no rendered frame follows them without a gap" in refused(capsys, *arguments, "bidirectional_image")
    assert not list((tmp_path / "out").iterdir())
    assert run(capsys, *arguments, "warp")[0] == 0
    assert (tmp_path / "out" / "0001.exr").exists()
    dumped(folder, (2,))
    code, _, err = run(capsys, *arguments, "bidirectional_image", "--fresh")
    assert code == 0
    assert "1 frames generated" in err


def test_methods_that_cannot_run_are_named(capsys, tmp_path):
    folder = tmp_path / "clip"
    for time in range(4):
        write_unreal_frame(folder, "A", time, jx.Frame(make_frame(time, SIZE).color))
    common = ("evaluate", folder, "--output", tmp_path / "out", "--pictures", 0, "--methods")
    code, out, err = run(capsys, *common, "repeat,warp")
    assert code == 0
    (line,) = [line for line in err.splitlines() if line.startswith("jaxtrapolate: ")]
    assert line.startswith("jaxtrapolate: warp was left out: ")
    assert "target.motion" in line
    assert "target.motion" in out
    assert "target.motion" in (tmp_path / "out" / "report.html").read_text()
    assert "no method can run: warp: " in refused(capsys, *common, "warp")


def test_what_each_history_costs(still_dump):
    sequence = open_sequence(still_dump)  # six frames: 1, 3 and 5 are held back
    methods = {name: jx.load(name) for name in ("repeat", "warp", "occlusion_warp", "blend")}
    before = "occlusion_warp needs 2 rendered frames before a held-back one"
    after = "blend needs 1 rendered frame after a held-back one"
    assert history_costs(sequence, {n: methods[n] for n in ("repeat", "warp")}) == []
    (note,) = history_costs(sequence, {n: methods[n] for n in ("repeat", "occlusion_warp")})
    assert note == f"{before}: 2 frames can be scored; without it there are 1 more"
    notes = history_costs(sequence, methods)
    assert notes == [f"{t}: 1 frames can be scored; without it there are 1 more" for t in (before, after)]


@pytest.mark.slow
def test_what_a_long_history_costs_is_said(capsys, still_dump, tmp_path):
    common = ("evaluate", still_dump, "--output", tmp_path, "--pictures", 0, "--methods")
    code, out, _ = run(capsys, *common, "repeat,occlusion_warp")
    assert code == 0
    text = (
        "occlusion_warp needs 2 rendered frames before a held-back one: 2 frames can be scored; without it there are 1"
    )
    assert text in " ".join(out.split())
    assert text in (tmp_path / "report.html").read_text()
    assert "needs" not in run(capsys, *common, "repeat,warp")[1]


def test_a_method_with_too_few_frames_is_left_out(capsys, tmp_path):
    folder = dumped(tmp_path / "dump", range(3))
    code, out, err = run(
        capsys, "evaluate", folder, "--output", tmp_path / "out", "--pictures", 0, "--methods", "repeat,occlusion_warp"
    )
    assert code == 0
    assert "occlusion_warp was left out: too few frames, needs 4 in a row without a gap" in err
    assert "3 frames" not in out.splitlines()[0]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("render", "demo", "--seed", -1), "--seed: expected a number from 0"),
        (("render", "demo", "--size", "99999999x99999999"), "--size: expected WxH"),
        (("render", "demo", "--frames", 0), "--frames: expected a number from 1"),
        (("demo", "--frames", -3), "--frames: expected a number from 1"),
        (("evaluate", "scenes:demo", "--methods", "warp", "--length", 10**20), "--length: expected a number from 1"),
        (("evaluate", f"scenes:demo:{10**19 - 1}", "--methods", "warp"), "SEED: expected a number from 0"),
        (("evaluate", "scenes:demo", "--methods", "warp", "--pictures", -5), "--pictures: expected 0 or more, got -5"),
        (("generate", "scenes:demo", "--method", "warp", "--factor", 10**9), "--factor: expected 2 to 1000"),
    ],
)
def test_numbers_that_cannot_be(capsys, tmp_path, arguments, message):
    assert message in refused(capsys, *arguments, "--output", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_paths_that_lead_nowhere(capsys, tmp_path):
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    assert "leads back to itself" in refused(capsys, "check", loop)
    strange = os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe")
    assert "does not exist" in refused(capsys, "check", strange)
    os.mkdir(strange)
    assert "is empty" in refused(capsys, "check", strange)
    dumped_there = dumped(tmp_path / "dump", range(2))
    os.rename(dumped_there, strange + "d")
    assert main(["evaluate", strange + "d", "--methods", "repeat", "--pictures", "0", "--output", strange + "o"]) == 0
    assert os.path.exists(strange + "o/report.html")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
@pytest.mark.slow
def test_a_full_standard_output():
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "jaxtrapolate", "scenes"],
            stdout=full,
            stderr=-1,
            text=True,
            timeout=120,
            check=False,
        )
    assert done.returncode == 2
    assert done.stderr == (
        "jaxtrapolate: standard output: cannot be written, the disk is full; free some space and run again\n"
    )
