"""Frames of two sizes, jittered ones, and cuts: what methods that super sample are handed and compared with."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import look, perspective
from rich.console import Console
from synthetic import SyntheticSequence, make_frame, make_keyframe

import jaxtrapolate as jx
from jaxtrapolate.commands.evaluate import Request, evaluate_into
from jaxtrapolate.commands.tables import print_table
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.evaluate import Evaluation
from jaxtrapolate.evaluation.pictures import Gallery
from jaxtrapolate.evaluation.schedule import held_back_slots
from jaxtrapolate.evaluation.score import causes_of, mean_over_inputs
from jaxtrapolate.evaluation.windows import arguments, windows
from jaxtrapolate.files import open_sequence, read_png, runs, write_exr, write_unreal_frame
from jaxtrapolate.methods import Method, Stage
from jaxtrapolate.ops.causes import CAUSES
from jaxtrapolate.ops.jitter import on_own_pixels, shift_camera
from jaxtrapolate.results import Results
from jaxtrapolate.scenes import SceneSequence
from jaxtrapolate.scenes.sequence import jitter_of

SIZE = (32, 48)


class Pair(SyntheticSequence):
    """Frames of two sizes: the larger ones are other frames, so that no one is taken for the other."""

    def __init__(self, numbers=range(8)):
        super().__init__(numbers, SIZE)
        self.larger = SyntheticSequence(numbers, (64, 96), fog=0.3)


def twice():
    """The warped newest frame, each pixel four times."""

    def function(state, values):
        image = jx.backward_warp(values["history"][-1].color, values["target"].motion)
        return {"image": image.repeat(2, 0).repeat(2, 1)}

    stages = (
        Stage(
            "twice",
            function,
            ("history", "target"),
            ("image",),
            reads=("target.motion", "history.color"),
            on="generated",
        ),
        Stage("again", again, ("target",), ("image",), past=0, on="rendered"),
    )
    return Method("twice", stages, scale=2)


def again(state, values):
    return {"image": values["target"].color.repeat(2, 0).repeat(2, 1)}


def test_scores_causes_and_pictures_at_output_size(tmp_path):
    sequence = Pair()
    evaluation = Evaluation.prepare(sequence, {"twice": twice(), "warp": jx.load("warp")}, {})
    gallery = Gallery(tmp_path, hdr=True)
    results = evaluation.run(gallery=gallery, keep_all=True)
    for k, window in enumerate(windows(sequence, [1, 3, 5, 7], past=1)):
        image = twice()(*arguments(twice(), window))
        truth = make_frame(window.number, (64, 96), fog=0.3).color
        expected = float(jx.psnr(jx.tonemap(image), jx.tonemap(jnp.asarray(truth))))
        assert results.methods["twice"].frames[k].psnr == pytest.approx(expected, abs=1e-4)
    assert sum(c.share for c in results.methods["twice"].by_cause.values()) == pytest.approx(1)
    assert set(results.methods["twice"].by_cause) & {"hole", "edge"}
    assert gallery.codes("twice", 3).shape == (64, 96, 3)
    assert gallery.codes("warp", 3).shape == (32, 48, 3)
    assert any("scored at the size of its own output: 48x32 and 96x64" in note for note in results.notes)
    alone = jx.evaluate(SyntheticSequence(range(8), SIZE), ["warp"])
    assert alone.methods["warp"].psnr == pytest.approx(results.methods["warp"].psnr, abs=1e-5)


@pytest.mark.slow
def test_rendered_frames_of_a_method_that_super_samples_are_scored_apart(tmp_path, capsys):
    sequence, calls = Pair(), []

    def counted(state, values):
        calls.append(1)
        return again(state, values)

    stage = Stage("again", counted, ("target",), ("image",), past=0, on="rendered", host=True)
    method = Method("twice", (twice().stages[0], stage), scale=2)
    request = Request({"twice": method, "warp": jx.load("warp")}, pictures=1)
    results = evaluate_into(sequence, request, tmp_path / "out", step=lambda *_: None)
    found, alone = results.methods["twice"], jx.evaluate(Pair(), {"warp": jx.load("warp")}).methods["warp"]
    assert [(f.number, f.distance) for f in found.rendered] == [(2, 0), (4, 0), (6, 0)]
    for frame in found.rendered:
        image = make_frame(frame.number, SIZE).color.repeat(2, 0).repeat(2, 1)
        truth = make_frame(frame.number, (64, 96), fog=0.3).color
        expected = float(jx.psnr(jx.tonemap(image), jx.tonemap(truth)))
        assert frame.psnr == pytest.approx(expected, abs=1e-4)
        assert sum(c.share for c in frame.by_cause.values()) == pytest.approx(1)
    assert [f.number for f in found.frames] == [1, 3, 5, 7]
    assert found.psnr == pytest.approx(np.mean([f.psnr for f in found.frames]))
    assert found.by_distance == pytest.approx({0: np.mean([f.psnr for f in found.rendered]), 1: found.psnr})
    assert found.drift is None
    assert results.methods["warp"].rendered == ()
    assert results.methods["warp"].psnr == pytest.approx(alone.psnr)
    assert any("twice: rendered frames are super sampled too" in note for note in results.notes)
    assert Results.from_json(json.loads(json.dumps(results.to_json()))) == results
    count = len(calls)
    again_results = evaluate_into(sequence, request, tmp_path / "out", step=lambda *_: None)
    assert len(calls) == count
    assert again_results.methods["twice"].rendered == found.rendered
    print_table(results, Console(width=200))
    assert "rendered" in capsys.readouterr().out
    over = mean_over_inputs([results.methods, results.methods])
    assert over["twice"].by_distance == pytest.approx(found.by_distance)
    assert over["warp"].by_distance == {}
    assert jx.evaluate(sequence, {"twice": twice()}, frames=[3]).methods["twice"].rendered == ()


def test_a_method_that_cannot_super_sample_these_frames_is_left_out():
    stage = Stage("again", again, ("target",), ("image",), reads=("target.sky",), past=0, on="rendered")
    methods = {"twice": Method("twice", (twice().stages[0], stage), scale=2), "warp": jx.load("warp")}
    assert "missing target.sky" in jx.evaluate(Pair(), methods).skipped["twice"]


def test_a_method_without_truth_of_its_size_is_left_out():
    results = jx.evaluate(SyntheticSequence(range(8)), {"twice": twice(), "warp": jx.load("warp")})
    assert "2 times as large" in results.skipped["twice"]
    assert list(results.methods) == ["warp"]


@pytest.mark.slow
def test_scenes_of_two_sizes():
    sequence = SceneSequence("demo", frames=3, size=(18, 32), jittered=True, scale=2, larger_samples=4)
    frame, larger = sequence.frame(1), sequence.larger.frame(1)
    assert frame.color.shape == (18, 32, 3)
    assert larger.color.shape == (36, 64, 3)
    np.testing.assert_array_equal(frame.jitter, jitter_of(1))
    assert larger.jitter is None
    assert sequence.scale == 2
    plain = SceneSequence("demo", frames=3, size=(18, 32))
    assert plain.identity() != sequence.identity()
    np.testing.assert_allclose(larger.motion[::2, ::2].mean() / frame.motion.mean(), 2, rtol=0.1)


def test_jitter_is_spread_evenly():
    points = np.stack([jitter_of(n) for n in range(16)])
    assert (np.abs(points) <= 0.5).all()
    assert np.abs(points.mean(0)).max() < 0.07
    assert len(np.unique(points, axis=0)) == 16
    np.testing.assert_array_equal(jitter_of(0), jitter_of(16))


def waves(x, y):
    return np.stack([np.sin(0.3 * x + 0.2 * y), np.cos(0.25 * x), np.sin(0.2 * y + 1)], -1).astype(np.float32)


@pytest.mark.slow
def test_a_jittered_frame_is_fetched_where_its_samples_are():
    """Against the function that was sampled: pixel p of a frame shows p + jitter, and all moves by 1.5 a frame."""
    y, x = np.mgrid[0:24, 0:32].astype(np.float64)
    jitters = [np.float32([0.4, -0.3]), np.float32([-0.2, 0.45]), np.float32([0.1, 0.2])]

    def frame(k, colored=True):
        color = waves(x + jitters[k][0] - 1.5 * k, y + jitters[k][1])
        motion = np.broadcast_to(np.float32([-1.5, 0]), (24, 32, 2))
        return jx.Frame(color=color if colored else None, motion=motion, jitter=jitters[k])

    frames = on_own_pixels([frame(0), frame(1, colored=False), frame(2)])
    motion = jx.chain_motion(frames[2].motion, frames[1].motion)
    found = np.asarray(jx.backward_warp(frames[0].color, motion, filter="bicubic"))
    np.testing.assert_allclose(found[4:-4, 6:-4], frame(2).color[4:-4, 6:-4], atol=3e-3)
    unaware = np.asarray(
        jx.backward_warp(frames[0].color, jnp.full((24, 32, 2), jnp.float32([-3, 0])), filter="bicubic")
    )
    assert np.abs(unaware - frame(2).color)[4:-4, 6:-4].max() > 0.05


@pytest.mark.parametrize(
    "name", ["warp", "guided_warp", pytest.param("bidirectional", marks=pytest.mark.slow), "blend"]
)
def test_methods_fetch_jittered_frames_where_their_samples_are(name):
    """A picture that stands still, sampled elsewhere each frame: what is generated lies on the target's pixels."""
    y, x = np.mgrid[0:24, 0:32].astype(np.float64)

    def frame(k, *, jitter):
        ones, still = np.ones((24, 32, 1), np.float32), np.zeros((24, 32, 2), np.float32)
        buffers = jx.GBuffer(albedo=np.full((24, 32, 3), 0.5, np.float32), depth=5 * ones, stencil=0 * ones)
        color = 1 + 0.5 * waves(x + jitter[0], y + jitter[1])
        return jx.Frame(
            color=color.astype(np.float32), gbuffer=buffers, motion=still, jitter=np.float32(jitter), time=float(k)
        )

    frames = [frame(0, jitter=(0.3, 0.2)), frame(1, jitter=(-0.4, 0.1)), frame(2, jitter=(0.25, -0.3))]
    target = jx.replace(frames[1], color=None)
    given = [*map(lambda f: jax.tree.map(jnp.asarray, f), (frames[0], target, frames[2]))]
    method = jx.load(name)
    future = (given[2],) if method.future else ()
    image = np.asarray(method((given[0],), given[1], future))
    error = np.abs(image - frames[1].color)[4:-4, 4:-4].max()
    assert (error < 0.02) == (name != "blend"), error  # blend fetches nothing: it mixes pixel by pixel


