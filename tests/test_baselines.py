"""The baselines of the bidirectional-reprojection paper as methods, and methods with a stage on the host."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow
from synthetic import FAR, NEAR, make_frame, texture

import jaxtrapolate as jx
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.methods import Method, Stage
from jaxtrapolate.methods.between import time_fraction
from jaxtrapolate.methods.reprojection import reprojection, steps_onward
from jaxtrapolate.ops.radiance import compress
from jaxtrapolate.records import Frame, GBuffer, replace

BETWEEN = ("blend", "half_motion", "grid_warp", "softmax_splat", "dis")
ONWARD = ("reproject", "warp_3d", "grid_extrapolate")
NAMES = BETWEEN + ONWARD
QUICKER = {"dis": {"preset": "ultrafast"}}  # to compile
SIZE = (24, 36)
SHIFT = (4, -2)  # whole pixels a frame; the middle is at half of it


@pytest.fixture(scope="module")
def methods():
    return {name: jx.load(name, **QUICKER.get(name, {})) for name in NAMES}


def sliding(time, size=SIZE, **buffers):
    """A texture that moves by SHIFT a frame."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
    color = texture(x - SHIFT[0] * time, y - SHIFT[1] * time).astype(np.float32)
    motion = np.broadcast_to(-np.float32(SHIFT), (*size, 2)).copy()
    return Frame(color=color, motion=motion, time=float(time), **buffers)


