"""Holes by depth: silhouettes between pixels, cameras that move fast, thin columns, far skies; against exact scenes."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxtrapolate as jx
from jaxtrapolate.ops.holes import possible_masks
from jaxtrapolate.ops.visibility import expected_depth
from jaxtrapolate.records import Frame, GBuffer, Keyframe
from jaxtrapolate.scenes import SceneSequence

SIZE = (40, 60)


def half_plane(edge):
    """Depth of a wall at 10 and of a sheet at 4 before it, left of a slanted edge that passes between pixels."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    return np.where(x + 0.37 * y < edge, 4, 10).astype(np.float32)[..., None], x + 0.37 * y


def test_a_silhouette_between_pixels():
    """The sheet moves by 6.3 pixels over a wall that moves by 0.6: what it uncovers is known exactly."""
    (target, along), (source, _) = half_plane(25.2), half_plane(25.2 + 6.3)
    flow = np.zeros((*SIZE, 3), np.float32)
    flow[..., 0] = np.where(target[..., 0] < 5, 6.3, 0.6)
    found = np.asarray(jx.disoccluded(Keyframe(depth=target, backward_flow=flow), Keyframe(depth=source)))
    hidden = (target[..., 0] > 5) & (along + 0.6 < 25.2 + 6.3) & np.asarray(jx.in_frame(jnp.asarray(flow[..., :2])))
    both = (found & hidden).sum()
    assert both / found.sum() > 0.97
    assert both / hidden.sum() > 0.97


@pytest.mark.slow
@pytest.mark.parametrize("name", ["forest", "street", "walkers", "interior"])
def test_disoccluded_on_scenes(name):
    """A training seed that nothing was chosen on."""
    sequence = SceneSequence(name, 902, frames=10, size=(180, 320))
    target, source = (jx.replace(sequence.keyframe(n), color=None) for n in (9, 8))
    hidden = ~sequence.visible(9, 8) & np.asarray(jx.in_frame(jnp.asarray(target.backward_flow[..., :2])))
    found = np.asarray(jx.disoccluded(target, source))
    assert (found & hidden).sum() > 0.85 * max(found.sum(), hidden.sum())


def moved(depth, shift, turn):
    """The motion and the depth of the points of a pinhole camera that moves by a shift and turns about y; float64."""
    height, width = depth.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    u, v, z = (x - width / 2) / width, (y - height / 2) / width, depth
    px, py, pz = u * z + shift[0], v * z + shift[1], z + shift[2]
    qx, qz = px * np.cos(turn) + pz * np.sin(turn), pz * np.cos(turn) - px * np.sin(turn)
    return np.stack([qx / qz * width + width / 2 - x, py / qz * width + height / 2 - y], -1), qz


@pytest.mark.parametrize("unit", [1.0, 100.0, 1e-3])
def test_expected_depth_of_a_camera_that_moves_fast(unit):
    """Found from depths and motion alone, though a third of the pixels do not show in the source what they are."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(3, 30, SIZE)
    motion, then = moved(depth, (0.4, -0.2, 1.5), 0.1)
    motion = np.round(motion)  # so that each pixel has a pixel of its own to look at
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    column, row = (x + motion[..., 0]).astype(int), (y + motion[..., 1]).astype(int)
    seen = (column >= 0) & (row >= 0) & (column < SIZE[1]) & (row < SIZE[0])
    source = rng.uniform(1, 3, SIZE)
    source[row[seen], column[seen]] = then[seen]  # where several land the last is seen
    given = [np.float32(unit * a)[..., None] for a in (depth, source)]
    found = np.asarray(expected_depth(*given, np.float32(motion)))[..., 0]
    np.testing.assert_allclose(found, unit * then, rtol=5e-3)
    assert np.abs(then / depth - 1).max() > 0.3


def test_expected_depth_without_anything_to_go_by():
    far, motion = np.full((4, 5, 1), np.inf, np.float32), np.zeros((4, 5, 2), np.float32)
    assert np.isinf(expected_depth(far, far, motion)).all()
    one = np.full((4, 5, 1), 3, np.float32)
    np.testing.assert_allclose(expected_depth(one, far, motion), 3, rtol=1e-6)
    np.testing.assert_allclose(expected_depth(one, one, motion + np.nan), 3, rtol=1e-6)


@pytest.mark.parametrize("taps", ["weighted", "nearest"])
def test_nearer_surfaces_are_holes_and_the_cameras_own_motion_is_none(taps):
    """A camera that backs by a third of the distance from a slanted wall, before which a sheet stood in the source."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    plane = lambda d: 1 / (1 / d + 0.002 * (x - 30) + 0.001 * (y - 20))  # noqa: E731
    target, source = plane(10.0), plane(10.0) * 0.7
    motion = np.zeros((*SIZE, 2), np.float32)
    source[10:20, 20:25] *= 0.8
    masks = jx.hole_masks(
        *(GBuffer(depth=jnp.asarray(d, jnp.float32)[..., None]) for d in (target, source)), motion, taps=taps
    )
    expected = np.zeros(SIZE, bool)
    expected[10:20, 20:25] = True
    np.testing.assert_array_equal(masks.depth[..., 0], expected)