def test_causes_of_jittered_frames():
    """All stands still; the newest frame's samples lie 0.8 pixels left of the target's: the last column leads out."""

    class Still(SyntheticSequence):
        def frame(self, number):
            jitter = np.float32([0.4 if number % 2 else -0.4, 0])
            return jx.replace(make_frame(0, self.size), motion=np.zeros((*self.size, 2), np.float32), jitter=jitter)

        def keyframe(self, number):
            return None

    sequence = Still(range(4))
    (window,) = windows(sequence, [1], past=1)
    border = causes_of(sequence, window) == CAUSES.index("border")
    assert border[:, -1].all()
    assert not border[:, :-1].any()


def test_a_jittered_camera_projects_to_pixels():
    camera = jx.Camera(look(0.1).astype(np.float32), perspective(*SIZE).astype(np.float32))
    rng = np.random.default_rng(0)
    position = np.float32(rng.uniform(-1, 1, (*SIZE, 3)) - [0, 0, 5])
    jitter = jnp.float32([0.3, -0.4])
    other = jx.Camera(look(-0.1).astype(np.float32), camera.projection)
    plain = jx.camera_motion(position, camera, other)
    both = jx.camera_motion(position, shift_camera(camera, jitter, SIZE), shift_camera(other, jitter, SIZE))
    np.testing.assert_allclose(both, plain, atol=1e-3)
    there = jx.camera_motion(position, camera, shift_camera(other, jitter, SIZE))
    np.testing.assert_allclose(there - plain, np.broadcast_to(-jitter, there.shape), atol=1e-3)


