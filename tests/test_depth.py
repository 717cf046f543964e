"""Depth where nothing was hit: however a renderer marks it, every operation and every method takes it for far."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtrapolate as jx
from jaxtrapolate.methods.extranet import minmax_depth, relative_depth
from jaxtrapolate.ops.causes import edges
from jaxtrapolate.ops.depth import apart, held, released, surface_depth, surfaces
from jaxtrapolate.ops.fill import fill_around
from jaxtrapolate.ops.grid import grid_warp
from jaxtrapolate.records import Frame, GBuffer, Keyframe, replace

SIZE = (8, 12)
MARKS = {"zero": 0.0, "negative": -1.0, "infinite": np.inf}
y, x = np.mgrid[: SIZE[0], : SIZE[1]]


def box(time, size=SIZE):
    """A box of 4 x 4 pixels that moves 1 pixel to the right a frame."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    return (rows >= 2) & (rows < 6) & (columns >= 3 + time) & (columns < 7 + time)


def depth(time, mark):
    """Of the box, 5, and nothing behind it."""
    return np.where(box(time), 5, mark).astype(np.float32)[..., None]


def flow(time, sign, change=0.0):
    """The box's flow `[H, W, 3]`; what shows nothing lies still, and its change of depth is `change`."""
    out = np.zeros((*SIZE, 3), np.float32)
    out[..., 2] = change
    out[box(time)] = (sign, 0, 0)
    return out


def texture(time):
    shade = 0.5 + 0.3 * np.sin(0.9 * (x - time) + 0.4 * y)
    return np.where(box(time), shade, 0.0).astype(np.float32)[..., None].repeat(3, -1)


def test_surface_depth():
    given = np.array([5, 0, -0.0, -1, -np.inf, np.inf, np.nan, 1e-30, 3, np.nan], np.float32).reshape(1, -1, 1)
    sky = np.array([0, 0, 0, 0, 0, 0, 0, 0, 1, 1], np.float32).reshape(1, -1, 1)
    expected = np.array([5, *[np.inf] * 5, np.nan, 1e-30, np.inf, np.inf], np.float32)
    np.testing.assert_array_equal(surface_depth(jnp.asarray(given), jnp.asarray(sky))[0, :, 0], expected)
    assert surface_depth(jnp.asarray(given, jnp.float16)).dtype == jnp.float16
    gradient = jax.grad(lambda d: jnp.sum(1 / surface_depth(d)))(jnp.asarray(given[:, [0, 1, 3, 5]]))
    np.testing.assert_allclose(gradient[0, :, 0], [-1 / 25, 0, 0, 0], rtol=1e-6)


def test_unlike_depths():
    near, far, nothing = (jnp.full((1, 1, 1), v) for v in (2.0, 50.0, np.inf))
    assert apart(near, far) == 48
    assert apart(nothing, nothing) == 0
    assert apart(near, nothing) > apart(nothing, far) > 1e20
    assert released(held(nothing)) == np.inf
    assert released(held(far)) == 50


# Operations: each is a function of the depths of frames 0 and 1, the flows between them and images.


