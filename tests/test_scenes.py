"""The renderer's buffers against each other, and against a float64 NumPy ray caster that shares no code with it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtrapolate as jx
from jaxtrapolate.records import check_frame
from jaxtrapolate.scenes import flow, keyframe, render, scene_names, visible
from jaxtrapolate.scenes import scene as named_scene
from jaxtrapolate.scenes.scene import Builder, Scene, frame_along, material, path, turn, yaw
from jaxtrapolate.scenes.worlds import common

SIZE = (46, 74)
TIME, BEFORE = 7.0, 5.0
SUN = common.sun_from(50.0, 40.0)


def zoo(seed: int = 0) -> Scene:
    """Each shape once still and once moving, under a moving camera; a hard sun and a lamp."""
    rng = np.random.default_rng(seed)
    b = Builder()
    b.add("plane", (0, 0, 0), (1, 1, 1), material((0.4, 0.4, 0.4), color_b=(0.1, 0.1, 0.1), frequency=(0.5, 0.5, 0)))
    rusty = material((0.6, 0.3, 0.2), roughness=0.3, noise=0.3)
    b.add("box", (1.4, 0.4, 0.5), (0.5, 0.4, 0.5), rusty, rotation=yaw(0.4))
    b.add("sphere", (-1.5, 0.3, 0.5), (0.5, 0.4, 0.5), material((0.8, 0.7, 0.2), metallic=1, roughness=0.2))
    b.limb((0, 1.6, 0.2), (0.4, 1.5, 1.8), 0.2, rusty)
    b.add("blade", (-0.7, 1.9, 0.8), (0.7, 0.4, 0.5), rusty, rotation=frame_along((0.3, -1, 0.2)))
    where = path(
        (0.2, -0.6, 0.9), amplitude=[(0.7, 0.5, 0.2)], frequency=[(0.02, 0.03, 0.04)], phase=[rng.uniform(0, 1, 3)]
    )
    body = b.body(where, turn((1, 2, 3), rate=0.05, amplitude=[0.3], frequency=[0.03]), stencil=3)
    b.add("box", (0, 0, 0), (0.3, 0.15, 0.2), rusty, body=body)
    b.limb((0.4, 0, 0), (0.8, 0.1, 0.2), 0.1, rusty, body=body)
    other = b.body(path((0.6, 0.2, 1.6)), turn((0, 0, 1), rate=0.1), stencil=5)
    arm = b.body(path((0.5, 0, 0)), turn((0, 1, 0), rate=-0.07), parent=other)
    b.add("sphere", (0.1, 0, 0), (0.2, 0.15, 0.25), rusty, body=arm)
    b.add("blade", (-0.3, 0, 0), (0.3, 0.1, 0.3), rusty, body=arm)
    return b.build(
        camera=common.camera(
            common.circle(4.6, 300.0, 0.6 + 0.05 * seed, centre=(0, 0, 1.8)),
            common.circle(0.3, 90.0, 0.0, centre=(0, 0, 0.7)),
        ),
        sky=common.daylight(rng),
        sun_direction=SUN,
        sun_color=2.0,
        bounce=False,
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    return zoo()


@pytest.fixture(scope="module")
def frame(scene):
    return jax.tree.map(np.asarray, render(scene, TIME, size=SIZE, previous_time=BEFORE))


@pytest.fixture(scope="module")
def before(scene):
    return jax.tree.map(np.asarray, render(scene, BEFORE, size=SIZE, previous_time=BEFORE - 2))


def to_pixels(camera, position):
    """By the public convention of `records.Camera` alone, in float64."""
    matrix = camera.projection.astype(np.float64) @ camera.view.astype(np.float64)
    clip = np.concatenate([position, np.ones_like(position[..., :1])], axis=-1).astype(np.float64) @ matrix.T
    x = (0.5 + 0.5 * clip[..., 0] / clip[..., 3]) * SIZE[1] - 0.5
    y = (0.5 - 0.5 * clip[..., 1] / clip[..., 3]) * SIZE[0] - 0.5
    return np.stack([x, y], axis=-1), clip[..., 3]


def grid(size=SIZE):
    y, x = np.mgrid[: size[0], : size[1]]
    return np.stack([x, y], axis=-1).astype(np.float64)


# The oracle: float64 intersections by other formulas than the renderer's.


def world(scene, time):
    """The primitives as float64 arrays: kind, rotation, centre, size, stencil."""
    from jaxtrapolate.scenes.primitives import KINDS

    poses = scene.bodies.at(jnp.float32(time))
    rows, first = [], 0
    for kind, pair in zip(KINDS, scene.counts, strict=True):
        for k in range(first, first + sum(pair)):
            body = scene.body[k]
            rotation = np.float64(poses.rotation[body]) @ np.float64(scene.rotation[k])
            centre = np.float64(poses.rotation[body]) @ np.float64(scene.centre[k]) + np.float64(
                poses.translation[body]
            )
            rows.append((kind, rotation, centre, np.float64(scene.size[k]), float(scene.bodies.stencil[body])))
        first += sum(pair)
    return rows


def oracle_hit(row, origin, direction):
    """The smallest t > 1e-6 at which rays `[N, 3]` enter a primitive, infinite for none."""
    kind, rotation, centre, size, _ = row
    o, d = (origin - centre) @ rotation, direction @ rotation
    o = np.broadcast_to(o, d.shape)
    with np.errstate(all="ignore"):
        if kind == "plane":
            t = np.where(d[:, 2] < 0, -o[:, 2] / d[:, 2], np.inf)
        elif kind == "blade":
            t = -o[:, 2] / d[:, 2]
            p = o + d * t[:, None]
            half = size[1] * (1 - size[2] * (p[:, 0] / size[0] + 1) / 2)
            t = np.where((np.abs(p[:, 0]) <= size[0]) & (np.abs(p[:, 1]) <= half), t, np.inf)
        elif kind == "box":
            t = np.full(len(d), np.inf)
            for axis in range(3):
                for side in (-1, 1):
                    face = (side * size[axis] - o[:, axis]) / d[:, axis]
                    p = o + d * face[:, None]
                    others = [k for k in range(3) if k != axis]
                    inside = np.all(np.abs(p[:, others]) <= size[others], axis=1) & (d[:, axis] * side < 0)
                    t = np.where(inside & (face > 1e-6), np.minimum(t, face), t)
        else:
            balls = [(np.zeros(3), size)]
            if kind == "capsule":
                balls = [(np.array([0, 0, s * size[2]]), np.full(3, size[0])) for s in (-1, 1)]
            t = np.full(len(d), np.inf)
            for middle, radii in balls:
                p, v = (o - middle) / radii, d / radii
                a, half_b, c = (v * v).sum(1), (p * v).sum(1), (p * p).sum(1) - 1
                root = (-half_b - np.sqrt(half_b**2 - a * c)) / a
                t = np.where(root > 1e-6, np.minimum(t, root), t)
            if kind == "capsule":
                a, half_b = (d[:, :2] ** 2).sum(1), (o[:, :2] * d[:, :2]).sum(1)
                root = (-half_b - np.sqrt(half_b**2 - a * ((o[:, :2] ** 2).sum(1) - size[0] ** 2))) / a
                z = o[:, 2] + root * d[:, 2]
                t = np.where((root > 1e-6) & (np.abs(z) <= size[2]), np.minimum(t, root), t)
    return np.where(t > 1e-6, np.where(np.isnan(t), np.inf, t), np.inf)


def rays(camera):
    """Eye and directions of unit depth through the pixel centres, from the matrices alone."""
    view = camera.view.astype(np.float64)
    eye = -view[:3, :3].T @ view[:3, 3]
    p = grid().reshape(-1, 2)
    x = ((p[:, 0] + 0.5) / SIZE[1] * 2 - 1) / camera.projection[0, 0]
    y = (1 - (p[:, 1] + 0.5) / SIZE[0] * 2) / camera.projection[1, 1]
    return eye, np.stack([x, y, -np.ones_like(x)], axis=1) @ view[:3, :3]


def test_frame_is_a_valid_record_and_finite(frame):
    assert check_frame("frame", frame) == SIZE
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(frame))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(frame))
    assert set(np.unique(frame.gbuffer.stencil)) == {0, 3, 5}
    for name in ("albedo", "roughness", "metallic", "specular", "n_dot_v", "shadow", "sky"):
        value = getattr(frame.gbuffer, name)
        assert value.min() >= 0, name
        assert value.max() <= 1, name
    assert frame.color.min() >= 0


def test_primary_rays_match_the_oracle(scene, frame):
    eye, d = rays(frame.camera)
    rows = world(scene, TIME)
    t = np.stack([oracle_hit(row, eye, d) for row in rows])
    nearest, winner = t.min(axis=0), t.argmin(axis=0)
    sky = frame.gbuffer.sky.reshape(-1) > 0.5
    depth = frame.gbuffer.depth.reshape(-1)
    stencil = frame.gbuffer.stencil.reshape(-1)
    agree = sky == np.isinf(nearest)
    close = np.abs(depth - nearest) < 1e-4 * np.where(sky, 1, nearest)
    good = agree & (sky | close)
    assert good.mean() > 0.998  # silhouettes may fall to the other side by rounding
    expected = np.array([row[4] for row in rows])[winner]
    assert (stencil == np.where(sky, 0, expected))[good].mean() > 0.999


def test_depth_and_position_agree_with_the_camera(frame):
    pixel, depth = to_pixels(frame.camera, frame.gbuffer.position)
    np.testing.assert_allclose(pixel, grid(), atol=2e-3)
    np.testing.assert_allclose(depth, frame.gbuffer.depth[..., 0], rtol=1e-4)


def test_motion_of_static_surfaces_is_that_of_their_positions(frame, before):
    there, _ = to_pixels(before.camera, frame.gbuffer.position)
    static = frame.gbuffer.stencil[..., 0] == 0
    np.testing.assert_allclose((there - grid())[static], frame.motion[static], atol=0.02)


def test_motion_of_dynamic_surfaces_is_that_of_their_bodies(scene, frame, before):
    now, then = (scene.bodies.at(jnp.float32(t)) for t in (TIME, BEFORE))
    error = np.full(SIZE, np.inf)
    for body in range(1, len(scene.bodies.parents)):
        stencil = float(scene.bodies.stencil[body])
        local = (frame.gbuffer.position - np.float64(now.translation[body])) @ np.float64(now.rotation[body])
        moved = local @ np.float64(then.rotation[body]).T + np.float64(then.translation[body])
        there, _ = to_pixels(before.camera, moved)
        off = np.abs(there - grid() - frame.motion).max(axis=-1)
        error = np.where(frame.gbuffer.stencil[..., 0] == stencil, np.minimum(error, off), error)
    assert error[frame.gbuffer.stencil[..., 0] > 0].max() < 0.02


@pytest.mark.slow
def test_scenes_have_as_many_object_matrices():
    """What is compiled for frames of one scene fits those of another."""
    shapes = set()
    for name in scene_names():
        found = jax.eval_shape(
            partial(render, size=(4, 5), previous_time=0.0), named_scene(name, 1), jnp.float32(1)
        ).objects
        shapes |= set() if found is None else {found.shape}
    assert shapes == {(40, 4, 4)}


def test_object_matrices_lead_to_the_frame_before(frame, before):
    """The motion of rigid objects is that of their positions, moved by the matrix of their id."""
    matrices = np.concatenate([np.eye(4, dtype=np.float32)[None], np.asarray(frame.objects)])
    buffers = frame.gbuffer
    motion = jx.camera_motion(
        buffers.position, frame.camera, before.camera, object_motion=jnp.asarray(matrices), stencil=buffers.stencil
    )
    rigid = (np.asarray(buffers.stencil) > 0)[..., 0] & np.isfinite(motion).all(-1)
    assert rigid.sum() > 20
    error = np.abs(np.asarray(motion) - np.asarray(frame.motion)).max(-1)
    assert np.median(error[rigid]) < 1e-2


@pytest.mark.slow
def test_motion_warps_the_frame_before_onto_this_one(scene, frame, before):
    seen = np.asarray(visible(scene, TIME, BEFORE, size=SIZE))
    there = np.rint(grid() + frame.motion).astype(int)
    inside = (there >= 0).all(-1) & (there[..., 0] < SIZE[1]) & (there[..., 1] < SIZE[0])
    x, y = np.clip(there[..., 0], 0, SIZE[1] - 1), np.clip(there[..., 1], 0, SIZE[0] - 1)
    check = seen & inside
    for name, limit in (("stencil", 0.5), ("sky", 0.5), ("metallic", 0.5), ("roughness", 0.1)):
        now, then = getattr(frame.gbuffer, name), getattr(before.gbuffer, name)[y, x]
        assert (np.abs(now - then).max(-1) < limit)[check].mean() > 0.97, name  # half a pixel off at silhouettes


@pytest.mark.slow
def test_visible_agrees_with_a_depth_comparison(scene, frame, before):
    exact = np.asarray(visible(scene, TIME, BEFORE, size=SIZE))
    displacement = np.asarray(flow(scene, TIME, BEFORE, size=SIZE))
    np.testing.assert_allclose(displacement[..., :2], frame.motion, atol=1e-4)
    depth = frame.gbuffer.depth[..., 0] + displacement[..., 2]
    there = grid() + displacement[..., :2]
    inside = (there > -0.5).all(-1) & (there[..., 0] < SIZE[1] - 0.5) & (there[..., 1] < SIZE[0] - 0.5)
    x0 = np.clip(np.floor(there[..., 0]).astype(int), 0, SIZE[1] - 2)
    y0 = np.clip(np.floor(there[..., 1]).astype(int), 0, SIZE[0] - 2)
    taps = np.stack([before.gbuffer.depth[y0 + j, x0 + i, 0] for j in (0, 1) for i in (0, 1)])
    near, far = taps.min(0), taps.max(0)
    flat = far - near < 0.05 * near  # no silhouette between the taps
    estimate = inside & (depth < far * 1.03)
    assert (estimate == exact)[flat].mean() > 0.99
    assert 0.005 < (inside & ~exact).mean() < 0.2


def test_normals(frame):
    g = frame.gbuffer
    surface = g.sky[..., 0] < 0.5
    length = np.linalg.norm(g.normal, axis=-1)
    np.testing.assert_allclose(length[surface], 1, atol=1e-5)
    assert (length[~surface] == 0).all()
    view = frame.camera.view.astype(np.float64)
    eye = -view[:3, :3].T @ view[:3, 3]
    to_eye = eye - g.position
    to_eye = to_eye / np.linalg.norm(to_eye, axis=-1, keepdims=True)
    cosine = (to_eye * g.normal).sum(-1)
    np.testing.assert_allclose(np.where(surface, cosine, 0), g.n_dot_v[..., 0], atol=2e-4)
    # Against differences of position, where no edge is near and the surface is flat enough for them.
    right = g.position[1:-1, 2:] - g.position[1:-1, :-2]
    down = g.position[2:, 1:-1] - g.position[:-2, 1:-1]
    estimate = np.cross(down, right)
    estimate = estimate / np.linalg.norm(estimate, axis=-1, keepdims=True)
    n = g.normal[1:-1, 1:-1]
    neighbours = [g.normal[1:-1, 2:], g.normal[1:-1, :-2], g.normal[2:, 1:-1], g.normal[:-2, 1:-1]]
    smooth = np.all([(n * other).sum(-1) > 0.97 for other in neighbours], axis=0) & surface[1:-1, 1:-1]
    jump = np.abs(g.depth[1:-1, 2:] - g.depth[1:-1, :-2]) + np.abs(g.depth[2:, 1:-1] - g.depth[:-2, 1:-1])
    smooth &= (jump < 0.25)[..., 0]
    assert smooth.sum() > 300
    assert ((estimate * n).sum(-1)[smooth] > 0.97).mean() > 0.99


@pytest.mark.slow
def test_shadow_is_what_dynamic_objects_block_of_the_sun(scene, frame):
    g = frame.gbuffer
    flat = lambda value: value.reshape(-1, value.shape[-1])  # noqa: E731
    rows = world(scene, TIME)
    facing = (flat(g.normal) @ SUN > 0.02) & (flat(g.sky)[:, 0] < 0.5)
    start = flat(g.position).astype(np.float64) + 1e-3 * flat(g.normal)
    d = np.broadcast_to(SUN, start.shape)
    blocked = {moving: np.zeros(len(start), bool) for moving in (False, True)}
    for row in rows:
        blocked[row[4] > 0] |= np.isfinite(oracle_hit(row, start, d))
    expected = facing & blocked[True] & ~blocked[False]
    assert expected.sum() > 20
    assert ((flat(g.shadow)[:, 0] > 0.5) == expected).mean() > 0.995
    lit = render(scene, TIME, size=SIZE, previous_time=BEFORE, shadows_of_dynamic=False)
    assert not np.asarray(lit.gbuffer.shadow).any()
    same = flat(g.shadow)[:, 0] == 0
    np.testing.assert_array_equal(flat(np.asarray(lit.color))[same], flat(frame.color)[same])
    assert (flat(np.asarray(lit.color))[expected].sum(-1) > flat(frame.color)[expected].sum(-1)).all()


@pytest.mark.slow
def test_flow_there_and_back(scene):
    """The point where a surface lands flows back to where it came from, where the grid meets it exactly enough."""
    ahead = np.asarray(flow(scene, TIME, TIME + 2, size=SIZE))
    back = np.asarray(flow(scene, TIME + 2, TIME, size=SIZE))
    seen = np.asarray(visible(scene, TIME, TIME + 2, size=SIZE))
    there = grid() + ahead[..., :2]
    x0 = np.clip(np.floor(there[..., 0]).astype(int), 0, SIZE[1] - 2)
    y0 = np.clip(np.floor(there[..., 1]).astype(int), 0, SIZE[0] - 2)
    fx, fy = (there[..., 0] - x0)[..., None], (there[..., 1] - y0)[..., None]
    taps = [back[y0 + j, x0 + i] for j in (0, 1) for i in (0, 1)]
    mean = (taps[0] * (1 - fx) + taps[1] * fx) * (1 - fy) + (taps[2] * (1 - fx) + taps[3] * fx) * fy
    alike = np.max([np.abs(tap - mean).max(-1) for tap in taps], axis=0) < 0.2
    check = seen & alike
    assert check.mean() > 0.5
    assert np.abs(mean + ahead)[check].max() < 0.2
    assert np.median(np.abs(mean + ahead)[check]) < 5e-3
    still = np.asarray(flow(scene, TIME, TIME, size=SIZE))
    assert not still[frame_static(scene)].any()
    np.testing.assert_allclose(still, 0, atol=1e-3)


def frame_static(scene):
    return np.asarray(render(scene, TIME, size=SIZE, previous_time=BEFORE).gbuffer.stencil)[..., 0] == 0


def test_keyframe(scene, frame):
    made = keyframe(scene, TIME, size=SIZE, next_time=TIME + 2, previous_time=BEFORE)
    np.testing.assert_array_equal(made.color, frame.color)
    np.testing.assert_array_equal(made.depth, frame.gbuffer.depth)
    np.testing.assert_allclose(made.backward_flow[..., :2], frame.motion, atol=1e-4)
    np.testing.assert_array_equal(made.forward_flow, flow(scene, TIME, TIME + 2, size=SIZE))


def test_left_out_objects_are_gone_with_their_shadows(scene, frame):
    one = render(scene, TIME, size=SIZE, previous_time=BEFORE, leave_out=(3,))
    assert set(np.unique(one.gbuffer.stencil)) == {0, 5}
    none = render(scene, TIME, size=SIZE, previous_time=BEFORE, leave_out=(3, 5))
    assert not np.asarray(none.gbuffer.stencil).any()
    assert not np.asarray(none.gbuffer.shadow).any()
    before_them = (frame.gbuffer.stencil == 0)[..., 0]
    np.testing.assert_array_equal(np.asarray(none.gbuffer.depth)[before_them], frame.gbuffer.depth[before_them])


@pytest.mark.slow
def test_same_again_and_under_jit_and_vmap(scene, frame):
    again = render(scene, TIME, size=SIZE, previous_time=BEFORE)
    jax.tree.map(np.testing.assert_array_equal, again, frame)
    scenes = jax.tree.map(lambda *leaves: jnp.stack(leaves), zoo(0), zoo(1))
    batched = jax.vmap(lambda s, t: render(s, t, size=SIZE, previous_time=t - 2))(scenes, jnp.array([TIME, 12.0]))
    other = render(zoo(1), 12.0, size=SIZE, previous_time=10.0)
    for k, single in enumerate((frame, other)):
        one = jax.tree.map(lambda leaf, k=k: np.asarray(leaf[k]), batched)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(single), strict=True):
            off = np.abs(a - np.asarray(b)) > 1e-3 * (1 + np.abs(np.asarray(b)))
            assert off.mean() < 2e-3


def test_times_seeds_and_objects_share_one_compilation(scene, frame):
    from jaxtrapolate.scenes.render import _render

    count = _render._cache_size()
    for seed, time in ((0, 1.0), (1, 2.5), (2, 1000.0)):
        render(zoo(seed), time, size=SIZE, previous_time=0.5, leave_out=(3,) * seed)
    assert _render._cache_size() == count


@pytest.mark.parametrize("size", [pytest.param((1, 1), marks=pytest.mark.slow), (1, 7)])
@pytest.mark.slow
def test_small_sizes(scene, size):
    assert flow(scene, 3.0, 1.0, size=size).shape == (*size, 3)
    assert visible(scene, 3.0, 1.0, size=size).shape == size


def test_errors(scene):
    with pytest.raises(ValueError, match="size"):
        render(scene, 0.0, size=(0, 4))
    with pytest.raises(ValueError, match="samples"):
        render(scene, 0.0, size=(4, 4), samples=0)
