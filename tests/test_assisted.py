"""Scene-assisted interpolation, alone and over the image-based one, through one depth buffer."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from oracles import random
from test_bidirectional import keyframe, layers

import jaxtrapolate as jx
from jaxtrapolate.bidirectional.assisted import CASES, blend

pytestmark = pytest.mark.usefixtures("strict")

H, W = 5, 8


def bar_target(alpha=0.5, *, left=4, width=8, speed=6, size=(4, 24), near=2.0, far=10.0):
    """The geometry of `layers` between its frames: exact flows both ways, depth, and stencil 1 on the bar."""
    on = np.zeros((*size, 1), bool)
    start = int(left + alpha * speed)
    on[:, start : start + width] = True
    still = np.zeros((*size, 2))
    flows = [np.concatenate([np.where(on, s * speed, 0), still], -1) for s in (1 - alpha, -alpha)]
    forward, backward = (f.astype(np.float32) for f in flows)
    depth, stencil = np.where(on, near, far).astype(np.float32), on.astype(np.float32)
    return keyframe(None, depth, forward, backward, stencil)


def assisted_loop(previous, next, target, alpha, epsilon=0.05):
    """Section 4, pixel by pixel: colour, and whether the point is visible in the frame before and after."""
    c0, z0, c1, z1 = (np.float64(a) for a in (previous.color, previous.depth, next.color, next.depth))
    depth, flows = np.float64(target.depth), (np.float64(target.backward_flow), np.float64(target.forward_flow))
    height, width, _ = c0.shape
    out, seen = np.zeros(c0.shape), np.zeros((height, width, 2), bool)
    for r, c in np.ndindex(height, width):
        found = []
        for k, (color, z, flow) in enumerate(((c0, z0, flows[0]), (c1, z1, flows[1]))):
            x, y = c + flow[r, c, 0], r + flow[r, c, 1]
            there, expected = oracles.sample(z, x, y)[0], depth[r, c, 0] + flow[r, c, 2]
            inside = -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5
            seen[r, c, k] = inside and abs(there - expected) < epsilon * min(there, expected)
            found.append((oracles.sample(color, x, y), there))
        (first, near0), (second, near1) = found
        if seen[r, c].all():
            out[r, c] = (1 - alpha) * first + alpha * second
        elif seen[r, c].any():
            out[r, c] = first if seen[r, c, 0] else second
        else:
            out[r, c] = second if near1 < near0 else first
    return out, seen


@pytest.mark.parametrize("size", [(H, W), (19, 7)], ids=str)
def test_against_the_loop(size):
    """19 rows are more than a strip of the CPU's loop."""
    rng = np.random.default_rng(3)

    def flow():
        return (rng.uniform(-2, 2, (*size, 3)) * [1, 1, 0.02]).astype(np.float32)

    def depth():
        return np.where(rng.uniform(size=(*size, 1)) < 0.7, 4.0, 6.0).astype(np.float32)

    previous, next = keyframe(random(*size, 2), depth()), keyframe(random(*size, 2, seed=1), depth())
    target = keyframe(None, depth(), flow(), flow())
    made = jx.interpolate_assisted(previous, next, target, 0.3)
    color, seen = assisted_loop(previous, next, target, 0.3)
    assert {tuple(s) for s in seen.reshape(-1, 2)} == {(a, b) for a in (False, True) for b in (False, True)}
    np.testing.assert_allclose(made.color, color, atol=1e-5)
    np.testing.assert_array_equal(made.case, np.where(seen.any(-1), CASES.index("assisted"), CASES.index("missed")))


def test_no_motion_and_whole_pixels():
    previous, next = layers()
    target = bar_target()
    made = jx.interpolate_assisted(previous, next, target, 0.5)
    row = np.asarray(made.color)[1, :, 0]
    np.testing.assert_allclose(row[7:15], 0.85, atol=1e-6)
    np.testing.assert_allclose(row[[0, 3, 18, 23]], 0.15, atol=1e-6)
    np.testing.assert_allclose(row[4:7], 0.2)
    np.testing.assert_allclose(row[15:18], 0.1)
    np.testing.assert_array_equal(made.depth, target.depth)
    for alpha, frame in ((0.0, previous), (1.0, next)):
        whole = jx.interpolate_assisted(previous, next, bar_target(alpha), alpha)
        np.testing.assert_array_equal(whole.color, frame.color)


