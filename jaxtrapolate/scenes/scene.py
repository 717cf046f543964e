"""A scene: primitives on rigid bodies, materials, lights, a sky and a camera path, all of them parameters.

A `Scene` is a pytree whose array shapes do not depend on the seed, so that all seeds of a scene share one compilation
and can be stacked for `vmap`.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrapolate.records import R, record
from jaxtrapolate.scenes.field import HeightField
from jaxtrapolate.scenes.kinematics import HARMONICS, Bodies, Path, Turn
from jaxtrapolate.scenes.primitives import KINDS

MATERIAL = {
    "color": 3,
    "color_b": 3,
    "frequency": 3,
    "offset": 3,
    "duty": 1,
    "tiled": 1,
    "noise": 1,
    "noise_frequency": 1,
    "roughness": 1,
    "roughness_b": 1,
    "metallic": 1,
    "specular": 1,
    "emission": 3,
    "emission_b": 3,
    "lamp": 1,
    "ripple": 1,
}
"""The columns of a material and how many numbers each has.

color, color_b, frequency, offset, duty, tiled, noise, noise_frequency: see `textures`. roughness, roughness_b: of the
two colours. emission, emission_b: radiance of the two colours. lamp: index of the lamp whose flicker the emission
follows, -1 for none. ripple: slope of the waves that bend the reflections of water.
"""

LIMIT = 126
"""How many primitives a scene may hold: their numbers are packed in seven bits when rays are cast."""


@record
@dataclasses.dataclass(frozen=True)
class Lights:
    """The sun and the lamps.

    sun_direction `[3]`: unit, towards the sun. sun_color `[3]`: radiance of a white diffuse surface that faces it.
    sun_radius: tangent of its angular radius, 0 = hard shadows. lamp_path: `Path` of the lamps `[L]`. lamp_color
    `[L, 3]`: as sun_color at one metre. lamp_radius `[L]`: metres. lamp_flicker `[L]`: depth of the flicker, 0..1.
    lamp_period `[L]`: frames between its possible changes. lamp_duty `[L]`: part of the time that it is bright.
    """

    sun_direction: Float[Array, "3"]
    sun_color: Float[Array, "3"]
    sun_radius: Float[Array, ""]
    lamp_path: Path
    lamp_color: Float[Array, "l 3"]
    lamp_radius: Float[Array, " l"]
    lamp_flicker: Float[Array, " l"]
    lamp_period: Float[Array, " l"]
    lamp_duty: Float[Array, " l"]


@record
@dataclasses.dataclass(frozen=True)
class Sky:
    """The sky's radiance, which is the ambient light as well, and haze.

    zenith, horizon, ground `[3]`: radiance. glow: radiance around the sun. cloud `[3]`: their radiance; cover: 0..1.
    ambient: factor of the sky's light on surfaces. haze: extinction a metre, towards the horizon's radiance.
    """

    zenith: Float[Array, "3"]
    horizon: Float[Array, "3"]
    ground: Float[Array, "3"]
    glow: Float[Array, ""]
    cloud: Float[Array, "3"]
    cover: Float[Array, ""]
    ambient: Float[Array, ""]
    haze: Float[Array, ""]


@record
@dataclasses.dataclass(frozen=True)
class CameraPath:
    """eye, target: paths `[3]`; roll: radians; tangent: of half the vertical field of view."""

    eye: Path
    target: Path
    roll: Float[Array, ""]
    tangent: Float[Array, ""]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Scene:
    """Everything that `render` needs; built by `scene`.

    Primitives are numbered shape by shape in the order of `primitives.KINDS`, as in `counts` in each, then the
    height field. rotation `[P, 3, 3]`, centre `[P, 3]`: pose in the body's space. size `[P, 3]`: see `primitives`.
    material `[P(+1), M]`: see `MATERIAL`. counts: (aside, static, dynamic) primitives of each kind; those aside are
    static and block no light. body: of each primitive. bounce: whether glossy surfaces reflect; sun: whether there is
    one; water: whether a material has ripples.
    """

    bodies: Bodies
    rotation: Float[Array, "p 3 3"]
    centre: Float[Array, "p 3"]
    size: Float[Array, "p 3"]
    material: Float[Array, "q m"]
    field: HeightField | None
    lights: Lights
    sky: Sky
    camera: CameraPath
    counts: tuple[tuple[int, int, int], ...] = dataclasses.field(metadata={"static": True})
    body: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    bounce: bool = dataclasses.field(metadata={"static": True})
    sun: bool = dataclasses.field(metadata={"static": True})
    water: bool = dataclasses.field(metadata={"static": True})


def stack_scenes(scenes: Sequence[Scene]) -> Scene:
    """Scenes of one name and several seeds as one pytree with a leading axis, for `vmap`."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)