def operations():
    image = jnp.asarray(texture(0))

    def keyframes(d, e, f, b):
        return (
            Keyframe(color=image, depth=d, forward_flow=f),
            Keyframe(color=jnp.asarray(texture(1)), depth=e, backward_flow=b),
        )

    def assisted(d, e, f, b):
        target = Keyframe(depth=e, backward_flow=b, forward_flow=0 * b)
        previous, next = keyframes(d, e, f, b)
        made = jx.interpolate_assisted(previous, next, target, 0.5)
        return made.color, made.weight, made.case, made.depth

    def bidirectional(d, e, f, b, **options):
        made = jx.interpolate_bidirectional(*keyframes(d, e, f, b), 0.5, **options)
        return made.color, made.weight, made.case, made.depth

    def over(d, e, f, b):
        still = jnp.zeros((*SIZE, 3))
        made = jx.interpolate_assisted(
            *keyframes(d, e, f, b), Keyframe(depth=e, backward_flow=still, forward_flow=still), 0.5
        )
        made = jx.overlay(made, image, d, jnp.asarray(x < 6))
        return made.color, made.depth, made.case

    def completed(kind):
        def function(d, e, f, b):
            previous, next = keyframes(d, e, f, b)
            made = jx.complete_flows(previous, replace(next, backward_flow=b[..., :2]), depth=kind)
            more = jx.complete_flows(replace(previous, forward_flow=None), next, depth=kind)
            return made.next.backward_flow, more.previous.forward_flow, more.forward_known, more.previous.depth

        return function

    def masks(taps, softness=0.0):
        def function(d, e, f, b):
            def buffers(depth):  # a position is its own frame's, and anything where nothing is
                position = jnp.concatenate([jnp.asarray(np.stack([x, y], -1), jnp.float32), jnp.minimum(depth, 5)], -1)
                return GBuffer(depth=depth, position=jnp.where(jnp.isfinite(position), position, 7))

            return jax.tree.leaves(
                jx.hole_masks(buffers(e), buffers(d), b[..., :2] + 0.1, taps=taps, softness=softness)
            )

        return function

    def carried(d, e, f, b):
        made = jx.forecast(Frame(gbuffer=GBuffer(depth=e), motion=b[..., :2]), 0.5)
        return made.motion, made.gbuffer.depth

    covered = jnp.asarray(((x + y) % 3 > 0) & (x > 1))
    return {
        "splat_nearest": lambda d, e, f, b: jx.splat_nearest(image, f[..., :2], d),
        "occlusion_motion": lambda d, e, f, b: jx.occlusion_motion(b[..., :2], e),
        "dilate_motion": lambda d, e, f, b: jx.dilate_motion(b[..., :2], e),
        "fill_around": lambda d, e, f, b: fill_around(image, covered, depth=d),
        "grid_warp": lambda d, e, f, b: grid_warp(image, f[..., :2], d, 0.5, cell=2),
        "latest_start": lambda d, e, f, b: jx.latest_start(b[..., :2], 0.5, depth=d),
        "hole_masks": masks("weighted"),
        "hole_masks_nearest": masks("nearest"),
        "hole_masks_soft": masks("weighted", 0.1),
        "disoccluded": lambda d, e, f, b: jx.disoccluded(Keyframe(depth=e, backward_flow=b), Keyframe(depth=d)),
        "edges": lambda d, e, f, b: (
            edges(GBuffer(depth=d), metric_depth=True),
            edges(GBuffer(depth=d), metric_depth=False),
        ),
        "complete_flows": completed("metric"),
        "complete_flows_ordinal": completed("ordinal"),
        "forecast": carried,
        "relative_depth": lambda d, e, f, b: relative_depth(d, None),
        "minmax_depth": lambda d, e, f, b: minmax_depth(d),
        "interpolate_assisted": assisted,
        "overlay": over,
        "interpolate_bidirectional": bidirectional,
        "interpolate_bidirectional_bilinear": lambda *a: bidirectional(*a, search=jx.SearchOptions(filter="bilinear")),
    }


OPERATIONS = operations()
SLOW = {"interpolate_bidirectional_bilinear", "hole_masks_nearest", "complete_flows_ordinal", "grid_warp"}
LONG_GRADIENTS = {"interpolate_bidirectional", "interpolate_assisted", "overlay", "hole_masks_soft"}


def arguments(mark, change=0.0):
    return [jnp.asarray(a) for a in (depth(0, mark), depth(1, mark), flow(0, 1, change), flow(1, -1, change))]


def listed(slow):
    return [pytest.param(n, marks=pytest.mark.slow) if n in slow else n for n in OPERATIONS]