def test_without_jitter_nothing_changes():
    frames = tuple(make_frame(k) for k in range(3))
    assert all(a is b for a, b in zip(on_own_pixels(frames), frames, strict=True))


def dumped(folder, size, times=range(4)):
    folder.mkdir(parents=True)
    for time in times:
        frame = make_frame(time, size)
        write_unreal_frame(folder, "Wall", time, frame, keyframe=make_keyframe(time, size), half=False)
    return folder


def test_dumps_of_two_sizes_and_cuts(tmp_path):
    small = dumped(tmp_path / "small", SIZE)
    dumped(tmp_path / "large", (64, 96))
    toml = small / "jaxtrapolate.toml"
    toml.write_text('larger = "../large"\ncuts = [2]\n')
    sequence = open_sequence(small)
    assert sequence.scale == 2
    assert runs(sequence) == (range(0, 2), range(2, 4))
    assert [s.number for s in held_back_slots(sequence, past=1) if s.first] == [0, 2]
    results = jx.evaluate(sequence, {"twice": twice()})
    assert results.frames == (1, 3)
    assert not any("gap" in note for note in results.notes)
    for text, message in (
        ('larger = "../small"', "expected frames a whole number of times as large as 48x32, got 48x32"),
        ("cuts = [9]", "cuts: there is no frame 9"),
        ('cuts = ["a"]', "cuts: expected a list of whole numbers"),
        ('larger = "../none"', "none"),
    ):
        toml.write_text(text)
        with pytest.raises(InputError, match=message):
            open_sequence(small)
    toml.write_text('larger = "../large"')
    (tmp_path / "large" / "WallBaseColor.0003.exr").unlink()
    for path in (tmp_path / "large").glob("*.0003.exr"):
        path.unlink()
    with pytest.raises(InputError, match="has no frame 3"):
        open_sequence(small)


