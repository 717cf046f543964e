"""Bidirectional interpolation: exact where it can be, a loop from the paper, every case of section 5.2 by hand."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import synthetic
from oracles import random
from test_search import search_loop

import jaxtrapolate as jx
from jaxtrapolate.bidirectional.assisted import CASES

pytestmark = pytest.mark.usefixtures("strict")

H, W = 6, 12
STEPS = 4
ONE_START = jx.SearchOptions(starts=("default",))


def keyframe(color, depth=None, forward=None, backward=None, stencil=None):
    arrays = {"color": color, "depth": depth, "forward_flow": forward, "backward_flow": backward, "stencil": stencil}
    return jx.Keyframe(**{k: None if a is None else jnp.asarray(a) for k, a in arrays.items()})


def pair(*, size=(H, W), flow=(0, 0, 0), depth=5.0, seed=0, channels=3, dtype=np.float32):
    """Two frames of random colours whose points all move by `flow`."""
    flow = np.broadcast_to(np.asarray(flow, dtype), (*size, 3))
    z = np.full((*size, 1), depth, dtype)
    colors = [random(*size, channels, seed=seed + k, dtype=dtype) for k in (0, 1)]
    return keyframe(colors[0], z, forward=flow), keyframe(colors[1], z + flow[..., 2:], backward=-flow)


def layers(*, size=(4, 24), left=4, width=8, speed=6, near=2.0, far=10.0):
    """A bar before a still wall, moving to the right by whole pixels. Colours: wall 0.1 then 0.2, bar 0.8 then 0.9."""
    frames = []
    for start, wall, bar in ((left, 0.1, 0.8), (left + speed, 0.2, 0.9)):
        on = np.zeros((*size, 1), bool)
        on[:, start : start + width] = True
        color, depth = np.where(on, bar, wall), np.where(on, near, far)
        flow = np.concatenate([np.where(on, speed, 0), np.zeros((*size, 2))], -1)
        frames.append((color.astype(np.float32), depth.astype(np.float32), flow.astype(np.float32)))
    (c0, z0, v0), (c1, z1, v1) = frames
    return keyframe(c0, z0, forward=v0), keyframe(c1, z1, backward=-v1)


def numbers(made):
    return np.asarray(made.color), np.asarray(made.case), np.asarray(made.weight)[..., 0]


# The loop, from the paper


def interpolate_loop(previous, next, alpha, epsilon_error=0.5, epsilon_depth=0.05, filter="nearest", starts="default"):
    """Sections 5.1 and 5.2, pixel by pixel in float64; choice by error, relative depths."""
    (c0, z0, v0), (c1, z1, v1) = ((np.float64(a) for a in frame) for frame in (previous, next))
    height, width, _ = c0.shape
    color, cases, depths = np.zeros(c0.shape), np.zeros((height, width), int), np.zeros((height, width))
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)

    def find(z, flow, fraction, opposite):
        found = [search_loop(flow, fraction, filter=filter)]
        if starts != "default":
            found.append(search_loop(flow, fraction, grid + fraction * opposite[..., :2], filter=filter))
        out = []
        for r, c in np.ndindex(height, width):
            best = found[0]
            for other in found[1:]:
                inner = inside(other[0][r, c])
                closer = other[2][r, c, 0] < best[2][r, c, 0] - 1e-3
                best = other if (closer if inner == inside(best[0][r, c]) else inner) else best
            q, error = best[0][r, c], best[2][r, c, 0]
            depth = oracles.sample(z, *q, filter)[0] + best[1][r, c, 0]
            out.append((q, oracles.sample(flow, *q, filter), error, depth))
        return out

    def inside(q):
        return -0.5 <= q[0] <= width - 0.5 and -0.5 <= q[1] <= height - 0.5

    def similar(a, b):
        return abs(a - b) < epsilon_depth * min(abs(a), abs(b))

    forward, backward = find(z0, v0, alpha, v1), find(z1, v1, 1 - alpha, v0)
    for k, (r, c) in enumerate(np.ndindex(height, width)):
        (qf, vf, ef, zf), (qb, vb, eb, zb) = forward[k], backward[k]
        hits = [e < epsilon_error and inside(q) for e, q in ((ef, qf), (eb, qb))]
        smaller = alpha < 0.5 if abs(ef - eb) < 1e-3 else ef < eb
        by_error = smaller if inside(qf) == inside(qb) else inside(qf)
        if all(hits):
            cases[r, c] = 0 if similar(zf, zb) else 1
            first = by_error if similar(zf, zb) else zf < zb
        else:
            cases[r, c] = 2 if any(hits) else 3
            first = hits[0] if any(hits) else by_error
        q, v, z, other = (qf, vf, zf + (1 - alpha) * vf[2], z1) if first else (qb, vb, zb + alpha * vb[2], z0)
        there = q + v[:2]
        seen = inside(there) and similar(oracles.sample(other, *there)[0], z)
        one, two = oracles.sample(c0, *(q if first else there)), oracles.sample(c1, *(there if first else q))
        color[r, c] = (1 - alpha) * one + alpha * two if seen else (one if first else two)  # eq. 14, 15
        depths[r, c] = zf if first else zb
    return color, cases, depths


@pytest.mark.parametrize("filter, starts", [("nearest", "default"), ("bilinear", "dual")])
def test_against_the_loop(filter, starts):
    rng = np.random.default_rng(5)
    size = (9, 13)
    flow = (rng.uniform(-1, 1, (*size, 3)) * [1.2, 1.2, 0.2] + [0.8, 0.3, 0]).astype(np.float32)
    back = (rng.uniform(-1, 1, (*size, 3)) * [1.2, 1.2, 0.2] - [0.8, 0.3, 0]).astype(np.float32)
    depths = [rng.choice([3.0, 3.05, 8.0], (*size, 1)).astype(np.float32) for _ in range(2)]
    colors = [random(*size, 2, seed=k) for k in (1, 2)]
    alpha, names = 0.37, ("default",) if starts == "default" else ("default", "dual")
    made = jx.interpolate_bidirectional(
        keyframe(colors[0], depths[0], forward=flow),
        keyframe(colors[1], depths[1], backward=back),
        jnp.float32(alpha),
        search=jx.SearchOptions(starts=names, filter=filter, choice="error"),
    )
    frames = (colors[0], depths[0], flow), (colors[1], depths[1], back)
    color, cases, depth = interpolate_loop(*frames, np.float32(alpha), filter=filter, starts=starts)
    assert len(np.unique(cases)) >= 3
    np.testing.assert_array_equal(made.case, cases)
    np.testing.assert_allclose(made.color, color, atol=1e-5)
    np.testing.assert_allclose(made.depth[..., 0], depth, rtol=1e-5)


# Exactness


@pytest.mark.parametrize(
    "size",
    [(5, 7), pytest.param((1, 6), marks=pytest.mark.slow), pytest.param((6, 1), marks=pytest.mark.slow), (1, 1)],
    ids=str,
)
def test_no_motion_blends(size):
    previous, next = pair(size=size)
    color, case, weight = numbers(jx.interpolate_bidirectional(previous, next, 0.25))
    np.testing.assert_allclose(color, 0.75 * previous.color + 0.25 * next.color, rtol=1e-6)
    np.testing.assert_array_equal(case, 0)
    np.testing.assert_array_equal(weight, 0.25)


def test_whole_pixels():
    """Where both frames show a point they are blended bit for bit, elsewhere the one that shows it is taken."""
    previous, next = pair(flow=(4, -2, 1))
    color, case, weight = numbers(jx.interpolate_bidirectional(previous, next, 0.5))
    first, second = (
        oracles.shift(np.asarray(f.color), *by, np.nan) for f, by in ((previous, (-2, 1)), (next, (2, -1)))
    )
    expected = np.where(np.isnan(first), second, np.where(np.isnan(second), first, (first + second) / 2))
    shown = ~np.isnan(expected)
    np.testing.assert_array_equal(color[shown], expected[shown])
    np.testing.assert_array_equal(weight[:, :2], 1)
    np.testing.assert_array_equal(case[:-1, 2:-2][1:], 0)
    np.testing.assert_array_equal(case[1:-1, :2], CASES.index("one"))


def test_translation_by_fractions_of_a_pixel():
    """A smooth picture that moves evenly is found at every alpha."""
    size, speed = (20, 30), np.array([2.6, -1.4])

    def picture(time):
        y, x = np.mgrid[: size[0], : size[1]]
        return synthetic.texture(x - speed[0] * time, y - speed[1] * time).astype(np.float32)

    flow = np.broadcast_to(np.float32([*speed, 0]), (*size, 3))
    depth = np.full((*size, 1), 3, np.float32)
    previous, next = keyframe(picture(0), depth, forward=flow), keyframe(picture(1), depth, backward=-flow)
    made = jx.interpolate_run(previous, next, factor=4)
    for k in (1, 2, 3):
        np.testing.assert_allclose(made[k - 1][3:-3, 3:-3], picture(k / 4)[3:-3, 3:-3], atol=0.012)


@functools.cache
def moving():
    """Two frames four steps apart, in which the flows are constant."""
    frames = []
    for time in (0, STEPS):
        frame = synthetic.make_keyframe(time)
        flows = {name: jnp.asarray(getattr(frame, name)) * STEPS for name in ("forward_flow", "backward_flow")}
        frame = dataclasses.replace(frame, time=None, **flows)
        frames.append(jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), frame))
    return tuple(frames)


@pytest.mark.parametrize("alpha", [0, 1])
def test_at_the_ends_the_frames_are_returned_bit_for_bit(alpha):
    previous, next = moving()
    flow = np.array(previous.forward_flow)
    flow[3, 4] = np.nan
    previous = jx.replace(previous, forward_flow=jnp.asarray(flow))
    made = jx.interpolate_bidirectional(previous, next, float(alpha))
    np.testing.assert_array_equal(made.color, (previous, next)[alpha].color)
    np.testing.assert_array_equal(made.weight, alpha)


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"search": jx.SearchOptions(choice="error")}, marks=pytest.mark.slow),
        pytest.param({"search": jx.SearchOptions(filter="bilinear")}, marks=pytest.mark.slow),
        {"visibility": jx.VisibilityOptions(test="round_trip")},
    ],
    ids=["default", "error", "bilinear", "round trip"],
)
def test_better_than_blending(options):
    previous, next = moving()
    truth = synthetic.make_frame(STEPS // 2).color
    made = jx.interpolate_bidirectional(previous, next, 0.5, **options).color
    plain = 0.5 * previous.color + 0.5 * next.color
    assert np.mean((np.asarray(made) - truth) ** 2) < 0.3 * np.mean((np.asarray(plain) - truth) ** 2)


# The cases of 5.2, by hand


def test_a_bar_before_a_wall():
    """Half way the bar covers pixels 7..14; the wall behind it is shown by both at 0..3 and 18.., else by one."""
    previous, next = layers()
    color, case, weight = numbers(jx.interpolate_bidirectional(previous, next, 0.5))
    row, cases = color[1, :, 0], case[1]
    np.testing.assert_allclose(row[7:15], 0.85, atol=1e-6)
    np.testing.assert_allclose(row[[0, 1, 2, 3, 18, 19, 20, 23]], 0.15, atol=1e-6)
    np.testing.assert_array_equal(cases[[0, 3, 10, 11, 18, 23]], CASES.index("agree"))
    # 4..6: hidden by the bar at t, shown at t + 1; 15..17 the other way round
    np.testing.assert_allclose(row[4:7], 0.2, atol=1e-6)
    np.testing.assert_allclose(row[15:18], 0.1, atol=1e-6)
    np.testing.assert_array_equal(weight[1, 4:7], 1)
    np.testing.assert_array_equal(weight[1, 15:18], 0)


def test_both_hit_and_differ_the_nearer_with_its_second_chance():
    """Only the default start: at pixels that the bar reaches at t + 1 only, one search stays on the wall."""
    previous, next = layers()
    made = jx.interpolate_bidirectional(previous, next, 0.5, search=ONE_START)
    color, case, weight = numbers(made)
    at = 13  # the forward search stays on the wall at 13, the backward one finds the bar
    assert case[1, at] == CASES.index("nearer")
    np.testing.assert_allclose(np.asarray(made.forward.position)[1, at], (13, 1))
    np.testing.assert_allclose(np.asarray(made.backward.position)[1, at], (16, 1))
    np.testing.assert_allclose(color[1, at, 0], 0.85, atol=1e-6)  # the bar's point is found in the other frame as well
    assert weight[1, at] == 0.5
    np.testing.assert_allclose(np.asarray(made.depth)[1, at], 2)


def test_a_nearer_point_that_the_other_frame_hides_is_taken_alone():
    previous, next = layers()
    # something in front of all covers the bar at t
    depth = np.array(previous.depth)
    depth[1, 10] = 1
    made = jx.interpolate_bidirectional(jx.replace(previous, depth=jnp.asarray(depth)), next, 0.5, search=ONE_START)
    assert np.asarray(made.weight)[1, 13, 0] == 1
    np.testing.assert_allclose(np.asarray(made.color)[1, 13], 0.9, atol=1e-6)


def one_sided(*, hidden=False):
    """The forward search cannot hit, its flow is unknown. The backward one is still and exact."""
    previous, next = pair()
    flow = np.full((H, W, 3), np.nan, np.float32)
    depth = np.array(previous.depth) * (0.5 if hidden else 1)
    return jx.replace(previous, forward_flow=jnp.asarray(flow), depth=jnp.asarray(depth)), next


@pytest.mark.parametrize("hidden", [False, True])
def test_one_hits(hidden):
    previous, next = one_sided(hidden=hidden)
    color, case, weight = numbers(jx.interpolate_bidirectional(previous, next, 0.5, search=ONE_START))
    inner = np.s_[1:-1, 2:-2]
    np.testing.assert_array_equal(case[inner], CASES.index("one"))
    np.testing.assert_array_equal(weight[inner], 1 if hidden else 0.5)
    expected = next.color if hidden else (previous.color + next.color) / 2
    np.testing.assert_allclose(color[inner], np.asarray(expected)[inner], atol=1e-6)


def test_neither_hits():
    """Both errors are above the threshold: the smaller one's point, and its place in the other frame."""
    previous, next = pair(flow=(0.25, 0, 0))
    back = np.zeros((H, W, 3), np.float32)
    back[..., 0] = np.where(np.arange(W) % 2, 1.5, -1.5)
    next = jx.replace(next, backward_flow=jnp.asarray(back))
    made = jx.interpolate_bidirectional(
        previous, next, 0.5, search=jx.SearchOptions(starts=("default",), epsilon=-1.0, iterations=1)
    )
    color, case, weight = numbers(made)
    np.testing.assert_array_equal(case, CASES.index("neither"))
    smaller = np.asarray(made.forward.error < made.backward.error)[..., 0][1:-1, 2:-2]
    assert smaller.all()
    np.testing.assert_array_equal(weight[1:-1, 2:-2], 0.5)
    along = jnp.asarray([[[1.0, 0.0]]]) * jnp.ones((H, W, 1))
    first, second = (jx.backward_warp(f.color, s * along) for f, s in ((previous, -0.125), (next, 0.125)))
    np.testing.assert_allclose(color[:, 1:-1], np.asarray((first + second) / 2)[:, 1:-1], atol=1e-6)