def layered(time, size=SIZE):
    """A box before a still wall, twelve pixels a frame faster; depth, and no other buffer."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
    left = 2 + 12 * time
    box = (x >= left) & (x < left + 8) & (y >= 8) & (y < 17)
    color = np.where(box[..., None], 2 + texture(x - left, y), texture(x, y)).astype(np.float32)
    motion = np.where(box[..., None], np.float32([-12, 0]), np.float32(0)).astype(np.float32)
    depth = np.where(box, NEAR, FAR).astype(np.float32)[..., None]
    return Frame(color=color, motion=motion, gbuffer=GBuffer(depth=depth), time=float(time)), box


def given(name, make=make_frame, size=SIZE):
    """What a method sees: two frames around one in the middle that has nothing but its time, or one frame before it."""
    if name in BETWEEN:
        return (make(0, size),), Frame(time=0.5), (make(1, size),)
    return (make(2, size),), hide(make(3, size)), ()


def stages(method, history, target, future):
    """The method stage by stage, each compiled on its own."""
    values = {"carry": (), "history": history, "target": target, "future": future}
    for stage in method.active(history, target, future):
        values |= method.jitted_stages[stage.name](method.state, values)
    return values


def test_names_and_kinds(methods):
    for name, method in methods.items():
        assert method.name == name
        assert (method.kind, method.past, method.future) == (
            ("interpolation", 1, 1) if name in BETWEEN else ("extrapolation", 1, 0)
        )


HEAVY = ("grid_warp", "softmax_splat", "dis", "grid_extrapolate")


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in HEAVY else n for n in BETWEEN])
def test_still_frames_are_returned(methods, name):
    frame = replace(make_frame(1, SIZE), motion=np.zeros((*SIZE, 2), np.float32))
    image = methods[name]((frame,), Frame(time=1.5), (replace(frame, time=2.0),))
    assert np.array_equal(image, frame.color)


@pytest.mark.slow
@pytest.mark.parametrize("name", ONWARD)
def test_a_still_frame_is_returned(methods, name):
    frame = replace(make_frame(1, SIZE), motion=np.zeros((*SIZE, 2), np.float32))
    assert np.array_equal(methods[name]((frame,), replace(hide(frame), time=2.0)), frame.color)


@pytest.mark.parametrize("name", ["half_motion", pytest.param("grid_warp", marks=pytest.mark.slow), "softmax_splat"])
def test_translation_is_exact_between(methods, name):
    history, target, future = given(name, sliding)
    truth = sliding(0.5).color
    inner = (slice(3, -3), slice(5, -5))
    np.testing.assert_allclose(np.asarray(methods[name](history, target, future))[inner], truth[inner], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ONWARD)
def test_translation_is_exact_onward(methods, name):
    history, target, _ = given(name, sliding)
    inner = (slice(None, -3), slice(5, None))
    np.testing.assert_allclose(np.asarray(methods[name](history, target))[inner], sliding(3).color[inner], atol=1e-5)


@pytest.mark.slow
def test_translation_is_found_by_optical_flow(methods):
    image = methods["dis"](*given("dis", sliding, (48, 64)))
    truth = sliding(0.5, (48, 64)).color
    blend = methods["blend"](*given("dis", sliding, (48, 64)))
    inner = (slice(8, -8), slice(8, -8))
    error, naive = (np.abs(np.asarray(a)[inner] - truth[inner]).mean() for a in (image, blend))
    assert error < 0.01
    assert error < 0.1 * naive


@pytest.mark.slow
@pytest.mark.parametrize("name", ["grid_warp", "warp_3d", *slow("softmax_splat", "grid_extrapolate")])
def test_a_box_before_a_wall(methods, name):
    """The box arrives whole; the wall away from it is untouched; the uncovered wall is not the box."""
    at = 0.5 if name in BETWEEN else 1
    (before, was), (truth, box) = layered(0), layered(at)
    target, future = Frame(time=at), (layered(1)[0],) if name in BETWEEN else ()
    image = np.asarray(methods[name]((before,), target, future))
    core = box & np.roll(box, 2, 0) & np.roll(box, -2, 0) & np.roll(box, 2, 1) & np.roll(box, -2, 1)
    if name == "softmax_splat":  # its wall, 2 below, shines through, but less than in a mean where colours are mixed
        whole, mixed, wall = (np.asarray(compress(jnp.asarray(a))) for a in (truth.color, image, truth.color - 2))
        assert ((whole - mixed) / (whole - wall))[core].max() < 0.5
    else:
        assert np.abs(image - truth.color)[core].max() < 1e-4
    assert np.array_equal(image[20:], truth.color[20:])
    uncovered = was & ~box & (np.mgrid[: SIZE[0], : SIZE[1]][1] < 6)
    assert np.abs(image - truth.color)[uncovered].mean() < 0.6  # the box is 2 above the wall


def test_uncovered_wall_comes_from_the_other_frame(methods):
    (before, was), (after, _), (truth, box) = layered(0), layered(1), layered(0.5)
    image = np.asarray(methods["softmax_splat"]((before,), Frame(time=0.5), (after,)))
    hole = was & ~box & (np.mgrid[: SIZE[0], : SIZE[1]][1] < 6)
    np.testing.assert_allclose(image[hole], truth.color[hole], atol=1e-4)


# Oracles


def test_blend_is_the_loop(methods):
    history, _, future = given("blend")
    for time in (0.5, 0.25):
        image = np.asarray(methods["blend"](history, Frame(time=time), future))
        expected = (1 - time) * history[0].color.astype(np.float64) + time * future[0].color
        np.testing.assert_allclose(image, expected, atol=1e-6)
    assert np.array_equal(methods["blend"](history, Frame(time=0.0), future), history[0].color)
    assert np.array_equal(methods["blend"](history, Frame(time=1.0), future), future[0].color)


def fetch_loop(image, x, y):
    """Bilinear, the edge repeated, float64."""
    height, width, _ = image.shape
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    i, j = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
    t, u = x - i, y - j
    i1, j1 = min(i + 1, width - 1), min(j + 1, height - 1)
    upper = (1 - t) * image[j, i].astype(np.float64) + t * image[j, i1]
    return (1 - u) * upper + u * ((1 - t) * image[j1, i].astype(np.float64) + t * image[j1, i1])


@pytest.mark.parametrize("drawn", [False, True])
def test_half_motion_is_the_loop(drawn):
    """Also where the target has motion: the next frame's then leads to it, and both are chained."""
    first, middle, last = (make_frame(t, SIZE) for t in (0, 1, 2))
    target = hide(middle) if drawn else Frame(time=1.0)
    image = np.asarray(jx.load("half_motion", space="linear")((first,), target, (last,)))
    whole = np.asarray(last.motion, np.float64)
    expected = np.zeros((*SIZE, 3))
    for y, x in np.ndindex(SIZE):
        v = whole[y, x]
        if drawn:
            v = v + fetch_loop(middle.motion, x + v[0], y + v[1])
        expected[y, x] = fetch_loop(first.color, x + v[0] / 2, y + v[1] / 2)
    np.testing.assert_allclose(image, expected, atol=1e-5)


