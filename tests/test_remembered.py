"""What rendered frames have shown and the newest hides: a box that passes before a wall with light of its own."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_seen import FOCAL, SIZE, STEP, hide, paint
from test_seen import frame as seen_frame

import jaxtrapolate as jx
from jaxtrapolate.methods import memory
from jaxtrapolate.ops.layered import Points, advanced, from_layer, margins, no_points
from jaxtrapolate.ops.projection import fitted_projection
from jaxtrapolate.records import replace

ROWS, COLUMNS = margins(SIZE)
ALL = jnp.ones((*SIZE, 1), bool)


@pytest.fixture(autouse=True)
def plain(unchecked):
    """NumPy arrays are taken, and the library's own errors seen."""


def box(time):
    """Where the box is."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    left = 40 + STEP * time
    return (x >= left) & (x < left + 12) & (y >= 15) & (y < 45)


def points(frame, *, static=True):
    """What a frame shows, the wall alone."""
    color = frame.color
    known = jnp.ones((*SIZE, 1), bool)
    return memory.points_of(frame.gbuffer, color, known & (frame.gbuffer.stencil < 0.5) if static else known)


def layers(frames):
    """The layer after each of some rendered frames."""
    layer = no_points(SIZE, 3, jnp.float32)
    for before, now in itertools.pairwise(frames):
        matrix, misses = fitted_projection(now.gbuffer.position, jnp.ones(SIZE, bool))
        assert misses < 0.01
        layer, *_ = advanced(layer, points(before), points(now, static=False), matrix, ALL)
    return layer


def expected_color(position):
    """Of the wall's points."""
    return 0.6 * paint(2 * position[..., 0], 2 * position[..., 1])[..., None] * [1, 0.9, 0.8]


def test_what_the_box_hides_and_was_seen_before_it_came():
    times = range(-9, 0)
    layer = layers([seen_frame(t, still=True) for t in times])
    known = np.asarray(layer.points.known)[..., 0]
    hidden = np.zeros(known.shape, bool)
    hidden[ROWS:-ROWS, COLUMNS:-COLUMNS] = box(-1) & ~box(-9)
    assert hidden.sum() > 300
    assert np.array_equal(known, hidden)
    position = np.float64(layer.points.position)[known]
    np.testing.assert_allclose(position[:, 2], 10, atol=1e-5)
    np.testing.assert_allclose(np.asarray(layer.points.values)[known], expected_color(position), atol=1e-5)


def test_what_a_moving_camera_leaves_stays_at_its_border():
    """Points keep their place and their light, whatever pixel they land in; as far as the margin reaches."""
    layer = layers([seen_frame(t) for t in range(-16, 0)])
    known = np.asarray(layer.points.known)[..., 0]
    position = np.float64(layer.points.position)[known]
    np.testing.assert_allclose(np.asarray(layer.points.values)[known], expected_color(position), atol=1e-4)
    inner = known[ROWS:-ROWS, COLUMNS:-COLUMNS]
    assert inner[box(-1)].mean() > 0.95  # the box has come from the left, over what was seen
    assert not inner[~box(-1)].any()
    beside = known[ROWS:-ROWS, :COLUMNS]
    assert beside.mean() > 0.95
    assert not known[:, -COLUMNS:].any()
    x = (position[:, 0] + 10 / FOCAL) * FOCAL / position[:, 2] + 48  # the camera is at x = -10 / FOCAL
    column = np.nonzero(known)[1] - COLUMNS
    assert np.abs(x - column).max() < 0.501


def test_what_is_asked_for_is_found_where_it_is_known():
    frames = [seen_frame(t) for t in range(-9, 0)]
    layer, target = layers(frames), seen_frame(0)
    found, seen = (np.asarray(a) for a in from_layer(layer, points(target)))
    revealed = box(-1)[:, :-1]
    revealed = np.pad(revealed, ((0, 0), (0, 1))) & ~box(0)
    revealed[:, 1:] |= box(-1)[:, 1:] & ~box(0)[:, 1:]
    inner = revealed & np.roll(revealed, 1, 1) & np.roll(revealed, -1, 1)
    assert inner.sum() > 60
    assert seen[..., 0][inner].mean() > 0.95
    off = np.abs(found - np.asarray(target.color))[seen[..., 0]]
    assert off.mean() < 0.05  # bilinear, of light that waves in 4 pixels
    assert not seen[..., 0][box(0)].any()
    away = points(replace(target, gbuffer=replace(target.gbuffer, normal=-target.gbuffer.normal)))
    assert not np.asarray(from_layer(layer, away)[1]).any()


