"""Validation: scores against float64, memory that starts anew, and a new network, which is its first guess."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from synthetic import make_frame
from test_training_extranet import OPTIONS

import jaxtrapolate as jx
from jaxtrapolate.evaluation.windows import Window, hide
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.stage import Stage
from jaxtrapolate.records import replace
from jaxtrapolate.training.extranet import ExtraNetTask
from jaxtrapolate.training.validation import Validation, lean


def decibels(image, truth):
    curve = [np.float64(np.asarray(a)) for a in (image, truth)]
    first, second = ((a / (1 + a)) ** (1 / 2.2) for a in curve)
    return -10 * np.log10(np.mean((first - second) ** 2))


def make_window():
    frames = [replace(jax.tree.map(jnp.asarray, make_frame(k)), time=jnp.float32(k)) for k in range(5)]
    frames = [hide(frame) if k in (1, 3) else frame for k, frame in enumerate(frames)]
    truth = jax.tree.map(jnp.asarray, make_frame(3))
    return Window(number=3, truth=truth, history=tuple(frames[:3]), target=frames[3], future=(frames[4],))


def windows(count):
    """Of frames of different brightness, so that each has dB of its own."""
    given = make_window()

    def dimmed(by):
        def one(frame):
            return frame if frame.color is None else replace(frame, color=frame.color * by)

        parts = {name: tuple(map(one, getattr(given, name))) for name in ("history", "future")}
        return replace(given, truth=one(given.truth), **parts)

    return [lean(dimmed(1 / (1 + k))) for k in range(count)]


def counting():
    """Black at first, then the number of frames since the start as grey: it remembers them."""

    def count(state, values):
        image = jnp.full_like(values["target"].motion[..., :1], 0.1) * values["carry"]
        return {"carry": values["carry"] + 1, "image": jnp.broadcast_to(image, (*image.shape[:2], 3))}

    stage = Stage("count", count, ("carry", "target"), ("carry", "image"), reads=("target.motion",))
    return Method("counting", (stage,), start=lambda history, target: jnp.float32(1))


def test_scores():
    """The mean over windows of each one's dB, and the other method's under its name."""
    given = windows(3)
    validation = Validation(given, "blend", jx.load("blend"))
    scores, images = validation(jx.load("repeat"))
    expected = {
        "psnr": np.mean([decibels(w.history[-1].color, w.truth.color) for w in given]),
        "blend": np.mean([decibels(jx.load("blend")(w.history, w.target, w.future), w.truth.color) for w in given]),
    }
    assert set(scores) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(scores[name], value, atol=1e-3)
    height, width, _ = given[0].truth.color.shape
    assert {name: image.shape for name, image in images.items()} == {
        f"window{i}": (height, 3 * width, 3) for i in range(3)
    }
    np.testing.assert_allclose(images["window0"][:, :width], jx.tonemap(given[0].truth.color), atol=1e-6)


def test_memory_starts_anew_with_each_window():
    given = [replace(w, truth=replace(w.truth, color=np.full_like(w.truth.color, 0.2))) for w in windows(3)]
    scores, _ = Validation(given, "repeat", jx.load("repeat"))(counting())
    np.testing.assert_allclose(scores["psnr"], decibels(np.full((2, 2), 0.1), np.full((2, 2), 0.2)), atol=1e-3)


@pytest.mark.slow
def test_what_is_left_of_a_window():
    """No method's image changes by what `lean` leaves out."""
    given = make_window()
    small = lean(given)
    assert all(isinstance(leaf, np.ndarray | np.generic | int | float) for leaf in jax.tree.leaves(small))
    for name in ("occlusion_warp", "softmax_splat"):
        method = jx.load(name)
        whole, less = (method(w.history, w.target, w.future if method.future else ()) for w in (given, small))
        np.testing.assert_array_equal(whole, less)


def test_weights_are_exchanged_without_compiling():
    method = Method("scaled", (Stage("scale", lambda s, v: {"image": s.weights * v["history"][-1].color},
                                     ("history",), ("image",)),), weights=jnp.float32(1))  # fmt: skip
    window = windows(1)[0]
    first, second = (m(window.history, window.target) for m in (method, method.with_weights(jnp.float32(2))))
    np.testing.assert_allclose(second, 2 * first, rtol=1e-6)
    assert method.with_weights(jnp.float32(2))._jitted is method._jitted
    assert method._jitted._cache_size() == 1


@pytest.mark.slow
@pytest.mark.parametrize("guess", ["warp", "guided"])
def test_a_network_that_corrects_nothing_gains_nothing(guess):
    """With all weights 0 the method's frames are its first guess; other weights give others."""
    preparation = dataclasses.replace(OPTIONS.preparation, first_guess=guess)
    scenes = dataclasses.replace(OPTIONS.windows, scenes=("demo",))
    task = ExtraNetTask(dataclasses.replace(OPTIONS, windows=scenes, preparation=preparation))
    model, other = (task.init(nnx.Rngs(0)) for _ in range(2))
    nnx.update(model, jax.tree.map(jnp.zeros_like, nnx.state(model, nnx.Param)))
    scores, images = task.validate(model)
    assert set(scores) == {"gain", "psnr", "psnr_hole", "guess", "guess_hole"}
    assert abs(scores["gain"]) < 0.02
    assert abs(scores["psnr_hole"] - scores["guess_hole"]) < 0.02
    assert scores["psnr_hole"] < scores["psnr"] > 15
    assert len(images) == 2
    assert abs(task.validate(other)[0]["gain"]) > 0.1