def test_a_search_that_ends_outside_misses():
    previous, next = pair(flow=(6, 0, 0))
    color, case, weight = numbers(jx.interpolate_bidirectional(previous, next, 0.5))
    np.testing.assert_array_equal(case[:, :3], CASES.index("one"))
    np.testing.assert_array_equal(color[:, :3], np.asarray(next.color)[:, 3:6])
    np.testing.assert_array_equal(color[:, -3:], np.asarray(previous.color)[:, -6:-3])
    np.testing.assert_array_equal(weight[:, -3:], 0)


@pytest.mark.parametrize("choice, expected", [("depth", 2), ("error", 10)])
def test_the_choice_among_starts(choice, expected):
    """Both starts hit without error: by depth the bar wins, by error the first, which stays on the wall."""
    previous, next = layers()
    made = jx.interpolate_bidirectional(
        previous, next, 0.5, search=jx.SearchOptions(starts=("default", "dual"), choice=choice)
    )
    at = np.asarray(made.forward.position)[1, 13, 0]
    assert np.asarray(previous.depth)[1, int(at), 0] == expected


# Inputs that lack something


def test_without_depth_a_round_trip_decides():
    previous, next = (jx.replace(f, depth=None) for f in layers())
    made = jx.interpolate_bidirectional(previous, next, 0.5)
    assert made.depth is None
    assert made.offsets.forward_depth is None
    color, _, weight = numbers(made)
    np.testing.assert_allclose(
        color[1, [0, 1, 2, 10, 11, 20, 23], 0], [0.15, 0.15, 0.15, 0.85, 0.85, 0.15, 0.15], atol=1e-6
    )
    # wall that the bar covers in the other frame: the bar's flow does not lead back
    inside = jx.interpolate_bidirectional(previous, next, 0.5, visibility=jx.VisibilityOptions(test="inside"))
    assert (np.asarray(inside.weight) == 0.5).mean() > (weight == 0.5).mean()


