"""What several scenes share: skies, surfaces, camera paths, figures and trees."""

from collections.abc import Sequence

import numpy as np

from jaxtrapolate.scenes.kinematics import Path
from jaxtrapolate.scenes.scene import Builder, CameraPath, Sky, material, path, turn

Generator = np.random.Generator


def sky(
    zenith: object,
    horizon: object,
    ground: object,
    *,
    glow: float = 0.25,
    cloud: object = (1.1, 1.1, 1.12),
    cover: float = 0.5,
    ambient: float = 1.0,
    haze: float = 0.0,
) -> Sky:
    """A `Sky` of NumPy arrays."""
    numbers = [np.float32(value) for value in (ambient, haze)]
    colors = [np.asarray(value, np.float32) for value in (zenith, horizon, ground)]
    return Sky(*colors, np.float32(glow), np.asarray(cloud, np.float32), np.float32(cover), *numbers)  # type: ignore[arg-type]


def daylight(rng: Generator, *, cover: float | None = None, haze: float = 0.0) -> Sky:
    """A blue sky with clouds."""
    tint = rng.uniform(0.9, 1.1, 3)
    return sky(
        np.array([0.16, 0.32, 0.72]) * tint,
        np.array([0.62, 0.72, 0.86]) * tint,
        np.array([0.22, 0.2, 0.17]),
        cover=rng.uniform(0.3, 0.6) if cover is None else cover,
        ambient=0.75,
        haze=haze,
    )


def sun_from(azimuth: float | int, elevation: float | int) -> np.ndarray:
    """The unit vector towards a sun, by angles in degrees."""
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def shifted(rng: Generator, color: object, amount: float = 0.08) -> np.ndarray:
    """A colour changed a little, in 0.02..0.95."""
    return np.clip(np.asarray(color) * rng.uniform(1 - amount, 1 + amount, 3) * rng.uniform(0.9, 1.1), 0.02, 0.95)


def hue(rng: Generator, *, saturation: float = 0.75, value: float = 0.7) -> np.ndarray:
    """A saturated colour of any hue."""
    h = rng.uniform(0, 1)
    wheel = np.clip(np.abs(((h + np.array([0.0, 2 / 3, 1 / 3])) % 1) * 6 - 3) - 1, 0, 1)
    return np.clip(value * (1 - saturation * (1 - wheel)), 0.03, 0.95)


def offset(rng: Generator) -> np.ndarray:
    """A random position in a solid texture, metres."""
    return rng.uniform(-20, 20, 3)


def circle(
    radius: float, period: float, phase: float, *, centre: object = (0, 0, 0), sway: float = 0.0, bob: float = 0.0
) -> Path:
    """Round a centre once in `period` frames (negative: clockwise), unevenly: `sway`, `bob` in metres."""
    f = 1 / period
    return path(
        centre,
        amplitude=[(radius, radius, bob), (sway, sway, 0)],
        frequency=[(f, f, 2.3 * abs(f)), (2.7 * abs(f), 3.1 * abs(f), 0)],
        phase=[(phase + 0.25, phase, 0.1), (0.3 * phase, 0.7 + phase, 0)],
    )


def camera(eye: Path, target: Path, *, degrees: float = 50.0, roll: float = 0.0) -> CameraPath:
    """A camera with a vertical field of view in degrees."""
    return CameraPath(eye, target, np.float32(roll), np.float32(np.tan(np.radians(degrees) / 2)))  # type: ignore[arg-type]


def spots(
    rng: Generator, count: int, low: Sequence[float | int], high: Sequence[float | int], apart: float | int
) -> np.ndarray:
    """Points `[count, 2]` in a rectangle, no two nearer than `apart` if that can be had, by best candidate."""
    points = [rng.uniform(low, high)]
    while len(points) < count:
        candidates = rng.uniform(low, high, (24, 2))
        distance = np.linalg.norm(candidates[:, None] - np.asarray(points)[None], axis=-1).min(axis=1)
        enough = np.flatnonzero(distance > apart)
        points.append(candidates[enough[0] if enough.size else int(np.argmax(distance))])
    return np.asarray(points)


