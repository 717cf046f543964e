"""The renderer's mirror, penumbra, height field, jitter and samples, each against what its geometry says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrapolate.scenes import render, visible
from jaxtrapolate.scenes.field import HeightField, enter_field
from jaxtrapolate.scenes.scene import Builder, material, path
from jaxtrapolate.scenes.vector import Vector
from jaxtrapolate.scenes.worlds import common

SIZE = (41, 62)
BLACK = material((0, 0, 0), specular=0)


def looking(eye, target, *, degrees=50.0):
    return common.camera(path(eye), path(target), degrees=degrees)


def dark(**options):
    return common.sky((0, 0, 0), (0, 0, 0), (0, 0, 0), glow=0.0, cover=0.0, **options)


def directions(frame, x, y):
    """(eye, rays through pixels) in the world, in float64, from the public camera alone."""
    view, projection = (np.asarray(m, np.float64) for m in (frame.camera.view, frame.camera.projection))
    height, width = SIZE
    ndc = np.stack([(x + 0.5) / width * 2 - 1, 1 - (y + 0.5) / height * 2], -1)
    local = np.stack([ndc[..., 0] / projection[0, 0], ndc[..., 1] / projection[1, 1], -np.ones_like(x)], -1)
    return -view[:3, :3].T @ view[:3, 3], local @ view[:3, :3]


@pytest.mark.slow
def test_a_mirror_shows_what_the_mirrored_ray_meets():
    centre, radius, glow = np.array([0.2, 0.3, 1.1]), 0.5, np.array([3.0, 2.0, 0.5])
    b = Builder()
    b.add("plane", (0, 0, 0), (1, 1, 1), material((1, 1, 1), metallic=1, roughness=0.06))
    b.add("sphere", centre, (radius,) * 3, material((0, 0, 0), specular=0, emission=glow))
    b.add("sphere", (9, 9, -5), (0.1,) * 3, BLACK)
    world = b.build(camera=looking((3.0, -2.0, 1.6), (0, 0, 0.4)), sky=dark())
    frame = jax.tree.map(np.asarray, render(world, 0.0, size=SIZE))
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    eye, d = directions(frame, x, y)

    def meets(origin, ray):
        """How far inside the sphere's outline a ray passes; < 0 where it misses."""
        ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        offset = centre - origin
        ahead = (offset * ray).sum(-1)
        return np.where(ahead > 0, radius - np.linalg.norm(offset - ahead[..., None] * ray, axis=-1), -1.0)

    t = -eye[2] / np.where(d[..., 2] < 0, d[..., 2], -1e-9)
    mirror = (d[..., 2] < 0) & (meets(eye, d) < -0.02)
    inside = meets(eye + t[..., None] * d, d * (1, 1, -1))
    # Karis' fit of the split sum, for f0 = 1
    rough, cosine = 0.06, -d[..., 2] / np.linalg.norm(d, axis=-1)
    a = np.minimum((1 - rough) ** 2, 2.0 ** (-9.28 * cosine)) * (1 - rough) + 0.0425 - 0.0275 * rough
    gain = (1.04 - 0.572 * rough - 1.04 * a) + (0.022 * rough - 0.04 + 1.04 * a)
    shown, dim = mirror & (inside > 0.02), mirror & (inside < -0.02)
    assert shown.sum() > 50
    assert dim.sum() > 500
    np.testing.assert_allclose(frame.color[shown], gain[shown][:, None] * glow, rtol=2e-3)
    assert np.abs(frame.color[dim]).max() < 1e-6


