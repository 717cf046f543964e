"""Landscapes: terrain from above, a windmill, a forest, a dock."""

import numpy as np

from jaxtrapolate.scenes.field import HeightField
from jaxtrapolate.scenes.scene import Builder, Scene, material, path, turn, yaw
from jaxtrapolate.scenes.worlds import common

WAVES = 7

GABLE = np.array([[1.0, 0, 1], [0, np.sqrt(2), 0], [-1, 0, 1]]) / np.sqrt(2)
"""An eighth of a turn about y: a box that stands on its edge is a roof."""

UPRIGHT = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
"""A blade's pose that stands on its edge: its x up, its y ahead."""


def terrain(rng: np.random.Generator) -> Scene:
    """Hills seen from above; balloons drift over them and drag their shadows along."""
    b = Builder()
    angle = rng.uniform(0, np.pi) + np.arange(WAVES) * 2.4
    frequency = 1 / (46.0 * 0.68 ** np.arange(WAVES)) * rng.uniform(0.9, 1.1, WAVES)
    hills = HeightField(
        base=np.float32(0),  # type: ignore[arg-type]
        direction=(frequency[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)).astype(np.float32),  # type: ignore[arg-type]
        phase=rng.uniform(0, 1, WAVES).astype(np.float32),  # type: ignore[arg-type]
        amplitude=(4.2 * 0.6 ** np.arange(WAVES)).astype(np.float32),  # type: ignore[arg-type]
    )
    grass = common.shifted(rng, (0.17, 0.24, 0.07), 0.2)
    soil = material(
        grass,
        color_b=common.shifted(rng, (0.42, 0.3, 0.17)),
        frequency=(0.04, 0.055, 0),
        duty=0.45,
        noise=0.6,
        noise_frequency=0.5,
        offset=common.offset(rng),
        roughness=0.9,
    )
    b.field(hills, soil)
    for x, y in common.spots(rng, 24, (-24, -24), (24, 24), 5):
        ground = float(hills.height(np.float32(x), np.float32(y)))
        r = rng.uniform(1.0, 1.9)
        common.crown(b, rng, (x, y, ground + 1.4 * r), (r, r, 2.6 * r), (0.1, 0.2, 0.06))
    for k in range(3):
        r = rng.uniform(2.2, 3.2)
        way = rng.choice([-1, 1])
        centre = (*rng.uniform(-6, 6, 2), rng.uniform(11, 13))
        drift = common.circle(
            rng.uniform(6, 14), way * rng.uniform(200, 300), rng.uniform(), centre=centre, sway=1.5, bob=1.0
        )
        body = b.body(drift, turn(rate=0.02 * way), stencil=k + 1)
        silk = common.hue(rng)
        gores = material(silk, color_b=0.3 * silk + 0.6, frequency=(0.25, 0.25, 0), offset=(1, 1, 0), roughness=0.45)
        b.add("sphere", (0, 0, 0), (r, r, 1.2 * r), gores, body=body)
        wicker = material((0.3, 0.18, 0.09), noise=0.3, noise_frequency=4)
        b.add("box", (0, 0, -2.0 * r), (0.22 * r, 0.22 * r, 0.2 * r), wicker, body=body)
        for x in (-0.2, 0.2):
            b.limb((0.2 * r, x * r, -1.8 * r), (0.55 * r, 2.4 * x * r, -0.9 * r), 0.05, wicker, body=body)
            b.limb((-0.2 * r, x * r, -1.8 * r), (-0.55 * r, 2.4 * x * r, -0.9 * r), 0.05, wicker, body=body)
    way = rng.choice([-1, 1])
    radius, phase = rng.uniform(23, 27), rng.uniform()
    return b.build(
        camera=common.camera(
            common.circle(radius, way * rng.uniform(300, 360), phase, centre=(0, 0, rng.uniform(18, 22)), bob=1.5),
            common.circle(4.0, way * 200.0, rng.uniform(), centre=(0, 0, 0)),
            degrees=rng.uniform(44, 52),
        ),
        sky=common.daylight(rng, haze=0.0015),
        sun_direction=common.sun_from(rng.uniform(0, 360), rng.uniform(32, 45)),
        sun_color=np.array([1.0, 0.87, 0.68]) * rng.uniform(1.6, 2.0),
        sun_radius=0.01,
        bounce=False,
    )