def test_the_nearer_of_two_points_is_kept():
    """Two walls behind what the newest frame shows, at its pixels; and what is gone is not kept."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    rays = np.stack([(x - 48) / FOCAL, (y - 30) / FOCAL, np.ones_like(x)], -1)
    ones, zero = np.ones((*SIZE, 1), np.float32), np.zeros((*SIZE, 3), np.float32)
    matrix = jnp.asarray([[FOCAL, 0, 48, 0], [0, FOCAL, 30, 0], [0, 0, 1, 0]], jnp.float32)

    def wall(depth):
        return Points(jnp.asarray(rays * depth), jnp.asarray(zero), jnp.asarray(depth * ones), jnp.asarray(ones > 0))

    layer = no_points(SIZE, 1, jnp.float32)
    for first, second in ((7, 9), (9, 7)):
        both = advanced(advanced(layer, wall(first), wall(5), matrix, ALL)[0], wall(second), wall(5), matrix, ALL)[0]
        inner = (slice(ROWS, -ROWS), slice(COLUMNS, -COLUMNS))
        assert (np.asarray(both.points.values)[inner] == 7).all()
    assert not np.asarray(advanced(layer, wall(7), wall(9), matrix, ALL)[0].points.known).any()
    assert not np.asarray(advanced(layer, wall(7), wall(5), 0 * matrix, ALL)[0].points.known).any()


@functools.cache
def method():
    return jx.load("shading_warp")


def play(frames):
    """The carry after the last of some frames, all but the first few of which have a history, and its image."""
    carry = method().init((), frames[0])
    image = frames[0].color
    for k, target in enumerate(frames):
        carry, image = method().step(carry, tuple(frames[max(0, k - 6) : k]), target)
    return carry, np.asarray(image)


def waiting(time):
    """The box moves right until time -16, stands there until -1, and goes on."""
    place, before = (t + 12 if t < -16 else -4 if t < 0 else -3 for t in (time, time - 1))
    frame = seen_frame(place, still=True)
    step = np.eye(4)
    step[0, 3] = -STEP * 5 / FOCAL * (place - before)
    objects = jnp.asarray(step[None], jnp.float32)
    return replace(frame, motion=frame.motion * (place - before), objects=objects, time=jnp.float32(time))


@pytest.mark.slow
def test_a_method_fills_holes_by_what_it_remembers():
    """The wall behind the box was seen before all frames that a method is handed."""
    frames = [waiting(t) if t % 2 else hide(waiting(t)) for t in range(-25, 1)]
    truth, holes = waiting(0).color, box(-4) & ~box(-3)
    assert holes.sum() == 150
    _, image = play(frames)
    alone = np.asarray(method()(tuple(frames[-6:-1]), frames[-1]))

    def error(image):
        return np.square(np.asarray(jx.tonemap(jnp.asarray(image))) - np.asarray(jx.tonemap(truth)))[holes].mean()

    assert error(image) < 1e-6 * error(alone), "the camera stands: what is remembered is exact, however it is compiled"
    np.testing.assert_array_equal(image[~holes], alone[~holes])


@pytest.mark.slow
def test_a_cut_and_a_change_of_light():
    """After a cut nothing is remembered; light that changes everywhere changes what is remembered."""
    frames = [seen_frame(t, still=True) for t in range(-9, 0)]
    brighter = [
        seen_frame(t, still=True, light=2.0) if t > -3 else f for t, f in zip(range(-9, 0), frames, strict=True)
    ]

    def moved(frame):
        position = frame.gbuffer.position + jnp.asarray([0, 0, 30.0])
        return replace(frame, gbuffer=replace(frame.gbuffer, position=position))

    usual, bright, cut = (play(f)[0] for f in (frames, brighter, [*frames[:-1], moved(frames[-1])]))
    assert np.asarray(usual.layer.points.known).sum() > 200
    assert not np.asarray(cut.layer.points.known).any()
    both = (np.asarray(usual.layer.points.known) & np.asarray(bright.layer.points.known))[..., 0]
    ratio = np.asarray(bright.layer.points.values)[both][:, :3] / np.asarray(usual.layer.points.values)[both][:, :3]
    np.testing.assert_allclose(ratio, 2, rtol=2e-3)


@pytest.mark.slow
def test_light_that_was_changing_is_not_remembered():
    """The box drives behind its own shadow: what it hides was lit until that came, and dark when it was seen last."""

    def shadowed(time):
        frame = seen_frame(time, still=True)
        shadow = np.roll(box(time), 14, 1) & ~box(time)
        return replace(frame, color=jnp.where(shadow[..., None], 0.2 * frame.color, frame.color))

    usual, dark = (
        np.asarray(play([make(t) for t in range(-9, 0)])[0].layer.points.known).sum()
        for make in (functools.partial(seen_frame, still=True), shadowed)
    )
    assert usual > 200
    assert dark < 0.1 * usual


@pytest.mark.slow
@pytest.mark.parametrize("light", [1e-30, 1e30])
def test_light_beyond_all_measure_stays_finite(light):
    """In one of the frames, and in those after it."""
    frames = [seen_frame(t, still=True) for t in range(-9, 0)]
    frames[4:6] = [replace(f, color=f.color * light) for f in frames[4:6]]
    carry, _ = play(frames)
    known = np.asarray(carry.layer.points.known)[..., 0]
    assert np.isfinite(np.asarray(carry.layer.points.values)[known]).all()
    image = method().step(carry, tuple(frames[-4:]), hide(seen_frame(0, still=True)))[1]
    assert np.isfinite(np.asarray(image)).all()


@pytest.mark.slow
def test_frames_that_say_nothing_are_forgotten():
    """Positions that are not finite, or absent, in one of the frames; the carry stays one pytree."""
    frames = [seen_frame(t) for t in range(-6, 0)]
    start = method().init((), frames[0])
    spoilt = jnp.asarray(frames[3].gbuffer.position).at[10:20].set(jnp.nan)
    for position in (spoilt, jnp.full_like(spoilt, jnp.inf), None):
        worse = replace(frames[3], gbuffer=replace(frames[3].gbuffer, position=position))
        carry, _ = play([*frames[:3], worse, *frames[4:]])
        assert jax.tree.structure(carry) == jax.tree.structure(start)
        assert [a.dtype for a in jax.tree.leaves(carry)] == [a.dtype for a in jax.tree.leaves(start)]
        known = np.asarray(carry.layer.points.known)[..., 0]
        assert np.isfinite(np.asarray(carry.layer.points.values)[known]).all()