def misses():
    """Nothing of the target's depth is in either frame; the nearer one is the frame after at odd pixels."""
    zero = np.zeros((H, W, 3), np.float32)
    near = np.where(np.arange(W) % 2, 1, 3)[None, :, None] * np.ones((H, W, 1))
    previous = keyframe(random(H, W, 3), np.full((H, W, 1), 2, np.float32))
    next = keyframe(random(H, W, 3, seed=1), near.astype(np.float32))
    return previous, next, keyframe(None, np.full((H, W, 1), 9, np.float32), zero, zero)


def test_closest_on_miss():
    previous, next, target = misses()
    made = jx.interpolate_assisted(previous, next, target, 0.5)
    odd = (np.arange(W) % 2 == 1)[None, :, None]
    np.testing.assert_array_equal(made.color, np.where(odd, next.color, previous.color))
    np.testing.assert_array_equal(made.case, CASES.index("missed"))


def test_shade_on_miss():
    previous, next, target = misses()
    depth = np.array(target.depth)
    depth[2, 3] = previous.depth[2, 3]
    target = jx.replace(target, depth=jnp.asarray(depth))

    def shade(mask):
        return jnp.where(mask[..., None], 0.25, jnp.nan) * jnp.ones((1, 1, 3))

    made = jx.interpolate_assisted(previous, next, target, 0.5, shade_on_miss=shade)
    expected = np.full((H, W, 3), 0.25, np.float32)
    expected[2, 3] = previous.color[2, 3]
    np.testing.assert_array_equal(made.color, expected)


def test_flow_that_is_not_finite_is_visible_nowhere():
    previous, next = layers()
    target = bar_target()
    flow = np.array(target.backward_flow)
    flow[1, 0] = np.nan
    target = jx.replace(target, backward_flow=jnp.asarray(flow))
    made = jx.interpolate_assisted(previous, next, target, 0.5)
    assert np.asarray(made.weight)[1, 0, 0] == 1
    assert np.isfinite(made.color).all()


@pytest.mark.slow
def test_gradients(x64):
    rng = np.random.default_rng(8)
    flow = rng.uniform(0.2, 0.4, (H, W, 3)) * [1, 1, 0.01]
    colors, depth = [rng.uniform(size=(H, W, 2)) for _ in range(2)], np.full((H, W, 1), 4.0)
    cotangent = rng.uniform(-1, 1, (H, W, 2))

    @jax.jit
    def total(first, second, flow, alpha):
        target = keyframe(None, depth, flow, -flow)
        made = jx.interpolate_assisted(keyframe(first, depth), keyframe(second, depth), target, alpha)
        return jnp.sum(cotangent * made.color)

    given = (*colors, flow, np.float64(0.3))
    oracles.assert_gradients(total, given, jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(*given), rtol=1e-4)


# Both together


def test_thin_geometry_is_scene_assisted_by_stencil():
    previous, next = layers(left=4, width=2, speed=10)
    target = bar_target(width=2, speed=10)
    made = jx.interpolate_bidirectional(previous, next, 0.5, target=target, stencil_ids=(1,))
    row, case = np.asarray(made.color)[1, :, 0], np.asarray(made.case)[1]
    np.testing.assert_allclose(row[9:11], 0.85, atol=1e-6)
    np.testing.assert_array_equal(case[9:11], CASES.index("assisted"))
    assert (case[[0, 1, 20, 23]] == CASES.index("agree")).all()
    np.testing.assert_array_equal(np.asarray(made.depth)[1, 9:11], 2)
    other = jx.interpolate_bidirectional(previous, next, 0.5, target=target, stencil_ids=(7,))
    plain = jx.interpolate_bidirectional(previous, next, 0.5)
    np.testing.assert_array_equal(other.color, plain.color)
    whole = jx.interpolate_bidirectional(previous, next, 0.5, target=target)
    np.testing.assert_array_equal(whole.color, jx.interpolate_assisted(previous, next, target, 0.5).color)


def test_the_depth_buffer_hides_what_is_behind():
    previous, next = layers(left=4, width=2, speed=10, near=12.0, far=10.0)  # the bar is behind the wall
    made = jx.interpolate_bidirectional(
        previous, next, 0.5, target=bar_target(width=2, speed=10, near=12.0), stencil_ids=(1,)
    )
    assert (np.asarray(made.case) != CASES.index("assisted")).all()


