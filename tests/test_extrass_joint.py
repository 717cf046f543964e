"""ExtraSS whole: what each network is shown, the history and its jitter, steps in turn, also scanned."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from flax import nnx
from oracles import random
from small_extranet import make_window, random_model

import jaxtrapolate as jx
from jaxtrapolate.methods.extrass import Refinement
from jaxtrapolate.methods.extrass_joint import extrass, extrass_config
from jaxtrapolate.methods.supersampling import Kept, upsampled_motion
from jaxtrapolate.networks import ExtraSS, ExtraSSConfig, ExtraSSNetConfig, FRNetConfig
from jaxtrapolate.ops.upsample import upsample
from jaxtrapolate.records import replace
from jaxtrapolate.weights import save_weights

CONFIG = ExtraSSConfig(FRNetConfig(widths=(4, 6)), ExtraSSNetConfig(widths=(4, 6), bottleneck=8))
SIZE = (9, 13)


@pytest.fixture(scope="module")
def model():
    return random_model(CONFIG, ExtraSS)


@pytest.fixture(scope="module")
def method(model):
    return extrass(model)


def sequence(count, *, jitter=False):
    """Frames in turn with and without colour; each with buffers and motion to the one before."""
    history, target = make_window(SIZE, rendered=(count + 1) // 2)
    frames = [*history, target][:count]
    if jitter:
        shifts = np.random.default_rng(3).uniform(-0.5, 0.5, (count, 2)).astype(np.float32)
        frames = [replace(f, jitter=jnp.asarray(j)) for f, j in zip(frames, shifts, strict=True)]
    return frames


def compressed(color):
    color = np.maximum(np.float64(color), 0)
    return np.sqrt(color / (1 + color))


def test_motion_at_the_output_size_by_hand():
    """A plane that moves evenly: whatever both frames' jitter, its motion is twice as long at twice the size."""
    still = np.broadcast_to(np.float32([1.25, -0.5]), (*SIZE, 2))
    shifts = [jnp.asarray(s, jnp.float32) for s in ([0.2, -0.3], [-0.4, 0.1])]
    before, target = (jx.Frame(motion=jnp.asarray(still), jitter=s) for s in shifts)
    seen = replace(target, motion=target.motion + (shifts[1] - shifts[0]))  # as stages see it
    found = upsampled_motion((before,), seen, 2)
    np.testing.assert_allclose(found, np.broadcast_to([2.5, -1.0], (18, 26, 2)), atol=1e-5)


def test_a_rendered_frame_at_first_is_shown_with_itself(method):
    frame = sequence(1, jitter=True)[0]
    carry = method.init((), frame)
    values = method.values_before("super sampling", method.state, carry, (), frame)
    color, history, depth, jitter = values["sampled"]
    np.testing.assert_allclose(color, compressed(frame.color), atol=1e-5)
    np.testing.assert_allclose(history, upsample(color, jitter=frame.jitter), atol=1e-6)
    np.testing.assert_array_equal(jitter, frame.jitter)
    assert depth.shape == (*SIZE, 1)
    assert not np.any(values["valid"])


def test_the_history_is_the_answer_before_along_the_unjittered_motion(method):
    frames = sequence(2, jitter=True)
    kept = Kept(jnp.asarray(random(18, 26, 3, high=2.0)), jnp.ones(()))
    values = method.values_before("super sampling", method.state, kept, (frames[0],), frames[1])
    motion = np.asarray(frames[1].motion)
    expected = np.asarray(upsample(jnp.asarray(motion), jitter=frames[1].jitter)) * 2
    warped = oracles.backward_warp(compressed(kept.image), expected)
    valid = np.asarray(values["valid"])[..., 0]
    assert 0.4 < valid.mean() < 1
    np.testing.assert_allclose(values["previous"][valid], warped[valid], atol=1e-4)
    np.testing.assert_array_equal(valid, oracles.in_frame(expected))


def test_an_extrapolated_frame_is_shown_what_the_refinement_made(method):
    """The guided warp beside it, always from rendered frames: the carry has no part in either."""
    *history, target = sequence(4)
    carries = [Kept(jnp.full((18, 26, 3), v), jnp.ones(())) for v in (0.2, 3.0)]
    both = [method.values_before("super sampling", method.state, c, tuple(history), target) for c in carries]
    for name in ("image", "guided"):
        np.testing.assert_array_equal(both[0][name], both[1][name])
    assert np.any(both[0]["previous"] != both[1]["previous"])
    color, _, _, _, guided, albedo = both[0]["sampled"]
    np.testing.assert_allclose(color, compressed(both[0]["image"]), atol=1e-5)
    np.testing.assert_allclose(guided, compressed(both[0]["guided"]), atol=1e-5)
    np.testing.assert_array_equal(albedo, target.gbuffer.albedo)
    plain = np.asarray(jx.load("extrass_warp").without("sky")(tuple(history), target))
    np.testing.assert_allclose(both[0]["guided"], plain, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_steps_in_turn_also_scanned(method):
    """Two pairs of a rendered and an extrapolated frame, step by step and by a scan over pairs."""
    frames = sequence(8)

    def step(carry, older, first, second):
        carry, one = method.function(method.state, carry, older, first)
        carry, two = method.function(method.state, carry, (*older, first), second)
        return carry, (one, two)

    pairs = [(tuple(frames[k - 4 : k]), frames[k], frames[k + 1]) for k in (4, 6)]
    carry, images = method.init(pairs[0][0], pairs[0][1]), []
    jitted = jax.jit(step)
    for pair in pairs:
        carry, shown = jitted(carry, *pair)
        images.append(shown)
    stacked = jax.tree.map(lambda *a: jnp.stack([jnp.asarray(v) for v in a]), *pairs)
    start = method.init(pairs[0][0], pairs[0][1])
    last, scanned = jax.jit(lambda c, s: jax.lax.scan(lambda c, p: step(c, *p), c, s))(start, stacked)
    for k in (0, 1):
        assert images[k][0].shape == images[k][1].shape == (18, 26, 3)
        for one, other in zip(images[k], scanned, strict=True):
            np.testing.assert_allclose(one, other[k], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(last.image, carry.image, rtol=1e-3, atol=1e-4)
    np.testing.assert_array_equal(carry.image, images[1][1])
    assert np.isfinite(last.image).all()


def test_of_colour_alone_rendered_frames_are_super_sampled(method):
    frame = jx.Frame(color=jnp.asarray(random(5, 7, 3)))
    carry, image = method.step(method.init((), frame), (), frame)
    assert image.shape == (10, 14, 3)
    assert np.isfinite(image).all()
    assert carry.seen == 1
    with pytest.raises(ValueError, match="history: expected a frame with colour"):
        method.step(carry, (), replace(frame, color=None))


def test_weights_of_both_networks_are_one_file(tmp_path, model, method):
    tree, config = nnx.to_pure_dict(nnx.state(model)), extrass_config(CONFIG, Refinement())
    path = save_weights(tmp_path, "extrass", tree, config=config, note="none")
    found = jx.load("extrass", weights=path)
    assert found.scale == 2
    assert all(
        np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (found.weights, method.weights)), strict=True)
    )
    with pytest.raises(ValueError, match="method 'extrass': no default weights come with this version"):
        jx.load("extrass")
