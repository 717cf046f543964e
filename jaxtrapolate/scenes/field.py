"""Height fields: an endless terrain z = h(x, y) that is a sum of waves, in world space.

The waves are periodic parabolas, a sine's shape for a tenth of its price: S(v) = 8 v (1 - 2 |v|) on |v| <= 1/2, once
continuously differentiable. Rays advance by steps that the largest slope allows (sphere tracing, Hart 1996), so that
none passes through a crest, and end with Newton's iteration.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.records import record
from jaxtrapolate.scenes.vector import Vector

STEPS = 44
SHADOW_STEPS = 12
NEWTON_STEPS = 3
_BRAKE = 0.35  # how much of the sum of all slopes is taken for the largest slope: all waves never peak together


@record
@dataclasses.dataclass(frozen=True)
class HeightField:
    """h(x, y) = base + sum over k of amplitude[k] S(direction[k] . (x, y) + phase[k]).

    base: metres. direction `[K, 2]`: cycles a metre; phase `[K]`: cycles; amplitude `[K]`: metres.
    """

    base: Float[Array, ""]
    direction: Float[Array, "k 2"]
    phase: Float[Array, " k"]
    amplitude: Float[Array, " k"]

    def reach(self) -> Array:
        """The largest height above or below the base."""
        return jnp.sum(jnp.abs(self.amplitude))

    def slope(self) -> Array:
        """The slope that steps are cut by."""
        return _BRAKE * 8 * jnp.sum(jnp.abs(self.amplitude) * jnp.linalg.norm(self.direction, axis=-1))

    def height(self, x: Any, y: Any) -> Any:
        """h, by point."""
        total = self.base + jnp.zeros_like(x)
        for k in range(self.amplitude.shape[-1]):
            v = self.direction[k, 0] * x + self.direction[k, 1] * y + self.phase[k]
            v = v - jnp.floor(v + 0.5)
            total += self.amplitude[k] * 8 * v * (1 - 2 * jnp.abs(v))
        return total

    def gradient(self, x: Array, y: Array) -> tuple[Array, Array]:
        """dh/dx and dh/dy, by point."""
        along_x, along_y = jnp.zeros_like(x), jnp.zeros_like(y)
        for k in range(self.amplitude.shape[-1]):
            v = self.direction[k, 0] * x + self.direction[k, 1] * y + self.phase[k]
            v = v - jnp.floor(v + 0.5)
            slope = self.amplitude[k] * 8 * (1 - 4 * jnp.abs(v))
            along_x += slope * self.direction[k, 0]
            along_y += slope * self.direction[k, 1]
        return along_x, along_y

    def normal(self, x: Array, y: Array) -> Vector:
        """The upward unit normal, by point."""
        along_x, along_y = self.gradient(x, y)
        return Vector(-along_x, -along_y, jnp.ones_like(x)).normalized()


def enter_field(field: HeightField, o: Vector, d: Vector) -> Array:
    """t > 0 where the ray origin + t direction meets the terrain from above, infinite where it does not."""
    top, bottom = field.base + field.reach(), field.base - field.reach()
    down = jnp.where(d.z < -1e-9, d.z, -1e-9)
    start = jnp.maximum((top - o.z) / down, 0.0)
    end = jnp.where(d.z < -1e-9, (bottom - o.z) / down, jnp.inf)
    speed = jnp.abs(d.z) + field.slope() * jnp.sqrt(d.x * d.x + d.y * d.y)

    def advance(_: Array | int, t: Array) -> Array:
        gap = o.z + t * d.z - field.height(o.x + t * d.x, o.y + t * d.y)
        return jnp.minimum(t + gap / speed, end)

    def polish(_: Array | int, t: Array) -> Array:
        x, y = o.x + t * d.x, o.y + t * d.y
        along_x, along_y = field.gradient(x, y)
        closing = along_x * d.x + along_y * d.y - d.z
        gap = o.z + t * d.z - field.height(x, y)
        return t + jnp.where(closing > 0.05 * speed, gap / jnp.where(closing > 0.05 * speed, closing, 1.0), 0.0)

    start = jnp.where(d.z < -1e-9, start, 0.0) + jnp.zeros_like(o.x + d.x)
    t = jax.lax.fori_loop(0, STEPS, advance, start)
    t = jax.lax.fori_loop(0, NEWTON_STEPS, polish, t)
    gap = o.z + t * d.z - field.height(o.x + t * d.x, o.y + t * d.y)
    hit = (jnp.abs(gap) < 2e-3 * (1 + t * d.length())) & (t > 0) & (d.z < -1e-9)
    return jnp.where(hit, t, jnp.inf)


def field_gap(field: HeightField, o: Vector, d: Vector, softness: Array) -> Array:
    """The smallest height over the terrain along a ray, in units of the half width of a light's cone there.

    softness: half width of the cone a unit of t; the ray ends at t = 1 for lights that are near, where it left the
    terrain for others. Below -1 the light is hidden, above 1 it is whole.
    """
    top = field.base + field.reach()
    rise = jnp.where(d.z > 1e-3, d.z, 1e-3)
    span = jnp.clip((top - o.z) / rise, 0.0, 60.0 / d.length())

    def look(step: Array | int, smallest: Array) -> Array:
        t = span * ((step + 1.0) / SHADOW_STEPS) ** 2
        gap = o.z + t * d.z - field.height(o.x + t * d.x, o.y + t * d.y)
        return jnp.minimum(smallest, gap / jnp.maximum(t * softness, 1e-6))

    return jax.lax.fori_loop(0, SHADOW_STEPS, look, jnp.full_like(span, 1e6))


def field_distance(field: HeightField, p: Vector) -> Array:
    """A lower bound on the distance to the terrain."""
    slope = field.slope()
    return (p.z - field.height(p.x, p.y)) / jnp.sqrt(1 + slope * slope)
