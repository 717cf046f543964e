"""Little light: an interior with a runner's moving shadow, a street at night whose lamp flickers."""

import numpy as np

from jaxtrapolate.scenes.scene import Builder, Scene, material, path, turn, yaw
from jaxtrapolate.scenes.worlds import common


def interior(rng: np.random.Generator) -> Scene:
    """A dim hall with two lamps; a runner between them throws long shadows over the floor and the walls."""
    b = Builder()
    tile = common.shifted(rng, (0.42, 0.36, 0.28))
    floor = material(
        tile,
        color_b=0.35 * tile,
        frequency=(0.7, 0.7, 0),
        offset=common.offset(rng) * (1, 1, 0),
        noise=0.2,
        noise_frequency=2,
        roughness=0.24,
        roughness_b=0.7,
    )
    b.add("plane", (0, 0, 0), (1, 1, 1), floor)
    plaster = common.shifted(rng, (0.5, 0.42, 0.34))
    wall = material(
        plaster,
        color_b=0.6 * plaster,
        frequency=(0.8, 0.8, 0),
        duty=0.3,
        offset=common.offset(rng),
        noise=0.25,
        noise_frequency=1.5,
        roughness=0.85,
    )
    for k in range(4):
        b.add(
            "box",
            7.5 * np.array([*yaw(k * np.pi / 2)[:2, 0], 0.28]),
            (0.3, 7.5, 2.2),
            wall,
            rotation=yaw(k * np.pi / 2),
            blocks=False,
        )
    beams = material(0.7 * plaster, frequency=(0.5, 0, 0), color_b=0.3 * plaster, duty=0.2)
    b.add("box", (0, 0, 4.3), (8, 8, 0.2), beams, blocks=False)
    start = rng.uniform(0, 2 * np.pi)
    pillar = material(common.shifted(rng, (0.48, 0.42, 0.36)), noise=0.3, noise_frequency=2, roughness=0.6)
    for k in range(5):
        a = start + 2 * np.pi * k / 5 + rng.uniform(-0.2, 0.2)
        x, y = 3.6 * np.cos(a), 3.6 * np.sin(a)
        b.limb((x, y, 0), (x, y, 4.2), rng.uniform(0.14, 0.22), pillar)
    for k in range(6):
        a = start + 2 * np.pi * (k + 0.4) / 6
        size = rng.uniform((0.3, 0.3, 0.3), (0.6, 0.6, 0.9))
        wood = common.shifted(rng, (0.4, 0.2, 0.1), 0.3)
        chest = material(
            wood, color_b=0.4 * wood, frequency=(2, 2, 2), duty=0.15, tiled=1, noise=0.3, noise_frequency=5
        )
        b.add("box", (6.4 * np.cos(a), 6.4 * np.sin(a), size[2]), size, chest, rotation=yaw(rng.uniform(0, 3)))
    for _ in range(3):
        x, y = rng.uniform(-0.9, 0.9, 2)
        b.add("sphere", (x, y, 0.3), (0.3, 0.3, 0.3), material((0.9, 0.75, 0.45), metallic=1, roughness=0.12))
    common.striding(b, rng, radius=rng.uniform(2.2, 2.6), speed=rng.uniform(0.1, 0.14), stencil=1)
    a = rng.uniform(0, 2 * np.pi)
    for k, color in enumerate(((1.0, 0.66, 0.34), (0.6, 0.75, 1.0))):
        x, y = rng.uniform(0.9, 1.3) * np.array([np.cos(a + np.pi * k), np.sin(a + np.pi * k)])
        b.lamp(path((x, y, 1.1 + 0.9 * k)), np.array(color) * (5.5 if k == 0 else 3.0), radius=0.06)
        glow = material((0.1, 0.1, 0.1), emission=np.array(color) * 14)
        b.add("sphere", (x, y, 1.3 + 0.9 * k), (0.09, 0.09, 0.09), glow)
    period = rng.choice([-1, 1]) * rng.uniform(360, 440)
    return b.build(
        camera=common.camera(
            common.circle(rng.uniform(5.2, 5.5), period, rng.uniform(), centre=(0, 0, rng.uniform(1.7, 2.2)), bob=0.2),
            common.circle(0.8, -period / 4, rng.uniform(), centre=(0, 0, 0.9)),
            degrees=rng.uniform(54, 62),
        ),
        sky=common.sky((0.045, 0.05, 0.06), (0.05, 0.05, 0.06), (0.03, 0.025, 0.02), cover=0.0, glow=0.0),
    )