@pytest.mark.slow
def test_penumbra_is_as_wide_as_the_sun_makes_it():
    height, radius, softness = 2.0, 0.4, 0.1
    b = Builder()
    b.add("plane", (0, 0, 0), (1, 1, 1), material((0.5, 0.5, 0.5)))
    body = b.body(path((0, 0, height)), stencil=1)
    b.add("sphere", (0, 0, 0), (radius,) * 3, BLACK, body=body)
    b.add("sphere", (0, 9, -5), (0.1,) * 3, BLACK)
    world = b.build(
        camera=looking((2.2, -2.4, 3.2), (0, 0, 0.3)),
        sky=dark(),
        sun_direction=(0, 0, 1),
        sun_color=1.0,
        sun_radius=softness,
        bounce=False,
    )
    frame = jax.tree.map(np.asarray, render(world, 0.0, size=SIZE))
    floor = frame.gbuffer.stencil[..., 0] == 0
    away = np.hypot(frame.gbuffer.position[..., 0], frame.gbuffer.position[..., 1])
    shadow = frame.gbuffer.shadow[..., 0]
    edge = height * softness  # half the penumbra's width
    assert (shadow[floor & (away < radius - edge)] == 1).all()
    assert (shadow[floor & (away > radius + edge)] == 0).all()
    within = floor & (np.abs(away - radius) < edge)
    assert within.sum() > 30
    np.testing.assert_allclose(shadow[within], 0.5 - 0.5 * (away[within] - radius) / edge, atol=0.02)


def hills() -> HeightField:
    rng = np.random.default_rng(3)
    angle = np.arange(5) * 2.4
    frequency = 1 / (20.0 * 0.6 ** np.arange(5))
    return HeightField(
        base=jnp.float32(0.3),
        direction=jnp.asarray(frequency[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1), jnp.float32),
        phase=jnp.asarray(rng.uniform(0, 1, 5), jnp.float32),
        amplitude=jnp.asarray(2.0 * 0.6 ** np.arange(5), jnp.float32),
    )


def ground(field, x, y):
    """The terrain's height in float64."""
    v = x[..., None] * np.float64(field.direction[:, 0]) + y[..., None] * np.float64(field.direction[:, 1])
    v = v + np.float64(field.phase)
    v = v - np.floor(v + 0.5)
    return float(field.base) + (np.float64(field.amplitude) * 8 * v * (1 - 2 * np.abs(v))).sum(-1)


def test_rays_meet_the_terrain_where_a_dense_march_does():
    field, rng = hills(), np.random.default_rng(0)
    o = np.concatenate([rng.uniform(-20, 20, (400, 2)), rng.uniform(6, 9, (400, 1))], 1).astype(np.float32)
    down = rng.uniform(-0.9, -0.2, (400, 1))
    heading = rng.uniform(0, 2 * np.pi, 400)
    d = np.concatenate([np.cos(heading)[:, None], np.sin(heading)[:, None], down], 1).astype(np.float32)
    planar = [Vector(*(jnp.asarray(v[:, k]) for k in range(3))) for v in (o, d)]
    t = np.asarray(enter_field(field, *planar))
    steps = np.arange(0, 80, 0.01)
    wrong = 0
    for k in range(400):
        p = o[k].astype(np.float64) + steps[:, None] * d[k].astype(np.float64)
        below = p[:, 2] < ground(field, p[:, 0], p[:, 1])
        first = steps[np.argmax(below)]
        assert below.any()
        wrong += not first - 0.015 <= t[k] <= first + 0.005
    assert wrong <= 1  # of 400 rays, most of them grazing ridges
    up = Vector(jnp.ones(2), jnp.zeros(2), jnp.array([0.0, 0.5]))
    assert np.isinf(enter_field(field, Vector(0.0, 0.0, 20.0), up)).all()


