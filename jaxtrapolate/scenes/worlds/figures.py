"""Figures that walk on a plaza; a head that turns under lamps."""

import numpy as np

from jaxtrapolate.scenes.scene import Builder, Scene, material, path, turn, yaw
from jaxtrapolate.scenes.worlds import common


def walkers(rng: np.random.Generator) -> Scene:
    """Three figures walk with non-linear motion on a plaza of columns under a turning camera."""
    b = Builder()
    stone = common.shifted(rng, (0.34, 0.29, 0.23))
    paving = material(
        stone,
        color_b=0.55 * stone,
        frequency=(0.5, 0.5, 0),
        offset=common.offset(rng) * (1, 1, 0),
        noise=0.35,
        noise_frequency=1.7,
        roughness=0.7,
    )
    b.add("plane", (0, 0, 0), (1, 1, 1), paving)
    for k in range(3):
        common.striding(
            b, rng, radius=1.2 + 1.1 * k, speed=rng.uniform(0.045, 0.07), stencil=k + 1, scale=rng.uniform(0.95, 1.1)
        )
    marble = material(common.shifted(rng, (0.62, 0.57, 0.5)), noise=0.25, noise_frequency=1.5, roughness=0.5)
    start = rng.uniform(0, 2 * np.pi)
    for k in range(6):
        a = start + 2 * np.pi * k / 6 + rng.uniform(-0.2, 0.2)
        x, y = rng.uniform(4.2, 4.8) * np.cos(a), rng.uniform(4.2, 4.8) * np.sin(a)
        b.limb((x, y, 0), (x, y, 3.4), rng.uniform(0.16, 0.24), marble)
    for k in range(7):
        a = start + 2 * np.pi * (k + 0.5) / 7 + rng.uniform(-0.15, 0.15)
        r = rng.uniform(12, 15)
        size = rng.uniform((1.5, 1.0, 1.5), (2.8, 2.0, 4.0))
        wall = common.shifted(rng, [(0.56, 0.34, 0.24), (0.6, 0.52, 0.38), (0.34, 0.38, 0.42)][k % 3], 0.15)
        brick = material(
            wall, color_b=0.5 * wall, frequency=(0, 0, 1.4), duty=0.25, noise=0.3, noise_frequency=2, roughness=0.85
        )
        b.add("box", (r * np.cos(a), r * np.sin(a), size[2]), size, brick, rotation=yaw(a + np.pi / 2))
    way = 1 if rng.uniform() < 0.5 else -1
    period = way * rng.uniform(380, 460)
    return b.build(
        camera=common.camera(
            common.circle(rng.uniform(6.6, 7.4), period, rng.uniform(), centre=(0, 0, rng.uniform(1.7, 2.3)), bob=0.2),
            common.circle(1.0, -90.0 * way, rng.uniform(), centre=(0, 0, 1.1), bob=0.1),
            degrees=rng.uniform(46, 54),
        ),
        sky=common.daylight(rng),
        sun_direction=common.sun_from(rng.uniform(0, 360), rng.uniform(20, 30)),
        sun_color=np.array([1.0, 0.88, 0.7]) * rng.uniform(1.3, 1.7),
        sun_radius=0.015,
        bounce=False,
    )