def test_time_is_counted_where_it_is_not_there():
    make = lambda time, color=True: Frame(color=np.zeros((2, 3, 3), np.float32) if color else None, time=time)  # noqa: E731
    assert float(time_fraction((make(None),), Frame(), (make(2.0),))) == 0.5
    assert float(time_fraction((make(1.0),), Frame(time=1.25), (make(2.0),))) == 0.25
    assert float(time_fraction((make(None), make(None, False)), Frame(), (make(None, False), make(None)))) == 0.5
    assert float(time_fraction((make(None),), Frame(), (make(None, False), make(None)))) == pytest.approx(1 / 3)
    assert float(time_fraction((make(1.0),), Frame(time=1.0), (make(1.0),))) == 0.5
    assert float(steps_onward((make(1.0),), Frame(time=1.5))) == 0.5
    assert float(steps_onward((make(0.0), make(2.0)), Frame(time=3.0))) == 0.5
    assert float(steps_onward((make(None), make(None, False)), Frame())) == 2


# Reprojection


def test_reproject_is_the_warp_and_shades_what_misses():
    (before, _), (after, box) = layered(0), layered(1)
    target = hide(after)
    plain = np.asarray(reprojection()((before,), target))
    assert np.array_equal(plain, jx.load("warp", space="tone")((before,), target))
    asked = []

    def shade(target, missed):
        asked.append(target)
        return jnp.full((*missed.shape, 3), 7.0)

    method = reprojection(shade)
    image = np.asarray(method((before,), target))
    (_, was) = layered(0)
    uncovered = was & ~box
    assert (image[uncovered] == 7).all()
    assert np.array_equal(image[~uncovered], plain[~uncovered])
    assert asked[0].color is None
    assert method.name == "reproject_shade"
    assert "reproject_shade" not in jx.method_names()


def test_without_depth_only_what_is_outside_misses():
    first, second = sliding(0), sliding(1)
    image = np.asarray(reprojection(lambda t, m: jnp.full((*m.shape, 3), 7.0))((first,), hide(second)))
    assert (image[:, :4] == 7).all()
    assert (image[-2:] == 7).all()
    assert (image[:-2, 4:] < 2).all()


# Cameras