def walker(
    builder: Builder,
    rng: Generator,
    *,
    parent: int,
    stencil: int,
    stride: float,
    scale: float = 1.0,
) -> int:
    """A figure of eleven capsules and ellipsoids, 1.8 m tall; returns its body.

    parent: the body of the point on the ground below it, whose +x is ahead; stride: double steps a frame.
    """
    phase = rng.uniform()
    skin = material(shifted(rng, (0.62, 0.42, 0.31), 0.2), roughness=0.55)
    cloth = material(hue(rng, value=0.6), roughness=0.8, noise=0.25, noise_frequency=9.0, offset=offset(rng))
    legs = material(hue(rng, saturation=0.4, value=0.3), roughness=0.75, noise=0.2, noise_frequency=12.0)
    base = builder.body(parent=parent, stencil=stencil)
    s = scale
    hips = builder.body(
        path((0, 0, 0.95 * s), amplitude=[(0, 0, 0.035 * s)], frequency=[(0, 0, 2 * stride)], phase=[(0, 0, phase)]),
        turn((0, 1, 0), angle=0.06),
        parent=base,
    )
    chest = builder.body(
        path((0, 0, 0.1 * s)), turn((0, 0, 1), amplitude=[0.16], frequency=[stride], phase=[phase]), parent=hips
    )
    builder.add("capsule", (0, 0, 0.24 * s), (0.17 * s, 0.17 * s, 0.17 * s), cloth, body=chest)
    builder.add("sphere", (0.02 * s, 0, 0.72 * s), (0.115 * s, 0.1 * s, 0.14 * s), skin, body=chest)
    builder.add("sphere", (0, 0, 0.02 * s), (0.14 * s, 0.17 * s, 0.13 * s), legs, body=hips)
    for side in (-1, 1):
        swing = phase + (0.5 if side > 0 else 0.0)
        hip = turn((0, 1, 0), amplitude=[0.55], frequency=[stride], phase=[swing])
        leg = builder.body(path((0, 0.1 * side * s, 0)), hip, parent=hips)
        builder.limb((0, 0, 0), (0, 0, -0.42 * s), 0.085 * s, legs, body=leg)
        knee = turn((0, 1, 0), angle=0.42, amplitude=[0.4], frequency=[stride], phase=[swing + 0.2])
        shin = builder.body(path((0, 0, -0.42 * s)), knee, parent=leg)
        builder.limb((0, 0, 0), (0, 0, -0.4 * s), 0.065 * s, legs, body=shin)
        back = phase + (0.0 if side > 0 else 0.5)
        shoulder = turn((0, 1, 0), angle=-0.15, amplitude=[0.6], frequency=[stride], phase=[back])
        arm = builder.body(path((0, 0.23 * side * s, 0.4 * s)), shoulder, parent=chest)
        builder.limb((0, 0, 0), (0, 0.03 * side * s, -0.28 * s), 0.055 * s, cloth, body=arm)
        builder.limb((0, 0.03 * side * s, -0.28 * s), (0.16 * s, 0.02 * side * s, -0.46 * s), 0.045 * s, skin, body=arm)
    return base


def going_round(
    builder: Builder, rng: Generator, *, radius: float, period: float, stencil: int, centre: object = (0, 0, 0)
) -> tuple[int, float]:
    """(body, phase): a body that goes round a centre unevenly, +x ahead, in `period` frames (negative: clockwise)."""
    phase = rng.uniform()
    wobble = dict(amplitude=[rng.uniform(0.25, 0.4)], frequency=[3.0 / abs(period)], phase=[rng.uniform()])
    hub = builder.body(path(centre), turn(angle=2 * np.pi * phase, rate=2 * np.pi / period, **wobble), stencil=stencil)
    ahead = np.sign(period) * np.pi / 2
    sway = path((radius, 0, 0), amplitude=[(0.12 * radius, 0, 0)], frequency=[(2.0 / abs(period), 0, 0)])
    return builder.body(sway, turn(angle=ahead), parent=hub), phase


def striding(
    builder: Builder,
    rng: Generator,
    *,
    radius: float,
    speed: float,
    stencil: int,
    centre: object = (0, 0, 0),
    scale: float = 1.0,
) -> None:
    """A figure that walks or runs round a centre at about `speed` metres a frame."""
    period = 2 * np.pi * radius / speed * (1 if rng.uniform() < 0.5 else -1)
    body, _ = going_round(builder, rng, radius=radius, period=period, stencil=stencil, centre=centre)
    walker(builder, rng, parent=body, stencil=stencil, stride=speed / 1.5, scale=scale)


def crown(builder: Builder, rng: Generator, place: object, radii: object, color: object) -> None:
    """Leaves: an ellipsoid with a strong grain."""
    leaves = material(
        shifted(rng, color, 0.2), noise=0.5, noise_frequency=rng.uniform(2, 4), offset=offset(rng), roughness=0.85
    )
    builder.add("sphere", place, radii, leaves)
