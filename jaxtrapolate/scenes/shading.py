"""What a ray sees: the surface, its textures, and its light.

The reflection is a diffuse part, albedo (1 - metallic), and a specular one with the reflectance at normal incidence
f0 = 0.08 specular (1 - metallic) + albedo metallic, as in the engine that the buffers are named after. Lights: the sun
and lamps, with a GGX lobe; the sky, as a hemisphere and, by Karis' fit of the split sum, mirrored; one traced bounce on
surfaces that are smooth enough.

References: Karis, "Real Shading in Unreal Engine 4" (2013) and "Physically Based Shading on Mobile" (2014).
"""

import dataclasses
from collections.abc import Callable
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxtrapolate.precision import divide
from jaxtrapolate.records import record
from jaxtrapolate.scenes import textures
from jaxtrapolate.scenes.casting import Hit, Placed, light_visibility, stage
from jaxtrapolate.scenes.primitives import normal
from jaxtrapolate.scenes.scene import MATERIAL, Lights, Scene, Sky
from jaxtrapolate.scenes.vector import Vector, mix, rotate, rotate_back, select, vector

SMOOTH, ROUGH = 0.35, 0.55
"""Below the first roughness reflections are traced, above the second they are the sky's; between, a mixture."""

Spread = Callable[[Array, Vector], list[Vector]]

_LUMINANCE = (0.2126, 0.7152, 0.0722)


@record
@dataclasses.dataclass(frozen=True)
class Surface:
    """What rays hit, by ray. `hit` is bool; `cloud` the sky's cover where nothing was hit; widths of the footprint."""

    hit: Any
    primitive: Any
    body: Any
    position: Any
    normal: Any
    albedo: Any
    roughness: Any
    metallic: Any
    specular: Any
    emission: Any
    ripple: Any
    width: Any
    cloud: Any


def _columns() -> dict[str, slice]:
    result, first = {}, 0
    for name, count in MATERIAL.items():
        result[name] = slice(first, first + count)
        first += count
    return result


def _picker(index: Array) -> tuple[Callable[[Any], Array], Callable[[Any], Vector]]:
    """Functions that look up one column of a table, and three, by ray."""

    def pick(column: Any) -> Array:
        return jnp.asarray(column).at[index].get(mode="promise_in_bounds")

    def pick3(table: Any) -> Vector:
        return Vector(pick(table[:, 0]), pick(table[:, 1]), pick(table[:, 2]))

    return pick, pick3


def _geometry(placed: Placed, hit: Hit, position: Vector, d: Vector) -> tuple[Vector, Vector, tuple]:
    """(normal, local, rotation): world normal, the point in the primitive's own space, and that space's rotation."""
    number, kinds = placed.number, placed.kinds()
    rotation, centre, size = placed.rotation, placed.centre, placed.size
    if placed.field is not None:
        rotation = jnp.concatenate([rotation, jnp.eye(3, dtype=rotation.dtype)[None]])
        centre = jnp.concatenate([centre, jnp.zeros((1, 3), centre.dtype)])
        size = jnp.concatenate([size, jnp.ones((1, 3), size.dtype)])
    pick, pick3 = _picker(hit.primitive)
    to_world = tuple(tuple(pick(rotation[:, row, column]) for column in range(3)) for row in range(3))
    local = stage(lambda position, d: (rotate_back(to_world, position - pick3(centre)), rotate_back(to_world, d)))
    at, ray = local(position, d)
    n = stage(lambda at, ray: normal(pick(kinds), at, ray, pick3(size)))(at, ray)
    n = stage(lambda n: rotate(to_world, n))(n)
    if placed.field is not None:
        n = select(hit.primitive == number, placed.field.normal(position.x, position.y), n)
    return n, at, to_world


def surface_normal(placed: Placed, hit: Hit, position: Vector, d: Vector) -> Vector:
    """The unit normals where rays of direction `d` hit, in the world; any vector where they hit nothing."""
    return _geometry(placed, hit, position, d)[0]


