"""Frames that have some buffers and lack others: every method runs on them, or says truly what is missing."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_extranet
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jaxtrapolate as jx
from jaxtrapolate.methods import neighbours
from jaxtrapolate.records import CHANNELS, Camera, Frame, GBuffer, Keyframe

SIZE = (8, 12)
NAMES = sorted(jx.method_names())
NETWORKS = ("guided_net", "extranet", "extrass_refine", "extrass", "interpolator")
BUFFERS = ("albedo", "depth", "normal", "position", "specular", "metallic", "stencil", "sky", "sky_color")

load = functools.cache(small_extranet.load)


def image(channels):
    return jax.ShapeDtypeStruct((*SIZE, channels), jnp.float32)


def frame(color, names, *, empty=False):
    """A frame of shapes, with what is named."""
    buffers = {n: image(CHANNELS[n]) for n in names if n in CHANNELS}
    matrix = jax.ShapeDtypeStruct((4, 4), jnp.float32)
    return Frame(
        color=image(3) if color else None,
        gbuffer=GBuffer(**buffers) if buffers or empty else None,
        motion=image(2) if "motion" in names else None,
        camera=Camera(matrix, matrix) if "camera" in names else None,
        time=jax.ShapeDtypeStruct((), jnp.float32) if "time" in names else None,
    )


def made(method, history, target, future):
    """The shape of a method's image, traced and not computed."""

    def function(history, target, future):
        return method.function(method.state, method.init(history, target), history, target, future)[1]

    return jax.eval_shape(function, history, target, future)


def runs_or_says_why(method, history, target, future):
    """Whether it runs; `missing` and `active` agree with that, and the error names what `missing` lists."""
    missing = method.missing(history, target, future)
    needed = {s.name: missing[s.name] for s in method.stages if s.name in missing and not s.optional}
    if not needed:
        expected: list = []
        for stage in method.stages:
            given = {name for before in expected for name in before.gives}
            skipped = stage.on == "rendered" or (stage.fallback and given >= set(stage.gives))
            if stage.name not in missing and not skipped:
                expected.append(stage)
        assert list(method.active(history, target, future)) == expected
        assert made(method, history, target, future).shape == (*(method.scale * n for n in SIZE), 3)
        return True
    with pytest.raises(ValueError, match=r"missing|frame with colour") as raised:
        made(method, history, target, future)
    if any(f.color is not None for f in history):
        name, lacks = next(iter(needed.items()))
        assert f"stage {name!r}: missing {', '.join(lacks)}" in str(raised.value)
    return False


# What a frame has, mostly: else hardly any example would get beyond the first stage.
names = st.sets(st.sampled_from((*BUFFERS, "camera", "time")))
names = st.tuples(names, st.sampled_from((True, True, True, False))).map(
    lambda a: a[0] | ({"motion"} if a[1] else set())
)
frames = st.builds(frame, st.booleans(), names, empty=st.booleans())
windows = st.tuples(st.lists(frames, min_size=1, max_size=5), names, st.lists(frames, max_size=3))
sampled = settings(deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in NETWORKS else n for n in NAMES])
@settings(sampled, max_examples=4)
@given(windows)
def test_any_buffers(name, window):
    history, target, future = window
    runs_or_says_why(load(name), tuple(history), frame(False, target), tuple(future))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@settings(sampled, max_examples=40)
@given(windows)
def test_any_buffers_at_length(name, window):
    history, target, future = window
    last = frame(True, target | {"motion"})
    runs_or_says_why(load(name), (*history, last), frame(False, target | {"motion"}), (*future, last))


def full(color, *without):
    return frame(color, {*BUFFERS, "motion", "camera", "time"} - set(without))


def test_the_guides_must_be_the_same_in_both():
    method = load("guided_warp")
    for one, other in (("normal", "albedo"), ("stencil", "normal"), ("albedo", "stencil")):
        assert not runs_or_says_why(method, (frame(True, {one}),), frame(False, {other, "motion"}), ())
        assert runs_or_says_why(method, (frame(True, {one}),), frame(False, {one, other, "motion"}), ())
    with pytest.raises(ValueError, match="missing albedo in target and newest or normal in target and newest or"):
        made(method, (frame(True, {"normal"}),), frame(False, {"albedo", "motion"}), ())


