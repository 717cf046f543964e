"""Mirrored frames and crops: the cameras, motion and hole masks of a mirrored world; synthetic frames, no rendering."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import look, perspective, random
from synthetic import make_frame

import jaxtrapolate as jx
from jaxtrapolate.evaluation.windows import Window, hide
from jaxtrapolate.records import replace
from jaxtrapolate.training.augment import brighten, crop, flip

SIZE = (9, 14)
FLIPS = [(True, False), (False, True), (True, True)]


def seen(view, projection, position):
    """Where a camera sees world points `[H, W, 3]`, in pixels `[H, W, 2]`: float64, from the records' convention."""
    height, width = position.shape[:2]
    points = np.concatenate([position, np.ones((height, width, 1))], -1)
    clip = points @ (np.asarray(projection, np.float64) @ np.asarray(view, np.float64)).T
    x, y = clip[..., 0] / clip[..., 3], clip[..., 1] / clip[..., 3]
    return np.stack([(x + 1) * width / 2 - 0.5, (1 - y) * height / 2 - 0.5], -1)


def camera_and_frame(angle, eye, seed):
    """A frame whose every pixel's position is on its ray, seen by a rolled camera with its axis off the middle."""
    roll = np.eye(4)
    roll[:2, :2] = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    view = roll @ look(angle, eye)
    projection = perspective(*SIZE)
    projection[0, 2], projection[1, 2] = 0.2, -0.1
    height, width = SIZE
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    ndc = np.stack([(2 * x + 1) / width - 1, 1 - (2 * y + 1) / height], -1)
    depth = random(height, width, 1, seed=seed, low=3, high=8).astype(np.float64)
    local = np.concatenate([(ndc + projection[:2, 2]) / projection[[0, 1], [0, 1]] * depth, -depth], -1)
    position = (local - view[:3, 3]) @ view[:3, :3]  # the inverse of a rotation and a shift
    normal = random(height, width, 3, seed=seed + 1, low=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    camera = jx.Camera(view=jnp.asarray(view, jnp.float32), projection=jnp.asarray(projection, jnp.float32))
    buffers = jx.GBuffer(
        albedo=random(*SIZE, 3, seed=seed + 2),
        depth=depth.astype(np.float32),
        normal=normal.astype(np.float32),
        position=position.astype(np.float32),
        stencil=np.zeros((*SIZE, 1), np.float32),
    )
    motion = random(*SIZE, 2, seed=seed + 3, low=-2, high=2)
    return jx.Frame(
        color=random(*SIZE, 3, seed=seed + 4),
        gbuffer=buffers,
        motion=motion,
        camera=camera,
        jitter=jnp.array([0.1, -0.2]),
    )


@pytest.fixture(scope="module")
def frames():
    return camera_and_frame(0.2, (0.5, -0.3, 1.0), 0), camera_and_frame(0.35, (0.8, -0.2, 0.7), 10)


@pytest.mark.parametrize("horizontal, vertical", FLIPS)
def test_the_flipped_camera_sees_the_flipped_positions(frames, horizontal, vertical):
    grid = np.stack(np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0])), -1)
    for frame in frames:
        np.testing.assert_allclose(
            seen(frame.camera.view, frame.camera.projection, frame.gbuffer.position), grid, atol=1e-4
        )
        made = flip(frame, horizontal=horizontal, vertical=vertical)
        where = seen(made.camera.view, made.camera.projection, np.asarray(made.gbuffer.position, np.float64))
        np.testing.assert_allclose(where, grid, atol=1e-4)
        rotation = np.asarray(made.camera.view)[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-6)  # a camera that can be built


