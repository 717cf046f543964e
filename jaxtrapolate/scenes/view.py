"""The camera: its matrices from a path, rays through pixels, points to pixels.

Convention:
    As in `records.Camera`. Pixel p = (x right, y down) of a frame `(H, W)`; integers are pixel centres. A primary ray
    has unit length along the view axis, so its t is the depth.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.records import Camera, record
from jaxtrapolate.scenes.kinematics import matmul
from jaxtrapolate.scenes.scene import CameraPath
from jaxtrapolate.scenes.vector import Vector, rotate, rotate_back, select

NEAR, FAR = 0.05, 16384.0
"""Metres: the clip planes; FAR is also the depth of the sky. It is finite in half precision."""


@record
@dataclasses.dataclass(frozen=True)
class View:
    """A camera for one size: eye; rotation, world to camera; scale: pixels at depth 1; middle: the axis' pixel."""

    eye: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    scale: Float[Array, "2"]
    middle: Float[Array, "2"]


@record
@dataclasses.dataclass(frozen=True)
class Pixels:
    """Where points are seen: x, y in pixels, depth in metres; ahead: whether in front of the camera."""

    x: Any
    y: Any
    depth: Any
    ahead: Any


def view_at(path: CameraPath, time: Float[Array, ""], size: tuple[int, int]) -> View:
    """The camera at `time`, for frames of `size` `(H, W)`."""
    eye, target = path.eye.at(time), path.target.at(time)
    back = eye - target
    back = back / jnp.linalg.norm(back)
    right = jnp.cross(jnp.array([0.0, 0.0, 1.0], back.dtype), back)
    right = right / jnp.linalg.norm(right)
    up = jnp.cross(back, right)
    c, s = jnp.cos(path.roll), jnp.sin(path.roll)
    rotation = jnp.stack([c * right + s * up, c * up - s * right, back])
    focal = 0.5 * size[0] / path.tangent
    middle = jnp.array([0.5 * (size[1] - 1), 0.5 * (size[0] - 1)], eye.dtype)
    return View(eye, rotation, jnp.stack([focal, focal]), middle)


def matrices(view: View, size: tuple[int, int]) -> Camera:
    """The view as a `Camera`."""
    translation = -matmul(view.rotation, view.eye[:, None])
    world_to_camera = jnp.concatenate(
        [jnp.concatenate([view.rotation, translation], axis=1), jnp.eye(4, dtype=translation.dtype)[3:]]
    )
    zero = jnp.zeros((), view.scale.dtype)
    x, y = 2 * view.scale[0] / size[1], 2 * view.scale[1] / size[0]
    a, b = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    projection = jnp.stack(
        [
            jnp.stack([x, zero, zero, zero]),
            jnp.stack([zero, y, zero, zero]),
            jnp.array([0.0, 0.0, a, b], zero.dtype),
            jnp.array([0.0, 0.0, -1.0, 0.0], zero.dtype),
        ]
    )
    return Camera(view=world_to_camera, projection=projection)


def origin(view: View) -> Vector:
    """The eye as a `Vector` of scalars."""
    return Vector(view.eye[0], view.eye[1], view.eye[2])


def ray_directions(view: View, x: Array, y: Array) -> Vector:
    """World directions through pixels (x, y), of unit length along the view axis."""
    local = Vector((x - view.middle[0]) / view.scale[0], (view.middle[1] - y) / view.scale[1], -jnp.ones_like(x))
    return rotate_back(view.rotation, local)


def pixel_steps(view: View) -> tuple[Vector, Vector]:
    """The changes of a ray's direction from one pixel to the next, along x and along y."""
    r = view.rotation
    return (
        Vector(r[0, 0], r[0, 1], r[0, 2]) * (1 / view.scale[0]),
        Vector(r[1, 0], r[1, 1], r[1, 2]) * (-1 / view.scale[1]),
    )


def project(view: View, point: Vector, *, at_infinity: Array | bool = False) -> Pixels:
    """Where points are seen; where `at_infinity`, `point` is a direction, and its depth is `FAR`.

    A point that is not at least 1 mm in front of the camera is not ahead; it is placed four frames outside, at a finite
    position.
    """
    p = rotate(view.rotation, select(at_infinity, point, point - origin(view)))
    depth = -p.z
    ahead = depth > jnp.where(at_infinity, 1e-6, 1e-3)
    divisor = jnp.where(ahead, depth, 1.0)
    x = view.middle[0] + view.scale[0] * p.x / divisor
    y = view.middle[1] - view.scale[1] * p.y / divisor
    far = 9 * (view.middle + 1)
    return Pixels(
        jnp.where(ahead, x, far[0]),
        jnp.where(ahead, y, far[1]),
        jnp.where(at_infinity, FAR, depth),
        ahead,
    )


def inside(pixels: Pixels, size: tuple[int, int]) -> Array:
    """Whether points are ahead and land on a pixel of the frame: within -0.5..W - 0.5, -0.5..H - 0.5."""
    x, y = pixels.x, pixels.y
    return pixels.ahead & (x >= -0.5) & (x <= size[1] - 0.5) & (y >= -0.5) & (y <= size[0] - 0.5)
