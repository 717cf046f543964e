"""Procedural textures, filtered over the footprint of a pixel as mip-maps would be.

A material's colour is a pattern of two colours (checks, stripes or tiles with joints, box-filtered in closed form)
times 1 + amount * noise (three octaves of value noise, each faded out where the footprint reaches its wavelength).
Patterns are solid: functions of the three coordinates in the primitive's own space, so they move with it.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxtrapolate.records import record
from jaxtrapolate.scenes.vector import Vector

OCTAVES = 3


@record
@dataclasses.dataclass(frozen=True)
class Texture:
    """The parameters by point: frequency in cycles a metre (0 = constant along that axis), offset in metres.

    duty: the part of a period that the second colour takes. tiled: 0 = checks, the axes multiply; 1 = joints, the
    second colour is wherever it is along any axis. noise_frequency: cycles a metre of the first octave.
    """

    frequency: Vector
    offset: Vector
    duty: Array
    tiled: Array
    noise_frequency: Array


def _band(x: Array, frequency: Array, duty: Array, width: Array) -> Array:
    """The mean over [x - width / 2, x + width / 2] of 1 where x * frequency mod 1 < duty, else 0."""
    width = jnp.maximum(width * frequency, 1e-4)
    v = x * frequency

    def integral(u: Array) -> Array:
        cell = jnp.floor(u)
        return cell * duty + jnp.minimum(u - cell, duty)

    # The cell number is taken off first: the difference of two large integrals would lose the digits of the small.
    v = v - jnp.floor(v)
    mean = (integral(v + 0.5 * width) - integral(v - 0.5 * width)) / width
    return jnp.where(frequency > 0, jnp.clip(mean, 0.0, 1.0), 0.0)


def pattern(texture: Texture, p: Vector, width: Vector) -> Array:
    """The weight 0..1 of the second colour at `p`, averaged over a box of edges `width` around it."""
    q = p + texture.offset
    x = _band(q.x, texture.frequency.x, texture.duty, width.x)
    y = _band(q.y, texture.frequency.y, texture.duty, width.y)
    z = _band(q.z, texture.frequency.z, texture.duty, width.z)
    checks = 0.5 - 0.5 * (1 - 2 * x) * (1 - 2 * y) * (1 - 2 * z)
    joints = 1 - (1 - x) * (1 - y) * (1 - z)
    return jnp.where(texture.tiled > 0.5, joints, checks)


def _hash(x: Array, y: Array, z: Array) -> Array:
    """A random number in -1..1 for each integer triple."""
    h = x * jnp.uint32(0x8DA6B343) ^ y * jnp.uint32(0xD8163841) ^ z * jnp.uint32(0xCB1AB31F)
    h = (h ^ (h >> 15)) * jnp.uint32(0x2C1B3C6D)
    h = (h ^ (h >> 12)) * jnp.uint32(0x297A2D39)
    h = h ^ (h >> 15)
    return (h >> 8).astype(jnp.float32) * (2.0 / 2**24) - 1.0


def _value_noise(p: Vector) -> Array:
    """Quintic interpolation of random numbers in -1..1 on the integer lattice."""
    cell = p.map(jnp.floor)
    f = p - cell
    f = f * f * f * (f * (f * 6 - 15) + 10)
    x, y, z = (c.astype(jnp.int32).astype(jnp.uint32) for c in (cell.x, cell.y, cell.z))

    def along_x(dy: int, dz: int) -> Array:
        a, b = _hash(x, y + jnp.uint32(dy), z + jnp.uint32(dz)), _hash(x + 1, y + jnp.uint32(dy), z + jnp.uint32(dz))
        return a + (b - a) * f.x

    near, far = along_x(0, 0), along_x(0, 1)
    near = near + (along_x(1, 0) - near) * f.y
    far = far + (along_x(1, 1) - far) * f.y
    return near + (far - near) * f.z


def noise(p: Vector, frequency: Array, width: Array) -> Array:
    """Three octaves of noise in about -1..1 at `p`; octaves whose wavelength is below two footprints are left out."""

    def add(octave: Array, total: Array) -> Array:
        number = jnp.asarray(octave, p.x.dtype)
        scale = jnp.exp2(number)
        fade = jnp.clip(1.5 - 2 * width * frequency * scale, 0.0, 1.0)
        return total + fade / scale * _value_noise(p * (frequency * scale) + 17.3 * number)

    return jax.lax.fori_loop(0, OCTAVES, add, jnp.zeros_like(p.x))
