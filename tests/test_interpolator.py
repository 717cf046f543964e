"""The learned interpolator: what holds for any weights, flows set by hand against an oracle's warp, that it learns."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import oracles
import pytest
from flax import nnx
from oracles import random

import jaxtrapolate as jx
from jaxtrapolate.networks import Interpolator, InterpolatorConfig, inference
from jaxtrapolate.networks.blocks import pixel_shuffle, upsample_2x, warp

SMALL = InterpolatorConfig(widths=(4, 6))


@pytest.fixture(scope="module")
def model():
    return Interpolator(SMALL, rngs=nnx.Rngs(3))


def still(model):
    """A copy whose decoders predict nothing."""
    model = nnx.clone(model)
    for decoder in model.decoders:
        decoder.head.feature.kernel[...] = jnp.zeros_like(decoder.head.feature.kernel[...])
        decoder.head.feature.bias[...] = jnp.zeros_like(decoder.head.feature.bias[...])
    return model


def predict(decoder, channels, values):
    """Let a decoder predict these values in these channels, at all pixels."""
    bias = np.zeros((4, decoder.head.feature.bias.shape[0] // 4), np.float32)
    bias[:, channels] = values
    decoder.head.feature.bias[...] = jnp.asarray(bias.reshape(-1))


def frames(height, width, seed=0):
    return random(height, width, 3, seed=seed), random(height, width, 3, seed=seed + 1)


def run(model, first, second, time):
    function, state = inference(model)
    return function(state, jnp.asarray(first), jnp.asarray(second), jnp.asarray(time, jnp.float32))


@pytest.mark.parametrize("size", [(5, 7), (1, 4)])
def test_double_and_shuffle_against_loops(size):
    x = random(1, *size, 8)
    height, width = size
    grown = np.stack([np.interp(np.arange(2 * height) / 2, np.arange(height), row) for row in x[0, :, 0].T], -1)
    np.testing.assert_allclose(upsample_2x(jnp.asarray(x), aligned=False)[0, :, 0], grown, atol=1e-6)
    grown = np.stack([np.interp(np.arange(2 * width) / 2, np.arange(width), row) for row in x[0, 0].T], -1)
    np.testing.assert_allclose(upsample_2x(jnp.asarray(x), aligned=False)[0, 0], grown, atol=1e-6)
    found = pixel_shuffle(jnp.asarray(x))
    for r, c in np.ndindex(2 * height, 2 * width):
        quarter = 2 * (r % 2) + c % 2
        np.testing.assert_array_equal(found[0, r, c], x[0, r // 2, c // 2, 2 * quarter : 2 * quarter + 2])


def test_the_warp_is_the_librarys():
    image, motion = jnp.asarray(random(2, 5, 7, 3)), jnp.asarray(random(2, 5, 7, 2, low=-3, high=3, seed=1))
    np.testing.assert_allclose(warp(image, motion), jax.vmap(jx.backward_warp)(image, motion), atol=1e-6)


@pytest.mark.slow
def test_the_frames_themselves_at_their_times(model):
    """For any weights; the size is no multiple of 4."""
    first, second = frames(9, 6)
    np.testing.assert_array_equal(run(model, first, second, 0), first)
    np.testing.assert_array_equal(run(model, first, second, 1), second)
    assert np.abs(run(model, first, second, 0.5) - (first + second) / 2).max() > 1e-3


def test_without_predictions_it_is_the_linear_blend(model):
    first, second = frames(9, 6)
    for time in (0.25, 0.5):
        expected = (1 - time) * np.float64(first) + time * np.float64(second)
        np.testing.assert_allclose(run(still(model), first, second, time), expected, atol=1e-6)


@pytest.mark.parametrize("level", [0, 1])
def test_flow_mask_and_residual_by_hand(model, level):
    """A flow predicted at a level is in that level's pixels; the first frame moves by time, the second by the rest."""
    velocity, logit, residual, time = np.array([3.0, -1.5, -2.0, 2.5]), 0.7, 0.2, 0.25
    model = still(model)
    predict(model.decoders[1], slice(4, 8), [logit, residual, residual, residual])
    if level == 1:
        predict(model.decoders[1], slice(0, 8), [*velocity, logit, residual, residual, residual])
    else:
        predict(model.decoders[0], slice(0, 4), velocity / 2)
    first, second = frames(8, 12)
    a, b = (
        oracles.backward_warp(frame, np.broadcast_to(share * motion, (8, 12, 2)))
        for frame, share, motion in ((first, time, velocity[:2]), (second, 1 - time, velocity[2:]))
    )
    mask = 1 / (1 + np.exp(-logit))
    near, far = (1 - time) * mask, time * (1 - mask)
    spread = np.pad(np.abs(np.float64(a) - b).max(-1, keepdims=True), ((1, 1), (1, 1), (0, 0)))
    spread = np.max([spread[j : j + 8, i : i + 12] for j in range(3) for i in range(3)], 0)
    held = np.minimum(residual, 2 * spread + 0.02)
    expected = (near * a + far * b) / (near + far) + 4 * time * (1 - time) * held
    np.testing.assert_allclose(run(model, first, second, time), expected, atol=2e-6)


def test_number_of_parameters():
    model = nnx.eval_shape(lambda: Interpolator(rngs=nnx.Rngs(0)))
    assert sum(p.size for p in jax.tree.leaves(nnx.state(model, nnx.Param))) == 671848