def test_flows_without_a_change_of_depth():
    previous, next = layers()
    previous = jx.replace(previous, forward_flow=previous.forward_flow[..., :2])
    next = jx.replace(next, backward_flow=next.backward_flow[..., :2])
    made = jx.interpolate_bidirectional(previous, next, 0.5)
    assert made.forward.depth_offset is None
    np.testing.assert_allclose(np.asarray(made.color)[1, 7:15, 0], 0.85, atol=1e-6)


def test_ordinal_depth_is_compared_absolutely():
    previous, next = layers(near=0.2, far=0.6)
    color, case, _ = numbers(
        jx.interpolate_bidirectional(
            previous,
            next,
            0.5,
            search=ONE_START,
            visibility=jx.VisibilityOptions(depth="ordinal"),
        )
    )
    assert case[1, 13] == CASES.index("nearer")
    np.testing.assert_allclose(color[1, 13], 0.85, atol=1e-6)
    loose = jx.interpolate_bidirectional(
        previous,
        next,
        0.5,
        search=ONE_START,
        visibility=jx.VisibilityOptions(depth="ordinal", epsilon_depth=0.5),
    )
    assert np.asarray(loose.case)[1, 13] == CASES.index("agree")


def test_infinite_depth_is_the_sky():
    previous, next = layers(far=np.inf)
    made = jx.interpolate_bidirectional(previous, next, 0.5)
    np.testing.assert_allclose(np.asarray(made.color)[1, [0, 1, 10, 23], 0], [0.15, 0.15, 0.85, 0.15], atol=1e-6)
    assert np.isinf(np.asarray(made.depth)[1, 0])


