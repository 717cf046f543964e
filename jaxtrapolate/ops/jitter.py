"""Jitter: frames whose samples are shifted by a fraction of a pixel, as super sampling over time needs them.

Motion and cameras are unjittered: they lead from where a surface point is on the screen to where it was. Pixel p of a
frame with jitter j shows the screen at p + j. So a motion that leads from pixel to pixel, by which images are fetched,
is the unjittered one plus the difference of the jitters, and a camera that projects to pixels is shifted by -j.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.records import Camera, Frame, replace


def jitter_difference(frame: Frame, other: Frame) -> Float[Array, "2"] | None:
    """What the motion from a frame's pixels to another's is more than the unjittered motion; `None` without jitter.

    A frame that has none counts as unjittered.
    """
    if frame.jitter is None and other.jitter is None:
        return None
    here, there = (0.0 if f.jitter is None else jnp.asarray(f.jitter) for f in (frame, other))
    return jnp.asarray(here - there)


def shift_motion(motion: Float[Array, "h w 2"], frame: Frame, other: Frame) -> Float[Array, "h w 2"]:
    """Unjittered motion from a frame to another as one from the frame's pixels to the other's.

    Args:
        motion: `[H, W, 2]`.
        frame: on whose grid the motion is.
        other: where it leads to.
    """
    difference = jitter_difference(frame, other)
    return motion if difference is None else motion + difference.astype(motion.dtype)


def shift_camera(camera: Camera, jitter: Float[Array, "2"], size: tuple[int, int]) -> Camera:
    """The camera that projects to the pixels of a jittered frame of a size `(H, W)`."""
    height, width = size
    x, y = -2 * jitter[0] / width, 2 * jitter[1] / height
    projection = jnp.asarray(camera.projection)
    shift = jnp.stack([x, y, jnp.zeros_like(x), jnp.zeros_like(x)]).astype(projection.dtype)
    return replace(camera, projection=projection + shift[:, None] * projection[3])


def on_own_pixels(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """Successive frames, whose motion leads from pixel to pixel and whose cameras project to pixels.

    Args:
        frames: in order of display, the motion of each leading to the one before it. The first one's motion leads to a
            frame that is not among them, whose jitter is not known, and is left unjittered.

    Returns:
        The frames; those without jitter, among frames without, are unchanged.
    """
    found = []
    for i, frame in enumerate(frames):
        fields = {}
        if i and frame.motion is not None and jitter_difference(frame, frames[i - 1]) is not None:
            fields["motion"] = shift_motion(jnp.asarray(frame.motion), frame, frames[i - 1])
        size = _size(frame)
        if frame.jitter is not None and frame.camera is not None and frame.camera.projection is not None and size:
            fields["camera"] = shift_camera(frame.camera, jnp.asarray(frame.jitter), size)
        found.append(replace(frame, **fields) if fields else frame)
    return tuple(found)


def _size(frame: Frame) -> tuple[int, int] | None:
    for image in (frame.color, frame.motion, *(vars(frame.gbuffer).values() if frame.gbuffer is not None else ())):
        if image is not None:
            return image.shape[0], image.shape[1]
    return None