@pytest.mark.slow
def test_terrain_hides_itself():
    field = hills()
    b = Builder()
    b.field(field, material((0.4, 0.4, 0.3)))
    b.add("sphere", (0, 0, -60), (0.1,) * 3, BLACK)
    eyes = path((0, -14, 6.0), drift=(1.5, 0.4, 0.0))
    world = b.build(camera=common.camera(eyes, path((0, 0, 1.0)), degrees=50.0), sky=dark(), bounce=False)
    frame = jax.tree.map(np.asarray, render(world, 0.0, size=SIZE))
    seen = np.asarray(visible(world, 0.0, 2.0, size=SIZE))
    surface = frame.gbuffer.sky[..., 0] == 0
    point = frame.gbuffer.position.astype(np.float64)
    height = ground(field, point[..., 0], point[..., 1])
    on = np.abs(point[..., 2] - height) < 3e-3
    assert on[surface].mean() > 0.98  # towards the horizon rays stop early, above the ridge that they graze
    surface &= on
    eye = np.array([0.0, -14, 6.0]) + 2 * np.array([1.5, 0.4, 0.0])
    share = np.linspace(0, 1, 800)[None, 1:-4]
    clearance = np.full(SIZE, np.inf)
    for row, column in zip(*np.nonzero(surface), strict=True):
        q = eye + share[0, :, None] * (point[row, column] - eye)
        clearance[row, column] = (q[:, 2] - ground(field, q[:, 0], q[:, 1])).min()
    other = jax.tree.map(np.asarray, render(world, 2.0, size=SIZE))
    clip = np.concatenate([point, np.ones((*SIZE, 1))], -1) @ (other.camera.projection @ other.camera.view).T
    at = clip[..., :2] / clip[..., 3:]
    framed = (np.abs(at) < 0.99).all(-1) & (clip[..., 3] > 0) & surface
    assert seen[framed & (clearance > 0)].mean() > 0.98
    assert (~seen[framed & (clearance < -0.02)]).mean() > 0.98
    assert (framed & (clearance < -0.02)).sum() > 10


@pytest.fixture(scope="module")
def columns():
    b = Builder()
    checks = material((0.9, 0.9, 0.9), color_b=(0.05, 0.05, 0.05), frequency=(1.5, 1.5, 0), roughness=0.9)
    b.add("plane", (0, 0, 0), (1, 1, 1), checks)
    for k in range(4):
        b.limb((k - 1.5, 0.5 * k, 0), (k - 1.5, 0.5 * k, 2.0), 0.12, material((0.7, 0.2, 0.1)))
    eye = path((0.3, -4.0, 1.8), drift=(0.05, 0.02, 0))
    return b.build(
        camera=common.camera(eye, path((0, 0, 0.7)), degrees=50.0),
        sky=common.daylight(np.random.default_rng(0)),
        sun_direction=(1, -1, 1.5),
        sun_color=1.5,
        bounce=False,
    )


@pytest.mark.slow
def test_jitter_moves_the_samples_and_not_the_motion(columns):
    jitter = np.array([0.31, -0.22], np.float32)
    frame = jax.tree.map(np.asarray, render(columns, 4.0, size=SIZE, jitter=jnp.asarray(jitter)))
    before = jax.tree.map(np.asarray, render(columns, 3.0, size=SIZE))
    surface = frame.gbuffer.sky[..., 0] == 0
    point = np.concatenate([frame.gbuffer.position, np.ones((*SIZE, 1))], -1).astype(np.float64)

    def pixels(camera):
        clip = point @ (camera.projection.astype(np.float64) @ camera.view.astype(np.float64)).T
        ndc = clip[..., :2] / clip[..., 3:]
        return (0.5 + 0.5 * ndc * (1, -1)) * (SIZE[1], SIZE[0]) - 0.5

    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    here = pixels(frame.camera)
    np.testing.assert_allclose(here[surface], (np.stack([x, y], -1) + jitter)[surface], atol=2e-3)
    np.testing.assert_allclose(frame.motion[surface], (pixels(before.camera) - here)[surface], atol=2e-3)
    np.testing.assert_array_equal(frame.jitter, jitter)


@pytest.mark.slow
def test_samples_average_over_the_pixel(columns):
    fine = np.asarray(render(columns, 4.0, size=(SIZE[0] * 6, SIZE[1] * 6)).color)
    reference = fine.reshape(SIZE[0], 6, SIZE[1], 6, 3).mean((1, 3))
    one, many = (np.asarray(render(columns, 4.0, size=SIZE, samples=n).color) for n in (1, 36))
    assert np.abs(many - reference).mean() < 0.55 * np.abs(one - reference).mean()