# Runs


@pytest.mark.slow
def test_a_run_is_the_frames_one_by_one():
    previous, next = moving()
    made = jx.interpolate_run(previous, next, factor=4)
    assert made.shape == (3, *previous.color.shape)
    offsets = None
    for k in (1, 2, 3):
        one = jx.interpolate_bidirectional(previous, next, k / 4, offsets=offsets)
        offsets = one.offsets
        np.testing.assert_allclose(made[k - 1], one.color, atol=1e-5)


def test_offsets_start_the_next_frame():
    """With them alone the searches begin where the last ended; without, such a start is left out."""
    previous, next = layers()
    first = jx.interpolate_bidirectional(previous, next, 0.25)
    made = jx.interpolate_bidirectional(
        previous, next, 0.5, search=jx.SearchOptions(starts=("latest",)), offsets=first.offsets
    )
    np.testing.assert_allclose(np.asarray(made.color)[1, 8:14, 0], 0.85, atol=1e-6)
    np.testing.assert_allclose(first.offsets.forward + made.forward.position * 0 + first.forward.position,
                               np.stack(np.meshgrid(np.arange(24), np.arange(4)), -1), atol=1e-5)  # fmt: skip


# Attributes


@pytest.mark.slow
def test_attributes_are_shaded_in_the_frame_made():
    previous, next = pair(channels=5)

    def shade(attributes):
        return attributes[..., :2] * attributes[..., 2:3]

    plain = jx.interpolate_bidirectional(previous, next, 0.5)
    made = jx.interpolate_bidirectional(previous, next, 0.5, shade_attributes=shade)
    np.testing.assert_allclose(made.color, shade(np.asarray(plain.color)), rtol=1e-6)
    assert jx.interpolate_run(previous, next, factor=3, shade_attributes=shade).shape == (2, H, W, 2)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["float16", "bfloat16"])
