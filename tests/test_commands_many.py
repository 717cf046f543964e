"""`evaluate` on several inputs, with other metrics, and with a video."""

import dataclasses
import json
import math

import numpy as np
import pytest
from PIL import Image
from synthetic import SyntheticSequence, make_frame, make_keyframe

import jaxtrapolate as jx
import jaxtrapolate.evaluation.evaluate as module
from jaxtrapolate.commands import inputs as inputs_module
from jaxtrapolate.commands.inputs import named_inputs
from jaxtrapolate.commands.main import main
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation import video
from jaxtrapolate.evaluation.evaluate import Evaluation
from jaxtrapolate.evaluation.pictures import Gallery, eight_bit
from jaxtrapolate.evaluation.score import display, mean_over_inputs
from jaxtrapolate.evaluation.windows import windows
from jaxtrapolate.files import write_unreal_frame
from jaxtrapolate.metrics import Metric
from jaxtrapolate.metrics import registry as metrics_module
from jaxtrapolate.metrics.perceptual import ClipScore
from jaxtrapolate.results import CauseScore, MethodResult, RunTime
from jaxtrapolate.scenes import DEVELOPMENT_SEEDS, TEST_SEEDS, scene_names

SIZE = (32, 48)


class Scene(SyntheticSequence):
    """In the place of an embedded scene: seeds differ in their fog."""

    def __init__(self, name, seed=0, frames=6, size=SIZE):
        super().__init__(range(frames), size, fog=0.1 * (seed % 5))
        self.name = f"{name}-{seed}"


@pytest.fixture
def scenes(monkeypatch):
    """Embedded scenes that need no compilation."""
    monkeypatch.setattr("jaxtrapolate.scenes.SceneSequence", Scene)


@pytest.fixture(scope="module")
def dump(tmp_path_factory):
    """An Unreal-style dump of four frames."""
    folder = tmp_path_factory.mktemp("dumps") / "wall"
    folder.mkdir()
    for time in range(4):
        write_unreal_frame(folder, "Wall", time, make_frame(time, SIZE), keyframe=make_keyframe(time, SIZE))
    return folder


def run(capsys, *arguments):
    code = main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return code, out, err


def refuses(capsys, *arguments):
    """The one line on stderr of a command that ends with status 2."""
    code, _, err = run(capsys, *arguments)
    assert code == 2
    assert err.startswith("jaxtrapolate: ")
    assert err.count("\n") == 1
    return err


def read(path):
    return json.loads(path.read_text())


def names(texts, **options):
    return [i.name for i in named_inputs(texts, **options)]


def test_what_inputs_name(tmp_path):
    assert names(["scenes:development"]) == [f"{n}-{s}" for n in scene_names() for s in DEVELOPMENT_SEEDS]
    assert names(["scenes:all"]) == [f"{n}-0" for n in scene_names()]
    assert names(["scenes:test"]) == [f"{n}-{s}" for n in scene_names() for s in TEST_SEEDS]
    assert names(["scenes:demo:7", "scenes:demo", "scenes:demo:0"]) == ["demo-7", "demo-0"]
    a, b = tmp_path / "a" / "Clip 1", tmp_path / "b" / "clip_1"
    assert names([str(a), str(b), str(a.parent / ".." / "a" / "Clip 1")]) == ["a-Clip_1", "b-clip_1"]
    assert names([str(a), str(tmp_path / "a" / "other")]) == ["Clip_1", "other"]
    assert names([str(tmp_path / "bunker" / "540p"), str(tmp_path / "town")]) == ["bunker-540p", "town"]
    assert names([str(a), str(a.with_name("Clip?1"))]) == ["Clip_1", "Clip_1-2"]
    assert names([str(a / "jaxtrapolate.toml")]) == ["Clip_1"]


def test_options_of_embedded_scenes(scenes):
    (one,) = named_inputs(["scenes:demo:3"], size="64x36", length=7)
    sequence = one.open()
    assert (sequence.name, sequence.size, sequence.numbers) == ("demo-3", (36, 64), tuple(range(7)))
    with pytest.raises(InputError, match=r"--length: expected a number from 1 to .*, got 0"):
        named_inputs(["scenes:demo"], length=0)
    with pytest.raises(InputError, match="--size, --length, --scale, --jitter: are for embedded scenes"):
        named_inputs(["folder"], size="64x36")


