"""A still life: nothing moves, the camera neither, so that a method that changes anything is wrong."""

import numpy as np

from jaxtrapolate.scenes.scene import Builder, Scene, material, path, yaw
from jaxtrapolate.scenes.worlds import common


def still(rng: np.random.Generator) -> Scene:
    """Vessels and fruit on a table by a window's light."""
    b = Builder()
    cloth = common.shifted(rng, (0.5, 0.46, 0.4))
    table = material(cloth, color_b=common.hue(rng, value=0.4), frequency=(2.2, 2.2, 0), noise=0.15, noise_frequency=9)
    b.add("plane", (0, 0, -0.8), (1, 1, 1), material(common.shifted(rng, (0.2, 0.17, 0.15)), noise=0.3))
    b.add("box", (0, 0, -0.05), (1.6, 1.1, 0.05), table)
    wall = common.shifted(rng, (0.3, 0.33, 0.36))
    b.add("box", (0, 2.6, 1.0), (5, 0.2, 2.5), material(wall, noise=0.25, noise_frequency=1.0, roughness=0.9))
    for x, y in common.spots(rng, 9, (-1.1, -0.7), (1.1, 0.7), 0.42):
        r = rng.uniform(0.1, 0.17)
        fruit = material(common.hue(rng), noise=0.15, noise_frequency=20, offset=common.offset(rng), roughness=0.3)
        b.add("sphere", (x, y, r), (r, r, 0.92 * r), fruit)
    for x, y in common.spots(rng, 3, (-1.0, 0.1), (1.0, 0.8), 0.6):
        metal = material(
            [(0.95, 0.64, 0.54), (0.95, 0.93, 0.88), (1.0, 0.78, 0.34)][rng.integers(3)], metallic=1, roughness=0.15
        )
        b.limb((x, y, 0.14), (x, y, rng.uniform(0.4, 0.7)), rng.uniform(0.1, 0.14), metal)
    for x, y in common.spots(rng, 3, (-1.2, -0.8), (1.2, 0.8), 0.7):
        size = rng.uniform((0.08, 0.15, 0.03), (0.15, 0.22, 0.06))
        b.add(
            "box",
            (x, y, size[2]),
            size,
            material(common.hue(rng, value=0.45), roughness=0.5),
            rotation=yaw(rng.uniform(0, 3)),
        )
    a = rng.uniform(-2.6, -0.6)
    eye = (rng.uniform(2.6, 3.0) * np.cos(a), rng.uniform(2.6, 3.0) * np.sin(a), rng.uniform(1.0, 1.5))
    return b.build(
        camera=common.camera(path(eye), path((0, 0.1, 0.15)), degrees=rng.uniform(38, 46)),
        sky=common.daylight(rng),
        sun_direction=common.sun_from(rng.uniform(190, 350), rng.uniform(30, 45)),
        sun_color=np.array([1.0, 0.86, 0.66]) * rng.uniform(1.8, 2.3),
        sun_radius=0.04,
    )
