"""Windows for training against what evaluation hands to methods; seeds, dumps, a network trained on real windows."""

import dataclasses
import pathlib
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from synthetic import make_frame, make_keyframe

import jaxtrapolate as jx
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.windows import Window, arguments, hide
from jaxtrapolate.evaluation.windows import windows as windows_of
from jaxtrapolate.files import open_sequence, write_unreal_frame
from jaxtrapolate.files.tables import parse
from jaxtrapolate.scenes import TEST_SEEDS, SceneSequence, flow, scene
from jaxtrapolate.training import Config, Optimizer, train_and_evaluate
from jaxtrapolate.training import windows as module
from jaxtrapolate.training.augment import crop
from jaxtrapolate.training.journal import read_metrics
from jaxtrapolate.training.windows import SEEDS, VALIDATION_SEEDS, WindowOptions, Windows, _parted, scene_window

SIZE = (22, 34)


def assert_same(first, second, *, skip=("time",), rtol=1e-4, atol=1e-4):
    """Two windows, frame by frame and buffer by buffer; what is absent in one is absent in the other."""
    a, b = (jax.tree_util.tree_flatten_with_path(dataclasses.replace(w, number=0)) for w in (first, second))
    assert a[1] == b[1]
    for (path, x), (_, y) in zip(a[0], b[0], strict=True):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        if name.split(".")[-1] not in skip:
            x, y = np.asarray(x), np.asarray(y)
            assert x.shape == y.shape, name
            wrong = ~np.isclose(x, y, rtol=rtol, atol=atol)
            assert wrong.mean() < 0.002, (name, wrong.mean())  # a ray that just hits or misses


def everything(window, key):
    """Keeps the whole window."""
    return {"window": window, "key": jax.random.key_data(key)}


@pytest.fixture
def cheap(monkeypatch):
    """Windows that name their seed, time and step instead of being rendered; what was asked for."""
    asked = []

    def made(name, seed):
        asked.append((name, seed))
        return jnp.float32(seed)

    monkeypatch.setattr(module, "scene", made)
    monkeypatch.setattr(module, "stack_scenes", jnp.stack)

    def drawn(world, time, step, *, size, past, future, motion):
        image = jnp.zeros((*size, 1)) + jnp.stack([world, time, step])
        return Window(number=0, truth=jx.Frame(color=image), history=(), target=jx.Frame(), future=())

    monkeypatch.setattr(module, "scene_window", drawn)
    return asked


def test_no_seed_is_of_two_kinds(cheap):
    """Training, validation and test: disjoint as ranges, and in what is drawn."""
    assert SEEDS.stop == VALIDATION_SEEDS.start
    assert max(VALIDATION_SEEDS) < min(TEST_SEEDS)
    windows = Windows(WindowOptions(size=(1, 2)), lambda w, key: w.truth.color, past=1)
    windows.pool(jax.random.key(0), range(300))
    assert {seed in SEEDS for _, seed in cheap} == {True}
    assert len({seed for _, seed in cheap}) == 300
    assert {name for name, _ in cheap} == set(module.MOVING)
    cheap.clear()
    assert len(list(windows.held(50))) == 50
    assert {seed in VALIDATION_SEEDS for _, seed in cheap} == {True}


def test_what_windows_are_drawn(cheap):
    """Times, steps, shares of the scenes and flips are as the options say."""
    options = WindowOptions(
        size=(1, 2), scenes=("demo", "head"), weights=(1, 3), step=(0.5, 1.5), time=(10, 20), flip=(0.25, 1.0)
    )
    windows = Windows(options, lambda w, key: (w.truth.color, key), past=1)
    colors, keys = windows.pool(jax.random.key(7), range(400))
    times, steps = np.asarray(colors)[:, 0, 0, 1:].T
    for values, low, high in ((times, 10, 20), (steps, 0.5, 1.5)):
        scaled = (values - low) / (high - low)
        assert ((scaled >= 0) & (scaled <= 1)).all()
        assert abs(scaled.mean() - 0.5) < 0.06
        assert abs(scaled.std() - 12**-0.5) < 0.04
    assert abs(np.mean([name == "head" for name, _ in cheap]) - 0.75) < 0.08
    assert len(np.unique(jax.random.key_data(keys), axis=0)) == 400