@pytest.mark.parametrize(
    "text, message",
    [
        ("scenes:moon", "scenes:moon: no such scene"),
        ("scenes:demo:x", "scenes:demo:x: expected a seed"),
        ("scenes:demo:-1", "expected a seed"),
        ("scenes:all:2", "scenes:all: no such scene"),
    ],
)
def test_scenes_that_there_are_not(capsys, tmp_path, text, message):
    assert message in refuses(capsys, "evaluate", text, "--methods", "warp", "--output", tmp_path)
    assert message in refuses(capsys, "check", text)


def test_commands_of_one_input(capsys):
    assert "names 10 inputs" in refuses(capsys, "check", "scenes:all")


def test_several_inputs(capsys, scenes, dump, tmp_path):
    gone = tmp_path / "gone"
    output = tmp_path / "out"
    code, out, err = run(
        capsys, "evaluate", gone, dump, "scenes:demo:1", "scenes:still:2", "scenes:moon", "--methods", "repeat,warp",
        "--output", output, "--pictures", 0, "--size", "48x36",
    )  # fmt: skip
    assert code == 2
    said = [line for line in err.splitlines() if line.startswith("jaxtrapolate: ")]
    assert [line.split(": ")[1] for line in said] == [str(gone), "scenes:moon"]
    assert sorted(p.name for p in output.iterdir()) == [
        *("demo-1", "report.html", "results.json", "run.json", "still-2", "wall"),
    ]
    single = {n: read(output / n / "results.json") for n in ("wall", "demo-1", "still-2")}
    assert [r["size"] for r in single.values()] == [[32, 48], [36, 48], [36, 48]]
    whole = read(output / "results.json")
    assert [i["folder"] for i in whole["inputs"]] == list(single)
    assert list(whole["failed"]) == [str(gone), "scenes:moon:0"]
    assert len({r["methods"]["warp"]["psnr"] for r in single.values()}) == 3
    for name, method in whole["methods"].items():
        found = [r["methods"][name] for r in single.values()]
        for key in ("psnr", "ssim"):
            assert method[key] == pytest.approx(np.mean([m[key] for m in found]))
        assert method["ms"]["median"] == pytest.approx(np.mean([m["ms"]["median"] for m in found]))
        for cause, entry in method["by_cause"].items():
            here = [m["by_cause"][cause] for m in found if cause in m["by_cause"]]
            assert entry["psnr"] == pytest.approx(np.mean([h["psnr"] for h in here]))
            assert entry["share"] == pytest.approx(sum(h["share"] for h in here) / 3)
    assert any("different sizes" in n for n in whole["notes"])
    page = (output / "report.html").read_text()
    assert all(f'href="{name}/report.html"' in page for name in single)
    for entry in (*whole["inputs"], whole):
        assert f"{entry['methods']['warp']['psnr']:.2f}" in out
        assert f"{entry['methods']['warp']['psnr']:.2f}" in page


def test_nothing_that_can_be_used(capsys, tmp_path):
    output = tmp_path / "out"
    code, _, err = run(capsys, "evaluate", tmp_path / "a", tmp_path / "b", "--methods", "warp", "--output", output)
    assert code == 2
    assert err.count("does not exist") == err.count("\n") == 2
    assert list(output.iterdir()) == []


