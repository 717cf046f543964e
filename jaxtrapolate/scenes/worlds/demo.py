"""A courtyard: a little cart and a ball move among blocks and polished stones, seen from a moving camera."""

import numpy as np

from jaxtrapolate.scenes.scene import Builder, Scene, material, path, turn, yaw
from jaxtrapolate.scenes.worlds import common


def demo(rng: np.random.Generator) -> Scene:
    """A courtyard: a little cart and a ball move among blocks and polished stones (the command `demo` shows it)."""
    b = Builder()
    stone = common.shifted(rng, (0.36, 0.32, 0.27))
    ground = material(
        stone,
        color_b=0.45 * stone,
        frequency=(0.8, 0.8, 0),
        duty=0.05,
        tiled=1,
        noise=0.3,
        noise_frequency=1.3,
        offset=common.offset(rng) * (1, 1, 0),
        roughness=0.6,
        roughness_b=0.9,
    )
    b.add("plane", (0, 0, 0), (1, 1, 1), ground)
    for k, (x, y) in enumerate(common.spots(rng, 7, (-4.5, -4.5), (4.5, 4.5), 2.4)):
        size = rng.uniform((0.35, 0.35, 0.3), (0.7, 0.7, 1.3))
        base = common.shifted(rng, [(0.66, 0.3, 0.2), (0.25, 0.37, 0.48), (0.72, 0.62, 0.42)][k % 3], 0.2)
        style = material(
            base,
            color_b=0.62 * base + 0.2,
            frequency=[(0, 0, 2.5), (1.7, 1.7, 1.7), (0, 0, 4.0)][k % 3],
            duty=[0.5, 0.5, 0.2][k % 3],
            noise=0.25,
            noise_frequency=3.0,
            offset=common.offset(rng),
            roughness=rng.uniform(0.45, 0.8),
        )
        b.add("box", (x, y, size[2]), size, style, rotation=yaw(rng.uniform(0, np.pi)))
        if k < 3:
            r = rng.uniform(0.22, 0.34)
            top = material(common.hue(rng, value=0.75), roughness=0.25, specular=0.6)
            b.add("sphere", (x, y, 2 * size[2] + r), (r, r, r), top)
    for k, (x, y) in enumerate(common.spots(rng, 4, (-3.5, -3.5), (3.5, 3.5), 2.5)):
        r = rng.uniform(0.3, 0.55)
        tone = [(0.93, 0.78, 0.46), (0.9, 0.9, 0.92), (0.95, 0.64, 0.5), (0.8, 0.85, 0.9)][k]
        b.add("sphere", (x, y, r), (r, r, r), material(tone, metallic=1, roughness=rng.uniform(0.06, 0.25)))
    for x, y in common.spots(rng, 5, (-6.5, -6.5), (6.5, 6.5), 3.0):
        height = rng.uniform(2.0, 3.4)
        post = material(common.shifted(rng, (0.5, 0.5, 0.47)), roughness=0.7, noise=0.2, noise_frequency=4.0)
        b.limb((x, y, 0), (x, y, height), rng.uniform(0.1, 0.18), post)

    # The cart goes round unevenly; its body is turned along the circle.
    turns = -1 if rng.uniform() < 0.5 else 1
    period, phase = rng.uniform(150, 210), rng.uniform()
    rate = turns * 2 * np.pi / period
    wobble = dict(amplitude=[0.35], frequency=[2.6 / period], phase=[rng.uniform()])
    hub = b.body(None, turn(angle=2 * np.pi * phase, rate=rate, **wobble), stencil=1)
    radius = rng.uniform(2.2, 2.8)
    cart = b.body(path((radius, 0, 0)), turn(angle=turns * np.pi / 2), parent=hub)
    paint = common.hue(rng)
    shell = material(
        paint, color_b=(0.9, 0.9, 0.86), frequency=(0, 2.2, 0), duty=0.3, offset=(0, 0.07, 0), roughness=0.3
    )
    b.add("box", (0, 0, 0.42), (0.62, 0.36, 0.2), shell, body=cart)
    b.add("box", (-0.12, 0, 0.76), (0.3, 0.3, 0.16), material((0.05, 0.06, 0.08), roughness=0.08), body=cart)
    rubber = material((0.04, 0.04, 0.045), roughness=0.7)
    for x in (-0.4, 0.4):
        b.limb((x, -0.42, 0.18), (x, 0.42, 0.18), 0.18, rubber, body=cart)
    f = 1 / rng.uniform(38, 52)
    jump = b.body(
        path(
            (*rng.uniform(-1, 1, 2), 1.0),
            amplitude=[(1.6, 1.4, 0.6), (0.5, 0.6, 0)],
            frequency=[(f / 3.1, f / 2.7, f), (f / 1.3, f / 1.1, 0)],
            phase=[rng.uniform(0, 1, 3), rng.uniform(0, 1, 3)],
        ),
        turn(rng.normal(size=3), rate=0.11),
        stencil=2,
    )
    striped = material(
        common.hue(rng), color_b=(0.9, 0.88, 0.82), frequency=(0, 0, 3.3), offset=(0, 0, 0.4), roughness=0.4
    )
    b.add("sphere", (0, 0, 0), (0.38, 0.38, 0.38), striped, body=jump)

    eye = common.circle(
        rng.uniform(7.0, 8.0),
        -turns * rng.uniform(420, 560),
        rng.uniform(),
        centre=(0, 0, rng.uniform(2.6, 3.4)),
        bob=0.4,
    )
    target = common.circle(0.8, 170.0, rng.uniform(), centre=(0, 0, 0.7), bob=0.2)
    return b.build(
        camera=common.camera(eye, target, degrees=rng.uniform(42, 50)),
        sky=common.daylight(rng),
        sun_direction=common.sun_from(rng.uniform(0, 360), rng.uniform(32, 50)),
        sun_color=np.array([1.0, 0.9, 0.74]) * rng.uniform(1.3, 1.7),
        sun_radius=0.02,
    )