def test_half_precision(x64, kind):
    """Colours of half precision, coordinates of float32: a place 600 pixels away is still right."""
    size = (2, 600)
    previous, next = pair(size=size, flow=(3, 0, 0), channels=1)
    half = [jx.replace(f, color=f.color.astype(kind)) for f in (previous, next)]
    made = jx.interpolate_bidirectional(*half, 0.5)
    assert made.color.dtype == kind
    assert made.forward.position.dtype == np.float32
    full = jx.interpolate_bidirectional(previous, next, 0.5).color
    np.testing.assert_allclose(np.float32(made.color), full, atol=2 * float(jnp.finfo(kind).eps))


@pytest.mark.slow
def test_jit_vmap_and_eager_agree():
    first = moving()
    second = tuple(jx.replace(f, color=f.color[::-1], depth=f.depth * 2) for f in first)
    stacked = tuple(jax.tree.map(lambda *a: jnp.stack(a), *frames) for frames in zip(first, second, strict=True))
    alphas = jnp.asarray([0.3, 0.6])

    def run(previous, next, alpha):
        return jx.interpolate_bidirectional(previous, next, alpha).color

    mapped = jax.jit(jax.vmap(run))(*stacked, alphas)
    for k, frames in enumerate((first, second)):
        eager = run(*frames, alphas[k])
        np.testing.assert_allclose(jax.jit(run)(*frames, alphas[k]), eager, atol=1e-5)
        same = np.abs(np.asarray(mapped[k]) - np.asarray(eager)).max(-1) < 1e-4
        assert same.mean() > 0.995  # where two errors are equal but for rounding, either may win


