"""Stages: the frames that they run on, and the carry of a method with memory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import make_frame

import jaxtrapolate as jx
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.methods import Method, Stage
from jaxtrapolate.methods.method import rendered
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
        Stage("along", along, reads=("target.motion",), past=0, on="both"),
        Stage("accumulate", accumulate, past=0, on="rendered"),
        Stage("show", show, past=0),
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
    method = Method(
        "hosted", (Stage("double", lambda state, values: {"image": 2 * values["image"]}, past=0, on="both", host=True),)
    )
    np.testing.assert_array_equal(method((), Frame(color=jnp.ones((2, 3, 3)))), np.full((2, 3, 3), 2))


def test_super_sampling_needs_stages_for_rendered_frames():
    stage = Stage(
        "repeat",
        lambda state, values: {"image": jnp.repeat(jnp.repeat(values["target"].color, 2, 0), 2, 1)},
        past=0,
        on="rendered",
    )
    with pytest.raises(ValueError, match="method 'double': expected stages that super sample"):
        Method("double", (Stage("repeat", stage.function),), scale=2)
    method = Method("double", (stage,), scale=2)
    assert method((), Frame(color=jnp.ones((2, 3, 3)))).shape == (4, 6, 3)