def windmill(rng: np.random.Generator) -> Scene:
    """Windmills whose thin blades turn fast, and their shadows, among hay and hedges."""
    b = Builder()
    grass = common.shifted(rng, (0.26, 0.32, 0.1), 0.15)
    field = material(
        grass,
        color_b=common.shifted(rng, (0.4, 0.36, 0.13)),
        frequency=(0.35, 0, 0),
        duty=0.4,
        noise=0.5,
        noise_frequency=1.2,
        offset=common.offset(rng) * (1, 1, 0),
        roughness=0.9,
    )
    b.add("plane", (0, 0, 0), (1, 1, 1), field)
    plaster = common.shifted(rng, (0.5, 0.44, 0.36))
    wall = material(
        plaster, color_b=0.5 * plaster, frequency=(0, 0, 1.3), duty=0.2, noise=0.3, noise_frequency=2, roughness=0.8
    )
    roof = material(common.shifted(rng, (0.42, 0.13, 0.08)), noise=0.3, noise_frequency=4, roughness=0.7)
    sail = material(
        (0.75, 0.72, 0.64), color_b=(0.3, 0.2, 0.12), frequency=(2.2, 2.2, 0), duty=0.2, tiled=1, roughness=0.7
    )
    wood = material((0.25, 0.16, 0.09), roughness=0.7)
    start = rng.uniform(0, 2 * np.pi)
    for k in range(3):
        a = start + 2 * np.pi * k / 3 + rng.uniform(-0.3, 0.3)
        x, y = np.array([np.cos(a), np.sin(a)]) * rng.uniform(2.6, 3.4)
        height = rng.uniform(4.0, 5.0)
        for part, half in enumerate((0.85, 0.72, 0.6)):
            z = height * (0.15 + 0.3 * part)
            b.add("box", (x, y, z), (half, half, 0.15 * height), wall, rotation=yaw(0.3 + k))
        b.add("box", (x, y, 0.92 * height), (0.5, 0.62, 0.5), roof, rotation=yaw(0.3 + k) @ GABLE)
        facing = rng.uniform(0, 2 * np.pi)
        hub = b.body(path((x, y, height)), turn(angle=facing))
        speed = rng.choice([-1, 1]) * rng.uniform(0.1, 0.16)
        wheel = b.body(
            path((0.95, 0, 0)),
            turn((1, 0, 0), rate=speed, amplitude=[0.5], frequency=[1 / 70], phase=[rng.uniform()]),
            parent=hub,
            stencil=k + 1,
        )
        b.limb((-0.4, 0, 0), (0.05, 0, 0), 0.12, wood, body=wheel)
        for arm in range(4):
            c, s = np.cos(arm * np.pi / 2), np.sin(arm * np.pi / 2)
            along, across = np.array([0.12, c, s]), np.array([0.25, -s, c])
            along = along / np.linalg.norm(along)
            across = across - along * (across @ along)
            across = across / np.linalg.norm(across)
            pose = np.stack([along, across, np.cross(along, across)], axis=1)
            b.add("blade", 1.45 * along, (1.3, 0.3, 0.3), sail, body=wheel, rotation=pose)
    for x, y in common.spots(rng, 8, (-5, -5), (5, 5), 2.2):
        r = rng.uniform(0.4, 0.7)
        common.crown(b, rng, (x, y, 0.7 * r), (r, r, r), (0.45, 0.36, 0.12))
    for k in range(8):
        a = start + 2 * np.pi * k / 8
        r = rng.uniform(13, 19)
        common.crown(b, rng, (r * np.cos(a), r * np.sin(a), 1.5), rng.uniform((2, 2, 2), (4, 4, 4.5)), (0.1, 0.2, 0.06))
    period = rng.choice([-1, 1]) * rng.uniform(330, 400)
    return b.build(
        camera=common.camera(
            common.circle(rng.uniform(9.5, 10.5), period, rng.uniform(), centre=(0, 0, rng.uniform(2.2, 3.2)), bob=0.3),
            common.circle(1.2, -period / 4, rng.uniform(), centre=(0, 0, 2.6)),
            degrees=rng.uniform(50, 56),
        ),
        sky=common.daylight(rng),
        sun_direction=common.sun_from(rng.uniform(0, 360), rng.uniform(22, 32)),
        sun_color=np.array([1.0, 0.88, 0.7]) * rng.uniform(1.4, 1.8),
        sun_radius=0.0,
        bounce=False,
    )