def surface(scene: Scene, placed: Placed, time: Array, o: Vector, d: Vector, hit: Hit, spread: Spread) -> Surface:
    """The surfaces that rays hit, their textures filtered over the footprint.

    spread: (t, normal) -> the two edges of the footprint, in the world.
    """
    pick, pick3 = _picker(hit.primitive)
    material = {}
    for name, columns in _columns().items():
        table = scene.material[:, columns]
        material[name] = pick3(table) if table.shape[1] == 3 else pick(table[:, 0])
    body = np.append(np.asarray(scene.body, np.int32), np.int32(0))  # the height field is the world's

    found = hit.t < jnp.inf

    # In steps, each kept: the three coordinates of a result would each compute all steps before it.
    t = jnp.where(found, hit.t, 1.0)
    position = stage(lambda o, d, t: o + d * t)(o, d, t)
    n, local, to_world = _geometry(placed, hit, position, d)
    edges = stage(spread)(t, n)

    @stage
    def footprint(first: Vector, second: Vector) -> tuple[Vector, Array]:
        a, b = rotate_back(to_world, first), rotate_back(to_world, second)
        size_of = jnp.sqrt(jnp.maximum(first.dot(first), second.dot(second)))
        return (a * a + b * b).map(jnp.sqrt), size_of

    width, size_of = footprint(*edges)
    texture = textures.Texture(
        material["frequency"], material["offset"], material["duty"], material["tiled"], material["noise_frequency"]
    )
    weight = stage(textures.pattern)(texture, local, width)
    # One evaluation of the noise serves the surfaces and, where there is none, the clouds.
    unit = d.normalized()
    high = 1 / jnp.maximum(unit.z + 0.12, 0.05)
    cloud_at = Vector(unit.x * high, unit.y * high, jnp.full_like(unit.x, 5.5))
    grain = textures.noise(
        select(found, local + texture.offset, cloud_at),
        jnp.where(found, texture.noise_frequency, 0.9),
        jnp.where(found, size_of, 0.01 * high),
    )
    albedo = mix(material["color"], material["color_b"], weight) * (1 + material["noise"] * grain)
    lamp = material["lamp"]
    level = jnp.ones_like(lamp)
    if scene.lights.lamp_radius.shape[0]:
        levels = lamp_levels(scene.lights, time)
        for k in range(levels.shape[0]):
            level = jnp.where(lamp == k, levels[k], level)
    cover = jnp.clip((grain - 0.9 + 1.5 * scene.sky.cover) * 1.2, 0.0, 1.0) * jnp.clip(unit.z * 8, 0.0, 1.0)
    zero = vector(0.0)
    return Surface(
        hit=found,
        primitive=hit.primitive,
        body=pick(body),
        position=position,
        normal=select(found, n, zero),
        albedo=select(found, albedo.map(lambda value: jnp.clip(value, 0.0, 1.0)), zero),
        roughness=jnp.where(found, material["roughness"] * (1 - weight) + material["roughness_b"] * weight, 1.0),
        metallic=jnp.where(found, material["metallic"], 0.0),
        specular=jnp.where(found, material["specular"], 0.0),
        emission=mix(material["emission"], material["emission_b"], weight) * level,
        ripple=material["ripple"],
        width=size_of,
        cloud=jnp.where(scene.sky.cover > 0, cover, 0.0),
    )


def lamp_levels(lights: Lights, time: Array) -> Array:
    """The brightness of each lamp at `time`, 0..1: it changes suddenly, at multiples of its period, at random."""
    count = lights.lamp_radius.shape[0]
    step = jnp.floor(time / jnp.maximum(lights.lamp_period, 1e-3)).astype(jnp.int32).astype(jnp.uint32)
    h = (step + jnp.arange(count, dtype=jnp.uint32) * jnp.uint32(7919)) * jnp.uint32(0x9E3779B1)
    h = (h ^ (h >> 15)) * jnp.uint32(0x85EBCA77)
    h = (h ^ (h >> 13)) * jnp.uint32(0xC2B2AE3D)
    random = ((h ^ (h >> 16)) >> 8).astype(jnp.float32) / 2**24
    return jnp.where(random >= lights.lamp_duty, 1 - lights.lamp_flicker, 1)


def sky_radiance(sky: Sky, lights: Lights, d: Vector, cloud: Array, *, sun: bool) -> Vector:
    """The radiance from direction `d`; `sun`: with its disc, which lit surfaces get from the light instead."""
    unit = d.normalized()
    up = unit.z

    def color(value: Array) -> Vector:
        return Vector(value[0], value[1], value[2])

    above = mix(color(sky.horizon), color(sky.zenith), jnp.sqrt(jnp.clip(up, 1e-6, 1.0)))
    below = mix(color(sky.horizon), color(sky.ground), jnp.clip(-up * 6, 0.0, 1.0))
    result = select(up > 0, mix(above, color(sky.cloud), cloud), below)
    towards = jnp.clip(unit.dot(color(lights.sun_direction)), 0.0, 1.0)
    halo = sky.glow * (0.35 * towards**8 + 1.0 * towards**64)
    if sun:
        halo = halo + 12 * sky.glow * jnp.clip((towards - 0.9993) * 4000, 0.0, 1.0) * (1 - cloud)
    return result + color(lights.sun_color) * halo


def sky_irradiance(sky: Sky, n: Vector) -> Vector:
    """Radiance of a white diffuse surface under the whole sky."""
    up = 0.5 + 0.5 * n.z

    def blend(zenith: Array, horizon: Array, ground: Array) -> Array:
        return ground * (1 - up) + (0.6 * zenith + 0.4 * horizon) * up

    z, h, g = sky.zenith, sky.horizon, sky.ground
    return Vector(blend(z[0], h[0], g[0]), blend(z[1], h[1], g[1]), blend(z[2], h[2], g[2])) * sky.ambient


@record
@dataclasses.dataclass(frozen=True)
class Reflectance:
    """The parts of a material that light is multiplied by: diffuse, f0 by colour; roughness squared is `alpha`."""

    diffuse: Any
    f0: Any
    roughness: Any