def column(width, at, depth, behind):
    """Buffers of a static column over something that is behind it; a wall at 10, or other columns."""
    z = np.full((5, 9, 1), 10, np.float32) if behind is None else np.float32(behind)
    z[:, at : at + width] = depth
    y, x = np.mgrid[:5, :9].astype(np.float32)
    position = np.concatenate([(x[..., None] - 4) * 0.01 * z, (y[..., None] - 2) * 0.01 * z, z], -1)
    return GBuffer(position=jnp.asarray(position), depth=jnp.asarray(z), stencil=jnp.zeros((5, 9, 1)))


@pytest.mark.parametrize("width", [1, 2])
@pytest.mark.parametrize("taps", ["weighted", "nearest"])
def test_a_thin_column_before_a_wall(width, taps):
    wall, before = column(width, 4, 10, None), column(width, 4, 5, None)
    for target, source in ((before, wall), (wall, before), (before, column(width, 4, 7, None))):
        found = np.asarray(jx.hole_masks(target, source, jnp.zeros((5, 9, 2)), taps=taps).position)[..., 0]
        expected = np.zeros((5, 9), bool)
        expected[:, 4 : 4 + width] = True
        np.testing.assert_array_equal(found, expected)
    assert not jx.hole_masks(before, before, jnp.zeros((5, 9, 2)), taps=taps).any.any()


@pytest.mark.parametrize("far", [np.inf, 1e7, 1e6, 1e5])
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.0, 0.0, 10.0), (0.0, 0.0, 1e7)], ids=str)
@pytest.mark.parametrize("marked", [True, False])
def test_a_far_sky_is_another_surface_than_a_trunk(far, place, marked):
    one = jnp.ones((4, 4, 1))

    def buffers(sky, depth, at):
        sky = sky * one if marked else None
        return GBuffer(stencil=0 * one, sky=sky, depth=depth * one, position=one * jnp.asarray(at))

    sky, trunk = buffers(1, far, place), buffers(0, 10.0, (0.0, 0.0, 10.0))
    for target, source in ((sky, trunk), (trunk, sky)):
        masks = jx.hole_masks(target, source, jnp.zeros((4, 4, 2)))
        assert masks.position.all()
        assert masks.depth.all()
    assert not jx.hole_masks(sky, sky, jnp.zeros((4, 4, 2))).any.any()


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_guided_warp_of_color_motion_and_depth_alone(unit):
    """A red box moved aside over a wall of one colour: there the warp repeats the box, the guided warp has the wall."""
    box = lambda left: (np.arange(60) >= left) & (np.arange(60) < left + 8)  # noqa: E731

    def frame(left, motion):
        there = np.broadcast_to(box(left)[None, :, None], (*SIZE, 1))
        color = np.where(there, np.float32([0.9, 0.1, 0.1]), np.float32([0.2, 0.4, 0.3]))
        vectors = np.zeros((*SIZE, 2), np.float32)
        vectors[..., 0] = np.where(there[..., 0], motion, 0)
        depth = np.where(there, 4, 10) * np.float32(unit)
        return color, Frame(gbuffer=GBuffer(depth=np.float32(depth)), motion=vectors)

    color, source = frame(20, 0)
    truth, target = frame(25, -5)
    source = jx.replace(source, color=np.float32(color))
    for name in ("guided_warp", "occlusion_warp"):
        method = jx.load(name)
        assert "holes" in [stage.name for stage in method.active((source,), target)]
        np.testing.assert_allclose(method((source,), target), truth, atol=1e-4)
    assert np.abs(np.asarray(jx.load("warp")((source,), target)) - truth).max() > 0.5


def test_the_line_of_masks():
    assert possible_masks(["depth", "albedo"]) == (
        "hole masks: by depth (nearer surfaces, since there is no position), the frame's edge; "
        "not by stencil (needs stencil), normal (needs normal), position (needs position)"
    )
    assert possible_masks([]).startswith("hole masks: by the frame's edge; not by stencil")
    every = possible_masks(["depth", "position", "normal", "stencil"])
    assert every == "hole masks: by stencil, normal, position, depth, the frame's edge"
