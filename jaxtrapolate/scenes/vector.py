"""Planar three-vectors: one array per coordinate, the layout that ray casting vectorises in."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.records import record

Scalar = Any
"""An array of any shape, or a number, that broadcasts with the coordinates."""


@record
@dataclasses.dataclass(frozen=True)
class Vector:
    """Three arrays of one shape; arithmetic is by coordinate, with another vector or with a scalar per point."""

    x: Any
    y: Any
    z: Any

    def __add__(self, other: "Vector | Scalar") -> "Vector":
        o = vector(other)
        return Vector(self.x + o.x, self.y + o.y, self.z + o.z)

    def __sub__(self, other: "Vector | Scalar") -> "Vector":
        o = vector(other)
        return Vector(self.x - o.x, self.y - o.y, self.z - o.z)

    def __mul__(self, other: "Vector | Scalar") -> "Vector":
        o = vector(other)
        return Vector(self.x * o.x, self.y * o.y, self.z * o.z)

    def __truediv__(self, other: "Vector | Scalar") -> "Vector":
        o = vector(other)
        return Vector(self.x / o.x, self.y / o.y, self.z / o.z)

    def __neg__(self) -> "Vector":
        return Vector(-self.x, -self.y, -self.z)

    def dot(self, other: "Vector") -> Array:
        """The scalar product, one per point."""
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: "Vector") -> "Vector":
        """The vector product."""
        return Vector(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def length(self) -> Array:
        """The Euclidean norm; its gradient at 0 is not finite."""
        return jnp.sqrt(self.dot(self))

    def normalized(self) -> "Vector":
        """The unit vector of a vector that is not 0; 0 stays 0."""
        square = self.dot(self)
        return self * jnp.where(square > 0, jax.lax.rsqrt(jnp.where(square > 0, square, 1.0)), 0.0)

    def map(self, function: Any) -> "Vector":
        """`function` applied to each coordinate."""
        return Vector(function(self.x), function(self.y), function(self.z))

    def largest(self) -> Array:
        """The largest coordinate."""
        return jnp.maximum(jnp.maximum(self.x, self.y), self.z)

    def smallest(self) -> Array:
        """The smallest coordinate."""
        return jnp.minimum(jnp.minimum(self.x, self.y), self.z)

    def stack(self) -> Float[Array, "*shape 3"]:
        """Channels last."""
        return jnp.stack(jnp.broadcast_arrays(self.x, self.y, self.z), axis=-1)


def vector(value: Any) -> Vector:
    """A `Vector` unchanged; an array or a number as the vector whose coordinates are all that."""
    return value if isinstance(value, Vector) else Vector(value, value, value)


def unstack(array: Float[Array, "*shape 3"]) -> Vector:
    """From channels last."""
    return Vector(array[..., 0], array[..., 1], array[..., 2])


def select(condition: Any, then: Vector, otherwise: "Vector | Scalar") -> Vector:
    """`jnp.where` by coordinate."""
    o = vector(otherwise)
    return Vector(
        jnp.where(condition, then.x, o.x), jnp.where(condition, then.y, o.y), jnp.where(condition, then.z, o.z)
    )


def mix(a: "Vector | Scalar", b: "Vector | Scalar", weight: Any) -> Vector:
    """a (1 - weight) + b weight."""
    return vector(a) * (1 - weight) + vector(b) * weight


def rotate(rotation: Any, v: Vector) -> Vector:
    """rotation @ v for one matrix `[3, 3]`, or for a nested tuple of its entries, one array per entry."""
    r = rotation
    return Vector(
        r[0][0] * v.x + r[0][1] * v.y + r[0][2] * v.z,
        r[1][0] * v.x + r[1][1] * v.y + r[1][2] * v.z,
        r[2][0] * v.x + r[2][1] * v.y + r[2][2] * v.z,
    )


def rotate_back(rotation: Any, v: Vector) -> Vector:
    """rotation.T @ v, as `rotate`."""
    r = rotation
    return Vector(
        r[0][0] * v.x + r[1][0] * v.y + r[2][0] * v.z,
        r[0][1] * v.x + r[1][1] * v.y + r[2][1] * v.z,
        r[0][2] * v.x + r[1][2] * v.y + r[2][2] * v.z,
    )
