"""The records that all functions and methods exchange: immutable pytrees, absent fields are `None`.

Convention:
    Images are `[H, W, C]`, channels last; batches by `vmap`. Coordinates are in pixels, x to the right and
    y down, an integer is a pixel's centre. Motion is a displacement to add: the surface point at pixel p is at
    p + motion[p] in the other frame. Readers convert each file's own convention to this one, nothing else does.

An absent buffer is part of the pytree's structure, so that a stage which would need it is left out when tracing.
Records are not checked when they are built (transformations put other leaves into them), but where a public function
receives them, by the functions `check_*` below.
"""

import dataclasses
from typing import Any, Literal, TypeVar

import jax
from jaxtyping import Array, Float

from jaxtrapolate.checks import Size, check_array, check_image

R = TypeVar("R")

Sign = Literal["previous_minus_current", "current_minus_previous"]
Units = Literal["pixels", "uv", "ndc"]
YAxis = Literal["down", "up"]
"""How motion vectors may be stated: see `jaxtrapolate.convert_motion`."""

DepthKind = Literal["metric", "ordinal"]
"""What depth is: the distance along the view axis, or numbers of which only the order counts."""
DepthOrAbsent = Literal["metric", "ordinal", "absent"]


def record(cls: type[R]) -> type[R]:
    """Register a frozen dataclass as a pytree whose fields are all leaves or subtrees."""
    names = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]
    return jax.tree_util.register_dataclass(cls, data_fields=names, meta_fields=[])


def replace(value: R, **fields: Any) -> R:
    """A copy of a record with some fields exchanged."""
    return dataclasses.replace(value, **fields)  # type: ignore[type-var]


@record
@dataclasses.dataclass(frozen=True)
class Camera:
    """An unjittered pinhole camera: `view` maps world to camera, `projection` camera to clip space.

    Convention: column vectors, clip = projection @ view @ (x, y, z, 1); clip space as in OpenGL, x right, y up, and
    visible where w > 0 and |x|, |y| <= w; the depth range does not matter here.
    """

    view: Float[Array, "4 4"] | None = None
    projection: Float[Array, "4 4"] | None = None


@record
@dataclasses.dataclass(frozen=True)
class GBuffer:
    """The geometry and material buffers of a frame. All floating point, `[H, W, 3]` or `[H, W, 1]`.

    albedo `[H, W, 3]`: base colour in 0..1. depth: distance along the view axis, in the unit of position; +inf, or not
    positive, where no surface was hit. normal `[H, W, 3]`: unit, world space, 0 at the sky. position `[H, W, 3]`: world
    space. roughness, metallic, specular in 0..1. n_dot_v: cosine between normal and direction to the eye. stencil: 0
    static, > 0 the id of a dynamic object. shadow: fraction of light that dynamic objects block, 1 = full shadow. sky:
    1 where no surface was hit. sky_color `[H, W, 3]`: radiance of the sky, where the engine draws it apart.
    """

    albedo: Float[Array, "h w 3"] | None = None
    depth: Float[Array, "h w 1"] | None = None
    normal: Float[Array, "h w 3"] | None = None
    position: Float[Array, "h w 3"] | None = None
    roughness: Float[Array, "h w 1"] | None = None
    metallic: Float[Array, "h w 1"] | None = None
    specular: Float[Array, "h w 1"] | None = None
    n_dot_v: Float[Array, "h w 1"] | None = None
    stencil: Float[Array, "h w 1"] | None = None
    shadow: Float[Array, "h w 1"] | None = None
    sky: Float[Array, "h w 1"] | None = None
    sky_color: Float[Array, "h w 3"] | None = None


@record
@dataclasses.dataclass(frozen=True)
class Frame:
    """One frame of a sequence.

    color `[H, W, 3]`: linear radiance; `None` where only the buffers were drawn. motion `[H, W, 2]`: pixels to add to
    reach the frame before it in the sequence handed over, unjittered. jitter `[2]`: sub-pixel offset of the samples in
    pixels. time: scalar, in frames. objects `[N, 4, 4]`: for the stencil's ids 1 to N the rigid map of the world now to
    that of the frame before it, column vectors.
    """

    color: Float[Array, "h w 3"] | None = None
    gbuffer: GBuffer | None = None
    motion: Float[Array, "h w 2"] | None = None
    camera: Camera | None = None
    jitter: Float[Array, "2"] | None = None
    time: Float[Array, ""] | float | None = None
    objects: Float[Array, "n 4 4"] | None = None


@record
@dataclasses.dataclass(frozen=True)
class Keyframe:
    """A rendered frame of bidirectional reprojection, its I-frame (Yang et al. 2011, section 5).

    color `[H, W, C]`: any attributes. depth, stencil `[H, W, 1]`. forward_flow, backward_flow `[H, W, 3]`: x and y in
    pixels, then the change of depth, to the next and to the previous I-frame. time: scalar, in frames.
    """

    color: Float[Array, "h w c"] | None = None
    depth: Float[Array, "h w 1"] | None = None
    stencil: Float[Array, "h w 1"] | None = None
    forward_flow: Float[Array, "h w 3"] | None = None
    backward_flow: Float[Array, "h w 3"] | None = None
    time: Float[Array, ""] | float | None = None


CHANNELS = {
    "albedo": 3,
    "depth": 1,
    "normal": 3,
    "position": 3,
    "roughness": 1,
    "metallic": 1,
    "specular": 1,
    "n_dot_v": 1,
    "stencil": 1,
    "shadow": 1,
    "sky": 1,
    "sky_color": 3,
}
"""The number of channels of each buffer of a `GBuffer`, in the order of its fields."""


def check_gbuffer(name: str, gbuffer: GBuffer, *, size: Size | None = None) -> Size | None:
    """The common size of the buffers that are there, `None` where there is none; raises where one differs."""
    if not isinstance(gbuffer, GBuffer):
        raise TypeError(f"{name}: expected a GBuffer, got {type(gbuffer).__name__}")
    for field, channels in CHANNELS.items():
        value = getattr(gbuffer, field)
        if value is not None:
            size = check_image(f"{name}.{field}", value, size=size, channels=channels)
    return size


def check_frame(name: str, frame: Frame, *, size: Size | None = None) -> Size | None:
    """The common size of a frame's images, `None` where there is none; raises where one differs."""
    if not isinstance(frame, Frame):
        raise TypeError(f"{name}: expected a Frame, got {type(frame).__name__}")
    for field, channels in (("color", 3), ("motion", 2)):
        value = getattr(frame, field)
        if value is not None:
            size = check_image(f"{name}.{field}", value, size=size, channels=channels)
    if frame.gbuffer is not None:
        size = check_gbuffer(f"{name}.gbuffer", frame.gbuffer, size=size)
    if frame.camera is not None:
        check_camera(f"{name}.camera", frame.camera)
    if frame.jitter is not None:
        check_array(f"{name}.jitter", frame.jitter, shape=(2,))
    if frame.objects is not None:
        check_array(f"{name}.objects", frame.objects, shape=("N", 4, 4))
    return size


def check_camera(name: str, camera: Camera) -> None:
    """Raise unless `camera` is a `Camera` with both matrices."""
    if not isinstance(camera, Camera):
        raise TypeError(f"{name}: expected a Camera, got {type(camera).__name__}")
    check_array(f"{name}.view", camera.view, shape=(4, 4))
    check_array(f"{name}.projection", camera.projection, shape=(4, 4))