def reflectance(s: Surface) -> Reflectance:
    """Of a surface."""
    dielectric = 0.08 * s.specular * (1 - s.metallic)
    return Reflectance(s.albedo * (1 - s.metallic), s.albedo * s.metallic + dielectric, jnp.maximum(s.roughness, 0.06))


def _reflect_light(r: Reflectance, n: Vector, v: Vector, to_light: Vector) -> tuple[Array, Vector]:
    """(cosine, reflected): n . l, and the radiance for a light that gives a white diffuse surface 1 at n . l = 1."""
    to_light = to_light.normalized()
    cosine = jnp.maximum(n.dot(to_light), 0.0)
    h = (v + to_light).normalized()
    n_h = jnp.clip(n.dot(h), 0.0, 1.0)
    alpha2 = r.roughness**4
    lobe = n_h * n_h * (alpha2 - 1) + 1
    strength = alpha2 / (lobe * lobe) * (0.25 * r.roughness + 0.25)
    grazing = (1 - jnp.clip(v.dot(h), 0.0, 1.0)) ** 5
    fresnel = r.f0 * (1 - grazing) + grazing
    return cosine, r.diffuse * cosine + fresnel * (strength * cosine)


def direct_light(
    scene: Scene, placed: Placed, time: Array, s: Surface, n: Vector, v: Vector, *, shadows_of_dynamic: bool
) -> tuple[Vector, Array]:
    """(radiance, shadow): of the sun and the lamps, and the fraction of their light that dynamic objects block.

    shadow = 1 - (irradiance with all blockers) / (irradiance with static ones), by luminance; 0 where there is none.
    """
    lights, r = scene.lights, reflectance(s)
    total = vector(jnp.zeros_like(s.width))
    with_all, with_static = jnp.zeros_like(s.width), jnp.zeros_like(s.width)

    def luminance(color: Array) -> Array:
        return cast(Array, sum(weight * color[k] for k, weight in enumerate(_LUMINANCE)))

    def add(to: Vector, color: Array, falloff: Array, *, near: bool, softness: Array) -> None:
        nonlocal total, with_all, with_static
        static, dynamic = light_visibility(placed, s.position, to, s.primitive, near=near, softness=softness)
        facing = s.normal.dot(to) > 0
        static = jnp.where(facing, static, 0.0)
        both = jnp.minimum(static, dynamic)
        cosine, reflected = stage(_reflect_light)(r, n, v, to)
        with_all += luminance(color) * falloff * cosine * both
        with_static += luminance(color) * falloff * cosine * static
        amount = falloff * (both if shadows_of_dynamic else static)
        total = total + reflected * Vector(color[0], color[1], color[2]) * amount

    if scene.sun:
        sun = Vector(*(lights.sun_direction[k] for k in range(3)))  # scalars: turned once for each primitive
        add(sun, lights.sun_color, jnp.ones((), jnp.float32), near=False, softness=lights.sun_radius)
    if lights.lamp_radius.shape[0]:
        where, levels = lights.lamp_path.at(time), lamp_levels(lights, time)
        for k in range(where.shape[0]):
            to = Vector(where[k, 0], where[k, 1], where[k, 2]) - s.position
            falloff = levels[k] / jnp.maximum(to.dot(to), 0.01)
            add(to, lights.lamp_color[k], falloff, near=True, softness=lights.lamp_radius[k])
    shadow = 1 - divide(with_all, with_static, where=with_static > 1e-6, otherwise=1)
    return total, jnp.clip(shadow, 0.0, 1.0)


def environment_gain(r: Reflectance, n_v: Array) -> Vector:
    """What part of a uniform environment is mirrored: Karis' fit of the split sum."""
    rough = r.roughness
    x, y = 1 - rough, 0.0425 - 0.0275 * rough
    a = jnp.minimum(x * x, jnp.exp2(-9.28 * n_v)) * x + y
    scale, bias = 1.04 - 0.572 * rough - 1.04 * a, 0.022 * rough - 0.04 + 1.04 * a
    return r.f0 * scale + bias


def rippled(s: Surface, time: Array) -> Vector:
    """The normal bent by waves on water; waves shorter than the footprint are left out."""
    slope_x, slope_y = jnp.zeros_like(s.width), jnp.zeros_like(s.width)
    for k, (x, y, speed) in enumerate(((0.9, 0.35, 0.02), (-0.5, 1.1, 0.017), (1.7, -1.2, 0.03), (2.6, 2.3, 0.041))):
        frequency = float(np.hypot(x, y))
        phase = x * s.position.x + y * s.position.y + speed * time + 0.16 * k
        phase -= jnp.floor(phase + 0.5)
        wave = 8 * phase * (1 - 2 * jnp.abs(phase))  # parabolas, as in `field`
        wave *= jnp.clip(1.5 - 2 * s.width * frequency, 0.0, 1.0) * s.ripple
        slope_x, slope_y = slope_x + wave * x / frequency, slope_y + wave * y / frequency
    return (s.normal + Vector(-slope_x, -slope_y, jnp.zeros_like(slope_x))).normalized()