def _array(value: object, shape: tuple[int, ...]) -> np.ndarray:
    return np.broadcast_to(np.asarray(value, np.float32), shape).astype(np.float32)


def path(
    base: object = 0.0, *, drift: object = 0.0, amplitude: object = (), frequency: object = (), phase: object = ()
) -> Path:
    """A `Path` of NumPy arrays; amplitude, frequency, phase: up to `HARMONICS` rows of three (or of one for all)."""
    rows = {"amplitude": amplitude, "frequency": frequency, "phase": phase}
    table = {}
    for name, values in rows.items():
        table[name] = np.zeros((HARMONICS, 3), np.float32)
        for row, value in enumerate(list(values)):  # type: ignore[call-overload]
            table[name][row] = value
    sines = (table["amplitude"], table["frequency"], table["phase"])
    return Path(_array(base, (3,)), _array(drift, (3,)), *sines)  # type: ignore[arg-type]


def turn(
    axis: object = (0, 0, 1),
    *,
    angle: float = 0.0,
    rate: float = 0.0,
    amplitude: Sequence[float] = (),
    frequency: Sequence[float] = (),
    phase: Sequence[float] = (),
) -> Turn:
    """A `Turn` of NumPy arrays; the axis is normalised."""
    direction = _array(axis, (3,))
    direction = direction / np.linalg.norm(direction)
    rows = []
    for values in (amplitude, frequency, phase):
        row = np.zeros(HARMONICS, np.float32)
        row[: len(values)] = values
        rows.append(row)
    return Turn(direction, np.float32(angle), np.float32(rate), *rows)  # type: ignore[arg-type]


def material(color: object, **columns: object) -> np.ndarray:
    """A row of `MATERIAL`; `color_b` and `roughness_b` default to the first colour's."""
    defaults = {"duty": 0.5, "noise_frequency": 1.0, "roughness": 0.8, "specular": 0.5, "lamp": -1.0}
    values = defaults | {"color": color} | columns
    values.setdefault("color_b", values["color"])
    values.setdefault("roughness_b", values["roughness"])
    unknown = set(values) - set(MATERIAL)
    if unknown:
        raise ValueError(f"material: expected columns among {', '.join(MATERIAL)}, got {', '.join(sorted(unknown))}")
    return np.concatenate([_array(values.get(name, 0.0), (count,)) for name, count in MATERIAL.items()])