@pytest.mark.parametrize("name", listed(SLOW))
def test_however_nothing_is_marked_the_answer_is_the_same(name):
    function = jax.jit(OPERATIONS[name])
    expected = [np.asarray(a) for a in jax.tree.leaves(function(*arguments(np.inf)))]
    assert not any(np.isnan(a).any() for a in expected)
    changes = (0.0, np.nan, -7.0) if name in ("disoccluded", "interpolate_assisted", "overlay") else (0.0,)
    for mark in MARKS.values():
        for change in changes:  # what is far stays far
            found = jax.tree.leaves(function(*arguments(mark, change)))
            for a, b in zip(found, expected, strict=True):
                np.testing.assert_array_equal(a, b)
    far = [np.asarray(a) for a in jax.tree.leaves(function(*arguments(1e7)))]
    if name in ("splat_nearest", "occlusion_motion", "dilate_motion", "fill_around", "grid_warp", "edges"):
        for a, b in zip(far, expected, strict=True):  # a surface that is very far: behind the others, too
            np.testing.assert_array_equal(a, b)
    if name.startswith("interpolate"):
        for a, b in zip(far[:3], expected[:3], strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("name", listed(SLOW | LONG_GRADIENTS))
def test_gradients_are_finite_where_nothing_is(name):
    def total(*given):
        leaves = [a for a in jax.tree.leaves(OPERATIONS[name](*given)) if jnp.issubdtype(a.dtype, jnp.floating)]
        return sum((jnp.sum(jnp.where(jnp.isfinite(a), a, 0)) for a in leaves), jnp.zeros(()))

    gradient = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))
    for mark in (0.0, np.inf):
        assert all(np.isfinite(g).all() for g in gradient(*arguments(mark)))


@pytest.mark.parametrize("mark", MARKS.values(), ids=MARKS)
def test_what_moves_lies_over_nothing(mark):
    """Every pixel of the box is found where it moved; what it left is the nothing beside it."""
    values, covered = jx.splat_nearest(jnp.asarray(texture(0)), flow(0, 1)[..., :2], depth(0, mark), footprint=1)
    np.testing.assert_array_equal(values, texture(1))
    np.testing.assert_array_equal(covered, ~(box(0) & ~box(1)))


@pytest.mark.parametrize("mark", [*MARKS.values(), "sky"], ids=[*MARKS, "sky"])
def test_holes_between_nothing_and_a_surface(mark):
    """The box uncovers a column of nothing; where its motion is that of nothing, it is not found. Nothing else."""

    def buffers(time):
        sky = None if mark != "sky" else jnp.asarray(~box(time), jnp.float32)[..., None]
        return GBuffer(depth=jnp.asarray(depth(time, 8.0 if mark == "sky" else mark)), sky=sky)

    left, right = box(0) & ~box(1), box(1) & ~box(0)
    for motion, expected in ((flow(1, -1)[..., :2], left), (np.zeros((*SIZE, 2), np.float32), left | right)):
        for taps in ("weighted", "nearest"):
            masks = jx.hole_masks(buffers(1), buffers(0), jnp.asarray(motion), taps=taps)
            np.testing.assert_array_equal(masks.depth[..., 0], expected)
            np.testing.assert_array_equal(masks.any[..., 0], expected)
        if mark != "sky":
            target = Keyframe(
                depth=jnp.asarray(depth(1, mark)), backward_flow=jnp.zeros((*SIZE, 3)).at[..., :2].set(motion)
            )
            hidden = jx.disoccluded(target, Keyframe(depth=jnp.asarray(depth(0, mark))))
            np.testing.assert_array_equal(hidden, expected)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.0, 0.0, 1e7), (np.nan, np.inf, 0.0)], ids=str)
def test_sky_that_a_trunk_uncovers_is_a_hole_wherever_it_is_said_to_be(place):
    one = np.ones((4, 4, 1), np.float32)

    def buffers(sky, far, at):
        return GBuffer(stencil=0 * one, sky=sky * one, depth=far * one, position=one * np.float32(at))

    trunk, sky = buffers(0, 10, (0, 0, 10)), buffers(1, 1e7, place)
    for target, source, hole in ((sky, trunk, True), (trunk, sky, True), (sky, sky, False), (trunk, trunk, False)):
        masks = jx.hole_masks(*(jax.tree.map(jnp.asarray, g) for g in (target, source)), jnp.zeros((4, 4, 2)))
        assert (np.asarray(masks.position) == hole).all()
        assert (np.asarray(masks.any) == hole).all()