def forest(rng: np.random.Generator) -> Scene:
    """A run through a forest of thin trunks, past a figure that walks there."""
    b = Builder()
    moss = common.shifted(rng, (0.2, 0.19, 0.08), 0.15)
    floor = material(
        moss,
        noise=0.7,
        noise_frequency=1.1,
        offset=common.offset(rng) * (1, 1, 0),
        roughness=0.95,
    )
    b.add("plane", (0, 0, 0), (1, 1, 1), floor)
    ring = 8.0
    count = 0
    while count < 40:
        x, y = rng.uniform(-15, 15, 2)
        if abs(np.hypot(x, y) - ring) < 0.9 or abs(np.hypot(x, y) - 5.2) < 0.5 or np.hypot(x, y) > 15:
            continue
        bark = material(
            common.shifted(rng, (0.3, 0.22, 0.15) if rng.uniform() < 0.7 else (0.6, 0.58, 0.52), 0.2),
            color_b=(0.12, 0.09, 0.06),
            frequency=(0, 0, rng.uniform(1.5, 3.0)),
            duty=0.3,
            noise=0.5,
            noise_frequency=5,
            offset=common.offset(rng),
            roughness=0.9,
        )
        lean = rng.normal(0, 0.25, 2)
        b.limb((x, y, -0.3), (x + lean[0], y + lean[1], 9.0), rng.uniform(0.06, 0.2), bark)
        count += 1
    for x, y in common.spots(rng, 8, (-4.2, -4.2), (4.2, 4.2), 1.5):
        r = rng.uniform(0.25, 0.5)
        common.crown(b, rng, (x, y, 0.6 * r), (r, r, r), (0.13, 0.24, 0.07))
    common.striding(b, rng, radius=5.2, speed=rng.uniform(0.05, 0.07), stencil=1)
    way = rng.choice([-1, 1])
    phase, period = rng.uniform(), way * rng.uniform(520, 640)
    return b.build(
        camera=common.camera(
            common.circle(ring, period, phase, centre=(0, 0, rng.uniform(1.5, 1.9)), bob=0.08),
            common.circle(5.5, period, phase + way * rng.uniform(0.13, 0.17), centre=(0, 0, 1.6)),
            degrees=rng.uniform(52, 60),
        ),
        sky=common.sky((0.3, 0.42, 0.5), (0.62, 0.68, 0.6), (0.12, 0.12, 0.06), cover=0.2, ambient=0.5, haze=0.012),
        sun_direction=common.sun_from(rng.uniform(0, 360), rng.uniform(38, 50)),
        sun_color=np.array([1.0, 0.85, 0.6]) * rng.uniform(1.6, 2.1),
        sun_radius=0.012,
        bounce=False,
    )