class Builder:
    """Collects bodies and primitives in any order and builds a `Scene` of them."""

    def __init__(self) -> None:
        self._paths, self._turns, self._stencils, self._parents = [path()], [turn()], [0.0], [0]
        self._primitives: dict[str, list[tuple]] = {kind: [] for kind in KINDS}
        self._lamps: list[tuple] = []
        self._field: tuple[HeightField, np.ndarray] | None = None

    def body(
        self, where: Path | None = None, how: Turn | None = None, *, parent: int = 0, stencil: int | None = None
    ) -> int:
        """A body on `parent`; returns its index. stencil: the parent's unless given."""
        self._paths.append(path() if where is None else where)
        self._turns.append(turn() if how is None else how)
        self._stencils.append(self._stencils[parent] if stencil is None else float(stencil))
        self._parents.append(parent)
        return len(self._parents) - 1

    def add(
        self,
        kind: str,
        centre: object,
        size: object,
        surface: np.ndarray,
        *,
        body: int = 0,
        rotation: object = None,
        blocks: bool | None = None,
    ) -> None:
        """A primitive on a body; rotation: `[3, 3]`, its own space to the body's.

        blocks: whether it may block light; all do but planes, which lie below all lights. A static one that cannot (the
        wall of a room that is lit from within) saves the time to find that out.
        """
        pose = np.eye(3) if rotation is None else rotation
        may = kind != "plane" if blocks is None else blocks
        row = (_array(pose, (3, 3)), _array(centre, (3,)), _array(size, (3,)), surface, body, may)
        self._primitives[kind].append(row)

    def limb(self, start: object, end: object, radius: float, surface: np.ndarray, *, body: int = 0) -> None:
        """A capsule between two points."""
        a, b = _array(start, (3,)), _array(end, (3,))
        length = float(np.linalg.norm(b - a))
        size = (radius, radius, 0.5 * length)
        self.add("capsule", 0.5 * (a + b), size, surface, body=body, rotation=frame_along(b - a))

    def field(self, height_field: HeightField, surface: np.ndarray) -> None:
        """The scene's height field."""
        self._field = (height_field, surface)

    def lamp(
        self,
        where: Path,
        color: object,
        *,
        radius: float = 0.0,
        flicker: float = 0.0,
        period: float = 1.0,
        duty: float = 0.5,
    ) -> int:
        """A lamp; returns its index."""
        self._lamps.append((where, _array(color, (3,)), radius, flicker, period, duty))
        return len(self._lamps) - 1

    def build(
        self,
        *,
        camera: CameraPath,
        sky: Sky,
        sun_direction: object = (0, 0, 1),
        sun_color: object = 0.0,
        sun_radius: float = 0.0,
        bounce: bool = True,
    ) -> Scene:
        """The scene, its leaves float32 arrays of JAX."""
        counts, rows = [], []
        for kind in KINDS:
            group = [2 if self._stencils[row[4]] > 0 else int(row[5]) for row in self._primitives[kind]]
            counts.append((group.count(0), group.count(1), group.count(2)))
            rows += [self._primitives[kind][k] for k in np.argsort(group, kind="stable")]
        if len(rows) > LIMIT:
            raise ValueError(f"a scene holds at most {LIMIT} primitives, got {len(rows)}")
        surfaces = [row[3] for row in rows] + ([] if self._field is None else [self._field[1]])
        direction = _array(sun_direction, (3,))
        lamps: dict[str, Any] = {  # NumPy's until the end, where the fields are JAX's
            name: np.asarray([lamp[k + 1] for lamp in self._lamps], np.float32)
            for k, name in enumerate(("lamp_color", "lamp_radius", "lamp_flicker", "lamp_period", "lamp_duty"))
        }
        lamps["lamp_color"] = lamps["lamp_color"].reshape(-1, 3)
        lights = Lights(
            sun_direction=direction / np.linalg.norm(direction),  # type: ignore[arg-type]
            sun_color=_array(sun_color, (3,)),  # type: ignore[arg-type]
            sun_radius=np.float32(sun_radius),  # type: ignore[arg-type]
            lamp_path=_stack([lamp[0] for lamp in self._lamps], path()),
            **lamps,
        )
        result = Scene(
            bodies=Bodies(
                _stack(self._paths, path()),
                _stack(self._turns, turn()),
                np.asarray(self._stencils, np.float32),  # type: ignore[arg-type]
                tuple(self._parents),
            ),
            rotation=np.stack([row[0] for row in rows]),  # type: ignore[arg-type]
            centre=np.stack([row[1] for row in rows]),  # type: ignore[arg-type]
            size=np.stack([row[2] for row in rows]),  # type: ignore[arg-type]
            material=np.stack(surfaces),  # type: ignore[arg-type]
            field=None if self._field is None else self._field[0],
            lights=lights,
            sky=sky,
            camera=camera,
            counts=tuple(counts),
            body=tuple(row[4] for row in rows),
            bounce=bounce,
            sun=bool(np.any(lights.sun_color > 0)),
            water=any(surface[-1] > 0 for surface in surfaces),
        )
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), result)


def _stack(values: list[R], example: R) -> R:
    if not values:
        return jax.tree.map(lambda leaf: np.zeros((0, *np.shape(leaf)), np.float32), example)
    return jax.tree.map(lambda *leaves: np.stack(leaves).astype(np.float32), *values)


def frame_along(direction: object) -> np.ndarray:
    """A rotation `[3, 3]` that takes z to `direction`."""
    z = _array(direction, (3,)).astype(np.float64)
    z = z / np.linalg.norm(z)
    helper = np.array([1.0, 0, 0]) if abs(z[0]) < 0.9 else np.array([0, 1.0, 0])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def yaw(angle: float) -> np.ndarray:
    """A rotation `[3, 3]` about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
