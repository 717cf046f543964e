"""Runs of interpolated frames and motion blur: exact motion by hand, a known scene averaged over the shutter."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import synthetic
from oracles import random
from test_assisted import bar_target
from test_bidirectional import keyframe, layers

import jaxtrapolate as jx

pytestmark = pytest.mark.usefixtures("strict")

H, W = 6, 13


def three(*, size=(H, W), flow=(0.0, 0.0, 0.0), channels=2, colors=None, dtype=np.float32):
    """Three frames of random colours, or of the given ones, whose points all move by `flow` from each to the next."""
    flow = np.broadcast_to(np.asarray(flow, dtype), (*size, 3))
    depth = np.full((*size, 1), 5, dtype)
    colors = [random(*size, channels, seed=k, dtype=dtype) for k in range(3)] if colors is None else colors
    return tuple(keyframe(color, depth + k * flow[..., 2:], flow, -flow) for k, color in enumerate(colors))


def moving(steps, size):
    """Three frames of the box before the wall, with their exact flows, `steps` of its steps apart."""
    frames = []
    for k in range(3):
        frame = synthetic.make_keyframe(k * steps, size)
        flows = (np.float32(steps) * getattr(frame, name) for name in ("forward_flow", "backward_flow"))
        frames.append(keyframe(frame.color, frame.depth, *flows))
    return tuple(frames)


def db(image, truth):
    return -10 * np.log10(np.mean(np.square(np.asarray(image, np.float64) - truth)))


# Runs


@pytest.mark.slow
def test_a_run_is_compiled_once():
    import jax._src.test_util as jtu

    previous, next, _ = three()
    jx.interpolate_run(previous, next, factor=3, search=jx.SearchOptions(starts=["default"]))
    with jtu.count_jit_and_pmap_lowerings() as count:
        jx.interpolate_run(previous, next, factor=3, search=jx.SearchOptions(starts=("default",)))
        jx.interpolate_run(next, previous, factor=3, search=jx.SearchOptions(starts=["default"]))
    assert count() == 0


# Attributes that are lit in each frame (section 9: vertex-bound scenes)


def brightness(time):
    """Of a lamp that flashes between the rendered frames, at 0, 1, ..., where it is 1."""
    return 1 - 0.7 * np.sin(np.pi * time) ** 2


def shade(attributes, light):
    """Albedo by a lamp from the front; attributes: albedo, normal."""
    return attributes[..., :3] * jnp.maximum(attributes[..., 5:6], 0) * light


def attributes_of(time, size):
    frame = synthetic.make_frame(time, size)
    return np.concatenate([frame.gbuffer.albedo, frame.gbuffer.normal], -1)


def with_attributes(size, steps=4):
    return tuple(jx.replace(frame, color=jnp.asarray(attributes_of(k * steps, size)))
                 for k, frame in enumerate(moving(steps, size)))  # fmt: skip


@pytest.mark.slow
def test_light_that_changes_between_rendered_frames():
    """Attributes are lit by each frame's own light; colours can only be blended, here of two bright frames."""
    size, steps, times = (48, 61), 4, np.float32([0.25, 0.5, 0.75])
    previous, next, _ = with_attributes(size, steps)
    lights = np.float32(brightness(times))
    lit = jx.interpolate_run(previous, next, factor=4, shade_attributes=shade, lights=jnp.asarray(lights))
    colors = [jx.replace(f, color=shade(f.color, jnp.float32(1))) for f in (previous, next)]
    blended = jx.interpolate_run(*colors, factor=4)
    for k, time in enumerate(times):
        truth = np.asarray(shade(jnp.asarray(attributes_of(steps * time, size)), lights[k]))
        assert db(lit[k], truth) > max(39, db(blended[k], truth) + 24)  # 40.6, 49.7, 42.3 against 14.7, 8.6, 14.7


@pytest.mark.slow
def test_other_lights_compile_nothing():
    import jax._src.test_util as jtu

    previous, next, _ = with_attributes((48, 61))
    lights, others = jnp.float32([1, 2, 3]), jnp.float32([2, 4, 6])
    first = jx.interpolate_run(previous, next, factor=4, shade_attributes=shade, lights=lights)
    with jtu.count_jit_and_pmap_lowerings() as count:
        second = jx.interpolate_run(previous, next, factor=4, shade_attributes=shade, lights=others)
    assert count() == 0
    np.testing.assert_allclose(second, 2 * first, rtol=1e-6)


# Motion blur


@pytest.mark.slow
@pytest.mark.parametrize("size", [(H, W), pytest.param((1, 1), marks=pytest.mark.slow)], ids=str)
def test_a_closed_shutter_returns_the_frame_bit_for_bit(size):
    frames = three(size=size, flow=(1.3, -0.7, 0.1))
    np.testing.assert_array_equal(jx.motion_blur(*frames, shutter=0.0, samples=2), frames[1].color)


