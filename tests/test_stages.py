"""Stages: the frames that they run on, the carry of a method with memory, what they take and give."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow_rows
from synthetic import make_frame

import jaxtrapolate as jx
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.methods import Method, Needed, Stage, default_methods
from jaxtrapolate.methods.frames import rendered
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.records import Frame, replace

SIZE = (12, 18)


@settings
class MeanSettings:
    weight: float = option(0.3, "of the frame rendered last", low=0, high=1)


def running_mean():
    """The mean of what was rendered, carried along the motion; a generated frame is that mean, moved on."""

    def along(state, values):
        return {"moved": jx.backward_warp(values["carry"], values["target"].motion)}

    def accumulate(state, values):
        mean = values["moved"] + state.settings.weight * (values["image"] - values["moved"])
        return {"carry": mean, "image": mean}

    def show(state, values):
        return {"carry": values["moved"], "image": values["moved"]}

    def start(history, target):
        frames = (*history, target)
        return jnp.asarray(frames[rendered(frames)[0]].color)

    stages = (
        Stage("along", along, ("carry", "target"), ("moved",), reads=("target.motion",), past=0, on="both"),
        Stage("accumulate", accumulate, ("moved", "image"), ("carry", "image"), past=0, on="rendered"),
        Stage("show", show, ("moved",), ("carry", "image"), past=0),
    )
    return Method("running_mean", stages, settings=MeanSettings(), start=start)


def sequence(count=12):
    """Frames of which every second one is rendered, the first one too."""
    frames = [jax.tree.map(jnp.float32, make_frame(time, SIZE)) for time in range(count)]
    return [frame if time % 2 == 0 else hide(frame) for time, frame in enumerate(frames)]


def scanned(method, state, frames):
    """The images of a sequence by `lax.scan`, a rendered frame and a generated one a step."""
    stacked = [jax.tree.map(lambda *a: jnp.stack(a), *frames[first::2]) for first in (0, 1)]

    def step(carry, pair):
        carry, first = method.function(state, carry, (), pair[0])
        carry, second = method.function(state, carry, (pair[0],), pair[1])
        return carry, jnp.stack([first, second])

    images = jax.lax.scan(step, method.init((), frames[0]), tuple(stacked))[1]
    return images.reshape(-1, *images.shape[2:])


def test_a_method_with_memory_by_steps_and_by_scan():
    """Against the same, a frame at a time; both ways are the same to the bit."""
    method, frames = running_mean(), sequence()
    assert method.memory
    carry, mean, stepped = method.init((), frames[0]), jnp.asarray(frames[0].color), []
    for place, frame in enumerate(frames):
        history = (frames[place - 1],) if frame.color is None else ()
        carry, image = method.step(carry, history, frame)
        stepped.append(image)
        mean = jx.backward_warp(mean, frame.motion)
        if frame.color is not None:
            mean = 0.7 * mean + 0.3 * frame.color
        np.testing.assert_allclose(image, mean, atol=1e-5)
    assert method._jitted._cache_size() == 2
    images = jax.jit(lambda state, frames: scanned(method, state, frames))(method.state, frames)
    np.testing.assert_array_equal(images, np.stack(stepped))


def test_the_blend_weight_is_fitted_by_gradient():
    method, frames = running_mean(), sequence()
    truth = jnp.stack([jnp.asarray(make_frame(time, SIZE).color) for time in range(len(frames))])
    slope = jax.jit(jax.grad(lambda state: jnp.mean(jnp.square(scanned(method, state, frames) - truth))))
    gradient = slope(method.state)
    assert np.isfinite(gradient.settings.weight)
    assert gradient.settings.weight != 0


def test_stages_are_chosen_by_the_target():
    method, frames = running_mean(), sequence(3)
    names = [[s.name for s in method.active((), frame)] for frame in frames[:2]]
    assert names == [["along", "accumulate"], ["along", "show"]]
    still = replace(frames[2], motion=None)
    assert method.missing((), still) == {"along": ["target.motion"]}
    with pytest.raises(ValueError, match=r"stage 'along': missing target\.motion"):
        method.step(method.init((), still), (), still)
    with pytest.raises(ValueError, match="expected a frame with colour"):
        method.step(method.init((), frames[0]), (), frames[1])


def test_a_method_without_stages_for_rendered_frames_returns_them():
    method, frame = jx.load("warp"), make_frame(0, SIZE)
    assert not method.memory
    assert method.active((), frame) == ()
    assert method.missing((), frame) == {}
    carry, image = method.step((), (), replace(frame, motion=None, gbuffer=None))
    assert carry == ()
    np.testing.assert_array_equal(image, frame.color)
    carry, image = method.function((), 7, (), frame)
    assert carry == 7
    np.testing.assert_array_equal(image, frame.color)


def test_a_stage_on_the_host_for_rendered_frames():
    stage = Stage(
        "double", lambda s, values: {"image": 2 * values["image"]}, ("image",), ("image",), past=0, on="rendered"
    )
    method = Method("hosted", (dataclasses.replace(stage, host=True),))
    np.testing.assert_array_equal(method((), Frame(color=jnp.ones((2, 3, 3)))), np.full((2, 3, 3), 2))


def test_super_sampling_needs_stages_for_rendered_frames():
    def twice(state, values):
        return {"image": jnp.repeat(jnp.repeat(values["target"].color, 2, 0), 2, 1)}

    stage = Stage("repeat", twice, ("target",), ("image",), past=0)
    with pytest.raises(ValueError, match="method 'double': expected stages that super sample"):
        Method("double", (stage,), scale=2)
    method = Method("double", (dataclasses.replace(stage, on="rendered"),), scale=2)
    assert method((), Frame(color=jnp.ones((2, 3, 3)))).shape == (4, 6, 3)
    frame = make_frame(0, SIZE)
    with pytest.raises(ValueError, match="method 'double': generates no frames"):
        method((frame,), hide(frame))


# What stages take and give


def stage(name, takes, gives, **options):
    """One that gives images of ones."""
    ones = dict.fromkeys(gives.split(), jnp.ones((*SIZE, 3)))
    return Stage(name, lambda state, values: ones, tuple(takes.split()), tuple(gives.split()), **options)


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ([stage("a", "light", "image")], "stage 'a': takes 'light', which no stage gives before it"),
        ([stage("a", "light", "image"), stage("b", "", "light")], "takes 'light', which no stage gives"),
        (
            [stage("a", "", "light", optional=True), stage("b", "light", "image")],
            "stage 'b': takes 'light', which only opt",
        ),
        ([stage("a", "image", "image")], "stage 'a': takes 'image', which no stage gives"),
        ([stage("a", "", "light")], "expected a stage that gives 'image'"),
        ([stage("a", "", "image", optional=True)], "expected a stage that gives 'image' and is not optional"),
        ([stage("a", "", "image"), stage("a", "", "light")], "expected stages with names of their own, got a, a"),
        ([stage("a", "", "image", optional=True, group="g")], "stage 'a': expected group 'g' to have several"),
        ([stage("a", "", "image", group="g"), stage("b", "", "image", group="g")], "all optional"),
    ],
)
def test_methods_that_cannot_be_put_together(stages, message):
    with pytest.raises(ValueError, match=f"method 'm'.*{message}"):
        Method("m", tuple(stages))


def test_a_stage_gives_what_it_says():
    frame = make_frame(0, SIZE)
    wrong = Stage("wrong", lambda state, values: {"picture": values["history"][0].color}, ("history",), ("image",))
    with pytest.raises(ValueError, match="stage 'wrong': expected to give image, got picture"):
        Method("m", (wrong,))((frame,), hide(frame))


def test_a_stage_sees_what_it_takes():
    seen = []

    def look(state, values):
        seen.append(dict(values))
        return {"image": values["light"]}

    frame = make_frame(0, SIZE)
    method = Method("m", (stage("a", "", "light dark"), Stage("look", look, ("light", "sky?"), ("image",))))
    method((frame,), hide(frame))
    assert list(seen[0]) == ["light", "sky"]
    assert seen[0]["sky"] is None


def test_what_is_left_out_with_what():
    """A stage without its buffer; what takes what it gives; and its group."""
    history, target = (make_frame(0, SIZE),), hide(make_frame(1, SIZE))
    stages = (
        stage("a", "", "light", optional=True, reads=("target.shadow",)),
        stage("b", "light", "lit", optional=True, group="g"),
        stage("c", "", "dark", optional=True, group="g"),
        stage("instead", "", "dark", fallback=True),
        stage("d", "dark lit?", "image"),
    )
    method = Method("m", stages)
    assert [s.name for s in method.active(history, target)] == ["instead", "d"]
    assert method.missing(history, target) == {
        "a": ["target.shadow"],
        "b": ["light of stage 'a'"],
        "c": ["stage 'b'"],
    }
    shadowed = replace(target, gbuffer=replace(target.gbuffer, shadow=target.gbuffer.depth))
    assert [s.name for s in method.active(history, shadowed)] == ["a", "b", "c", "d"]
    assert method.missing(history, shadowed) == {}
    assert [s.name for s in method.without("a").stages] == ["instead", "d"]
    assert [s.name for s in method.without("c").stages] == ["a", "instead", "d"]
    with pytest.raises(ValueError, match="method 'm': expected one of its optional stages a, b, c, got 'd'"):
        method.without("d")


def test_a_fallback_that_is_needed_lacks_its_buffers():
    history, target = (make_frame(0, SIZE),), hide(make_frame(1, SIZE))
    stages = (
        stage("a", "", "image", optional=True, reads=("target.depth",)),
        stage("instead", "", "image", fallback=True, reads=("target.shadow",)),
    )
    method = Method("m", stages)
    assert method.missing(history, target) == {}
    flat = replace(target, gbuffer=replace(target.gbuffer, depth=None))
    assert list(method.missing(history, flat)) == ["a", "instead"]
    with pytest.raises(ValueError, match=r"stage 'instead': missing target\.shadow"):
        method.active(history, flat)


def lit(time):
    """A frame in constant white light: its colour is its albedo."""
    frame = make_frame(time, (32, 48))
    none = np.zeros_like(frame.gbuffer.depth)
    gbuffer = replace(frame.gbuffer, sky=none, sky_color=np.zeros_like(frame.color))
    return replace(frame, color=frame.gbuffer.albedo, gbuffer=gbuffer)


OPTIONAL = [(name, s.name) for name in default_methods() for s in jx.load(name).stages if s.optional]


LONG = ("guided_net", "bidirectional_guided", "shading_warp", "bidirectional_shading")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "left_out"), [pytest.param(*p, marks=pytest.mark.slow) if p[0] in LONG else p for p in OPTIONAL]
)
def test_any_optional_stage_may_be_left_out(name, left_out):
    """Never is light shown that was not multiplied by the reflectance again: that would be white."""
    whole = jx.load(name)
    method = whole.without(left_out)
    assert left_out not in [s.name for s in method.stages]
    camera = jx.Camera(np.eye(4, dtype=np.float32), np.eye(4, dtype=np.float32))
    cameras = left_out in ("linear motion", "camera motion", "change of depth")
    place = max(5, 2 * method.past - 1)
    frames = [replace(lit(time), camera=camera) if cameras else lit(time) for time in range(place + 2)]
    shown = [frame if time % 2 == 0 else hide(frame) for time, frame in enumerate(frames)]
    dark = np.zeros_like(frames[place].color)
    target = replace(shown[place], gbuffer=replace(shown[place].gbuffer, sky_color=dark))
    past, next = 2 * method.past - 1, place + 1
    given = tuple(shown[place - past : place]), target, tuple(shown[next : next + 2 * method.future])
    (stage,) = (s for s in whole.stages if s.name == left_out)
    shown_target = replace(target, color=frames[place].color) if stage.on == "rendered" else target
    assert left_out in [s.name for s in whole.active(given[0], shown_target, given[2])]
    image = method(*given)
    assert np.isfinite(image).all()
    if left_out != "linear motion":  # the cameras of these frames do not move
        assert jx.psnr(image, frames[place].color) > 18


def test_a_stage_runs_where_it_is_needed():
    """The count is of the branch that was taken: by a callback of the compiled program."""
    runs = []

    def costly(state, values):
        jax.debug.callback(lambda: runs.append(1))
        return {"image": 2 * values["history"][-1].color}

    needed = Needed(
        "anything moves",
        lambda state, values: jnp.any(values["target"].motion != 0),
        lambda state, values: {"image": values["history"][-1].color},
    )
    stages = (Stage("costly", costly, ("history", "target"), ("image",), reads=("history.color",), needed=needed),)
    method = Method("spared", stages)
    frame = Frame(color=jnp.ones((4, 6, 3)), time=0.0)
    for motion, expected in ((0.0, 1.0), (1.0, 2.0)):
        image = method((frame,), Frame(motion=jnp.full((4, 6, 2), motion), time=1.0))
        np.testing.assert_array_equal(image, jnp.full((4, 6, 3), expected))
        jax.effects_barrier()
        assert len(runs) == motion


@pytest.mark.slow
@pytest.mark.parametrize("name, stage", [("occlusion_warp", "occlusion motion"), *slow_rows(("guided_net", "network"))])
def test_what_is_spared_gives_the_same(name, stage):
    """Without the test the image is the same: in frames that stand still, and in frames that do not."""
    method = jx.load(name)
    spared = dataclasses.replace(
        method, stages=tuple(dataclasses.replace(s, needed=None) if s.name == stage else s for s in method.stages)
    )
    assert [s.needed is None for s in method.stages if s.name == stage] == [False]
    moving = [jax.tree.map(jnp.float32, make_frame(time, SIZE)) for time in range(3)]
    still = [replace(moving[0], motion=jnp.zeros((*SIZE, 2)), time=jnp.float32(time)) for time in range(3)]
    for frames in (moving, still):
        given = tuple(frames[:2]), hide(frames[2])
        np.testing.assert_allclose(method(*given), spared(*given), rtol=2e-6, atol=2e-6)
    np.testing.assert_array_equal(method(*given), still[0].color)