@pytest.mark.slow
def test_a_killed_run_goes_on_and_what_is_finished_stays(capsys, scenes, tmp_path, monkeypatch):
    scored, real = [], module.score_window

    def counted(sequence, slot, *rest):
        if len(scored) == stop:
            raise KeyboardInterrupt
        scored.append((sequence.name, slot.number))
        return real(sequence, slot, *rest)

    monkeypatch.setattr(module, "score_window", counted)
    arguments = ["evaluate", "scenes:demo:0", "scenes:demo:1", "--methods", "repeat", "--output", tmp_path]
    arguments += ["--pictures", 0]
    stop = 4
    assert run(capsys, *arguments)[0] == 130
    assert scored == [("demo-0", 1), ("demo-0", 3), ("demo-0", 5), ("demo-1", 1)]
    finished = (tmp_path / "demo-0" / "results.json").stat().st_mtime_ns
    assert not (tmp_path / "results.json").exists()
    scored.clear()
    assert run(capsys, *arguments)[0] == 0
    assert scored == [("demo-1", 3), ("demo-1", 5)]
    assert (tmp_path / "demo-0" / "results.json").stat().st_mtime_ns == finished
    whole = read(tmp_path / "results.json")
    assert [i["frames"] for i in whole["inputs"]] == [3, 3]

    scored.clear()
    assert run(capsys, *arguments[:2], "scenes:demo:1", *arguments[3:])[0] == 0
    assert scored == []
    stop = 100
    assert run(capsys, *arguments, "--length", 4)[0] == 0  # others are finished: fewer frames, whose scores are kept
    assert scored == []
    assert [i["frames"] for i in read(tmp_path / "results.json")["inputs"]] == [2, 2]
    code, _, err = run(capsys, *arguments, "--length", 4, "--size", "32x24")
    assert (code, scored) == (2, [])  # other images
    assert err.count("size was [32, 48], is now [24, 32]") == 2
    assert run(capsys, *arguments, "--length", 4, "--size", "32x24", "--fresh")[0] == 0
    assert len(scored) == 4
    (tmp_path / "demo-1" / "report.html").unlink()
    assert run(capsys, *arguments, "--length", 4, "--size", "32x24")[0] == 0
    assert len(scored) == 4
    assert (tmp_path / "demo-1" / "report.html").exists()


@pytest.mark.slow
def test_exact_frames_survive_a_killed_run(capsys, tmp_path, monkeypatch):
    """Infinite dB are kept as such, and a later run works with them."""

    class Still(Scene):
        def frame(self, number):
            frame = make_frame(0, self.size)
            return dataclasses.replace(frame, motion=np.zeros_like(frame.motion), time=float(number))

    monkeypatch.setattr("jaxtrapolate.scenes.SceneSequence", Still)
    for _ in range(2):
        assert run(capsys, "evaluate", "scenes:still", "--methods", "repeat", "--output", tmp_path)[0] == 0
        assert read(tmp_path / "results.json")["methods"]["repeat"]["psnr"] == "inf"
        (tmp_path / "results.json").unlink()


@pytest.mark.slow
def test_seeds_share_one_compilation(capsys, scenes, tmp_path, monkeypatch):
    loaded = []
    monkeypatch.setattr(inputs_module, "load", lambda name: loaded.append(jx.load(name)) or loaded[-1])
    seeds = [f"scenes:demo:{s}" for s in range(3)]
    arguments = ("--methods", "repeat,warp", "--output", tmp_path, "--pictures", 0)
    assert run(capsys, "evaluate", *seeds, *arguments)[0] == 0
    assert [m.name for m in loaded] == ["repeat", "warp"]
    assert [m._jitted._cache_size() for m in loaded] == [1, 1]
    warps = [i["methods"]["warp"]["psnr"] for i in read(tmp_path / "results.json")["inputs"]]
    assert len(set(warps)) == 3


def scores(psnr, *, ms=1.0, **causes):
    by_cause = {c: CauseScore(p, s) for c, (p, s) in causes.items()}
    return MethodResult(psnr, {"ssim": 0.5}, RunTime(ms, 0.1, 2.0), by_cause)


def test_means_over_inputs_are_on_equal_footing():
    inputs = [
        {"a": scores(20.0, ms=1.0, hole=(10.0, 0.2)), "b": scores(30.0, hole=(12.0, 0.2))},
        {"a": scores(40.0, ms=3.0), "b": scores(50.0)},
        {"a": scores(35.0), "b": scores(math.inf)},  # b is exact here, which would win by far
        {"a": scores(90.0)},  # b cannot run here
    ]
    mean = mean_over_inputs(inputs)
    assert [mean[n].psnr for n in "ab"] == [30.0, 40.0]
    assert [mean[n].inputs for n in "ab"] == [2, 2]
    assert mean["a"].by_cause["hole"] == CauseScore(10.0, pytest.approx(0.1))
    assert mean["a"].ms == RunTime(pytest.approx(2), pytest.approx(0.1), 8.0)
    assert mean_over_inputs([{"a": scores(math.inf)}])["a"].psnr == math.inf
    apart = mean_over_inputs([{"a": scores(1.0)}, {"b": scores(2.0)}])
    assert [apart[n].psnr for n in "ab"] == [1.0, 2.0]