def test_what_stands_still_stays_as_it_is():
    frames = three(colors=[random(H, W, 2)] * 3)
    np.testing.assert_allclose(jx.motion_blur(*frames, shutter=1.0, samples=2), frames[1].color, rtol=2e-7)


@pytest.mark.slow
def test_whole_pixels_and_attributes():
    """Three parts of a shutter of 3/4: the frames made are 1/4 away, where all has moved by (2, -1) of (8, -4).

    Colours are averaged, not the attributes that each frame's colour is made of.
    """
    frames, lights = three(size=(11, 29), flow=(8, -4, 1), channels=3), np.float32([0.5, 1, 3])

    def shade(attributes, light):
        return attributes[..., :2] * attributes[..., 2:] * light

    blurred = np.asarray(
        jx.motion_blur(*frames, shutter=0.75, samples=1, shade_attributes=shade, lights=jnp.asarray(lights))
    )
    colors = [np.float64(frame.color) for frame in frames]
    before = 0.25 * oracles.shift(colors[0], -6, 3, np.nan) + 0.75 * oracles.shift(colors[1], 2, -1, np.nan)
    after = 0.75 * oracles.shift(colors[1], -2, 1, np.nan) + 0.25 * oracles.shift(colors[2], 6, -3, np.nan)
    expected = sum(map(shade, (before, colors[1], after), lights)) / 3
    inside = ~np.isnan(expected)
    assert inside.mean() > 0.2
    np.testing.assert_allclose(blurred[inside], expected[inside], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "shutter, least",
    [(0.5, 41.0), pytest.param(1.0, 42.0, marks=pytest.mark.slow), pytest.param(2.0, 45.0, marks=pytest.mark.slow)],
)
def test_against_the_scene_averaged_over_the_shutter(shutter, least):
    """Rendered at the eleven times and averaged: 42.0, 43.0 and 46.0 dB; the rendered frame itself 34.2, 26.7, 17.0."""
    size, steps = (96, 121), 4
    frames = moving(steps, size)
    times = steps * (1 + shutter / 11 * np.arange(-5, 6))
    truth = np.mean([np.float64(synthetic.make_frame(time, size).color) for time in times], 0)
    assert db(jx.motion_blur(*frames, shutter=shutter), truth) > least
    assert db(frames[1].color, truth) < least - 6


def bars():
    """A bar that moves by 6 pixels between frames, before a still wall."""
    first, second = layers()
    _, third = layers(left=10)
    flows = (second.backward_flow, -second.backward_flow)
    return first, jx.replace(second, forward_flow=flows[1]), jx.replace(third, color=third.color + jnp.float32(0.1))


@pytest.mark.slow
@pytest.mark.parametrize("assisted", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_bar_before_a_wall(assisted):
    """Half an interval before the bar is at 7..14, then at 10..17, half an interval after it at 13..20."""
    targets = None
    if assisted:
        given = bar_target(0.5), bar_target(0.5, left=10)
        targets = jax.tree.map(lambda *a: jnp.stack(a), *given)
    blurred = np.asarray(jx.motion_blur(*bars(), shutter=1.5, samples=1, targets=targets))[1, :, 0]
    # wall 0.1, 0.2, 0.3 and bar 0.8, 0.9, 1.0 in the three frames; what both around show is blended half and half
    np.testing.assert_allclose(blurred[:4], (0.15 + 0.2 + 0.25) / 3, atol=1e-6)
    np.testing.assert_allclose(blurred[4:7], (0.2 + 0.2 + 0.25) / 3, atol=1e-6)  # the bar hid the wall in the first
    np.testing.assert_allclose(blurred[7:10], (0.85 + 0.2 + 0.25) / 3, atol=1e-6)
    np.testing.assert_allclose(blurred[10:13], (0.85 + 0.9 + 0.3) / 3, atol=1e-6)  # wall that the last alone shows
    np.testing.assert_allclose(blurred[13:15], (0.85 + 0.9 + 0.95) / 3, atol=1e-6)
    np.testing.assert_allclose(blurred[15:18], (0.1 + 0.9 + 0.95) / 3, atol=1e-6)  # wall that the first alone shows
    np.testing.assert_allclose(blurred[18:21], (0.15 + 0.2 + 0.95) / 3, atol=1e-6)
    np.testing.assert_allclose(blurred[21:], (0.15 + 0.2 + 0.2) / 3, atol=1e-6)  # the bar hides the wall in the last


@pytest.mark.slow
def test_gradients_against_differences(x64):
    """With respect to colours, a flow, and the shutter: evenly moving points, away from choices and from edges."""
    size = (5, 7)
    rng = np.random.default_rng(4)
    flow = np.float64([0.63, 0.41, 0.0]) + 0.02 * rng.uniform(-1, 1, (*size, 3))
    colors, depth = [rng.uniform(0, 1, (*size, 1)) for _ in range(3)], np.full((*size, 1), 5.0)
    cotangent = rng.uniform(-1, 1, (*size, 1))

    @jax.jit
    def total(first, second, third, flow, shutter):
        previous = keyframe(first, 2 * depth, forward=0.98 * flow)  # farther: the rendered frame's point counts
        current, next = keyframe(second, depth, flow, -flow), keyframe(third, 2 * depth, backward=-0.98 * flow)
        search = jx.SearchOptions(starts=("default",), iterations=40, filter="bilinear")
        options = {"search": search, "visibility": jx.VisibilityOptions(test="round_trip")}
        return jnp.sum(cotangent * jx.motion_blur(previous, current, next, shutter=shutter, samples=2, **options))

    given = (*colors, flow, np.float64(0.9))
    gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3, 4)))(*given)
    assert abs(gradients[4]) > 1e-3
    oracles.assert_gradients(total, given, gradients, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_gradients_stay_finite():
    frames = bars()
    flow = np.array(frames[1].forward_flow)
    flow[1, 2], flow[2, 3, 0], flow[0, 0, 2] = np.nan, np.inf, np.nan

    def total(color, flow, shutter):
        current = jx.replace(frames[1], color=color, forward_flow=flow)
        return jnp.sum(jx.motion_blur(frames[0], current, frames[2], shutter=shutter))

    for shutter in (0.0, 0.8):
        given = frames[1].color, jnp.asarray(flow), jnp.float32(shutter)
        gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2)))(*given)
        assert all(np.isfinite(g).all() for g in gradients)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_samples():
    frames = three(size=(64, 64))

    def temporary(samples):
        blur = jax.jit(lambda *frames: jx.motion_blur(*frames, samples=samples))
        return blur.lower(*frames).compile().memory_analysis().temp_size_in_bytes

    assert temporary(9) < 1.01 * temporary(2)