@pytest.mark.parametrize("horizontal, vertical", FLIPS)
def test_what_is_flipped(frames, horizontal, vertical):
    """Against NumPy's flips; the sides seen are the same: the cosines between normals and rays are flipped images."""
    frame, axes = frames[0], [a for a, f in ((1, horizontal), (0, vertical)) if f]
    made = flip(frame, horizontal=horizontal, vertical=vertical)
    for get in (lambda f: f.color, lambda f: f.gbuffer.albedo, lambda f: f.gbuffer.depth, lambda f: f.gbuffer.stencil):
        np.testing.assert_array_equal(get(made), np.flip(get(frame), axes))
    signs = np.array([-1 if horizontal else 1, -1 if vertical else 1], np.float32)
    np.testing.assert_array_equal(made.motion, np.flip(frame.motion, axes) * signs)
    np.testing.assert_array_equal(made.jitter, np.asarray(frame.jitter) * signs)

    def cosines(f):
        view = np.asarray(f.camera.view, np.float64)
        eye = -view[:3, :3].T @ view[:3, 3]
        ray = np.asarray(f.gbuffer.position) - eye
        return (np.asarray(f.gbuffer.normal) * ray).sum(-1) / np.linalg.norm(ray, axis=-1)

    np.testing.assert_allclose(cosines(made), np.flip(cosines(frame), axes), atol=1e-5)


@pytest.mark.parametrize("horizontal, vertical", FLIPS)
def test_motion_from_positions_is_the_flipped_motion(frames, horizontal, vertical):
    """All frames are mirrored at the same plane, so that what positions say between two frames is what motion says."""
    now, before = frames
    motion = jx.camera_motion(jnp.asarray(now.gbuffer.position), now.camera, before.camera)
    a, b = (flip(f, horizontal=horizontal, vertical=vertical) for f in (jx.replace(now, motion=motion), before))
    np.testing.assert_allclose(jx.camera_motion(a.gbuffer.position, a.camera, b.camera), a.motion, atol=2e-4)


@pytest.mark.parametrize("name", ["position", "normal"])
def test_distances_between_frames_stay(frames, name):
    for flags in FLIPS:
        made = [flip(f, horizontal=flags[0], vertical=flags[1]) for f in frames]
        a, b = (np.asarray(getattr(f.gbuffer, name)).reshape(-1, 3) for f in frames)
        c, d = (np.asarray(getattr(f.gbuffer, name)) for f in made)
        axes = [i for i, f in ((1, flags[0]), (0, flags[1])) if f]
        c, d = (np.flip(x, axes).reshape(-1, 3) for x in (c, d))
        np.testing.assert_allclose(np.linalg.norm(c - d, axis=-1), np.linalg.norm(a - b, axis=-1), rtol=1e-5)


def test_twice_is_nothing_and_flags_may_be_traced(frames):
    for horizontal, vertical in [*FLIPS, (False, False)]:
        flipped = jax.jit(lambda f, h, v: flip(f, horizontal=h, vertical=v))
        twice = flipped(flipped(frames[0], horizontal, vertical), horizontal, vertical)
        for a, b in zip(jax.tree.leaves(twice), jax.tree.leaves(frames[0]), strict=True):
            np.testing.assert_array_equal(a, b)
        once = flipped(frames[0], horizontal, vertical)
        eager = flip(frames[0], horizontal=horizontal, vertical=vertical)
        for a, b in zip(jax.tree.leaves(once), jax.tree.leaves(eager), strict=True):
            np.testing.assert_array_equal(a, b)


def window(size=(32, 48)):
    """Six synthetic frames as methods see them."""
    frames = [make_frame(t, size) for t in range(6)]
    history = tuple(f if t % 2 == 0 else hide(f) for t, f in enumerate(frames[:5]))
    return Window(number=5, truth=frames[5], history=history, target=hide(frames[5]), future=())


@pytest.mark.parametrize("horizontal, vertical", FLIPS)
@pytest.mark.parametrize("name", ["warp", "occlusion_warp"])
def test_methods_make_the_flipped_image(name, horizontal, vertical):
    """A window without cameras; where two sources splat to one pixel, ties go to another one of them."""
    method, given = jx.load(name), window()
    made = flip(given, horizontal=horizontal, vertical=vertical)
    assert made.number == 5
    axes = [a for a, f in ((1, horizontal), (0, vertical)) if f]
    image, mirrored = method(given.history, given.target), method(made.history, made.target)
    difference = np.abs(np.flip(mirrored, axes) - image).max(-1)
    assert np.quantile(difference, 0.98) < 1e-4
    np.testing.assert_array_equal(made.truth.color, np.flip(given.truth.color, axes))


def test_absent_stays_absent():
    made = flip(jx.Frame(motion=np.ones((2, 3, 2), np.float32)), horizontal=True, vertical=False)
    assert made.gbuffer is None
    assert made.color is None
    np.testing.assert_array_equal(made.motion[..., 0], -1)