def camera(eye):
    """At (eye, 0, 0), looking along -z, 90 degrees wide."""
    view = np.eye(4, dtype=np.float32)
    view[0, 3] = -eye
    near, far = 0.1, 100
    ratio = SIZE[1] / SIZE[0]
    projection = np.zeros((4, 4), np.float32)
    projection[0, 0], projection[1, 1], projection[3, 2] = 1, ratio, -1
    projection[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
    return jx.Camera(view, projection)


def plane(eye, depth=6.0):
    """A wall at `depth` seen from there: its points, and colour by place; a pixel is depth * 2 / 36 wide."""
    width = depth * 2 / SIZE[1]
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    px, py = eye + (x + 0.5 - SIZE[1] / 2) * width, -(y + 0.5 - SIZE[0] / 2) * width
    position = np.stack([px, py, np.full(SIZE, -depth)], -1).astype(np.float32)
    color = texture(px / width, py / width).astype(np.float32)
    stencil, far = np.zeros((*SIZE, 1), np.float32), np.full((*SIZE, 1), depth, np.float32)
    return color, GBuffer(position=position, depth=far, stencil=stencil)


@pytest.mark.parametrize("name", ["warp_3d", *slow("grid_extrapolate")])
@pytest.mark.parametrize("moving", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_cameras_tell_the_motion_of_what_is_static(methods, name, moving):
    """The view turns back: motion carried on is wrong there, cameras are right. Without motion vectors they suffice."""
    width = 12 / SIZE[1]
    color, buffers = plane(0.0)
    motion = np.broadcast_to(np.float32([3, 0]), (*SIZE, 2)).copy() if moving else None
    newest = Frame(color=color, gbuffer=buffers, camera=camera(0.0), motion=motion, time=1.0)
    target = Frame(camera=camera(-2 * width), time=2.0)
    image = np.asarray(methods[name]((newest,), target))
    truth, _ = plane(-2 * width)
    np.testing.assert_allclose(image[:, 3:], truth[:, 3:], atol=1e-3)
    if moving:  # a dynamic object goes on as it did
        ids = np.ones((*SIZE, 1), np.float32)
        dynamic = replace(newest, gbuffer=replace(buffers, stencil=ids))
        image = np.asarray(methods[name]((dynamic,), target))
        np.testing.assert_allclose(image[:, :-4], color[:, 3:-1], atol=1e-4)


# All of them


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in HEAVY else n for n in NAMES])
def test_compiled_whole_is_stage_by_stage(methods, name):
    frames = given(name)
    image = methods[name](*frames)
    np.testing.assert_allclose(image, stages(methods[name], *frames)["image"], atol=1e-5)
    assert np.isfinite(image).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "size", [(1, 1), pytest.param((1, 7), marks=pytest.mark.slow), pytest.param((13, 11), marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("name", NAMES)
def test_any_size(methods, name, size):
    image = methods[name](*given(name, size=size))
    assert image.shape == (*size, 3)
    assert np.isfinite(image).all()


@pytest.mark.parametrize("name", NAMES)
def test_a_rendered_target_is_returned(methods, name):
    history, target, future = given(name)
    truth = make_frame(5, SIZE).color
    assert np.array_equal(methods[name](history, replace(target, color=truth), future), truth)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_missing_is_named(methods, name):
    history, target, future = given(name)
    if name in BETWEEN:
        with pytest.raises(ValueError, match=rf"'{name}', stage 'pair': missing future\.color"):
            methods[name](history, target)
    bare = tuple(replace(f, motion=None, gbuffer=None) for f in history)
    following = tuple(replace(f, motion=None, gbuffer=None) for f in future)
    lacks = {
        "half_motion": r"future\.motion",
        "grid_warp": r"future\.motion",
        "softmax_splat": r"future\.motion",
        "reproject": r"target\.motion",
        "warp_3d": r"history\.motion or history\.position",
        "grid_extrapolate": r"history\.motion or history\.position",
    }
    if name in lacks:
        with pytest.raises(ValueError, match=lacks[name]):
            methods[name](bare, replace(target, motion=None, gbuffer=None), following)
    else:
        assert np.isfinite(methods[name](bare, target, following)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_colour_and_motion_are_enough(methods, name):
    history, target, future = given(name)
    bare = [tuple(replace(f, gbuffer=None) for f in frames) for frames in (history, (target,), future)]
    image = methods[name](bare[0], bare[1][0], bare[2])
    assert np.isfinite(image).all()


def test_frames_without_colour_in_the_future_are_chained_through(methods):
    """Three frames are made between two: the middle one's future begins with one that has only buffers."""
    first, *hidden, last = [sliding(t) for t in (0, 0.25, 0.5, 0.75, 1)]
    step = np.broadcast_to(-np.float32(SHIFT) / 4, (*SIZE, 2)).copy()
    hidden = [hide(replace(f, motion=step)) for f in hidden]
    history, target, future = (first, hidden[0]), hidden[1], (hidden[2], replace(last, motion=step))
    image = np.asarray(methods["half_motion"](history, target, future))
    inner = (slice(3, -3), slice(5, -5))
    np.testing.assert_allclose(image[inner], sliding(0.5).color[inner], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["half_motion", pytest.param("softmax_splat", marks=pytest.mark.slow), "warp_3d"])
def test_gradients_are_finite_and_there(methods, name):
    history, target, future = given(name)
    method = methods[name]

    def loss(color, motion):
        frames = [tuple(replace(f, color=color, motion=motion) for f in given) for given in (history, future)]
        return jnp.sum(jnp.square(method.function(method.state, (), frames[0], target, frames[1])[1]))

    frame = (future or history)[0]
    gradients = jax.jit(jax.grad(loss, argnums=(0, 1)))(jnp.asarray(frame.color), jnp.asarray(frame.motion))
    for gradient in gradients:
        assert np.isfinite(gradient).all()
        assert np.abs(gradient).max() > 0


# Stages on the host


def hosted(log):
    def first(state, values):
        return {"double": 2 * values["history"][0].color}

    def second(state, values):
        log.append(type(values["double"]))
        return {"sum": np.asarray(values["double"]) + 1}

    def third(state, values):
        return {"image": jnp.asarray(values["sum"])}

    return Method(
        "hosted",
        (
            Stage("first", first, ("history",), ("double",)),
            Stage("second", second, ("double",), ("sum",), host=True),
            Stage("third", third, ("sum",), ("image",)),
        ),
    )


def test_a_stage_on_the_host_is_never_traced():
    log: list = []
    method, history = hosted(log), (make_frame(0, (4, 5)),)
    for _ in range(2):
        np.testing.assert_allclose(method(history, Frame()), 2 * history[0].color + 1, rtol=1e-6)
    assert len(log) == 2
    assert not any(issubclass(kind, jax.core.Tracer) for kind in log)
    assert [f._cache_size() for f in method._compiled_rows.values()] == [1, 1]  # type: ignore[attr-defined]
    np.testing.assert_allclose(
        method.function(method.state, (), history, Frame())[1], 2 * history[0].color + 1, rtol=1e-6
    )
    np.testing.assert_allclose(stages(method, history, Frame(), ())["image"], 2 * history[0].color + 1, rtol=1e-6)
    with pytest.raises(TypeError, match="'hosted', stage 'second': runs on the host"):
        jax.jit(method.function)((), (), history, Frame())


def test_an_extra_that_is_not_installed_is_named(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *a: None if n == "flip_evaluator" else find(n, *a))
    stage = Stage("error", lambda state, values: {"image": 0}, ("history",), ("image",), extra="flip")
    method, history = Method("sharp", (stage,)), (make_frame(0, (4, 5)),)
    with pytest.raises(ValueError, match=r"stage 'error': missing the package .*\"jaxtrapolate\[flip\]\""):
        method(history, Frame())
    assert list(method.missing(history, Frame())) == ["error"]


# Real frames


def decibels(method, folder, numbers):
    from jaxtrapolate.evaluation.score import display
    from jaxtrapolate.evaluation.windows import arguments, windows
    from jaxtrapolate.files import open_sequence

    sequence = open_sequence(folder)
    scores = []
    for window in windows(sequence, numbers, past=1, future=method.future):
        image = display(method(*arguments(method, window)), hdr=sequence.hdr)
        scores.append(float(jx.psnr(image, display(window.truth.color, hdr=sequence.hdr))))
    return np.mean(scores)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "known"), [("blend", 24.23), ("dis", 28.11), ("reproject", 28.59)])
def test_known_figures_of_an_engine_clip(data, name, known):
    assert abs(decibels(jx.load(name), data / "bunker", list(range(1, 18, 2))) - known) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least"),
    [("blend", 24.8), ("dis", 28.1), ("half_motion", 27.1), ("grid_warp", 27.2), ("softmax_splat", 28.3)],
)
def test_figures_of_a_path_traced_clip(data, methods, name, least):
    """Frames 6, 8, 10: the clip ends with frame 12, which nothing follows."""
    assert least < decibels(methods[name], data / "czest1dm", [6, 8, 10]) < least + 1
