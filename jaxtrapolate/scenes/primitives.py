"""The shapes in their own space: where a ray enters, how far a point is, how nearly a ray to a light is blocked.

Each shape is convex and seen from outside; it sits at the origin of its own space, and `size` is a vector of three
lengths in metres. Rays are origin + t direction; the direction need not be of length 1.

| shape | surface | size |
|---|---|---|
| plane | z = 0, seen from z > 0 | unused |
| box | the box of these half lengths | half lengths |
| sphere | the ellipsoid of these radii | radii |
| capsule | points at distance x from the segment \\|z\\| <= z | radius, unused, half length |
| blade | z = 0, \\|x\\| <= x, \\|y\\| <= y, narrower by 1 - z at +x; two-sided | x, y, taper |

References: Haines et al., "Precision Improvements for Ray/Sphere Intersection" (Ray Tracing Gems, 2019); Quilez,
"Intersectors" and "Distance functions".
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array

from jaxtrapolate.scenes.vector import Vector, select

KINDS = ("plane", "box", "sphere", "capsule", "blade")
"""The shapes, in the order in which primitives are numbered; a height field comes after them."""

Gap = tuple[Array, Array]
"""(t, gap): where along a ray it comes closest to a shape, and its signed distance there, < 0 where the ray hits."""


def _safe(value: Array) -> Array:
    return jnp.where(jnp.abs(value) < 1e-9, 1e-9, value)


def _closest_approach(o: Vector, d: Vector) -> tuple[Array, Vector]:
    t = -o.dot(d) / d.dot(d)
    return t, o + d * t


def _slabs(o: Vector, d: Vector, size: Vector) -> tuple[Array, Array]:
    inverse = d.map(lambda value: 1 / _safe(value))
    middle, half = -o * inverse, size * inverse.map(jnp.abs)
    return (middle - half).largest(), (middle + half).smallest()


def _blade_width(x: Array, size: Vector) -> Array:
    return size.y * (1 - size.z * (0.5 + 0.5 * jnp.clip(x / size.x, -1, 1)))


def enter_plane(o: Vector, d: Vector, size: Vector) -> Array:
    """t at which a ray enters the half space z < 0 from above; infinite where it does not."""
    t = -o.z / _safe(d.z)
    return jnp.where((d.z < 0) & (t > 0), t, jnp.inf)


def enter_box(o: Vector, d: Vector, size: Vector) -> Array:
    """t at which a ray enters the box of half edges `size`; infinite where it misses or starts inside."""
    near, far = _slabs(o, d, size)
    return jnp.where((near < far) & (near > 0), near, jnp.inf)


def _enter_ball(o: Vector, d: Vector, radius2: Array | float) -> tuple[Array, Array]:
    """(t, hit) for a sphere at the origin; |o x d|^2 has none of the cancellation of (o . d)^2 - |o|^2 |d|^2."""
    square = d.dot(d)
    across = d.cross(o)
    inside = square * radius2 - across.dot(across)
    t = (-o.dot(d) - jnp.sqrt(jnp.maximum(inside, 0))) / square
    return t, inside > 0


def enter_sphere(o: Vector, d: Vector, size: Vector) -> Array:
    """t at which a ray enters the ellipsoid of half axes `size`; infinite where it misses."""
    inverse = Vector(1 / size.x, 1 / size.y, 1 / size.z)
    t, hit = _enter_ball(o * inverse, d * inverse, 1.0)
    return jnp.where(hit & (t > 0), t, jnp.inf)


def enter_capsule(o: Vector, d: Vector, size: Vector) -> Array:
    """t at which a ray enters the capsule along z, radius size.x, half length size.z; infinite where it misses."""
    radius2 = size.x * size.x
    square = jnp.maximum(d.x * d.x + d.y * d.y, 1e-18)
    across = d.x * o.y - d.y * o.x
    inside = square * radius2 - across * across
    side = (-(o.x * d.x + o.y * d.y) - jnp.sqrt(jnp.maximum(inside, 0))) / square
    z = o.z + side * d.z
    on_side = jnp.abs(z) <= size.z
    cap, on_cap = _enter_ball(Vector(o.x, o.y, o.z - jnp.where(z > 0, size.z, -size.z)), d, radius2)
    entry = jnp.where(on_side, side, cap)
    return jnp.where((inside > 0) & (on_side | on_cap) & (entry > 0), entry, jnp.inf)


def enter_blade(o: Vector, d: Vector, size: Vector) -> Array:
    """t at which a ray crosses the flat blade in z = 0 that narrows along x; infinite where it misses."""
    t = -o.z / _safe(d.z)
    x, y = o.x + t * d.x, o.y + t * d.y
    hit = (jnp.abs(x) <= size.x) & (jnp.abs(y) <= _blade_width(x, size)) & (t > 0)
    return jnp.where(hit, t, jnp.inf)


def distance_plane(p: Vector, size: Vector) -> Array:
    """Signed distance of a point to the plane."""
    return p.z


def distance_box(p: Vector, size: Vector) -> Array:
    """Signed distance of a point to the box."""
    q = p.map(jnp.abs) - size
    return q.map(lambda value: jnp.maximum(value, 0)).length() + jnp.minimum(q.largest(), 0)


def distance_sphere(p: Vector, size: Vector) -> Array:
    """Signed distance of a point to the ellipsoid; exact for a sphere, else to first order."""
    scaled = jnp.maximum((p / size).length(), 1e-6)
    return p.length() * (1 - 1 / scaled)


def distance_capsule(p: Vector, size: Vector) -> Array:
    """Signed distance of a point to the capsule."""
    z = p.z - jnp.clip(p.z, -size.z, size.z)
    return jnp.sqrt(p.x * p.x + p.y * p.y + z * z) - size.x


def distance_blade(p: Vector, size: Vector) -> Array:
    """Distance of a point to the blade, which has no inside."""
    x = jnp.maximum(jnp.abs(p.x) - size.x, 0)
    y = jnp.maximum(jnp.abs(p.y) - _blade_width(p.x, size), 0)
    return jnp.sqrt(x * x + y * y + p.z * p.z)


def gap_plane(o: Vector, d: Vector, size: Vector) -> Gap:
    """Where a ray meets the plane, and -1 or 1: from above it always hits, from below never."""
    t = -o.z / _safe(d.z)
    return t, jnp.where(d.z < 0, -1.0, 1.0) * jnp.ones_like(t)


def gap_box(o: Vector, d: Vector, size: Vector) -> Gap:
    """t of the middle of the ray within the slabs, and the signed distance there: how nearly it misses the box."""
    near, far = _slabs(o, d, size)
    t = 0.5 * (near + far)
    return t, distance_box(o + d * t, size)


def gap_sphere(o: Vector, d: Vector, size: Vector) -> Gap:
    """t of the closest approach to the ellipsoid, and the signed distance there."""
    inverse = Vector(1 / size.x, 1 / size.y, 1 / size.z)
    t, q = _closest_approach(o * inverse, d * inverse)
    return t, distance_sphere(q * size, size)


def gap_capsule(o: Vector, d: Vector, size: Vector) -> Gap:
    """t of the closest approach to the capsule, and the signed distance there."""
    t = -(o.x * d.x + o.y * d.y) / jnp.maximum(d.x * d.x + d.y * d.y, 1e-18)
    z = jnp.clip(o.z + t * d.z, -size.z, size.z)
    t, q = _closest_approach(Vector(o.x, o.y, o.z - z), d)
    return t, q.length() - size.x


def gap_blade(o: Vector, d: Vector, size: Vector) -> Gap:
    """t at which a ray crosses the plane of the blade, and how far outside, as the ray sees it."""
    t = -o.z / _safe(d.z)
    x, y = o.x + t * d.x, o.y + t * d.y
    gap = jnp.maximum(jnp.abs(x) - size.x, jnp.abs(y) - _blade_width(x, size))
    return t, gap * jnp.abs(d.z) / d.length()


def normal(kind: Array, q: Vector, d: Vector, size: Vector) -> Vector:
    """The outward unit normal at a surface point `q` that a ray of direction `d` came to, in the shape's own space.

    kind: index into `KINDS`, by point. A blade's normal faces the ray.
    """
    one, zero = jnp.ones_like(q.x), jnp.zeros_like(q.x)
    up = Vector(zero, zero, one)
    relative = (q / size).map(jnp.abs)
    on_x = (relative.x >= relative.y) & (relative.x >= relative.z)
    on_y = ~on_x & (relative.y >= relative.z)
    sign = q.map(lambda value: jnp.where(value < 0, -1.0, 1.0))
    box = Vector(jnp.where(on_x, sign.x, 0), jnp.where(on_y, sign.y, 0), jnp.where(on_x | on_y, 0, sign.z))
    sphere = q / (size * size)
    capsule = Vector(q.x, q.y, q.z - jnp.clip(q.z, -size.z, size.z))
    blade = Vector(zero, zero, jnp.where(d.z > 0, -one, one))
    result = select(kind == KINDS.index("box"), box, up)
    result = select(kind == KINDS.index("sphere"), sphere, result)
    result = select(kind == KINDS.index("capsule"), capsule, result)
    return select(kind == KINDS.index("blade"), blade, result).normalized()


ENTER: dict[str, Callable[[Vector, Vector, Vector], Array]] = {
    "plane": enter_plane,
    "box": enter_box,
    "sphere": enter_sphere,
    "capsule": enter_capsule,
    "blade": enter_blade,
}
"""(origin, direction, size) -> t > 0 where the ray enters the shape, infinite where it does not."""

DISTANCE: dict[str, Callable[[Vector, Vector], Array]] = {
    "plane": distance_plane,
    "box": distance_box,
    "sphere": distance_sphere,
    "capsule": distance_capsule,
    "blade": distance_blade,
}
"""(point, size) -> signed distance, exact but for ellipsoids and tapered blades, whose sign is exact."""

GAP: dict[str, Callable[[Vector, Vector, Vector], Gap]] = {
    "plane": gap_plane,
    "box": gap_box,
    "sphere": gap_sphere,
    "capsule": gap_capsule,
    "blade": gap_blade,
}
"""(origin, direction, size) -> `Gap`; the sign is exact, the distance exact for spheres and capsules."""