def test_unknown_and_missing_metrics(capsys, scenes, tmp_path, monkeypatch):
    arguments = ("evaluate", "scenes:demo", "--methods", "warp", "--output", tmp_path / "out", "--metrics")
    assert "no metric 'pnsr'; there are psnr, ssim" in refuses(capsys, *arguments, "psnr,pnsr")
    assert "--metrics: expected names" in refuses(capsys, *arguments, ",")

    def missing(extra):
        raise ImportError(f'the package is missing: pip install "jaxtrapolate[{extra}]"')

    monkeypatch.setattr(metrics_module, "check_installed", missing)
    assert 'pip install "jaxtrapolate[flip]"' in refuses(capsys, *arguments, "psnr,flip")
    assert not (tmp_path / "out").exists()


def test_metrics_by_name(capsys, scenes, tmp_path, monkeypatch):
    clips = []

    def distance(made, truth):
        if np.shape(made)[0] < 32:
            raise ValueError("made: expected at least 32 pixels")
        return np.abs(made - truth).mean()

    def clip(made, truth):
        clips.append((list(made), list(truth)))
        return ClipScore(80.0 + len(clips), np.zeros(3))

    found = {
        "psnr": metrics_module.load("psnr"),
        "flip": Metric("flip", distance),
        "flip_hdr": Metric("flip_hdr", distance, space="linear"),
        "vmaf": Metric("vmaf", clip, per="clip", better="higher"),
    }
    monkeypatch.setattr(inputs_module, "load_metric", found.__getitem__)
    arguments = ["evaluate", "scenes:demo", "--methods", "repeat,warp", "--output", tmp_path, "--pictures", 0]
    arguments += ["--metrics", "flip,flip_hdr,vmaf"]
    code, out, _ = run(capsys, *arguments)
    assert code == 0
    assert "FLIP HDR ↓" in out
    results = read(tmp_path / "results.json")
    assert list(results["metrics"]) == ["flip", "flip_hdr", "vmaf"]
    sequence, method = Scene("demo"), jx.load("repeat")
    seen = list(windows(sequence, [1, 3, 5], past=1))
    pairs = [(method(w.history, w.target), w.truth.color) for w in seen]
    shown = [tuple(display(c, hdr=True) for c in pair) for pair in pairs]
    repeat, warp = results["methods"]["repeat"], results["methods"]["warp"]
    assert repeat["flip"] == pytest.approx(np.mean([np.abs(a - b).mean() for a, b in shown]))
    assert repeat["flip_hdr"] == pytest.approx(np.mean([np.abs(a - b).mean() for a, b in pairs]))
    assert "ssim" not in repeat
    assert (repeat["vmaf"], warp["vmaf"]) == (81.0, 82.0)
    for k, (a, b) in enumerate(zip(*clips[0], strict=True)):
        np.testing.assert_array_equal(a, eight_bit(shown[k][0]))
        np.testing.assert_array_equal(b, eight_bit(shown[k][1]))
    page = (tmp_path / "report.html").read_text()
    assert f'<td class="top">{warp["flip"]:.4f}</td>' in page
    assert '<td class="top">82.00</td>' in page

    assert run(capsys, *arguments)[0] == 0
    assert len(clips) == 2  # kept
    assert run(capsys, *arguments, "--size", "48x20", "--fresh")[0] == 0
    small = read(tmp_path / "results.json")
    assert small["methods"]["warp"]["flip"] is None
    assert "flip: made: expected at least 32 pixels" in small["notes"]


def test_installed_metrics(capsys, scenes, tmp_path):
    for package in ("flip_evaluator", "imageio_ffmpeg"):
        pytest.importorskip(package)
    arguments = ("--methods", "repeat,warp", "--output", tmp_path, "--pictures", 0)
    assert run(capsys, "evaluate", "scenes:demo", *arguments, "--metrics", "psnr,flip,vmaf")[0] == 0
    repeat, warp = read(tmp_path / "results.json")["methods"].values()
    assert 0 < warp["flip"] < repeat["flip"] < 1
    assert repeat["vmaf"] < warp["vmaf"] <= 100