def street(rng: np.random.Generator) -> Scene:
    """A wet street at night: windows, a car with its lights, and a lamp that suddenly flickers."""
    b = Builder()
    asphalt = material(
        common.shifted(rng, (0.07, 0.07, 0.075)),
        color_b=(0.16, 0.15, 0.14),
        frequency=(0.33, 0.21, 0),
        duty=0.6,
        tiled=1,
        noise=0.5,
        noise_frequency=2.0,
        offset=common.offset(rng) * (1, 1, 0),
        roughness=0.12,
        roughness_b=0.75,
    )
    b.add("plane", (0, 0, 0), (1, 1, 1), asphalt)
    start = rng.uniform(0, 2 * np.pi)
    for k in range(8):
        a = start + 2 * np.pi * k / 8
        r = rng.uniform(12, 14)
        size = rng.uniform((2.0, 2.6, 3.0), (3.0, 4.0, 7.0))
        wall = common.shifted(rng, (0.3, 0.22, 0.18), 0.3)
        lit = np.array([1.0, 0.72, 0.4]) * rng.uniform(0.5, 1.6) if k % 2 else np.array([0.5, 0.7, 1.0]) * 0.6
        house = material(
            (0.05, 0.05, 0.06),
            color_b=wall,
            frequency=(0.0, 0.55, 0.5),
            duty=0.5,
            tiled=1,
            offset=common.offset(rng),
            noise=0.3,
            noise_frequency=2,
            roughness=0.6,
            roughness_b=0.8,
            emission=lit * 0.5,
        )
        b.add("box", (r * np.cos(a), r * np.sin(a), size[2]), size, house, rotation=yaw(a), blocks=False)
    iron = material((0.05, 0.05, 0.05), roughness=0.35)
    for k in range(4):
        a = start + 2 * np.pi * (k + 0.5) / 4
        x, y = 4.4 * np.cos(a), 4.4 * np.sin(a)
        b.limb((x, y, 0), (x, y, 3.6), 0.07, iron)
        if k % 2 == 0:
            color = np.array([(1.0, 0.62, 0.3), (0.6, 0.75, 1.0)][k // 2])
            lamp = b.lamp(
                path((0.92 * x, 0.92 * y, 3.45)),
                color * rng.uniform(17, 22),
                radius=0.08,
                flicker=(0.95, 0.5)[k // 2],
                period=(3.0, 7.0)[k // 2],
                duty=0.55,
            )
            b.add("sphere", (x, y, 3.75), (0.2, 0.2, 0.2), material((0.2, 0.2, 0.2), emission=color * 12, lamp=lamp))
    for k in range(6):
        x, y = 3.2 * np.cos(start + k * 1.05 + 0.3), 3.2 * np.sin(start + k * 1.05 + 0.3)
        size = rng.uniform((0.25, 0.25, 0.3), (0.45, 0.45, 0.6))
        tone = common.hue(rng, saturation=0.6, value=0.5)
        bin_ = material(tone, color_b=0.4 * tone, frequency=(0, 0, 2.5), duty=0.4, roughness=0.4)
        b.add("box", (x, y, size[2]), size, bin_, rotation=yaw(rng.uniform(0, 3)))
    way = rng.choice([-1, 1])
    car, _ = common.going_round(b, rng, radius=1.9, period=way * rng.uniform(140, 180), stencil=1)
    paint = material(common.hue(rng), roughness=0.15, specular=0.8)
    b.add("box", (0, 0, 0.42), (0.95, 0.42, 0.2), paint, body=car)
    b.add("box", (-0.1, 0, 0.76), (0.5, 0.36, 0.16), material((0.03, 0.03, 0.04), roughness=0.06), body=car)
    for x in (-0.6, 0.6):
        b.limb((x, -0.42, 0.2), (x, 0.42, 0.2), 0.2, iron, body=car)
    for y in (-0.28, 0.28):
        b.add("sphere", (0.95, y, 0.45), (0.06, 0.09, 0.06), material((0.3, 0.3, 0.3), emission=(14, 13, 11)), body=car)
        b.add(
            "sphere",
            (-0.95, y, 0.45),
            (0.04, 0.09, 0.05),
            material((0.3, 0.02, 0.02), emission=(6, 0.3, 0.2)),
            body=car,
        )
    sign = b.body(path((0, 0, 2.2)), turn(rate=0.06), stencil=2)
    neon = material(
        (0.1, 0.1, 0.1),
        color_b=(0.1, 0.1, 0.1),
        frequency=(1.6, 0, 0),
        emission=(0.2, 1.6, 2.4),
        emission_b=(2.6, 0.3, 1.4),
    )
    b.add("box", (0, 0, 0), (0.7, 0.08, 0.3), neon, body=sign)
    b.limb((0, 0, 0), (0, 0, 2.0), 0.05, iron)
    period = rng.choice([-1, 1]) * rng.uniform(360, 430)
    return b.build(
        camera=common.camera(
            common.circle(rng.uniform(6.6, 7.4), period, rng.uniform(), centre=(0, 0, rng.uniform(1.7, 2.5)), bob=0.2),
            common.circle(1.0, -period / 4, rng.uniform(), centre=(0, 0, 1.2)),
            degrees=rng.uniform(50, 58),
        ),
        sky=common.sky((0.006, 0.009, 0.02), (0.03, 0.03, 0.05), (0.012, 0.01, 0.01), glow=0.0, cover=0.0, ambient=1.0),
    )
