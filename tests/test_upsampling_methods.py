"""Baselines that super sample, as methods: rendered frames, extrapolated ones, jitter, memory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow
from oracles import random
from small_extranet import make_window
from test_temporal import disc, loop

import jaxtrapolate as jx
from jaxtrapolate.ops.upsample import easu, upsample

SIZE = (9, 13)


def compressed(color):
    color = np.maximum(np.float64(color), 0)
    return np.sqrt(color / (1 + color))


@pytest.mark.parametrize("name", ["bilinear", "bicubic"])
def test_a_rendered_frame_is_upsampled_at_its_jitter(name):
    frame = jx.Frame(color=jnp.asarray(random(5, 7, 3)), jitter=jnp.asarray([0.3, -0.2]))
    found = jx.load(name, space="linear")((), frame)
    np.testing.assert_allclose(found, upsample(frame.color, filter=name, jitter=frame.jitter), atol=1e-6)


def test_easu_works_after_a_tone_curve():
    frame = jx.Frame(color=jnp.asarray(random(5, 7, 3, high=4.0)))
    found = compressed(jx.load("easu")((), frame))
    np.testing.assert_allclose(found, easu(jnp.asarray(np.float32(compressed(frame.color)))), atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bicubic", *slow("bilinear")])
def test_another_frame_is_the_guided_warp_upsampled(name):
    history, target = make_window(SIZE, rendered=2)
    small = jx.load("guided_warp", space="linear")(history, target)
    found = jx.load(name, space="linear")(history, target)
    np.testing.assert_allclose(found, upsample(small, filter=name), rtol=1e-4, atol=1e-5)


def test_the_first_answer_of_taau_and_the_next_against_the_loop():
    """Two rendered frames that stand still, with jitter: the second is mixed into the first's answer."""
    shifts = np.float32([[0.2, -0.3], [-0.4, 0.1]])
    motion = jnp.zeros((*SIZE, 2))
    frames = [
        jx.Frame(color=jnp.asarray(random(*SIZE, 3, seed=k, high=3.0)), jitter=jnp.asarray(s), motion=motion)
        for k, s in enumerate(shifts)
    ]
    method = jx.load("taau", weight=0.3, rectify="clamp")
    carry, first = method.step(method.init((), frames[0]), (), frames[0])
    nothing = np.zeros((18, 26, 1), bool)
    expected = loop(compressed(frames[0].color), np.zeros((18, 26, 3)), nothing, scale=2, jitter=shifts[0])
    np.testing.assert_allclose(compressed(first), expected, atol=1e-4)
    carry, second = method.step(carry, (frames[0],), frames[1])
    how = {"scale": 2, "jitter": shifts[1], "rectify": "clamp", "weight": 0.3}
    expected = loop(compressed(frames[1].color), compressed(first), ~nothing, **how)
    most = max(compressed(frames[1].color).max(), compressed(first).max())  # no answer is brighter
    np.testing.assert_allclose(compressed(second), np.clip(expected, 0, most), atol=1e-4)
    np.testing.assert_array_equal(carry.image, second)


@pytest.mark.slow
def test_taa_follows_the_motion():
    """A jittered disc that moves two pixels a frame comes near its coverage, where it is now."""
    rng, size, fine = np.random.default_rng(0), (12, 20), 8

    def place(k, jitter, scale=1):
        return disc(size[0] * scale, size[1] * scale, 1 / scale, (jitter[0] - (2 * k - 6) * scale, jitter[1]))

    method, carry, history = jx.load("taa", rectify="clamp"), None, ()
    motion = jnp.broadcast_to(jnp.asarray([-2.0, 0.0]), (*size, 2))
    for k in range(6):
        jitter = rng.uniform(-0.5, 0.5, 2).astype(np.float32)
        frame = jx.Frame(color=jnp.asarray(place(k, jitter)), jitter=jnp.asarray(jitter), motion=motion)
        carry = method.init(history, frame) if carry is None else carry
        carry, image = method.step(carry, history, frame)
        history = (frame,)
    truth = place(5, (0, 0), fine).reshape(size[0], fine, size[1], fine, 3).mean((1, 3))
    alone = method.step(method.init((), frame), (), frame)[1]
    errors = [np.square(compressed(a) - compressed(truth)).mean() for a in (image, alone)]
    assert errors[0] < 0.8 * errors[1]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["taa", "taau"])
def test_extrapolated_frames_have_a_history_too(name):
    history, target = make_window(SIZE, rendered=2)
    method = jx.load(name)
    carry, images = method.init((), history[0]), []
    frames = (*history, target)
    for k, frame in enumerate(frames):
        carry, image = method.step(carry, frames[:k], frame)
        images.append(image)
    scale = method.scale
    assert all(image.shape == (scale * 9, scale * 13, 3) for image in images)
    assert all(np.isfinite(a).all() for a in jax.tree.leaves((carry, images)))
