"""What is hidden in the newest frame and was seen before: a box that passes before a wall with light of its own."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import jaxtrapolate as jx
from jaxtrapolate.methods.seen import seen_at
from jaxtrapolate.records import Frame, GBuffer, replace

SIZE = (60, 96)
FOCAL = 80.0
STEP = 5.0  # pixels that the box moves right in a frame
PAN = 1.0  # pixels that the wall moves left in a frame: the camera moves right


@pytest.fixture(autouse=True)
def plain(unchecked):
    """NumPy arrays are taken, and the library's own errors seen."""


def paint(u, v):
    """Light on the wall that no guide knows of, by the wall's own coordinates."""
    return 1 + 0.5 * np.sin(u * 1.7 + 2 * np.sin(v * 0.9)) + 0.3 * np.cos(v * 2.1 - u * 0.4)


def frame(time, *, light=1.0, still=False, objects=True):
    """A wall 10 away and a box 5 away, id 1, seen by a camera that moves right (or, still, by one that does not)."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    eye = 0.0 if still else PAN * time * 10 / FOCAL
    left = 40 + STEP * time
    box = (x >= left) & (x < left + 12) & (y >= 15) & (y < 45)
    depth = np.where(box, 5.0, 10.0)[..., None]
    rays = np.stack([(x - 48) / FOCAL, (y - 30) / FOCAL, np.ones_like(x)], -1)
    position = rays * depth + [eye, 0, 0]
    color = np.where(box, 0.3, light * 0.6 * paint(2 * position[..., 0], 2 * position[..., 1]))
    motion = np.where(box, -STEP, 0.0 if still else PAN)[..., None] * [1.0, 0.0]
    flat = np.ones((*SIZE, 1))
    step = np.eye(4)
    step[0, 3] = -(STEP * 5 / FOCAL + (0 if still else PAN * 10 / FOCAL))
    arrays = {
        "albedo": 0.6 * flat * [1, 1, 1],
        "normal": flat * [0, 0, -1],
        "depth": depth,
        "position": position,
        "stencil": box[..., None].astype(float),
    }
    return Frame(
        color=jnp.asarray(color[..., None] * [1, 0.9, 0.8], jnp.float32),
        motion=jnp.asarray(motion, jnp.float32),
        gbuffer=GBuffer(**{k: jnp.asarray(v, jnp.float32) for k, v in arrays.items()}),
        time=jnp.float32(time),
        objects=jnp.asarray(step[None], jnp.float32) if objects else None,
    )


def hide(frame):
    return replace(frame, color=None)


def window(past, make=frame):
    frames = [make(t) if t % 2 else hide(make(t)) for t in range(1 - 2 * past, 0)]
    return tuple(frames), hide(make(0)), make(0).color


@functools.cache
def method():
    return jx.load("shading_warp").without("light before")


def hidden(history, target):
    return np.asarray(jx.hole_masks(target.gbuffer, history[-1].gbuffer, target.motion, taps="nearest").any)[..., 0]


def error(image, truth, where):
    return np.square(np.asarray(jx.tonemap(image)) - np.asarray(jx.tonemap(truth)))[where].mean()


@pytest.mark.parametrize("still", [True, False])
def test_where_it_was_seen(still):
    """Behind the box: in no frame that it covered, in each that it did not; to a hundredth of a pixel there."""
    history, target, _ = window(5, functools.partial(frame, still=still))
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    wall = np.asarray(target.gbuffer.stencil)[..., 0] < 0.5
    for place, age in ((8, 1), (6, 3), (4, 5), (2, 7)):
        motion, seen = (np.asarray(a) for a in seen_at(history, target, place))
        at = x + (0 if still else PAN * age)
        left = 40 - STEP * age
        covered = (np.round(at) >= left) & (np.round(at) < left + 12) & (y >= 15) & (y < 45)
        inside = at <= SIZE[1] - 1
        assert np.abs(motion[..., 0] - (at - x))[wall].max() < 0.01
        assert np.abs(motion[..., 1])[wall].max() < 0.01
        assert np.array_equal(seen[..., 0][wall], (~covered & inside)[wall])


def test_rigid_objects_are_followed():
    history, target, _ = window(3)
    box = np.asarray(target.gbuffer.stencil)[..., 0] > 0.5
    motion, seen = (np.asarray(a) for a in seen_at(history, target, 2))
    assert seen[..., 0][box].all()
    np.testing.assert_allclose(motion[box], np.broadcast_to([-3 * STEP, 0], motion[box].shape), atol=0.05)
    history, target, _ = window(3, functools.partial(frame, objects=False))
    assert not np.asarray(seen_at(history, target, 2)[1])[..., 0][box].any()


def test_holes_are_filled_from_the_newest_frame_that_saw_them():
    history, target, truth = window(3)
    holes = hidden(history, target)
    assert 100 < holes.sum() < 500
    images = [m(history, target) for m in (jx.load("guided_warp"), method())]
    inner = holes & (np.arange(SIZE[1]) < 90)
    before, after = (error(image, truth, inner) for image in images)
    assert after < 0.05 * before
    np.testing.assert_array_equal(np.asarray(images[0])[~holes], np.asarray(images[1])[~holes])


@pytest.mark.slow
def test_light_that_has_changed_since_is_carried():
    """All light is twice as bright since the last frame: what older frames saw is as well."""
    history, target, truth = window(3, lambda t: frame(t, light=2.0 if t >= -1 else 1.0))
    inner = hidden(history, target) & (np.arange(SIZE[1]) < 90)
    followed = method()(history, target)
    ignored = method().replace(relight=1.0)(history, target)
    assert error(followed, truth, inner) < 0.1 * error(ignored, truth, inner)


@pytest.mark.slow
def test_frames_that_say_nothing_fill_nothing():
    """Positions at random, or not there: the image is that without the stage."""
    history, target, _ = window(3)
    without = np.asarray(method().without("seen before")(history, target))
    rng = np.random.default_rng(0)

    def spoilt(frame, position):
        return replace(frame, gbuffer=replace(frame.gbuffer, position=position))

    noise = jnp.asarray(rng.normal(size=(*SIZE, 3)), jnp.float32)
    for position in (noise, None):
        given = tuple(spoilt(f, position) for f in history)
        bare = replace(target, gbuffer=replace(target.gbuffer, position=position)) if position is None else target
        made = np.asarray(method()(given, bare))
        expected = np.asarray(method().without("seen before")(given, bare))
        np.testing.assert_array_equal(made, expected)
    assert np.isfinite(without).all()
