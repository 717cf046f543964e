"""Methods whose light goes on moving: exact shadows over exact surfaces, and all that must change nothing."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from marks import slow

import jaxtrapolate as jx
from jaxtrapolate.methods.extrass import Refinement, extrass_refine
from jaxtrapolate.methods.shading import _gained, steps_on
from jaxtrapolate.networks import FRNet, FRNetConfig
from jaxtrapolate.records import Frame, GBuffer, replace

SIZE = (66, 100)
PAN = 1.5  # pixels that surfaces move left in a frame
SPEED = np.float64([2.0, -1.0])  # of the shadow over the surfaces, pixels in a frame


@pytest.fixture(autouse=True)
def plain(unchecked):
    """NumPy arrays are taken, and the library's own errors seen."""


def lit(time, *, speed=SPEED, pan=PAN, at=48):
    """The light at a time: even, but for a soft round shadow that moves over the surfaces."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    away = np.hypot(x + pan * time - at - speed[0] * time, y - 34 - speed[1] * time)
    return 1.2 - 0.9 / (1 + np.exp((away - 15) / 1.2))


def frame(time, *, speed=SPEED, pan=PAN, at=48, light=None, stamped=True, buffers=True):
    """A textured wall seen by a camera that pans, lit by `lit` or by `light` times that of no shadow."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    albedo = 0.5 + 0.2 * np.sin((x + pan * time) / 5) * np.cos(y / 7)
    albedo = albedo[..., None] * [1.0, 0.8, 0.6]
    irradiance = lit(time, speed=speed, pan=pan, at=at) if light is None else np.full(SIZE, 1.2 * light)
    motion = np.broadcast_to([pan, 0.0], (*SIZE, 2))
    flat = np.ones((*SIZE, 1))
    shown = {"albedo": albedo, "normal": flat * [0.0, 0.0, 1.0]} if buffers else {}
    arrays = shown | {"depth": 5 * flat, "stencil": 0 * flat}
    return Frame(
        color=jnp.asarray(albedo * irradiance[..., None], jnp.float32),
        motion=jnp.asarray(motion, jnp.float32),
        gbuffer=GBuffer(**{k: jnp.asarray(v, jnp.float32) for k, v in arrays.items()}),
        time=jnp.float32(time) if stamped else None,
    )


def hide(frame):
    return replace(frame, color=None)


def window(past, make=frame):
    """History of `past` rendered frames with those between, at -1, -3, ..., and the target at 0."""
    frames = [make(t) if t % 2 else hide(make(t)) for t in range(1 - 2 * past, 0)]
    return tuple(frames), hide(make(0)), make(0).color


def db(image, truth):
    inner = np.s_[6:-6, 14:-14]  # away from where the picture comes in
    images = (jx.tonemap(jnp.asarray(a)[inner]) for a in (image, truth))
    return float(jx.psnr(*images))


@functools.cache
def method(name):
    return jx.load(name)


@pytest.mark.parametrize("past", [3, *slow(2)])
def test_shadow_goes_on(past):
    history, target, truth = window(past)
    before, after = (db(method(name)(history, target), truth) for name in ("guided_warp", "shading_warp"))
    assert after > before + 8
    assert after > 38


def test_shadow_that_speeds_up_goes_on_speeding_up():
    """Its place is a square of the time; with even steps what it gains on its mean is 3/8 of what the last step did."""
    flow, then = jnp.full((3, 4, 2), -5.0), (jnp.full((3, 4, 2), -3.0), jnp.ones((3, 4, 1)))
    still, sure = jnp.zeros((3, 4, 2)), jnp.ones((3, 4, 1))
    half, one, two = (jnp.float32(v) for v in (0.5, 1, 2))
    np.testing.assert_allclose(_gained(flow, sure, then, still, half, one), -2 * 0.375, rtol=1e-6)
    np.testing.assert_array_equal(_gained(flow, 0 * sure, then, still, half, one), 0)
    np.testing.assert_array_equal(_gained(flow, sure, (-then[0], then[1]), still, half, one), 0)  # it turned: no trust
    place = lambda t: 7 - 2 * t + 0.3 * t**2  # noqa: E731
    flow, earlier = place(-3.0) - place(-1.0), place(-4.0) - place(-3.0)  # the newest at -1, then -3 and -4
    gained = _gained(*(jnp.full((1, 1, k), v) for k, v in ((2, flow), (1, 1.0))), (jnp.full((1, 1, 2), earlier),
                     jnp.ones((1, 1, 1))), jnp.zeros((1, 1, 2)), half, two)  # fmt: skip
    np.testing.assert_allclose(gained + 0.5 * flow, place(-1.0) - place(0.0), rtol=1e-5)


@pytest.mark.slow
def test_shadows_that_speed_up_and_slow_down():
    """With its acceleration light is as near as without any; without, one of the two is not."""

    def make(time, fast):
        return frame(time, at=48 + fast * time * abs(time) / 2)

    found = []
    for fast in (-0.25, 0.0, 0.25):
        history, target, truth = window(3, functools.partial(make, fast=fast))
        made = [method("shading_warp").replace(acceleration=a)(history, target) for a in (0.0, 1.0)]
        found.append([db(image, truth) for image in made])
    without, with_it = np.transpose(found)
    assert np.ptp(with_it) < 1
    assert with_it.min() > without.min() + 2