def test_a_flow_turned_around_does_not_put_surfaces_where_nothing_is():
    """A point whose flow leads to nothing in the other frame is hidden there: it does not cover the pixel."""
    backward = np.zeros((1, 4, 2), np.float32)
    backward[0, 2] = (-1, 0)
    near, bare = np.full((1, 4, 1), 5, np.float32), np.full((1, 4, 1), np.inf, np.float32)
    bare[0, 3], near[0, 0] = 5, np.inf
    made = jx.complete_flows(Keyframe(depth=bare), Keyframe(depth=near, backward_flow=backward))
    np.testing.assert_array_equal(made.forward_known[0], [True, False, False, True])
    np.testing.assert_array_equal(made.next.backward_flow[0, :, 2], 0)


# Methods


def frame(time, mark, *, color=True, sky=False):
    buffers = GBuffer(depth=depth(time, mark), sky=(sky * ~box(time)).astype(np.float32)[..., None])
    motion = flow(time, -1)[..., :2]
    return Frame(color=texture(time) if color else None, motion=motion, gbuffer=buffers, time=float(time))


def given(method, mark, **options):
    history = tuple(frame(t, mark, color=t % 2 == 1, **options) for t in range(4 - (2 * method.past - 1), 4))
    future = (frame(5, mark, **options),) if method.future else ()
    return history, frame(4, mark, color=False, **options), future


def test_frames_reach_the_stages_with_nothing_at_infinity():
    method = jx.load("warp_3d")
    expected = jax.tree.leaves(method.first_values((), *given(method, np.inf)))
    for mark, sky in ((0.0, False), (-1.0, False), (3.0, True)):
        found = method.first_values((), *given(method, mark, sky=sky))
        cleared = replace(found["target"], gbuffer=replace(found["target"].gbuffer, sky=None))
        wanted = replace(frame(4, np.inf, color=False), gbuffer=GBuffer(depth=depth(4, np.inf)))
        for a, b in zip(jax.tree.leaves(cleared), jax.tree.leaves(wanted), strict=True):
            np.testing.assert_array_equal(a, b)
        assert len(jax.tree.leaves(found)) == len(expected)
    bare = Frame(motion=np.zeros((*SIZE, 2), np.float32))
    assert surfaces(bare) is bare


METHODS = ("occlusion_warp", "reproject", "warp_3d")
LONG = ("grid_warp", "grid_extrapolate", "softmax_splat", "bidirectional_image", "bidirectional")


@pytest.mark.parametrize("name", [*METHODS, *(pytest.param(n, marks=pytest.mark.slow) for n in LONG)])
def test_methods_take_nothing_for_far(name):
    """Whatever marks it, a box that moves before nothing is where it should be: the same image, and the right one."""
    # the bounds below are of linear light, in which PSNR is taken here, too
    method = jx.load(name, space="linear") if name.startswith("grid_") else jx.load(name)
    truth = texture(4)
    images = [np.asarray(method(*given(method, mark))) for mark in MARKS.values()]
    images += [np.asarray(method(*given(method, mark, sky=True))) for mark in (1.0, 1e7)]
    assert np.isfinite(images[0]).all()
    for image in images[1:]:
        np.testing.assert_allclose(image, images[0], atol=1e-6)
    if name == "reproject":  # it shades misses, and has no shader here: the box is right
        np.testing.assert_allclose(images[0][box(4)], truth[box(4)], atol=1e-5)
    else:
        least = {"softmax_splat": 40, "grid_warp": 25, "grid_extrapolate": 18}.get(name, 60)
        assert jx.psnr(images[0], truth) > least


@pytest.mark.slow
@pytest.mark.parametrize("name", [*METHODS, *LONG, "guided_net"])
def test_gradients_of_methods_are_finite(name):
    method = jx.load(name)
    history, target, future = jax.tree.map(jnp.asarray, given(method, 0.0))

    def total(history, target, future):
        return jnp.sum(jnp.square(method.function(method.state, (), history, target, future)[1]))

    gradient = jax.grad(total, argnums=(0, 1, 2))(history, target, future)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradient))