@pytest.mark.parametrize("name", ["occlusion_warp", "guided_warp"])
def test_hindsight_needs_motion_between_the_rendered_frames(name):
    """Also of the frame held back between them; without it that stage is left out, and no other."""
    method = load(name)
    history = full(True), full(False, "motion"), full(True)
    assert method.missing(history, full(False)) == {"hindsight": ["before_newest.motion"]}
    assert runs_or_says_why(method, history, full(False), ())
    history = full(True, "motion"), full(False), full(True)  # what led to the older frame is no matter
    assert method.missing(history, full(False)) == {}
    assert runs_or_says_why(method, history, full(False), ())


def test_motion_must_lead_through_frames_without_colour():
    history, future = (full(True), full(False, "motion")), (full(False, "motion"), full(True))
    for name in ("warp", "occlusion_warp", "guided_warp", "reproject"):
        with pytest.raises(ValueError, match=r"missing since_newest\.motion"):
            made(load(name), history, full(False), ())
    for name in ("half_motion", "softmax_splat", "bidirectional", "bidirectional_image"):
        with pytest.raises(ValueError, match=r"missing before_next\.motion"):
            made(load(name), (full(True),), full(False), future)
        assert runs_or_says_why(load(name), (full(True),), full(False, "motion"), (full(True),)) == (
            name != "bidirectional_guided"
        )


def test_flows_are_turned_around_without_the_depth_of_one_frame():
    """Metric depth in one of the two frames alone tells nothing of what is hidden: the flow is as without."""
    flow = np.zeros((2, 5, 3), np.float32)
    flow[..., 0], flow[..., 2] = -1, 0.5
    known = jx.complete_flows(Keyframe(depth=jnp.full((2, 5, 1), 3.0)), Keyframe(backward_flow=jnp.asarray(flow)))
    np.testing.assert_array_equal(known.previous.forward_flow[..., 0], 1)
    assert known.forward_known.all()


# Which frames a method is handed


@pytest.mark.parametrize(
    "colored, index, options, history, future",
    [
        ("x...x", 1, {"future": 1}, [0], [2, 3, 4]),
        ("x...x", 2, {"future": 1}, [0, 1], [3, 4]),
        ("x...x", 3, {"future": 1}, [0, 1, 2], [4]),
        ("x.x.x.", 5, {"past": 2}, [2, 3, 4], []),
        ("x.x.x.", 5, {"past": 9}, [0, 1, 2, 3, 4], []),
        ("..x.x..", 3, {"past": 2, "future": 2}, [2], [4]),
        ("...", 1, {"future": 1}, [], []),
        ("x.x", 1, {"future": 1, "numbers": [0, 1, 8]}, [0], []),
        ("x.x", 1, {"future": 1, "numbers": [0, 7, 8]}, [], [2]),
        ("x.x.x", 3, {"past": 2, "future": 1, "numbers": [0, 5, 6, 7, 8]}, [2], [4]),
        ("x.x", 1, {"future": 1, "numbers": [4, 4.5, 5]}, [0], [2]),
    ],
)
def test_neighbours(colored, index, options, history, future):
    found = neighbours([c == "x" for c in colored], index, **options)
    assert [list(r) for r in found] == [history, future]


@pytest.mark.parametrize(
    "index, numbers, message",
    [
        (3, None, "index: expected 0 to 2, got 3"),
        (1, [0, 1], "numbers: expected 3 as there are frames, got 2"),
        (1, [0, 1, 1], "numbers: expected each above the one before"),
    ],
)
def test_neighbours_that_are_none(index, numbers, message):
    with pytest.raises(ValueError, match=message):
        neighbours([True, False, True], index, numbers=numbers)


def test_several_missing_in_a_row_are_made_along_the_whole_motion():
    """Three frames in a row without colour, in a picture that moves evenly: each is the picture where it is then."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]

    def moving(time):
        texture = 0.5 + 0.3 * np.sin(0.8 * (columns - time) + 0.5 * rows)
        motion = np.broadcast_to(np.float32([-1, 0]), (*SIZE, 2)).copy()
        color = texture.astype(np.float32)[..., None].repeat(3, -1)
        return Frame(color=color if time in (0, 4) else None, motion=motion, time=float(time)), color

    sequence = [moving(t)[0] for t in range(5)]
    method = load("half_motion")
    for place in (1, 3):
        before, after = neighbours([f.color is not None for f in sequence], place, past=method.past, future=1)
        image = method(tuple(sequence[i] for i in before), sequence[place], tuple(sequence[i] for i in after))
        np.testing.assert_allclose(image[:, 4:], moving(place)[1][:, 4:], atol=1e-5)