# Gradients


def test_the_color_alone_is_that_of_all_outputs():
    """Compiled for one output, XLA makes other loops, in which an error of 0 pixels may come out as 1e-8."""
    flow = np.float32([0.4, -0.3, 0.01]) + np.float32(0.1) * random(5, 7, 3, seed=9)
    depth = 1 + random(5, 7, 1, seed=3, low=0.1)
    given = [jnp.asarray(a) for a in (random(5, 7, 3, seed=0), random(5, 7, 3, seed=1), flow, depth)]

    def make(first, second, flow, depth):
        frames = keyframe(first, depth, forward=flow), keyframe(second, depth, backward=-flow)
        return jx.interpolate_bidirectional(*frames, 0.4, search=jx.SearchOptions(starts=("default",), iterations=1))

    made = make(*given)
    assert {"agree", "nearer"} <= {CASES[k] for k in np.unique(np.asarray(made.case))}
    np.testing.assert_allclose(jax.jit(lambda *a: make(*a).color)(*given), made.color, atol=1e-6)


@pytest.mark.slow
def test_gradients_against_differences(x64):
    """With respect to colours, flow and alpha: of a smooth bilinear flow, away from choices."""
    size = (5, 6)
    rng = np.random.default_rng(4)
    flow = np.float64([0.43, 0.31, 0.1]) + 0.05 * rng.uniform(-1, 1, (*size, 3))
    colors = [rng.uniform(0, 1, (*size, 2)) for _ in range(2)]
    depth, cotangent = np.full((*size, 1), 5.0), rng.uniform(-1, 1, (*size, 2))

    @jax.jit
    def total(first, second, flow, alpha):
        previous = keyframe(first, depth, forward=flow)
        next = keyframe(second, 2 * depth, backward=-flow * 0.98)  # farther, so that the forward search counts
        search = jx.SearchOptions(starts=("default",), iterations=40, filter="bilinear")
        options = {"search": search, "visibility": jx.VisibilityOptions(test="round_trip")}
        made = jx.interpolate_bidirectional(previous, next, alpha, **options)
        return jnp.sum(cotangent * made.color)

    given = (*colors, flow, np.float64(0.37))
    gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(*given)
    oracles.assert_gradients(total, given, gradients, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_gradients_stay_finite():
    previous, next = layers()
    flow = np.array(previous.forward_flow)
    flow[1, 2], flow[2, 3, 0], flow[0, 0, 2] = np.nan, np.inf, np.nan

    def total(first, flow, depth, alpha, epsilon):
        bad = jx.replace(previous, color=first, forward_flow=flow, depth=depth)
        made = jx.interpolate_bidirectional(bad, next, alpha, search=jx.SearchOptions(epsilon=epsilon))
        return jnp.sum(made.color) + jnp.sum(made.depth)

    given = (previous.color, jnp.asarray(flow), previous.depth, jnp.float32(0.5), jnp.float32(0.5))
    gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3, 4)))(*given)
    assert all(np.isfinite(g).all() for g in gradients)
    assert gradients[4] == 0


