"""camera_flow and complete_flows: flows from cameras, and those that the input lacks."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from oracles import look, perspective, random
from test_bidirectional import keyframe, layers

import jaxtrapolate as jx

H, W = 5, 7


def camera(view, projection=None):
    projection = perspective(H, W) if projection is None else projection
    return jx.Camera(jnp.asarray(view, jnp.float32), jnp.asarray(projection, jnp.float32))


def surface():
    return (random(H, W, 3, seed=7, low=-1) - np.float32([0, 0, 5])).astype(np.float32)


VIEWS = look(0.1), look(-0.1, (0.2, 0.1, 0.3))


@pytest.mark.parametrize("objects", [False, True])
def test_camera_flow_against_the_loop(objects):
    position, stencil = surface(), np.round(random(H, W, 1, seed=2, high=3)).astype(np.float32)
    position[1, 2] = np.nan
    matrices = np.stack([look(0.2 * k, (0.1 * k, 0, 0)) for k in range(2)]).astype(np.float32)
    matrices[0] = np.eye(4)
    given = {"object_motion": jnp.asarray(matrices), "stencil": jnp.asarray(stencil)} if objects else {}
    flow = np.asarray(jx.camera_flow(jnp.asarray(position), camera(VIEWS[0]), camera(VIEWS[1]), **given))
    p = perspective(H, W)
    extra = (matrices, stencil) if objects else ()
    np.testing.assert_allclose(
        flow[..., :2], oracles.camera_motion(position, (VIEWS[0], p), (VIEWS[1], p), *extra), atol=2e-5
    )
    for r, c in np.ndindex(H, W):
        point = np.append(np.float64(position[r, c]), 1)
        k = int(stencil[r, c, 0])
        moved = np.float64(matrices[k]) @ point if objects and k < 2 else point
        expected = -(VIEWS[1] @ moved)[2] + (VIEWS[0] @ point)[2]
        np.testing.assert_allclose(flow[r, c, 2], expected, atol=1e-5)


def test_camera_flow_of_an_orthographic_camera():
    projection = np.diag([0.5, 0.5, -0.1, 1.0])
    flow = jx.camera_flow(jnp.asarray(surface()), camera(look(), projection), camera(look(0, (0, 0, 1)), projection))
    np.testing.assert_allclose(flow, np.broadcast_to(np.float32([0, 0, 1]), (H, W, 3)), atol=1e-5)


def test_camera_flow_is_zero_for_one_camera_and_finite_in_its_gradient():
    position = surface()
    position[0, 0] = np.inf
    position[2, 2, 2] = 5  # behind the camera

    def total(position, view):
        flow = jx.camera_flow(position, camera(look()), jx.Camera(view, jnp.asarray(perspective(H, W), jnp.float32)))
        return jnp.sum(jnp.where(jnp.isfinite(flow), flow, 0)), flow

    view = jnp.asarray(look(), jnp.float32)
    gradients, flow = jax.grad(total, argnums=(0, 1), has_aux=True)(jnp.asarray(position), view)
    bad = np.zeros((H, W), bool)
    bad[0, 0] = bad[2, 2] = True
    np.testing.assert_array_equal(np.isnan(flow).all(-1), bad)
    np.testing.assert_allclose(np.asarray(flow)[~bad], 0, atol=1e-5)
    assert all(np.isfinite(g).all() for g in gradients)


def backward_only(**options):
    """`layers` of which only 2D backward motion is known, and the true forward flow."""
    previous, next = layers(**options)
    return (
        jx.replace(previous, forward_flow=None),
        jx.replace(next, backward_flow=next.backward_flow[..., :2]),
        previous,
    )


def test_the_forward_flow_is_the_backward_one_turned_around():
    previous, next, true = backward_only()
    made = jx.complete_flows(previous, next)
    assert made.derived == ("forward_flow", "forward_flow.z", "backward_flow.z")
    assert made.backward_known is None
    found = np.asarray(made.previous.forward_flow)
    # the wall that the bar hides at t + 1 is filled from the wall beside it, not from the bar
    np.testing.assert_array_equal(found[..., :2], np.asarray(true.forward_flow)[..., :2])
    known = np.asarray(made.forward_known)[1]
    assert known[4:12].all(), "the bar"
    assert not known[13:18].any(), "wall hidden by the bar in the other frame"
    np.testing.assert_array_equal(found[..., 2], 0)


def test_the_other_way_round_and_without_depth():
    previous, next = layers()
    only = jx.replace(previous, depth=None), jx.replace(next, depth=None, backward_flow=None)
    made = jx.complete_flows(*only)
    assert made.derived == ("backward_flow",)
    assert made.next.backward_flow.shape == (4, 24, 3)
    assert made.forward_known is None
    assert np.asarray(made.next.backward_flow)[1, 12, 0] == -6
    whole = jx.complete_flows(previous, next)
    assert whole.derived == ()
    np.testing.assert_array_equal(whole.previous.forward_flow, previous.forward_flow)


def test_holes_take_the_most_similar_depth_else_the_closest():
    """One row: left of the hole depth 5, right of it depth 2; the hole is as deep as the left, nearer to the right."""
    depth = np.float32([5, 5, 5, 5, 5, 2, 2])[None, :, None]
    back = np.zeros((1, 7, 3), np.float32)
    back[0, :2, 0], back[0, 2:5, 0], back[0, 5:, 0] = 0.0, 100.0, -0.25
    previous, next = keyframe(np.ones((1, 7, 1), np.float32), depth), keyframe(np.ones((1, 7, 1), np.float32), depth)
    next = jx.replace(next, backward_flow=jnp.asarray(back))
    made = jx.complete_flows(previous, next)
    known = np.asarray(made.forward_known)[0]
    assert not known[3]
    assert np.asarray(made.previous.forward_flow)[0, 3, 0] == 0
    flat = jx.complete_flows(jx.replace(previous, depth=None), jx.replace(next, depth=None))
    assert np.asarray(flat.forward_known)[0].tolist() == [True, True, True, False, True, True, True]
    assert np.asarray(flat.previous.forward_flow)[0, 3, 0] == 0  # both one step away: the left one


def test_nothing_known_is_no_motion():
    zero = np.zeros((3, 4, 1), np.float32)
    next = keyframe(zero, backward=np.full((3, 4, 2), np.nan, np.float32))
    made = jx.complete_flows(keyframe(zero), next)
    np.testing.assert_array_equal(made.previous.forward_flow, 0)
    assert not np.asarray(made.forward_known).any()


def test_the_change_of_depth():
    """A plane that comes nearer by 10 %; a jump of half the depth is another surface."""
    flow = np.zeros((H, W, 2), np.float32)
    near = np.full((H, W, 1), 9, np.float32)
    near[2, 3] = 4
    color = np.ones((H, W, 1), np.float32)
    previous = keyframe(color, np.full((H, W, 1), 10, np.float32), forward=flow)
    made = jx.complete_flows(previous, keyframe(color, near, backward=flow))
    assert made.derived == ("forward_flow.z", "backward_flow.z")
    expected = np.full((H, W), -1, np.float32)
    expected[2, 3] = 0
    np.testing.assert_array_equal(np.asarray(made.previous.forward_flow)[..., 2], expected)
    ordinal = jx.complete_flows(previous, keyframe(color, near, backward=flow), depth="ordinal")
    assert ordinal.derived == ()


def test_the_frame_between_from_backward_motion_alone():
    previous, next, _ = backward_only()
    made = jx.complete_flows(previous, next)
    options = {"visibility": jx.VisibilityOptions(test="round_trip")}
    row = np.asarray(jx.interpolate_bidirectional(made.previous, made.next, 0.5, **options).color)[1, :, 0]
    np.testing.assert_allclose(row[7:15], 0.85, atol=1e-6)
    np.testing.assert_allclose(row[[0, 1, 2, 20, 23]], 0.15, atol=1e-6)


@pytest.mark.slow
def test_jit_vmap_and_gradients():
    previous, next, _ = backward_only()

    def total(flow, depth):
        made = jx.complete_flows(jx.replace(previous, depth=depth), jx.replace(next, backward_flow=flow))
        return jnp.sum(jnp.sin(made.previous.forward_flow)) + jnp.sum(jnp.sin(made.next.backward_flow))

    given = next.backward_flow, previous.depth
    gradients = jax.jit(jax.grad(total, argnums=(0, 1)))(*given)
    assert all(np.isfinite(g).all() for g in gradients)
    assert np.abs(gradients[0]).sum() > 0
    stacked = [jnp.stack([a, a]) for a in given]
    np.testing.assert_allclose(jax.vmap(total)(*stacked), np.full(2, total(*given)), rtol=1e-5)


def test_errors(unchecked):
    previous, next = layers()
    with pytest.raises(ValueError, match=r"previous\.forward_flow, next\.backward_flow: expected at least one"):
        jx.complete_flows(jx.replace(previous, forward_flow=None), jx.replace(next, backward_flow=None))
    with pytest.raises(ValueError, match=r"next.depth: expected shape \[4, 24, 1\]"):
        jx.complete_flows(previous, jx.replace(next, depth=jnp.ones((4, 4, 1))))
    with pytest.raises(ValueError, match="depth: expected one of 'metric', 'ordinal'"):
        jx.complete_flows(previous, next, depth="none")
    with pytest.raises(ValueError, match="object_motion, stencil: expected both or neither"):
        jx.camera_flow(jnp.ones((H, W, 3)), camera(look()), camera(look()), stencil=jnp.ones((H, W, 1)))