def head(rng: np.random.Generator) -> Scene:
    """A head-like object of shining skin turns and moves in a studio; lamps put highlights on it."""
    b = Builder()
    floor = common.shifted(rng, (0.3, 0.27, 0.25))
    b.add("plane", (0, 0, 0), (1, 1, 1), material(floor, noise=0.2, noise_frequency=1.5, roughness=0.6))
    f = 1 / rng.uniform(60, 90)
    base = b.body(
        path(
            (0, 0, 1.25),
            amplitude=[(0.28, 0.28, 0.07), (0.08, 0.06, 0.04)],
            frequency=[(f, 1.3 * f, 0.9 * f), (2.9 * f, 2.3 * f, 2.1 * f)],
            phase=rng.uniform(0, 1, (2, 3)),
        ),
        turn((0, 0, 1), rate=rng.choice([-1, 1]) * rng.uniform(0.012, 0.02), amplitude=[0.5], frequency=[1.7 * f]),
        stencil=1,
    )
    nod = b.body(None, turn((0, 1, 0), amplitude=[0.25], frequency=[1.9 * f], phase=[rng.uniform()]), parent=base)
    tone = common.shifted(rng, (0.6, 0.38, 0.28), 0.15)
    skin = material(tone, noise=0.12, noise_frequency=14, offset=common.offset(rng), roughness=0.28, specular=0.6)
    lips = material((0.45, 0.12, 0.1), roughness=0.2)
    hair = material(
        common.shifted(rng, (0.12, 0.07, 0.04), 0.4), noise=0.5, noise_frequency=25, roughness=0.4, specular=0.7
    )
    eye = material((0.85, 0.85, 0.82), roughness=0.08, specular=0.7)
    iris = material(common.hue(rng, value=0.3), roughness=0.08, specular=0.7)
    b.add("sphere", (0, 0, 0), (0.34, 0.28, 0.4), skin, body=nod)
    b.add("sphere", (0.1, 0, -0.26), (0.22, 0.2, 0.18), skin, body=nod)
    b.add("sphere", (-0.06, 0, 0.09), (0.345, 0.305, 0.36), hair, body=nod)
    b.add("sphere", (0.35, 0, -0.04), (0.07, 0.05, 0.09), skin, body=nod)
    b.add("sphere", (0.3, 0, -0.22), (0.03, 0.09, 0.025), lips, body=nod)
    for side in (-1, 1):
        b.add("sphere", (0.27, 0.12 * side, 0.07), (0.06, 0.06, 0.06), eye, body=nod)
        b.add("sphere", (0.31, 0.125 * side, 0.07), (0.028, 0.028, 0.028), iris, body=nod)
        b.add("sphere", (-0.02, 0.29 * side, 0.0), (0.07, 0.04, 0.1), skin, body=nod)
    b.limb((-0.05, 0, -0.3), (-0.08, 0, -0.7), 0.13, skin, body=base)
    cloth = material(common.hue(rng, value=0.4), noise=0.3, noise_frequency=20, roughness=0.8)
    b.add("sphere", (-0.1, 0, -0.85), (0.26, 0.52, 0.24), cloth, body=base)
    start = rng.uniform(0, 2 * np.pi)
    for k in range(10):
        a = start + 2 * np.pi * k / 10
        r = rng.uniform(3.2, 3.9)
        size = rng.uniform((0.25, 0.5, 0.7), (0.4, 0.8, 1.5))
        color = common.hue(rng, saturation=0.5, value=0.45)
        shelf = material(
            color,
            color_b=0.35 * color + 0.1,
            frequency=[(0, 0, 1.6), (0, 2.0, 2.0)][k % 2],
            offset=common.offset(rng),
            noise=0.2,
            noise_frequency=4,
            roughness=0.6,
        )
        b.add("box", (r * np.cos(a), r * np.sin(a), size[2]), size, shelf, rotation=yaw(a))
    for k in range(5):
        a = start + 2 * np.pi * (k + 0.3) / 5
        x, y = 2.5 * np.cos(a), 2.5 * np.sin(a)
        b.limb((x, y, 0), (x, y, rng.uniform(1.6, 2.4)), 0.035, material((0.7, 0.7, 0.72), metallic=1, roughness=0.25))
    for k, color in enumerate(((1.0, 0.8, 0.6), (0.5, 0.7, 1.0))):
        a = start + 2.2 * k + rng.uniform(-0.3, 0.3)
        where = path((2.2 * np.cos(a), 2.2 * np.sin(a), 2.7))
        b.lamp(where, np.array(color) * rng.uniform(5, 7), radius=0.25)
    period = rng.choice([-1, 1]) * rng.uniform(330, 400)
    return b.build(
        camera=common.camera(
            common.circle(1.75, period, rng.uniform(), centre=(0, 0, 1.45), bob=0.15),
            common.circle(0.12, -period / 3, rng.uniform(), centre=(0, 0, 1.2)),
            degrees=rng.uniform(48, 56),
        ),
        sky=common.sky((0.05, 0.06, 0.09), (0.2, 0.19, 0.2), (0.06, 0.05, 0.05), cover=0.0, ambient=1.0),
    )