@pytest.mark.parametrize(
    "size, config",
    [
        pytest.param((1, 1), SMALL, marks=pytest.mark.slow),
        ((5, 3), SMALL),
        pytest.param((1, 1), InterpolatorConfig(), marks=pytest.mark.slow),
        pytest.param((1, 17), InterpolatorConfig(), marks=pytest.mark.slow),
        pytest.param((33, 18), InterpolatorConfig(), marks=pytest.mark.slow),
    ],
)
def test_any_size(size, config):
    """In a batch of two, each frame as on its own."""
    model = Interpolator(config, rngs=nnx.Rngs(0))
    pairs = [frames(*size, seed) for seed in (0, 4)]
    batch = [jnp.stack([pair[k] for pair in pairs]) for k in (0, 1)]
    time = jnp.asarray([0.5, 0.25])
    found = nnx.jit(lambda model, *arrays: model(*arrays))(model, *batch, time)
    assert found.shape == (2, *size, 3)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[1], run(model, *pairs[1], 0.25), atol=1e-5)


@pytest.mark.slow
def test_gradients_are_finite(model):
    """At the times of the frames and between, also where both frames are equal."""
    first, second = map(jnp.asarray, frames(6, 5))
    function, state = inference(model)

    @jax.jit
    def gradients(state, *inputs):
        return jax.grad(lambda *a: jnp.sum(jnp.square(function(*a))), argnums=(0, 1, 2, 3))(state, *inputs)

    for pair in ((first, second), (first, first), (jnp.zeros_like(first), jnp.zeros_like(first))):
        for time in (0.0, 0.5, 1.0):
            found = gradients(state, *pair, jnp.asarray(time))
            assert all(np.isfinite(g).all() for g in jax.tree.leaves(found))
    found = gradients(state, first, second, jnp.asarray(0.5))
    assert all(np.any(g) for g in jax.tree.leaves(found))


@pytest.mark.slow
def test_half_precision(model):
    """Features in half precision; the frames are warped and blended in float32."""
    first, second = frames(6, 5)
    function, state = inference(model, dtype=jnp.bfloat16)
    found = function(state, jnp.asarray(first), jnp.asarray(second), jnp.asarray(0.5))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, run(model, first, second, 0.5), atol=2e-2)
    np.testing.assert_array_equal(function(state, jnp.asarray(first), jnp.asarray(second), jnp.asarray(0.0)), first)


def test_no_implicit_promotion(strict):
    arrays = [jnp.zeros((2, 5, 6, 3)), jnp.zeros((2, 5, 6, 3)), jnp.zeros(2)]

    def train():
        model = Interpolator(SMALL, rngs=nnx.Rngs(0))
        return nnx.grad(lambda model: jnp.mean(model(*arrays)))(model)

    nnx.eval_shape(train)


def test_errors(unchecked, model):
    image = jnp.zeros((1, 4, 5, 3))
    with pytest.raises(ValueError, match=r"first: expected shape \[B, H, W, 3\], got \[4, 5, 3\]"):
        model(image[0], image[0], jnp.zeros(1))
    with pytest.raises(ValueError, match=r"second: expected shape \[1, 4, 5, 3\], got \[1, 4, 4, 3\]"):
        model(image, image[:, :, :4], jnp.zeros(1))
    with pytest.raises(ValueError, match=r"time: expected shape \[1\], got \[\]"):
        model(image, image, jnp.zeros(()))


@pytest.mark.slow
def test_it_learns_to_move():
    """Textures that shift by up to 4 pixels: on ones it has not seen its error falls well below the blend's."""
    rng = np.random.default_rng(0)

    def batch(count, size=32):
        place = np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1)
        shift, time = rng.uniform(-4, 4, (count, 2)), rng.uniform(0.2, 0.8, count)
        waves, phases = rng.normal(0, 0.35, (count, 2, 6)), rng.uniform(0, 2 * np.pi, (count, 1, 1, 6, 3))

        def frame(at):
            moved = place - (at[:, None] * shift)[:, None, None]
            angle = np.einsum("bhwx,bxk->bhwk", moved, waves)
            return jnp.asarray(0.5 + 0.1 * np.sin(angle[..., None] + phases).sum(-2), jnp.float32)

        return frame(np.zeros(count)), frame(np.ones(count)), jnp.asarray(time, jnp.float32), frame(time)

    model = Interpolator(InterpolatorConfig(widths=(12, 16, 24)), rngs=nnx.Rngs(0))
    steps = 500
    optimizer = nnx.Optimizer(model, optax.adam(optax.cosine_decay_schedule(2e-3, steps)), wrt=nnx.Param)

    @nnx.jit
    def step(model, optimizer, first, second, time, truth):
        loss, gradient = nnx.value_and_grad(lambda m: jnp.mean(jnp.abs(m(first, second, time) - truth)))(model)
        optimizer.update(model, gradient)
        return loss

    for _ in range(steps):
        step(model, optimizer, *batch(8))
    first, second, time, truth = batch(16)
    share = time[:, None, None, None]
    blend = jnp.mean(jnp.abs((1 - share) * first + share * second - truth))
    found = jnp.mean(jnp.abs(nnx.jit(lambda m, *a: m(*a))(model, first, second, time) - truth))
    assert found < 0.6 * blend, (float(found), float(blend))
