"""The space in which colours are fetched: against the same fetch of encoded colours, and what is exact in any."""

import numpy as np
import pytest
from jax import numpy as jnp
from synthetic import make_frame

import jaxtrapolate as jx
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.methods.space import in_space
from jaxtrapolate.records import replace

SIZE = (10, 14)
CURVES = {"log": (np.log1p, np.expm1), "tone": (lambda x: np.sqrt(x / (1 + x)), lambda y: y * y / (1 - y * y))}
SPACES = ("log", "tone")
FAST = ("warp", "occlusion_warp")
SLOW = ("guided_warp", "reproject", "half_motion", "softmax_splat", "grid_warp", "bidirectional", "warp_3d")


@pytest.mark.parametrize("space", SPACES)
def test_a_fetch_in_another_space(space):
    """By float64: half a pixel between a dark and a bright one."""
    image = np.random.default_rng(0).gamma(0.3, 4.0, (*SIZE, 3))
    motion = np.full((*SIZE, 2), 0.5)
    there, back = CURVES[space]
    encoded = np.pad(there(image), ((0, 1), (0, 1), (0, 0)), mode="edge")
    expected = back((encoded[:-1, :-1] + encoded[1:, :-1] + encoded[:-1, 1:] + encoded[1:, 1:]) / 4)
    given = jnp.asarray(image, jnp.float32)
    found = in_space(space, lambda a: jx.backward_warp(a, jnp.asarray(motion, jnp.float32)), given)
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-6)
    linear = in_space("linear", lambda a: jx.backward_warp(a, jnp.asarray(motion, jnp.float32)), given)
    assert np.all(np.asarray(found) <= np.asarray(linear) * (1 + 1e-5) + 1e-6)  # the mean of a concave curve


@pytest.mark.parametrize("space", SPACES)
def test_what_is_fetched_unmixed(space):
    """From its own place bit for bit, from another to rounding; what is not finite stays in its place."""
    values = jnp.asarray([0.0, 1e-30, 0.2, 1.0, 3e4, 65504.0, 3e8, jnp.nan, jnp.inf, -1.0], jnp.float32)
    image = jnp.broadcast_to(values[None, :, None], (3, 10, 2))
    still = in_space(space, lambda a: jx.backward_warp(a, jnp.zeros((3, 10, 2))), image)
    np.testing.assert_array_equal(still, image)
    moved = in_space(space, lambda a: jx.backward_warp(a, jnp.full((3, 10, 2), jnp.asarray([1.0, 0.0]))), image)
    np.testing.assert_allclose(moved[:, :5], image[:, 1:6], rtol={"log": 2e-5, "tone": 2e-2}[space], atol=1e-6)
    assert np.all(np.isfinite(moved[:, :6]))
    assert np.max(moved[:, :6]) <= 3e8
    assert np.all(np.isnan(moved[:, 6]))
    assert np.all(np.isposinf(moved[:, 7]))
    mirrored = in_space(space, lambda a: jx.backward_warp(a, jnp.full((3, 10, 2), 0.25)), -image[:, :6])
    np.testing.assert_array_equal(
        mirrored, -in_space(space, lambda a: jx.backward_warp(a, jnp.full((3, 10, 2), 0.25)), image[:, :6])
    )


@pytest.mark.slow
@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", [*FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_the_option(name, space):
    """What lies still stays bit for bit, and what moves comes out otherwise than in linear light."""
    method = jx.load(name, space=space)
    moving = [make_frame(time, SIZE) for time in range(4)]
    still = [
        replace(frame, color=moving[0].color, motion=0 * frame.motion, gbuffer=moving[0].gbuffer) for frame in moving
    ]
    answers = {}
    for frames in (moving, still):
        history, target, future = tuple(frames[:2]), hide(frames[2]), (frames[3],) if method.future else ()
        answers[id(frames)] = method(history, target, future)
    np.testing.assert_array_equal(answers[id(still)], np.asarray(moving[0].color))
    history, target, future = tuple(moving[:2]), hide(moving[2]), (moving[3],) if method.future else ()
    linear = jx.load(name, space="linear")(history, target, future)
    assert np.max(np.abs(np.asarray(linear) - np.asarray(answers[id(moving)]))) > 1e-5
    np.testing.assert_allclose(answers[id(moving)], linear, atol=0.25)


@pytest.mark.slow
def test_every_fetch_of_a_method_is_in_its_space():
    """A picture of two values, a pixel wide each, moved by half a pixel, demodulated or not: the same light between.

    In linear light it is 0.5; after the curve 0.143. Both the demodulated and the undivided colour are fetched so.
    """
    color = jnp.broadcast_to(jnp.where(jnp.arange(32) % 2, 1.0, 0.0)[None, :, None], (24, 32, 3))
    motion = jnp.broadcast_to(jnp.asarray([0.5, 0.0]), (24, 32, 2))
    buffers = jx.GBuffer(albedo=jnp.ones((24, 32, 3)), normal=jnp.ones((24, 32, 3)), depth=jnp.ones((24, 32, 1)))
    frames = [jx.Frame(color=color, motion=motion, gbuffer=buffers) for _ in range(4)]
    half = np.sqrt(0.5) / 2
    between = {"linear": 0.5, "tone": half**2 / (1 - half**2)}
    for name in ("occlusion_warp", "reproject", "bidirectional"):
        for space, expected in between.items():
            method = jx.load(name, space=space)
            image = method(tuple(frames[:2]), hide(frames[2]), (frames[3],) if method.future else ())
            np.testing.assert_allclose(image[4:-4, 8:-8], expected, rtol=1e-5, err_msg=f"{name} {space}")


def test_the_option_is_checked():
    with pytest.raises(ValueError, match="space"):
        jx.load("warp", space="gamma")
