"""Height fields: an endless terrain z = h(x, y) that is a sum of waves, in world space.

The waves are periodic parabolas, a sine's shape for a tenth of its price: S(v) = 8 v (1 - 2 |v|) on |v| <= 1/2, once
continuously differentiable. Rays advance by steps that the largest curvature allows (after sphere tracing, Hart 1996),
so that none passes through a crest.
"""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.records import record
from jaxtrapolate.scenes.vector import Vector

STEPS = 28
SHADOW_STEPS = 12
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
        """The slope that distances are cut by."""
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
    """t > 0 where the ray origin + t direction meets the terrain from above, infinite where it does not.

    The height over the terrain, g(t), bends down by no more than K = sum of 32 |amplitude| (direction . d)^2, so that
    g(t) + g'(t) s - K s^2 / 2 is below it, and its root a step that crosses nothing. Towards a crossing these are
    Newton's steps; past a ridge that a ray grazes they grow with the root of the height, not in proportion to it. A
    ray that is not there after `STEPS` of them misses: towards the horizon, and one in 50,000 that looks down.
    """
    top, bottom = field.base + field.reach(), field.base - field.reach()
    down = jnp.where(d.z < -1e-9, d.z, -1e-9)
    start = jnp.where(d.z < -1e-9, jnp.maximum((top - o.z) / down, 0.0), 0.0)
    end = jnp.where(d.z < -1e-9, (bottom - o.z) / down, jnp.inf)
    along = [field.direction[k, 0] * d.x + field.direction[k, 1] * d.y for k in range(field.amplitude.shape[-1])]
    bend = cast(Array, sum(32 * jnp.abs(field.amplitude[k]) * v * v for k, v in enumerate(along)))
    bend = jnp.maximum(bend, 1e-9)

    def gap(t: Array) -> tuple[Array, Array]:
        """g and its derivative."""
        x, y = o.x + t * d.x, o.y + t * d.y
        height, slope = field.base + jnp.zeros_like(t), jnp.zeros_like(t)
        for k, rate in enumerate(along):
            v = field.direction[k, 0] * x + field.direction[k, 1] * y + field.phase[k]
            v = v - jnp.floor(v + 0.5)
            height += field.amplitude[k] * 8 * v * (1 - 2 * jnp.abs(v))
            slope += field.amplitude[k] * 8 * (1 - 4 * jnp.abs(v)) * rate
        return o.z + t * d.z - height, d.z - slope

    def advance(_: Array | int, t: Array) -> Array:
        g, rate = gap(t)
        root = jnp.sqrt(jnp.maximum(rate * rate + 2 * bend * g, 0.0))
        step = jnp.where(rate > 0, (rate + root) / bend, 2 * g / jnp.maximum(root - rate, 1e-9))
        return jnp.minimum(t + step, end)

    t = jax.lax.fori_loop(0, STEPS, advance, start + jnp.zeros_like(o.x + d.x))
    hit = (jnp.abs(gap(t)[0]) < 5e-3 * (1 + t * d.length())) & (t > 0) & (d.z < -1e-9)
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
        t = span * ((jnp.asarray(step, span.dtype) + 1) / SHADOW_STEPS) ** 2
        gap = o.z + t * d.z - field.height(o.x + t * d.x, o.y + t * d.y)
        return jnp.minimum(smallest, gap / jnp.maximum(t * softness, 1e-6))

    return jax.lax.fori_loop(0, SHADOW_STEPS, look, jnp.full_like(span, 1e6))


def field_distance(field: HeightField, p: Vector) -> Array:
    """A lower bound on the distance to the terrain."""
    slope = field.slope()
    return (p.z - field.height(p.x, p.y)) / jnp.sqrt(1 + slope * slope)