@pytest.mark.slow
def test_eager_is_jit_is_vmap():
    first = moving(4, (20, 27))
    second = tuple(jx.replace(frame, color=frame.color[::-1]) for frame in first)
    stacked = tuple(jax.tree.map(lambda *a: jnp.stack(a), *pair) for pair in zip(first, second, strict=True))
    shutters = jnp.float32([0.4, 1.1])

    def blur(*given):
        return jx.motion_blur(*given[:-1], shutter=given[-1], samples=2)

    mapped = jax.jit(jax.vmap(blur))(*stacked, shutters)
    for k, frames in enumerate((first, second)):
        eager = np.asarray(blur(*frames, shutters[k]))
        np.testing.assert_allclose(jax.jit(blur)(*frames, shutters[k]), eager, atol=1e-5)
        assert (np.abs(np.asarray(mapped[k]) - eager).max(-1) < 1e-4).mean() > 0.995  # of equal errors either may win


@pytest.mark.slow
@pytest.mark.parametrize("name, shutter, least", [("walkers", 0.5, 41.0), ("walkers", 1.0, 40.4)])
def test_against_an_embedded_scene(name, shutter, least):
    """I-frames two scene frames apart, 320 x 240, tone-mapped: 42.1 and 41.1 dB at the least of three times."""
    from jaxtrapolate import scenes

    world, size, step = scenes.scene(name, 0), (240, 320), 2.0
    for time in (5.0, 25.0, 45.0):
        frames = [
            scenes.keyframe(world, t, size=size, next_time=t + step, previous_time=t - step)
            for t in (time - step, time, time + step)
        ]
        times = [time + step * shutter / 11 * k for k in range(-5, 6)]
        truth = sum(scenes.render(world, t, size=size).color for t in times) / 11
        shown = [jx.tonemap(image) for image in (jx.motion_blur(*frames, shutter=shutter), frames[1].color, truth)]
        assert jx.psnr(shown[0], shown[2]) > max(least, jx.psnr(shown[1], shown[2]) + 4)


@pytest.mark.parametrize(
    "options, error, message",
    [
        ({"samples": 0}, ValueError, "samples: expected an integer of at least 1, got 0"),
        ({"shutter": jnp.ones(2)}, ValueError, r"shutter: expected shape \[\], got \[2\]"),
        ({"offsets": None}, ValueError, "offsets: expected none"),
        ({"target": None}, ValueError, "target: expected none"),
        ({"next": None}, TypeError, "next: expected a Keyframe, got NoneType"),
        ({"previous": jx.Keyframe(color=jnp.ones((2, 3, 1)))}, ValueError, r"previous.color: expected shape \[6, 13,"),
        ({"search": jx.SearchOptions(choice="best")}, ValueError, "choice: expected one of"),
        ({"lights": jnp.ones(11)}, ValueError, "lights: expected none without shade_attributes"),
        (
            {"lights": jnp.ones(10), "shade_attributes": shade},
            ValueError,
            r"lights: expected arrays \[11, ...\], got \[10\]",
        ),
    ],
)
def test_errors(unchecked, options, error, message):
    given = dict(zip(("previous", "current", "next"), three(), strict=True)) | options
    frames = [given.pop(name) for name in ("previous", "current", "next")]
    with pytest.raises(error, match=message):
        jx.motion_blur(*frames, **given)