# Errors


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"previous": None}, TypeError, "previous: expected a Keyframe, got NoneType"),
        ({"next.color": None}, ValueError, "next.color: absent"),
        ({"next.color": jnp.ones((3, 4, 3))}, ValueError, r"next.color: expected shape \[6, 12, C\], got \[3, 4, 3\]"),
        ({"previous.forward_flow": None}, ValueError, "previous.forward_flow: absent .*complete_flows"),
        ({"next.backward_flow": None}, ValueError, "next.backward_flow: absent"),
        ({"previous.depth": jnp.ones((H, W, 2))}, ValueError, r"previous.depth: expected shape \[6, 12, 1\]"),
        ({"search": jx.SearchOptions(solver="secant")}, ValueError, "solver: expected one of"),
        (
            {"search": jx.SearchOptions(starts=("best",))},
            ValueError,
            "starts: expected one of 'default', 'dual', 'latest', got 'best'",
        ),
        ({"search": jx.SearchOptions(choice="nearest")}, ValueError, "choice: expected one of 'error', 'depth'"),
        (
            {"visibility": jx.VisibilityOptions(depth="relative")},
            ValueError,
            "depth: expected one of 'metric', 'ordinal'",
        ),
        ({"visibility": jx.VisibilityOptions(test="none")}, ValueError, "test: expected one of"),
        (
            {"visibility": jx.VisibilityOptions(test="depth", depth="ordinal")},
            ValueError,
            "test='depth' needs metric depth",
        ),
        ({"filter": "cubic"}, ValueError, "filter: expected one of"),
        ({"search": jx.SearchOptions(filter="bicubic")}, ValueError, "filter: expected one of 'bilinear', 'nearest'"),
        ({"search": jx.SearchOptions(reach=-1)}, ValueError, "reach: .* got -1"),
        ({"alpha": jnp.ones(2)}, ValueError, r"alpha: expected shape \[\], got \[2\]"),
        ({"stencil_ids": (1,)}, ValueError, "stencil_ids: expected None without a target"),
        ({"search": {"reach": 1}}, TypeError, "search: expected SearchOptions, got dict"),
        ({"visibility": jx.VisibilityOptions(epsilon_trip=jnp.ones(2))}, ValueError, r"epsilon_trip: expected shape"),
        ({"target_mode": "draw"}, ValueError, "target_mode: expected one of 'reproject', 'render'"),
    ],
)
def test_errors(unchecked, change, error, message):
    previous, next = pair()
    arguments = {"previous": previous, "next": next, "alpha": 0.5}
    for name, value in change.items():
        record, _, field = name.partition(".")
        arguments[record] = jx.replace(arguments[record], **{field: value}) if field else value
    given = [arguments.pop(name) for name in ("previous", "next", "alpha")]
    with pytest.raises(error, match=message):
        jx.interpolate_bidirectional(*given, **arguments)


def test_errors_of_runs(unchecked):
    previous, next = pair()
    with pytest.raises(ValueError, match="factor: expected an integer of at least 2, got 1"):
        jx.interpolate_run(previous, next, factor=1)
    with pytest.raises(ValueError, match="offsets: expected none"):
        jx.interpolate_run(previous, next, factor=2, offsets=None)