def test_pictures_of_two_sizes_are_png(tmp_path):
    evaluation = Evaluation.prepare(Pair(), {"twice": twice()}, {}, frames=[3])
    gallery = Gallery(tmp_path, hdr=True)
    evaluation.run(gallery=gallery, keep_all=True)
    (window,) = windows(Pair(), [3], past=1)
    described = gallery.describe(Pair(), window, ["twice"])
    assert read_png(tmp_path / described["methods"]["twice"]["error"]).shape == (64, 96, 3)


@pytest.mark.slow
def test_larger_frames_that_have_changed_are_noticed(tmp_path):
    """What scores depend on, as much as the frames themselves."""
    small, large = dumped(tmp_path / "small", SIZE), dumped(tmp_path / "large", (64, 96))
    (small / "jaxtrapolate.toml").write_text('larger = "../large"\n')
    request = Request({"twice": twice()}, pictures=0)

    def run(output):
        return evaluate_into(open_sequence(small), request, tmp_path / output, step=lambda *_: None)

    first = run("a").methods["twice"].psnr
    assert run("a").methods["twice"].psnr == first
    write_exr(large / "WallPreTonemapHDRColor.0001.exr", np.zeros((64, 96, 3), np.float32))
    with pytest.raises(InputError, match=r"WallPreTonemapHDRColor\.0001\.exr \(frame 1 of the input\) has changed"):
        run("a")
    assert run("b").methods["twice"].psnr < first


def test_larger_frames_are_read_for_methods_that_are_scored_by_them_alone(monkeypatch):
    sequence, read = Pair(), []
    real = sequence.larger.frame
    monkeypatch.setattr(sequence.larger, "frame", lambda number: read.append(number) or real(number))
    jx.evaluate(sequence, ["warp"])
    assert read == []
    jx.evaluate(sequence, {"twice": twice()}, frames=[3])
    assert 3 in read