def test_crop_cuts_the_same_everywhere():
    y, x = np.mgrid[0:9, 0:7].astype(np.float32)
    tree = {"x": jnp.asarray(x)[..., None], "y": jnp.asarray(y)}
    places = set()
    for seed in range(200):
        made = crop(tree, jax.random.key(seed), size=(7, 4))
        assert made["x"].shape == (7, 4, 1)
        left, top = float(made["x"][0, 0, 0]), float(made["y"][0, 0])
        np.testing.assert_array_equal(made["x"][..., 0], x[:7, :4] + left)
        np.testing.assert_array_equal(made["y"], y[:7, :4] + top)
        places.add((top, left))
    assert places == {(float(t), float(s)) for t in range(3) for s in range(4)}


def test_crop_of_the_whole_and_of_one_pixel():
    image = jnp.asarray(random(5, 3, 2))
    np.testing.assert_array_equal(crop(image, jax.random.key(0), size=(5, 3)), image)
    assert crop(image, jax.random.key(0), size=(1, 1)).shape == (1, 1, 2)


@pytest.mark.usefixtures("unchecked")
def test_crops_that_cannot_be():
    with pytest.raises(ValueError, match=r"at most the images' \[5, 3\], got \[6, 3\]"):
        crop(jnp.zeros((5, 3, 1)), jax.random.key(0), size=(6, 3))
    with pytest.raises(ValueError, match="images of one size"):
        crop([jnp.zeros((5, 3, 1)), jnp.zeros((5, 4, 1))], jax.random.key(0), size=(2, 2))
    with pytest.raises(ValueError, match="images of one size"):
        crop(jnp.zeros(5), jax.random.key(0), size=(2, 2))


@pytest.mark.slow
def test_a_weighted_crop_holds_what_has_weight():
    """All weight on one pixel: it is in every crop, at the border too, and everywhere in it."""
    image = jnp.stack(jnp.meshgrid(jnp.arange(11.0), jnp.arange(9.0)), -1)
    keys = jax.random.split(jax.random.key(0), 300)
    for x, y in ((5, 4), (0, 8), (10, 0)):
        weight = jnp.zeros((9, 11, 1)).at[y, x].set(1.0)
        cut = np.asarray(jax.vmap(lambda key, w=weight: crop(image, key, size=(3, 4), weight=w))(keys))
        found = (cut == [x, y]).all(-1)
        assert found.any((1, 2)).all()
        if (x, y) == (5, 4):
            assert found.mean(0).min() > 0.04
    shares = np.zeros((9, 11, 1), np.float32)
    shares[4, 2], shares[4, 8], shares[0, 0] = 3, 1, np.nan
    cut = np.asarray(jax.vmap(lambda key: crop(image, key, size=(3, 3), weight=jnp.asarray(shares)))(keys))
    left = (cut == [2, 4]).all(-1).any((1, 2))
    assert (left | (cut == [8, 4]).all(-1).any((1, 2))).all()
    assert 0.65 < left.mean() < 0.85


def test_lamps_shine_as_lamps_do():
    """By a loop; what is not bright stays bit for bit, the hue of what is stays, and nothing is beyond the most."""
    color = np.float32([[[0.2, 3.9, 1.0], [8.0, 2.0, 0.0]], [[14.0, 7.0, 3.5], [1e5, 1.0, 1.0]]])
    frame = jx.Frame(jnp.asarray(color), motion=jnp.zeros((2, 2, 2)))
    found = brighten((frame, replace(frame, color=None)), 3.0)
    expected = np.float64(color)
    expected[0, 1] *= (8 / 4) ** 3
    expected[1, 0] *= (14 / 4) ** 3
    np.testing.assert_allclose(found[0].color, expected, rtol=1e-5)
    np.testing.assert_array_equal(found[0].color[0, 0], color[0, 0])
    assert found[1].color is None
    np.testing.assert_array_equal(brighten(frame, 0.0).color, color)
    most = brighten(frame, 8.0).color[1, 0]
    np.testing.assert_allclose(most, [3e4, 1.5e4, 7.5e3], rtol=1e-5)