def dock(rng: np.random.Generator) -> Scene:
    """Boats rock on glossy water by a wooden dock, in evening light."""
    b = Builder()
    water = material(
        common.shifted(rng, (0.02, 0.05, 0.06)), roughness=0.08, specular=0.5, ripple=rng.uniform(0.03, 0.06)
    )
    b.add("plane", (0, 0, 0), (1, 1, 1), water)
    plank = common.shifted(rng, (0.36, 0.24, 0.14))
    boards = material(
        plank,
        color_b=0.3 * plank,
        frequency=(3.3, 0, 0),
        duty=0.1,
        noise=0.45,
        noise_frequency=3.5,
        offset=common.offset(rng),
        roughness=0.65,
    )
    b.add("box", (0, 0, 0.55), (7.0, 0.9, 0.07), boards)
    b.add("box", (-1.5, 3.0, 0.55), (0.8, 2.2, 0.07), boards, rotation=np.eye(3))
    post = material(0.6 * plank, noise=0.4, noise_frequency=5, roughness=0.7)
    for x in np.linspace(-6.5, 6.5, 6):
        for y in (-0.9, 0.9):
            b.limb((x, y, -0.5), (x, y, rng.uniform(0.9, 1.3)), 0.1, post)
    for x in rng.uniform(-6, 6, 5):
        size = rng.uniform(0.2, 0.4)
        tone = common.hue(rng, saturation=0.6, value=0.5)
        crate = material(tone, color_b=0.4 * tone, frequency=(2, 2, 2), duty=0.12, tiled=1, roughness=0.7)
        pose = yaw(rng.uniform(0, 3))
        b.add("box", (x, rng.uniform(-0.4, 0.4), 0.62 + size), (size, size, size), crate, rotation=pose)
    for k in range(3):
        f = 1 / rng.uniform(40, 60)
        centre = ((-4.5, 4.2, 0.12), (4.0, -3.6, 0.12), (4.2, 3.8, 0.12))[k]
        sway = common.circle(1.3, rng.choice([-1, 1]) * rng.uniform(110, 150), rng.uniform(), centre=centre, bob=0.07)
        course = b.body(sway, turn(amplitude=[0.5], angle=rng.uniform(0, 6), frequency=[0.4 * f]), stencil=k + 1)
        boat = b.body(None, turn((1, 0.3, 0), amplitude=[0.12], frequency=[f], phase=[rng.uniform()]), parent=course)
        paint = common.hue(rng)
        hull = material(
            paint, color_b=(0.85, 0.83, 0.8), frequency=(0, 0, 2.5), duty=0.35, offset=(0, 0, 0.1), roughness=0.2
        )
        b.add("sphere", (0, 0, 0.05), (1.3, 0.5, 0.4), hull, body=boat)
        b.add("box", (-0.15, 0, 0.5), (0.4, 0.28, 0.2), material((0.75, 0.72, 0.68), roughness=0.4), body=boat)
        b.limb((0.3, 0, 0.3), (0.3, 0, 2.7), 0.04, post, body=boat)
        canvas = material((0.8, 0.74, 0.62), color_b=paint, frequency=(1.1, 0, 0), duty=0.3, roughness=0.8)
        b.add("blade", (-0.22, 0, 1.65), (0.95, 0.5, 0.7), canvas, body=boat, rotation=UPRIGHT)
    for x, y in common.spots(rng, 6, (-7, -7), (7, 7), 2.5):
        y = y + 1.8 * np.sign(y)
        b.add("sphere", (x, y, 0.05), (0.22, 0.22, 0.22), material(common.hue(rng, value=0.75), roughness=0.25))
    period = rng.choice([-1, 1]) * rng.uniform(360, 440)
    return b.build(
        camera=common.camera(
            common.circle(rng.uniform(8.6, 9.6), period, rng.uniform(), centre=(0, 0, rng.uniform(2.4, 3.4)), bob=0.25),
            common.circle(1.5, -period / 4, rng.uniform(), centre=(0, 0, 0.5)),
            degrees=rng.uniform(44, 52),
        ),
        sky=common.sky(
            (0.14, 0.22, 0.45),
            (0.95, 0.62, 0.4),
            (0.06, 0.07, 0.08),
            glow=0.5,
            cover=rng.uniform(0.3, 0.6),
            ambient=0.75,
            cloud=(0.95, 0.7, 0.6),
        ),
        sun_direction=common.sun_from(rng.uniform(0, 360), rng.uniform(16, 26)),
        sun_color=np.array([1.0, 0.72, 0.45]) * rng.uniform(2.0, 2.6),
        sun_radius=0.015,
    )