def test_rendered_over_frames_that_leave_it_out():
    wall = np.full((4, 24, 1), 0.1, np.float32)
    zero, far = np.zeros((4, 24, 3), np.float32), np.full((4, 24, 1), 10, np.float32)
    previous, next = keyframe(wall, far, forward=zero), keyframe(wall + 0.1, far, backward=zero)
    target = jx.replace(bar_target(), color=jnp.full((4, 24, 1), 0.7, jnp.float32))
    options = {"target": target, "stencil_ids": (1,), "target_mode": "render"}
    made = jx.interpolate_bidirectional(previous, next, 0.5, **options)
    row = np.asarray(made.color)[1, :, 0]
    np.testing.assert_allclose(row[7:15], 0.7)
    np.testing.assert_allclose(np.delete(row, np.s_[7:15]), 0.15, atol=1e-6)
    assert (np.asarray(made.case)[1, 7:15] == CASES.index("rendered")).all()
    plain = jx.interpolate_bidirectional(previous, next, 0.5)
    over = jx.overlay(plain, target.color, target.depth, target.stencil[..., 0] > 0)
    np.testing.assert_array_equal(over.color, made.color)
    np.testing.assert_array_equal(over.depth, made.depth)


@pytest.mark.slow
def test_runs_with_targets():
    previous, next = layers(speed=6)
    targets = jax.tree.map(lambda *a: jnp.stack(a), bar_target(0.5), bar_target(0.5))
    whole = jx.interpolate_run(previous, next, factor=3, targets=targets)
    single = jx.interpolate_assisted(previous, next, bar_target(0.5), 1 / 3)
    np.testing.assert_allclose(whole[0], single.color, atol=1e-6)
    some = jx.interpolate_run(previous, next, factor=3, targets=targets, stencil_ids=(1,))
    assert some.shape == whole.shape


def test_blend_is_exact_at_its_ends():
    first, second = jnp.full((1, 2, 1), jnp.nan), random(1, 2, 1)
    np.testing.assert_array_equal(blend(first, jnp.asarray(second), jnp.ones((1, 2, 1))), second)
    np.testing.assert_array_equal(blend(jnp.asarray(second), first, jnp.zeros((1, 2, 1))), second)


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"target": None}, TypeError, "target: expected a Keyframe, got NoneType"),
        ({"target.depth": None}, ValueError, "target.depth: absent"),
        ({"target.forward_flow": jnp.ones((H, W, 2))}, ValueError, r"target.forward_flow: expected shape \[5, 8, 3\]"),
        ({"previous.depth": None}, ValueError, "previous.depth: absent"),
        ({"next.color": jnp.ones((H, 3, 1))}, ValueError, "next.color: expected shape"),
        ({"filter": "cubic"}, ValueError, "filter: expected one of"),
        ({"alpha": jnp.ones(3)}, ValueError, r"alpha: expected shape \[\], got \[3\]"),
    ],
)
def test_errors(unchecked, change, error, message):
    previous, next, target = misses()
    arguments = {"previous": previous, "next": next, "target": target, "alpha": 0.5}
    for name, value in change.items():
        record, _, field = name.partition(".")
        arguments[record] = jx.replace(arguments[record], **{field: value}) if field else value
    given = [arguments.pop(name) for name in ("previous", "next", "target", "alpha")]
    with pytest.raises(error, match=message):
        jx.interpolate_assisted(*given, **arguments)


def test_errors_of_both_together(unchecked):
    previous, next = layers()
    target = bar_target()
    with pytest.raises(ValueError, match=r"target\.stencil: absent"):
        jx.interpolate_bidirectional(previous, next, 0.5, target=jx.replace(target, stencil=None), stencil_ids=(1,))
    with pytest.raises(ValueError, match=r"target\.color: absent"):
        jx.interpolate_bidirectional(previous, next, 0.5, target=target, stencil_ids=(1,), target_mode="render")
    made = jx.interpolate_bidirectional(previous, next, 0.5)
    with pytest.raises(ValueError, match=r"depth: expected shape \[4, 24, 1\]"):
        jx.overlay(made, made.color, jnp.ones((4, 24, 2)), jnp.ones((4, 24), bool))
