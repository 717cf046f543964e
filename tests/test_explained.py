"""What a network may say: its correction held within what its inputs differ by, and nothing where nothing changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow
from synthetic import texture

import jaxtrapolate as jx
from jaxtrapolate.networks.explained import GAIN, TOLERANCE, explained, standing
from jaxtrapolate.records import replace
from jaxtrapolate.scenes import TRAINING_SEEDS, SceneSequence

SHAPE = (7, 9, 3)


def random(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def test_corrections_are_held_by_a_loop():
    """Within twice what the inputs differ by among a pixel and its neighbours; free in holes."""
    correction, images = 3 * random(*SHAPE), 0.3 * random(4, *SHAPE, seed=1)
    images[:, 2:5, 3:8] = images[0, 2:5, 3:8]  # here they agree
    free = random(*SHAPE[:2], 1, seed=2) > 1
    expected = np.float64(correction)
    for r in range(SHAPE[0]):
        for c in range(SHAPE[1]):
            near = np.float64(images[:, max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2])
            limit = 2 * (near.max(0) - near.min(0)).max() + 0.02
            if not free[r, c, 0]:
                expected[r, c] = np.clip(expected[r, c], -limit, limit)
    found = explained(jnp.asarray(correction), tuple(map(jnp.asarray, images)), free=jnp.asarray(free))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
    assert (GAIN, TOLERANCE) == (2, 0.02)
    small = jnp.asarray(0.01 * correction / np.abs(correction).max())
    np.testing.assert_array_equal(explained(small, tuple(map(jnp.asarray, images))), small)
    pairs = jnp.stack([jnp.asarray(correction)] * 2), tuple(jnp.stack([jnp.asarray(image)] * 2) for image in images)
    single = explained(jnp.asarray(correction), tuple(map(jnp.asarray, images)))
    np.testing.assert_allclose(jax.vmap(explained)(*pairs)[1], single, rtol=1e-6)


@pytest.mark.slow
def test_gradients_of_corrections_are_finite():
    correction, images = jnp.asarray(random(*SHAPE)), tuple(map(jnp.asarray, random(3, *SHAPE, seed=1)))
    for given in (images, (jnp.zeros(SHAPE),) * 3):
        found = jax.grad(lambda *a: jnp.sum(jnp.square(explained(*a))), argnums=(0, 1))(correction, given)
        assert all(np.isfinite(g).all() for g in jax.tree.leaves(found))
    within = explained(correction, images) == correction
    passed = jax.grad(lambda c: jnp.sum(explained(c, images)))(correction)
    np.testing.assert_array_equal(passed[within], 1)
    np.testing.assert_array_equal(passed[~within], 0)


def test_what_stands_still_is_found_tile_by_tile():
    """One pixel that changes takes its tile of 16 x 16 and those around it, and no more; so does one that moves."""
    image, motion = jnp.asarray(random(50, 70, 3)), jnp.zeros((50, 70, 2))
    assert standing((image, image, image), motion, motion).all()
    expected = np.ones((50, 70, 1), bool)
    expected[16:, 32:] = False  # the tile of row 40 and column 60 is the third by the fourth
    for changed in (image.at[40, 60, 1].multiply(1.001), image.at[40, 60, 1].set(jnp.nan)):
        np.testing.assert_array_equal(standing((image, image, changed), motion, motion), expected)
        np.testing.assert_array_equal(standing((changed, changed, image), motion, motion), expected)
    np.testing.assert_array_equal(standing((image, image), motion, motion.at[40, 60, 0].set(1e-3)), expected)
    assert standing((image[:1, :1], image[:1, :1])).all()


def psnr(image, truth, mask):
    """As displayed, where a mask `[H, W]` says."""
    return float(jx.psnr(jx.tonemap(image), jx.tonemap(truth), mask=jnp.asarray(mask[..., None])))


# Networks with their default weights


def lit(time, *, lamp=1.0, step=2, size=(48, 72), albedo=False):
    """A wall that moves by whole pixels, with a lamp on it."""
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    x = x + step * time
    color = np.float32(0.6 * texture(x, y))
    on = (abs(x - 40) < 6) & (abs(y - 24) < 6)
    color[on] = lamp
    motion = np.broadcast_to(np.float32([step, 0]), (*size, 2))
    normal = np.broadcast_to(np.float32([0, 0, 1]), (*size, 3))
    buffers = jx.GBuffer(
        albedo=np.full((*size, 3), 0.5, np.float32) if albedo else None,
        normal=normal,
        depth=np.full((*size, 1), 5, np.float32),
        stencil=np.zeros((*size, 1), np.float32),
    )
    return jax.tree.map(jnp.asarray, jx.Frame(color, buffers, motion, time=float(time))), on


def without_color(frame):
    return replace(frame, color=None)


@pytest.mark.slow
def test_a_lamp_does_not_ring():
    """From two pixels beside it on all that the network sees agrees, and so does its answer, but for its tolerance."""
    frames = [lit(time, lamp=3e4)[0] for time in range(6)]
    history = tuple(frame if time % 2 == 0 else without_color(frame) for time, frame in enumerate(frames[:5]))
    image = np.asarray(jx.load("guided_net")(history, without_color(frames[5])))
    truth, on = np.asarray(frames[5].color), lit(5)[1]
    wall = np.ones_like(on)
    wall[:, -12:] = False  # beyond that the oldest frame does not reach
    for j in range(-2, 3):
        for i in range(-2, 3):
            wall &= ~np.roll(on, (j, i), (0, 1))
    assert np.abs(np.log1p(image) - np.log1p(truth))[wall].max() < 0.1


def test_around_a_contradiction_next_to_nothing_is_believed():
    """Up to 4 pixels from where inputs differ by 4, which no shading does; beyond it they say what they may."""
    first = jnp.full((13, 15, 1), 0.5)
    second = first + 0.25
    for apart, inside in ((4.0, 0.02), (3.0, 0.02 + 0.5 * 0.5), (2.0, 0.52)):
        other = second.at[6, 7].set(0.5 + apart)
        held = np.asarray(explained(jnp.full((13, 15, 1), 9.0), (first, other)))[..., 0]
        near = np.zeros((13, 15), bool)
        near[2:11, 3:12] = True
        touching = np.zeros((13, 15), bool)
        touching[5:8, 6:9] = True
        np.testing.assert_allclose(held[near & ~touching], inside, rtol=1e-5)
        np.testing.assert_allclose(held[~near], 0.52, rtol=1e-5)


def test_light_on_what_is_dark_is_no_contradiction():
    """Divided by next to no albedo it is bright, but not shown so; what is shown says where a lamp is."""
    first = jnp.full((9, 11, 1), 0.5)
    inputs, correction = (first, first.at[4, 5].set(6.0)), jnp.full((9, 11, 1), 9.0)
    held = explained(correction, inputs, shown=lambda image: jnp.log1p(0.01 * jnp.expm1(image)))
    np.testing.assert_allclose(held[3:6, 4:7], 9.0, rtol=1e-6)
    np.testing.assert_allclose(explained(correction, inputs)[3:6, 4:7], TOLERANCE, rtol=1e-5)


@pytest.mark.parametrize("lamp", [1.0, *slow(100.0), 3e4])
@pytest.mark.parametrize("name", ["guided_warp", *slow("guided_net")])
def test_beside_a_lamp_the_wall_is_as_it_was(name, lamp):
    """One to four pixels from it, and in it: motion by whole pixels is no mean of both."""
    frames = [lit(time, lamp=lamp, albedo=True)[0] for time in range(6)]
    history = tuple(frame if time % 2 == 0 else without_color(frame) for time, frame in enumerate(frames[:5]))
    method = jx.load(name)
    image = method(history[-(2 * method.past - 1) :], without_color(frames[5]))
    on = lit(5)[1]
    near = np.any([np.roll(on, (j, i), (0, 1)) for j in range(-4, 5) for i in range(-4, 5)], 0)
    assert psnr(image, frames[5].color, near) > {"guided_warp": 50, "guided_net": 60}[name]


def test_a_still_lamp_is_interpolated_exactly():
    frame = lit(0, lamp=100.0)[0]
    pair = (replace(frame, time=0.0),), jx.Frame(time=1.0), (replace(frame, time=2.0),)
    image = jx.load("interpolator")(*pair)
    np.testing.assert_array_equal(image, frame.color)


def glowing(time, size=(56, 88)):
    """Panels that shine the same whatever their texture, and a wall that does not; whole scene seen in passing."""
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    u, v = x + 2.3 * time, y + 0.4 * time
    albedo = np.float32(np.clip(texture(3 * u, 3 * v), 0.05, 1))
    panel = (abs(u % 60 - 30) < 18) & (abs(v - 28) < 20)
    color = np.where(panel[..., None], np.float32([3, 2, 1]), 0.4 * albedo)
    motion = np.broadcast_to(np.float32([2.3, 0.4]), (*size, 2))
    normal = np.broadcast_to(np.float32([0, 0, 1]), (*size, 3))
    one = np.ones((*size, 1), np.float32)
    buffers = jx.GBuffer(albedo=albedo, normal=normal, depth=5 * one, stencil=0 * one, roughness=one, metallic=0 * one)
    return jax.tree.map(jnp.asarray, jx.Frame(np.float32(color), buffers, motion, time=float(time))), panel


@pytest.mark.slow
def test_the_edges_of_what_shines_do_not_break():
    """No guide says where a panel ends: beside its edges the guided warp is the composite, which fetches bilinearly."""
    frames = [glowing(time)[0] for time in range(6)]
    history = tuple(frame if time % 2 == 0 else without_color(frame) for time, frame in enumerate(frames[:5]))
    panel = glowing(5)[1]
    edge = np.zeros_like(panel)
    inner = slice(4, -4), slice(4, -14)
    edge[inner] = np.any([np.roll(panel, by, axis) != panel for axis in (0, 1) for by in (-1, 1)], 0)[inner]

    def decibels(name):
        method = jx.load(name)
        image = method(history[-(2 * method.past - 1) :], without_color(frames[5]))
        return psnr(image, frames[5].color, edge)

    assert decibels("guided_warp") > decibels("occlusion_warp") - 0.3


@pytest.mark.slow
def test_no_texture_is_printed_on_what_shines():
    """Inside panels the network is not behind the guided warp, whose first guess would print the albedo there."""
    frames = [glowing(time)[0] for time in range(6)]
    history = tuple(frame if time % 2 == 0 else without_color(frame) for time, frame in enumerate(frames[:5]))
    truth, panel = np.asarray(frames[5].color), glowing(5)[1]
    inside = np.zeros_like(panel)
    inside[6:-6, 6:-6] = panel[6:-6, 6:-6]
    for k in (-3, 3):
        inside &= np.roll(panel, k, 0) & np.roll(panel, k, 1)

    def decibels(name):
        method = jx.load(name)
        image = method(history[-(2 * method.past - 1) :], without_color(frames[5]))
        return float(jx.psnr(jx.tonemap(image), jx.tonemap(jnp.asarray(truth)), mask=jnp.asarray(inside[..., None])))

    assert decibels("guided_net") > 35


@pytest.mark.slow
def test_one_changed_pixel_does_not_take_the_frame():
    """What stands still elsewhere is returned to the last bits."""
    frame = lit(0, step=0, size=(64, 96))[0]
    other = replace(frame, color=frame.color.at[60, 90].multiply(1.001))
    for history in ((other, *[frame] * 4), (*[frame] * 4, other)):
        image = np.asarray(jx.load("guided_net")(history, without_color(frame)))
        np.testing.assert_allclose(image[:32, :64], frame.color[:32, :64], rtol=1e-6)


def test_the_order_of_default_weights():
    """On a training seed: network above guided warp above warp, and the interpolator above the blend."""
    from jaxtrapolate.evaluation.windows import arguments, windows

    sequence = SceneSequence("walkers", TRAINING_SEEDS[-7], frames=7, size=(72, 128))
    (window,) = windows(sequence, [5], past=3, future=1)

    def decibels(name):
        image = jx.load(name)(*arguments(jx.load(name), window))
        return float(jx.psnr(jx.tonemap(image), jx.tonemap(jnp.asarray(window.truth.color))))

    found = {name: decibels(name) for name in ("guided_net", "guided_warp", "warp", "interpolator", "blend")}
    assert found["guided_net"] > found["guided_warp"] + 0.2 > found["warp"] + 1.2, found
    assert found["interpolator"] > found["blend"] + 1, found