@pytest.mark.parametrize("together", [1, 3])
def test_an_example_depends_on_its_number_alone(cheap, together):
    """A pool made in parts, as several hosts make it, is the pool; another key gives another one."""
    options = WindowOptions(size=(1, 2), together=together)
    windows = Windows(options, lambda w, key: (w.truth.color, jax.random.key_data(key)), past=1)
    whole = windows.pool(jax.random.key(1), range(9))
    parts = [windows.pool(jax.random.key(1), r) for r in (range(4), range(4, 5), range(5, 9))]
    joined = jax.tree.map(lambda *a: np.concatenate(a), *parts)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(joined), strict=True):
        assert a.shape[0] == 9
        np.testing.assert_array_equal(a, b)
    other = windows.pool(jax.random.key(2), range(9))
    assert not np.isin(np.asarray(other[0])[..., 0], np.asarray(whole[0])[..., 0]).any()
    names = [name for name, _ in cheap[:9]]
    assert all(len(set(names[i : i + together])) == 1 for i in range(0, 9, together))


@pytest.mark.parametrize("flags", [(0, 0), (1, 0), (0, 1)])
def test_flips(monkeypatch, flags):
    monkeypatch.setattr(module, "scene", lambda name, seed: jnp.float32(seed))
    monkeypatch.setattr(module, "stack_scenes", jnp.stack)
    image = np.random.default_rng(0).random((2, 3, 3), np.float32)

    def drawn(*_, **named):
        return Window(number=0, truth=jx.Frame(color=jnp.asarray(image)), history=(), target=jx.Frame(), future=())

    monkeypatch.setattr(module, "scene_window", drawn)
    options = WindowOptions(size=(2, 3), flip=(float(flags[0]), float(flags[1])))
    made = Windows(options, lambda w, key: w.truth.color, past=1).pool(jax.random.key(0), range(3))
    expected = np.flip(image, [a for a, f in ((1, flags[0]), (0, flags[1])) if f])
    np.testing.assert_array_equal(made, np.stack([expected] * 3))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"size": [0, 3]}, r"size: expected \[H, W\] of at least 1, got \[0, 3\]"),
        ({"scenes": ["moon"]}, "scenes: expected one of 'demo', .*, got 'moon'"),
        ({"scenes": []}, "scenes: expected some, got none"),
        ({"weights": [1.0]}, r"weights: expected a share for each of 9 scenes, got \(1.0,\)"),
        ({"step": [0.0, 1.0]}, r"step: expected \[least, largest\] above 0, got \[0.0, 1.0\]"),
        ({"time": [3, 2]}, r"time: expected \[least, largest\], got \[3.0, 2.0\]"),
        ({"flip": [0.5, 1.5]}, r"flip: expected two probabilities, got \[0.5, 1.5\]"),
        ({"motion": "none"}, "motion: expected one of 'chained', 'direct', got 'none'"),
        ({"together": 0}, "together: expected at least 1, got 0"),
        ({"dumps_share": 1.0}, "dumps: expected some, got none"),
    ],
)
def test_options_that_cannot_be(change, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        parse(WindowOptions, change)


@pytest.fixture(scope="module")
def dump(tmp_path_factory):
    """An Unreal-style dump of eight frames."""
    folder = tmp_path_factory.mktemp("dump")
    for time in range(8):
        write_unreal_frame(folder, "Wall", time, make_frame(time, SIZE), keyframe=make_keyframe(time, SIZE))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("together", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_windows_of_dumps(dump, together):
    """Three of eight frames have five before them: every second one counts as rendered; the last is for validation."""
    options = WindowOptions(dumps=(str(dump),), dumps_share=1.0, flip=(0, 0), together=together)
    windows, seen = Windows(options, everything, past=3), {True: set(), False: set()}
    frame = open_sequence(dump).frame
    for validation, numbers in seen.items():
        made = windows.pool(jax.random.key(0), range(8))["window"]
        single = [jax.tree.map(lambda a, i=i: a[i], made) for i in range(8)]
        for window in list(windows.held(7)) if validation else single:
            number = int(window.number)
            frames = [frame(k) if (number - k) % 2 else hide(frame(k)) for k in range(number - 5, number + 1)]
            expected = Window(number, frame(number), tuple(frames[:-1]), frames[-1], ())
            assert_same(window, jax.tree.map(jnp.asarray, expected), skip=(), rtol=0, atol=0)
            numbers.add(int(window.number))
    assert seen == {False: {5, 6}, True: {7}}


@pytest.mark.parametrize(("count", "training"), [(1, 1), (2, 1), (9, 8), (10, 9), (11, 9), (40, 36)])
def test_the_last_tenth_of_a_dump_is_held_back(count, training):
    numbers = list(range(count))
    seen, held = _parted(numbers)
    assert seen == numbers[:training]
    assert held == (numbers[training:] or numbers)


@pytest.mark.slow
def test_dumps_that_cannot_be(dump, tmp_path):
    def windows(prepare=everything, past=3, **options):
        return Windows(WindowOptions(dumps_share=1.0, **options), prepare, past=past)

    with pytest.raises(InputError, match="has no 10 frames in a row for a window"):
        windows(past=5, dumps=(str(dump),))
    with pytest.raises(InputError, match="does not exist"):
        windows(dumps=(str(tmp_path / "none"),))

    def lacking(window, key):
        raise ValueError("method 'extranet', stage 'network': missing target.roughness")

    with pytest.raises(InputError, match=r"windows of .*: method 'extranet', .*: missing target.roughness"):
        windows(lacking, dumps=(str(dump),)).pool(jax.random.key(0), range(1))
    small = tmp_path / "small"
    small.mkdir()
    for time in range(3):
        write_unreal_frame(small, "Wall", time, make_frame(time, (20, 30)))
    both = windows(lambda w, key: w.truth.color, past=1, dumps=(str(dump), str(small)))
    with pytest.raises(ValueError, match=r"same shapes of every window, got .*\(2\d, 3\d, 3\) and "):
        both.pool(jax.random.key(0), range(16))
    cut = windows(lambda w, key: crop(w.truth.color, key, size=(20, 30)), past=1, dumps=(str(dump), str(small)))
    assert cut.pool(jax.random.key(0), range(16)).shape == (16, 20, 30, 3)


@pytest.mark.slow
@pytest.mark.parametrize("past, future", [(3, 0), (1, 2)])
def test_chained_windows_are_evaluations(past, future):
    """In each scene's own time steps of one: what `windows` reads of the sequence; times count from the target."""
    number = 7
    sequence = SceneSequence("demo", 5, 12, SIZE)
    (expected,) = windows_of(sequence, [number], past=past, future=future)
    draw = jax.jit(scene_window, static_argnames=("size", "past", "future", "motion"))
    made = draw(scene("demo", 5), jnp.float32(number), jnp.float32(1), size=SIZE, past=past, future=future)
    assert_same(made, expected)
    times = [float(f.time) for f in (*made.history, made.target, *made.future)]
    assert times == list(range(1 - 2 * past, max(0, 2 * future - 1) + 1))
    assert float(made.truth.time) == 0


@pytest.mark.slow
def test_direct_windows_lead_from_one_rendered_frame_to_the_next():
    """Against exact flow, at a step that is no whole number; there are no frames between."""
    world, time, step = scene("demo", 5), 20.0, 0.7
    draw = jax.jit(scene_window, static_argnames=("size", "past", "future", "motion"))
    made = draw(world, jnp.float32(time), jnp.float32(step), size=SIZE, past=2, future=2, motion="direct")
    assert [float(f.time) for f in made.history] == [-3, -1]
    assert [float(f.time) for f in made.future] == [1, 3]
    assert all(f.color is not None for f in (*made.history, *made.future, made.truth))
    assert made.target.color is None
    for frame, back in ((made.target, 1), (made.history[1], 2), (made.future[0], 1), (made.future[1], 2)):
        now = time + float(frame.time) * step
        exact = flow(world, now, now - back * step, size=SIZE)[..., :2]
        wrong = np.abs(np.asarray(frame.motion - exact)).max(-1) > 1e-2
        assert wrong.mean() < 0.01


@pytest.mark.slow
def test_pools_of_scenes(monkeypatch):
    """Examples are the windows of their seeds; at once, as on accelerators, they are what they are one by one."""
    asked = []

    def watched(name, seed):
        asked.append(seed)
        return scene(name, seed)

    monkeypatch.setattr(module, "scene", watched)
    options = WindowOptions(size=SIZE, scenes=("demo",), together=2, flip=(0, 0), step=(0.8, 0.8), time=(30, 30))
    pool = Windows(options, everything, past=2).pool(jax.random.key(3), range(2))
    draw = jax.jit(scene_window, static_argnames=("size", "past", "future", "motion"))
    for i in range(2):
        expected = draw(scene("demo", asked[i]), jnp.float32(30), jnp.float32(0.8), size=SIZE, past=2)
        assert_same(jax.tree.map(lambda a, i=i: a[i], pool["window"]), expected, skip=())
    monkeypatch.setattr(jax, "default_backend", lambda: "an accelerator")
    at_once = Windows(options, everything, past=2).pool(jax.random.key(3), range(2))
    for i in range(2):
        assert_same(*(jax.tree.map(lambda a, i=i: a[i], p["window"]) for p in (pool, at_once)), skip=())


DIVIDED = """
import sys
sys.path.insert(0, {tests!r})
import jax, numpy as np
from jaxtrapolate.training.windows import Windows, WindowOptions
assert jax.local_device_count() == {count}
options = WindowOptions(size=(10, 13), scenes=("demo",), together=4)
pool = Windows(options, lambda w, key: w.truth.color, past=1).pool(jax.random.key(0), range(4))
assert len(pool.sharding.device_set) == {count}, pool.sharding
np.save(sys.argv[1], np.asarray(pool))
"""


@pytest.mark.slow
def test_local_devices_share_the_rendering(tmp_path):
    from test_training import ends, run_python

    made = []
    for count in (1, 4):
        path = tmp_path / f"{count}.npy"
        script = DIVIDED.format(tests=str(pathlib.Path(__file__).parent), count=count)
        ends(run_python(script, path, XLA_FLAGS=f"--xla_force_host_platform_device_count={count}"))
        made.append(np.load(path))
    assert (~np.isclose(*made, rtol=1e-4, atol=1e-4)).mean() < 0.002


@dataclasses.dataclass(frozen=True)
class RefineOptions:
    """What the task below is made of."""

    crop: tuple[int, int] = (24, 32)
    windows: WindowOptions = dataclasses.field(default_factory=WindowOptions)


class Refine(nnx.Module):
    """A few convolutions that correct a warp in its holes."""

    def __init__(self, rngs):
        self.first = nnx.Conv(8, 16, (3, 3), rngs=rngs)
        self.norm = nnx.BatchNorm(16, momentum=0.9, rngs=rngs)
        self.second = nnx.Conv(16, 16, (3, 3), rngs=rngs)
        self.last = nnx.Conv(16, 3, (3, 3), kernel_init=nnx.initializers.zeros, rngs=rngs)

    def __call__(self, x):
        y = jax.nn.relu(self.norm(self.first(x)))
        return x[..., :3] + x[..., 3:4] * self.last(jax.nn.relu(self.second(y)))


class RefineTask:
    """Trains it on a method's own stages up to the warp; at first it is the warp, ghosts in holes and all."""

    score, about = "gain", MappingProxyType({})

    def __init__(self, options):
        self.options, self.method = options, jx.load("warp")
        self.windows = Windows(options.windows, self.prepare, past=self.method.past)

    def prepare(self, window, key):
        history, target, _ = arguments(self.method, window)
        values = {"carry": (), "history": history, "target": target, "future": ()}
        for stage in self.method.active(history, target):
            if stage.name == "warp":
                break
            values |= stage(self.method.state, values)
        newest, motion, buffers = values["newest"], values["motion"], target.gbuffer
        warped = jx.backward_warp(jx.demodulate(newest.color, newest.gbuffer), motion)
        holes = jx.hole_masks(buffers, newest.gbuffer, motion, taps="nearest").any.astype(jnp.float32)
        truth = jx.demodulate(window.truth.color, buffers)
        inputs = [jx.log_encode(warped), holes, buffers.normal, buffers.roughness]
        return {"x": jnp.concatenate(inputs, -1), "y": jx.log_encode(truth)}

    def init(self, rngs):
        return Refine(rngs)

    def pool(self, key, numbers):
        return self.windows.pool(key, numbers)

    def sample(self, example, key):
        return crop(example, key, size=self.options.crop)

    def loss(self, model, batch):
        return jnp.mean(jnp.abs(model(batch["x"]) - batch["y"])), {}

    def validate(self, model):
        held = [self.prepare(jax.tree.map(jnp.asarray, window), None) for window in self.windows.held(8)]
        pool = jax.tree.map(lambda *leaves: jnp.stack(leaves), *held)
        made, warped, true, holes = model(pool["x"]), pool["x"][..., :3], pool["y"], pool["x"][..., 3:4]
        error, ghosts = (float(jnp.sum(holes * jnp.abs(v - true)) / jnp.sum(holes) / 3) for v in (made, warped))
        scores = {"gain": ghosts / error, "error": error, "ghosts": ghosts}
        return scores, {"made": jx.tonemap(jx.log_decode(made[0])), "true": jx.tonemap(jx.log_decode(true[0]))}


@pytest.mark.slow
def test_a_network_trained_on_rendered_windows(tmp_path):
    """On seeds that it never saw, its error in holes is less than that of the warp that it is given."""
    options = RefineOptions(windows=WindowOptions(size=(48, 64), scenes=("demo",)))
    settings = Config(
        task="refine",
        options=options,
        steps=400,
        pool=32,
        steps_per_round=100,
        log_every=100,
        checkpoint_every=400,
        validate_every=400,
        ema_decay=0.98,
        optimizer=Optimizer(peak_learning_rate=3e-3, clip=1.0),
    )
    scores = train_and_evaluate(settings, tmp_path, task=RefineTask(options))
    losses = [entry["loss"] for entry in read_metrics(tmp_path) if entry["kind"] == "train"]
    assert losses[-1] < losses[0]
    assert scores["gain"] > 1.3
    assert len(list((tmp_path / "images").iterdir())) == 2


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_bare_windows_have_depth_and_stencil_alone(monkeypatch, share):
    names = ("albedo", "depth", "normal", "stencil")
    frame = jx.Frame(color=jnp.ones((4, 5, 3)), motion=jnp.zeros((4, 5, 2)),
                     gbuffer=jx.GBuffer(**{name: jnp.ones((4, 5, 3)) for name in names}))  # fmt: skip
    window = Window(
        number=0, truth=frame, history=(frame, jx.Frame(motion=frame.motion)), target=hide(frame), future=()
    )
    monkeypatch.setattr(Windows, "_draw", lambda *_: ("walkers", jax.tree.map(lambda a: jnp.asarray(a)[None], window)))

    def prepare(window, key):
        there = {str([name for name in names if getattr(f.gbuffer, name) is not None])
                 for f in (window.truth, window.history[0], window.target)}  # fmt: skip
        assert len(there) == 1
        assert window.history[1].motion is not None
        return jnp.float32("albedo" not in there.pop())

    made = Windows(WindowOptions(size=(4, 5), bare=share), prepare, past=1).pool(jax.random.key(0), range(100))
    assert abs(np.asarray(made).mean() - share) <= (0.15 if 0 < share < 1 else 0)


@pytest.mark.slow
def test_sparse_windows_lack_one_kind_of_buffer_and_lamps_shine(monkeypatch):
    """In all their frames alike, each kind now and then; and what is bright is brighter in some windows."""
    names = ("albedo", "depth", "normal", "stencil", "position", "roughness", "metallic", "sky")
    frame = jx.Frame(color=jnp.full((4, 5, 3), 8.0), motion=jnp.zeros((4, 5, 2)),
                     gbuffer=jx.GBuffer(**{name: jnp.ones((4, 5, 1)) for name in names}))  # fmt: skip
    window = Window(number=0, truth=frame, history=(frame,), target=hide(frame), future=())
    monkeypatch.setattr(Windows, "_draw", lambda *_: ("walkers", jax.tree.map(lambda a: jnp.asarray(a)[None], window)))

    def prepare(window, key):
        lacks = {tuple(n for n in names if getattr(f.gbuffer, n) is None)
                 for f in (window.truth, window.history[0], window.target)}  # fmt: skip
        assert len(lacks) == 1
        kinds = [
            (),
            ("albedo",),
            ("depth",),
            ("normal",),
            ("stencil",),
            ("position",),
            ("roughness", "metallic"),
            ("sky",),
        ]
        kind = jnp.float32(kinds.index(lacks.pop()))
        return jnp.stack([kind, window.truth.color[0, 0, 0], window.history[0].color[0, 0, 0]])

    options = WindowOptions(size=(4, 5), sparse=0.7, lamps=0.5)
    made = np.asarray(Windows(options, prepare, past=1).pool(jax.random.key(0), range(200)))
    assert set(made[:, 0]) == set(range(8))
    assert abs((made[:, 0] > 0).mean() - 0.7) < 0.12
    assert abs((made[:, 1] > 8).mean() - 0.5) < 0.12
    assert made[:, 1].min() == 8
    assert made[:, 1].max() > 500
    np.testing.assert_array_equal(made[:, 1], made[:, 2])
