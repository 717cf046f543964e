"""The command line, as a user types it: results, resumption, and one clear line for what cannot be used."""

import json
import os

import numpy as np
import pytest
from synthetic import make_frame, make_keyframe

import jaxtrapolate as jx
from jaxtrapolate.commands.inputs import terminal
from jaxtrapolate.commands.main import main
from jaxtrapolate.commands.tables import print_table
from jaxtrapolate.errors import InputError
from jaxtrapolate.files import open_sequence, read_exr, read_png, write_png, write_unreal_frame
from jaxtrapolate.files.packed import encode_motion
from jaxtrapolate.results import Results

SIZE = (32, 48)


@pytest.fixture(scope="module")
def dump(tmp_path_factory):
    """An Unreal-style dump of nine frames."""
    folder = tmp_path_factory.mktemp("dump")
    for time in range(9):
        write_unreal_frame(folder, "Wall", time, make_frame(time, SIZE), keyframe=make_keyframe(time, SIZE))
    return folder


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A packed clip of five 8-bit frames: colour and motion."""
    folder = tmp_path_factory.mktemp("clip")
    for part in ("color", "motion"):
        (folder / part).mkdir()
    for time in range(5):
        frame = make_frame(time, SIZE)
        codes = np.round(255 * np.asarray(jx.srgb_encode(np.clip(frame.color, 0, 1)))).astype(np.uint8)
        write_png(folder / "color" / f"{time:04d}.png", codes)
        uv = frame.motion * np.array([-1 / SIZE[1], 1 / SIZE[0]], np.float32)  # current minus previous, y up
        write_png(folder / "motion" / f"{time:04d}.png", encode_motion(uv))
    return folder


def run(capsys, *arguments):
    code = main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return code, out, err


def fails(capsys, *arguments):
    """The one line on stderr of a command that ends with status 2."""
    code, _, err = run(capsys, *arguments)
    assert code == 2
    assert err.startswith("jaxtrapolate: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    return err


def test_check_reports_buffers_convention_and_methods(capsys, dump):
    code, out, _ = run(capsys, "check", dump)
    assert code == 0
    assert "9 frames (0-8), 48x32, HDR" in out
    assert "read: all 9 frames" in out
    assert "current_minus_previous,pixels,up, as in use" in out
    for word in ("albedo", "no non-finite pixels", "guided_warp", "absent: "):
        assert word in out


@pytest.mark.parametrize(
    "convention",
    ["previous_minus_current,pixels,up", pytest.param("current_minus_previous,pixels,down", marks=pytest.mark.slow)],
)
@pytest.mark.slow
def test_check_finds_the_convention(capsys, dump, convention):
    """The reader is told a wrong one; check names the right one."""
    code, out, _ = run(capsys, "check", dump, "--motion", convention)
    assert code == 0
    assert "--motion current_minus_previous,pixels,up" in " ".join(out.split())


def test_check_of_uv_vectors(capsys, dump, tmp_path):
    for time in range(4):
        frame = make_frame(time, SIZE)
        write_unreal_frame(tmp_path, "Wall", time, jx.replace(frame, motion=frame.motion / np.float32([48, 32])))
    code, out, _ = run(capsys, "check", tmp_path)
    assert code == 0
    assert "--motion current_minus_previous,uv,up" in " ".join(out.split())


@pytest.mark.slow
def test_check_of_a_packed_clip(capsys, clip):
    code, out, _ = run(capsys, "check", clip)
    assert code == 0
    assert "8-bit sRGB" in out
    assert "as in use" in out


def test_evaluate_writes_results_report_and_pictures(capsys, dump, tmp_path):
    output = tmp_path / "results"
    code, out, _ = run(
        capsys, "evaluate", dump, "--methods", "repeat,warp", "--output", output, "--frames", "3,5", "--pictures", 1
    )
    assert code == 0
    assert "PSNR" in out
    results = json.loads((output / "results.json").read_text())
    assert results["frames"] == [3, 5]
    assert set(results["methods"]) == {"repeat", "warp"}
    for method in results["methods"].values():
        assert {"psnr", "ssim", "ms", "by_cause", "stages", "frames"} <= set(method)
        assert {"median", "iqr", "compile"} <= set(method["ms"])
        assert [f["number"] for f in method["frames"]] == [3, 5]
    assert results["methods"]["warp"]["psnr"] > results["methods"]["repeat"]["psnr"] + 3
    assert "hole" in results["methods"]["warp"]["by_cause"]
    assert set(results["methods"]["warp"]["stages"]) == {"reproject", "warp"}
    assert (output / "report.html").stat().st_size > 10_000
    (shown,) = results["pictures"]
    truth = read_png(output / shown["truth"])
    assert truth.shape == (32, 48, 3)


def test_evaluate_goes_on_where_it_was(capsys, dump, tmp_path, monkeypatch):
    import jaxtrapolate.evaluation.evaluate as module

    arguments = ("evaluate", dump, "--methods", "repeat", "--output", tmp_path, "--pictures", 0)
    scored, real = [], module.score_window

    def interrupted(sequence, slot, *rest):
        if len(scored) == 2:
            raise KeyboardInterrupt
        scored.append(slot.number)
        return real(sequence, slot, *rest)

    monkeypatch.setattr(module, "score_window", interrupted)
    assert run(capsys, *arguments)[0] == 130
    assert not (tmp_path / "results.json").exists()
    first, scored[:] = list(scored), []
    monkeypatch.setattr(module, "score_window", lambda s, w, *r: scored.append(w.number) or real(s, w, *r))
    assert run(capsys, *arguments)[0] == 0
    assert first == [1, 3]
    assert scored == [5, 7]
    assert json.loads((tmp_path / "results.json").read_text())["frames"] == [1, 3, 5, 7]


def test_generate_carries_motion_on(capsys, dump, tmp_path):
    code, _, err = run(capsys, "generate", dump, "--method", "warp", "--output", tmp_path, "--factor", 3)
    assert code == 0
    assert "its motion carried on" in " ".join(err.split())
    assert len(list(tmp_path.glob("*.exr"))) == 9 * 2
    made = read_exr(tmp_path / "0004.333.exr")
    image = np.stack([made[c] for c in "RGB"], -1)
    assert image.shape == (32, 48, 3)
    near = float(jx.psnr(jx.tonemap(image), jx.tonemap(make_frame(4, SIZE).color)))
    assert 15 < near < 60
    assert json.loads((tmp_path / "generate.json").read_text())["how"].startswith("after each rendered frame")


def test_generate_makes_frames_without_colour(capsys, tmp_path):
    half = tmp_path / "half"
    half.mkdir()
    for time in range(6):
        frame = make_frame(time, SIZE)
        write_unreal_frame(half, "Wall", time, frame if time % 2 == 0 else jx.replace(frame, color=None))
    output = tmp_path / "out"
    code, _, err = run(capsys, "generate", half, "--method", "occlusion_warp", "--output", output)
    assert code == 0
    assert "from the buffers drawn for them" in " ".join(err.split())
    assert sorted(p.name for p in output.glob("*.exr")) == ["0001.exr", "0003.exr", "0005.exr"]
    made = read_exr(output / "0003.exr")
    image = np.stack([made[c] for c in "RGB"], -1).astype(np.float32)
    assert float(jx.psnr(jx.tonemap(image), jx.tonemap(make_frame(3, SIZE).color))) > 20

    kept = (output / "0001.exr").stat().st_mtime_ns
    (output / "0003.exr").unlink()
    code, _, err = run(capsys, "generate", half, "--method", "occlusion_warp", "--output", output)
    assert code == 0
    assert "2 were there already" in err
    assert (output / "0001.exr").stat().st_mtime_ns == kept
    assert (output / "0003.exr").exists()


def test_generate_writes_png_for_8_bit_input(capsys, clip, tmp_path):
    code, *_ = run(capsys, "generate", clip, "--method", "repeat", "--output", tmp_path)
    assert code == 0
    names = sorted(p.name for p in tmp_path.glob("*.png"))
    assert names == [f"{n:04d}.5.png" for n in range(5)]
    np.testing.assert_allclose(
        read_png(tmp_path / "0002.5.png").astype(int), read_png(clip / "color" / "0002.png").astype(int), atol=1
    )


def test_one_line_for_what_cannot_be_used(capsys, dump, tmp_path):
    assert "does not exist" in fails(capsys, "check", tmp_path / "nowhere")
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "is empty" in fails(capsys, "evaluate", empty, "--methods", "warp", "--output", tmp_path / "o")
    assert "no method 'wrap'; there are repeat" in fails(
        capsys, "evaluate", dump, "--methods", "warp,wrap", "--output", tmp_path / "o"
    )
    assert "is not one of" in fails(capsys, "check", dump, "--motion", "sideways")
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert str(blocked) in fails(capsys, "evaluate", dump, "--methods", "warp", "--output", blocked)
    assert "--factor: expected 2" in fails(
        capsys, "generate", dump, "--method", "warp", "--output", tmp_path / "o", "--factor", 1
    )
    assert "expected one name" in fails(capsys, "generate", dump, "--method", "warp,repeat", "--output", tmp_path / "o")
    assert "cannot be scored" in fails(
        capsys, "evaluate", dump, "--methods", "warp", "--output", tmp_path / "o", "--frames", "2"
    )
    assert "no scene 'moon'" in fails(capsys, "render", "moon", "--output", tmp_path / "o")
    assert "no such scene" in fails(capsys, "check", "scenes:moon")
    assert "--size: expected WxH" in fails(capsys, "render", "demo", "--size", "big", "--output", tmp_path / "o")


def test_a_truncated_file_is_named(capsys, tmp_path):
    for time in range(4):
        write_unreal_frame(tmp_path, "Wall", time, make_frame(time, SIZE))
    victim = tmp_path / "WallBaseColor.0001.exr"
    victim.write_bytes(victim.read_bytes()[:400])
    assert "WallBaseColor.0001.exr" in fails(capsys, "check", tmp_path)


def test_what_misses_buffers_is_left_out_by_name(capsys, clip, tmp_path):
    code, out, _ = run(
        capsys, "evaluate", clip, "--methods", "repeat,occlusion_warp", "--output", tmp_path, "--pictures", 0
    )
    assert code == 0
    assert "missing target.depth" in out
    assert "target.depth" in json.loads((tmp_path / "results.json").read_text())["skipped"]["occlusion_warp"]


def test_colour_alone_is_enough_to_repeat(capsys, tmp_path):
    (tmp_path / "color").mkdir()
    for time in range(4):
        codes = np.full((*SIZE, 3), 40 * time, np.uint8)
        write_png(tmp_path / "color" / f"{time:04d}.png", codes)
    output = tmp_path / "out"
    code, out, _ = run(capsys, "evaluate", tmp_path, "--methods", "repeat,warp", "--output", output, "--pictures", 1)
    assert code == 0
    assert "missing target.motion" in out
    results = json.loads((output / "results.json").read_text())
    assert results["methods"]["repeat"]["psnr"] == pytest.approx(20 * np.log10(255 / 40), abs=1e-3)
    assert results["methods"]["repeat"]["by_cause"] == {}
    assert run(capsys, "check", tmp_path)[0] == 0


def test_gaps_and_non_finite_pixels(capsys, tmp_path):
    for time in (0, 1, 2, 3, 5, 6, 7):
        frame = make_frame(time, SIZE)
        if time == 3:
            color = frame.color.copy()
            color[4, 5] = np.nan
            frame = jx.replace(frame, color=color)
        write_unreal_frame(tmp_path, "Wall", time, frame)
    output = tmp_path / "out"
    code, _out, _ = run(capsys, "evaluate", tmp_path, "--methods", "warp", "--output", output, "--pictures", 0)
    assert code == 0
    results = json.loads((output / "results.json").read_text())
    assert results["frames"] == [1, 3, 6]
    assert any("gap" in n for n in results["notes"])
    assert any("1 non-finite pixels" in n for n in results["notes"])
    assert "gap: frame 4 is missing" in run(capsys, "check", tmp_path)[1]
    said = fails(capsys, "check", tmp_path, "--strict")
    assert "frame 4 missing; render what is missing, or read it without --strict" in said
    with pytest.raises(InputError, match=r"or read it without strict$"):
        open_sequence(tmp_path, strict=True)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written(capsys, dump, tmp_path):
    tmp_path.chmod(0o500)
    assert "permission" in fails(capsys, "evaluate", dump, "--methods", "warp", "--output", tmp_path / "o")


def test_a_full_disk_leaves_nothing_half_written(capsys, dump, tmp_path, monkeypatch):
    import errno

    real = os.replace

    def full(source, target, *args, **kwargs):
        if str(target).endswith(".exr"):
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(source, target, *args, **kwargs)

    monkeypatch.setattr(os, "replace", full)
    error = fails(capsys, "generate", dump, "--method", "repeat", "--output", tmp_path)
    assert "disk is full" in error
    assert not list(tmp_path.iterdir())


def test_the_usual_options(capsys):
    with pytest.raises(SystemExit) as version:
        main(["--version"])
    assert version.value.code == 0
    assert capsys.readouterr().out.strip() == f"jaxtrapolate {jx.__version__}"
    with pytest.raises(SystemExit) as nothing:
        main([])
    assert nothing.value.code == 2


@pytest.mark.slow
def test_render_check_and_demo(capsys, tmp_path):
    dump = tmp_path / "dump"
    code, *_ = run(capsys, "render", "demo", "--frames", 3, "--size", "64x36", "--output", dump)
    assert code == 0
    code, out, _ = run(capsys, "check", dump)
    assert code == 0
    assert "as in use" in out
    code, out, _ = run(capsys, "demo", "--output", tmp_path / "demo", "--frames", 8, "--size", "96x54")
    assert code == 0
    results = json.loads((tmp_path / "demo" / "results.json").read_text())
    assert results["methods"]["guided_warp"]["psnr"] > results["methods"]["warp"]["psnr"]
    assert (tmp_path / "demo" / "report.html").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["czest1dm", "bunker"])
@pytest.mark.parametrize("change", ["as it is", "negated", "flipped", "other units"])
def test_check_finds_the_convention_of_real_input(data, name, change):
    """The best of all conventions is the stated one, and what it becomes when the stored vectors are altered."""
    from rich.console import Console

    from jaxtrapolate.commands.check import try_conventions
    from jaxtrapolate.commands.inputs import progress
    from jaxtrapolate.files import MotionConvention, open_sequence

    sequence = open_sequence(data / name)
    height, width = sequence.size
    stated, stored = sequence.convention, sequence.stored_motion
    other = "uv" if stated.units == "pixels" else "pixels"
    scale = np.float32([width, height]) ** (1 if other == "pixels" else -1)
    factor, expected = {
        "as it is": (np.float32([1, 1]), str(stated)),
        "negated": (np.float32([-1, -1]), "previous_minus_current"),
        "flipped": (np.float32([1, -1]), "down"),
        "other units": (scale, other),
    }[change]
    sequence.stored_motion = lambda number: stored(number) * factor
    with progress(Console(stderr=True)) as bar:
        trial = try_conventions(sequence, bar)
    assert trial is not None
    tried = trial.conventions
    assert len(tried) == 12
    assert tried[0][0] == MotionConvention.parse(expected, base=stated)
    assert tried[0][1] > tried[1][1] + 1


def test_brackets_are_printed(capsys):
    """In file names, and in what to install."""
    results = {
        "input": "clip[final]",
        "size": [2, 4],
        "frames": [1],
        "metrics": {},
        "methods": {"warp": {"psnr": 30.0, "ms": {"median": 1.0, "compile": None}, "by_cause": {}}},
        "skipped": {"sharp": 'pip install "jaxtrapolate[flip]"'},
        "notes": ["[a]"],
    }
    print_table(Results.from_json(results), terminal())
    out = capsys.readouterr().out
    for text in ("clip[final]", '"jaxtrapolate[flip]"', "note: [a]"):
        assert text in out