def test_video_shows_rendered_and_generated_frames_in_turn(scenes, tmp_path, monkeypatch):
    sequence, method = Scene("demo"), jx.load("warp")
    evaluation = Evaluation.prepare(sequence, {"repeat": jx.load("repeat"), "warp": method}, {}, frames=[3, 5])
    gallery = Gallery(tmp_path, hdr=True)
    evaluation.run(gallery=gallery, keep_all=True)
    pictures, written = [], []
    monkeypatch.setattr(video, "side_by_side", lambda row, labels: pictures.append((row, labels)))
    monkeypatch.setattr(
        video, "write_video", lambda path, frames, **options: written.append((len(list(frames)), options))
    )
    slots = [slot for slot in evaluation.slots if slot.number in (3, 5)]
    labels = {"repeat": "a", "warp": "b"}
    video.write_evaluation_video(tmp_path / "video.webp", sequence, slots, labels, gallery, fps=30)
    assert written == [(4, {"count": 4, "fps": 30})]
    assert all(labels == ["truth", "a", "b"] for _, labels in pictures)
    pictures = [row for row, _ in pictures]
    assert [len(p) for p in pictures] == [3] * 4

    def codes(color):
        return np.round(np.asarray(display(color, hdr=True)) * 255).astype(np.uint8)

    for k, w in enumerate(windows(sequence, [3, 5], past=1)):
        before, made = pictures[2 * k], pictures[2 * k + 1]
        assert all((p == codes(make_frame(w.number - 1, SIZE).color)).all() for p in before)
        np.testing.assert_array_equal(made[0], codes(make_frame(w.number, SIZE).color))
        np.testing.assert_array_equal(made[1], before[0])  # repeat knows no more
        np.testing.assert_array_equal(made[2], codes(method(w.history, w.target)))
        assert (made[2] != made[0]).any()


def test_video_is_written_and_linked(capsys, scenes, tmp_path):
    output = tmp_path / "out"
    arguments = ["evaluate", "scenes:demo", "--methods", "repeat", "--output", output, "--pictures", 0, "--video"]
    assert run(capsys, *arguments)[0] == 0
    with Image.open(output / "video.webp") as image:
        assert image.n_frames == 6
    assert read(output / "results.json")["video"] == "video.webp"
    assert 'href="video.webp"' in (output / "report.html").read_text()
    assert run(capsys, *arguments, tmp_path / "films" / "a.gif", "--fps", 10)[0] == 0
    with Image.open(tmp_path / "films" / "a.gif") as image:
        assert image.n_frames == 6
        assert image.info["duration"] == 100
    assert 'href="../films/a.gif"' in (output / "report.html").read_text()
    several = [*arguments, "gif", "--fresh"]
    several[2:2] = ["scenes:demo:1"]
    assert run(capsys, *several)[0] == 0
    assert (output / "demo-0" / "video.gif").exists()
    assert (output / "demo-1" / "video.gif").exists()


def test_videos_that_cannot_be(capsys, scenes, tmp_path, monkeypatch):
    arguments = ("--methods", "repeat", "--output", tmp_path / "out")
    one = ("evaluate", "scenes:demo", *arguments)
    assert "--video: dump: expected a name of a video" in refuses(capsys, *one, "--video", "dump")
    assert "--fps: expected a number above 0" in refuses(capsys, *one, "--video", "--fps", 0)
    two = ("evaluate", "scenes:demo", "scenes:demo:1", *arguments)
    assert "--video: several inputs have one each" in refuses(capsys, *two, "--video", "a.webp")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert 'pip install "jaxtrapolate[video]"' in refuses(capsys, *one, "--video", "a.mp4")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_speed_of_scenes(tmp_path, capsys):
    main(["scenes", "forest", "--speed", "--size", "33x17", "--json", str(tmp_path / "speed.json")])
    (row,) = json.loads((tmp_path / "speed.json").read_text())["speed"].values()
    assert row["fps"] == pytest.approx(1e3 / row["frame_ms"])
    assert f"| forest | {row['compile_s']:.0f} | {row['frame_ms']:.1f} | {row['fps']:.1f} |" in capsys.readouterr().out