@pytest.mark.slow
@pytest.mark.parametrize("past", [3, 2])
def test_shadow_goes_on_in_a_network_that_is_led(past):
    """FRNet, untrained, begins with the motion of light; without two rendered frames it is the guided warp."""
    model = FRNet(FRNetConfig(widths=(4, 6), led=True), rngs=nnx.Rngs(0))
    led = extrass_refine(model, preparation=Refinement(modulated=False, taken="change", changed=0.0))
    history, target, truth = window(past)
    plain = method("extrass_warp")(history, target)
    assert db(led(history, target), truth) > db(plain, truth) + 6
    assert np.array_equal(led(history[-1:], target), plain)


def test_shadow_goes_on_where_it_was_hidden():
    """Beyond the border of the older frame, where only the newer one shows its surface."""
    history, target, truth = window(3, functools.partial(frame, pan=4.0, at=88))
    strip = np.s_[:, 88:96]
    before, after = (
        np.square(np.asarray(jx.tonemap(method(name)(history, target)) - jx.tonemap(truth))[strip]).mean()
        for name in ("guided_warp", "shading_warp")
    )
    assert after < 0.75 * before


@pytest.mark.slow
def test_shadow_goes_on_without_times_and_without_normals():
    for make in (functools.partial(frame, stamped=False), functools.partial(frame, buffers=False)):
        history, target, truth = window(3, make)
        before, after = (db(method(name)(history, target), truth) for name in ("guided_warp", "shading_warp"))
        assert after > before + 6


def test_one_rendered_frame_is_the_guided_warp():
    history, target, _ = window(1)
    assert np.array_equal(method("shading_warp")(history, target), method("guided_warp")(history, target))


def test_light_that_stands_still_is_the_guided_warp():
    """Bit for bit; so is what blinks, where two frames differ by no motion."""
    for light in ((1, 1, 1), (1, 1.5, 0.7)):
        steps = dict(zip((-5, -3, -1), light, strict=True))
        history, target, _ = window(3, lambda t, steps=steps: frame(t, light=steps.get(t, 1)))
        assert np.array_equal(method("shading_warp")(history, target), method("guided_warp")(history, target))


@pytest.mark.slow
def test_no_stage_works_where_no_light_changes():
    """What is skipped gives what would have been made."""
    history, target, _ = window(3, functools.partial(frame, light=1))
    whole = method("shading_warp")
    always = dataclasses.replace(whole, stages=tuple(dataclasses.replace(s, needed=None) for s in whole.stages))
    assert np.array_equal(whole(history, target), always(history, target))


@pytest.mark.slow
def test_light_that_turned_is_not_followed():
    """The older frames saw the shadow come from elsewhere: hindsight does not trust what confidence alone would."""
    turned = functools.partial(frame, speed=SPEED)

    def make(time):
        return turned(time) if time >= -3 else frame(time, speed=-SPEED * 3, pan=PAN)

    history, target, truth = window(3, make)
    both = method("shading_warp")
    careless = both.without("light in hindsight")
    far = np.asarray(careless(history, target)) - np.asarray(method("guided_warp")(history, target))
    near = np.asarray(both(history, target)) - np.asarray(method("guided_warp")(history, target))
    assert np.square(near).sum() < 0.5 * np.square(far).sum()
    assert np.isfinite(truth).all()


def test_a_cut_does_no_harm():
    rng = np.random.default_rng(0)
    other = jnp.asarray(rng.uniform(0, 1, (*SIZE, 3)), jnp.float32)
    history, target, truth = window(3)
    history = tuple(replace(f, color=other) if f.color is not None else f for f in history[:-1]) + history[-1:]
    before, after = (db(method(name)(history, target), truth) for name in ("guided_warp", "shading_warp"))
    assert after > before - 0.05


def test_steps_by_times_and_by_counts():
    frames = tuple(replace(frame(t), time=jnp.float32(time)) for t, time in ((-3, 1.0), (-2, 2.0), (-1, 5.0)))
    at = replace(frame(0), time=jnp.float32(6.0))
    assert float(steps_on(frames, 0, 2, at, 1)) == 0.25
    assert float(steps_on(frames, 0, 2, replace(at, time=None), 1)) == 0.5
    assert float(steps_on((frames[0], frames[0]), 0, 1, at, 1)) == 1.0  # times that do not differ


def between(alpha_of=0):
    history, target, truth = window(1)
    return history, target, (frame(1),), truth


@pytest.mark.slow
def test_light_between_two_frames():
    history, target, future, truth = between()
    before, after = (
        db(method(name)(history, target, future), truth) for name in ("bidirectional_guided", "bidirectional_shading")
    )
    assert after > before + 6
    assert after > 40


@pytest.mark.slow
def test_light_at_any_time_between_two_frames():
    """A quarter of the way, the shadow is there."""
    history = (frame(-1),)
    target, truth = hide(frame(-0.5)), frame(-0.5).color
    target = replace(target, motion=target.motion / 2)
    future = (replace(frame(1), motion=1.5 * frame(1).motion),)
    before, after = (
        db(method(name)(history, target, future), truth) for name in ("bidirectional_guided", "bidirectional_shading")
    )
    assert after > before + 5


def test_light_that_stands_still_between_two_frames():
    still = functools.partial(frame, light=1)
    history, target, _ = window(1, still)
    images = [method(n)(history, target, (still(1),)) for n in ("bidirectional_guided", "bidirectional_shading")]
    assert np.array_equal(*images)
