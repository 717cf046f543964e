"""A small sequence whose motion is exact by construction: a textured wall, a box moving before it, a panning view."""

import numpy as np

from jaxtrapolate.files import MotionConvention, Sequence
from jaxtrapolate.records import Frame, GBuffer, Keyframe

PAN = np.array([1.5, -0.5])  # what the view moves by, pixels a frame
BOX = np.array([2.0, 1.0])  # what the box moves by on the screen
FAR, NEAR = 10.0, 4.0


def texture(u, v, phase=0.0):
    """A smooth colour texture `[H, W, 3]`."""
    waves = [np.sin(0.37 * u + 0.21 * v + phase + k) + np.cos(0.23 * u - 0.31 * v + 2 * k) for k in range(3)]
    return 0.5 + 0.2 * np.stack(waves, -1)


def make_frame(time: int, size=(32, 48), *, fog: float = 0.0) -> Frame:
    """Frame number `time` with every buffer; `fog` is how much of the colour does not depend on the albedo."""
    height, width = size
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    u, v = x + PAN[0] * time, y + PAN[1] * time
    left, top = 6 + BOX[0] * time, 5 + BOX[1] * time
    box = (x >= left) & (x < left + 14) & (y >= top) & (y < top + 10)
    albedo = np.where(box[..., None], texture(x - left, y - top, 1.0), texture(u, v))
    light = 1.0 + 0.5 * np.sin(0.02 * u)
    color = (1 - fog) * albedo * light[..., None] + fog * 0.6
    motion = np.where(box[..., None], -BOX, PAN)
    depth = np.where(box, NEAR, FAR)
    position = np.stack([np.where(box, x, u), np.where(box, y, v), depth], -1) / 10
    normal = np.where(box[..., None], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0])

    def f32(a):
        a = np.asarray(a, np.float32)
        return a if a.ndim == 3 else a[..., None]

    one = np.ones(size)
    gbuffer = GBuffer(
        albedo=f32(albedo),
        depth=f32(depth),
        normal=f32(normal),
        position=f32(position),
        roughness=f32(0.8 * one),
        metallic=f32(0 * one),
        specular=f32(0 * one),
        n_dot_v=f32(one),
        stencil=f32(box),
        shadow=f32(0 * one),
    )
    return Frame(color=f32(color), gbuffer=gbuffer, motion=f32(motion), time=float(time))


def make_keyframe(time: int, size=(32, 48)) -> Keyframe:
    """The 3D flows of a frame: nothing changes its depth."""
    frame = make_frame(time, size)
    still = np.zeros((*size, 1), np.float32)
    backward = np.concatenate([frame.motion, still], -1)
    return Keyframe(
        color=frame.color,
        depth=frame.gbuffer.depth,
        stencil=frame.gbuffer.stencil,
        forward_flow=-backward,
        backward_flow=backward,
        time=frame.time,
    )


class SyntheticSequence(Sequence):
    """The sequence in memory; `numbers` may have gaps."""

    def __init__(self, numbers=range(8), size=(32, 48), fog=0.0):
        self.name, self.numbers, self.size, self.hdr = "synthetic", tuple(numbers), size, True
        self.convention, self.depth, self.forward_motion, self.fog = MotionConvention(), "metric", True, fog

    def frame(self, number):
        return make_frame(number, self.size, fog=self.fog)

    def stored_motion(self, number):
        return self.frame(number).motion

    def keyframe(self, number):
        return make_keyframe(number, self.size)


def _rotation(axis, angle):
    """Rodrigues' formula."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def static_scene(size=(48, 64), *, turn=0.02, shift=(0.1, -0.05, 0.2), zoom=1.0, seed=0):
    """Depth and motion of random smooth relief before a camera that moved, by projecting every point; ids in blocks."""
    height, width = size
    y, x = np.mgrid[:height, :width].astype(np.float64)
    rng = np.random.default_rng(seed)
    waves = sum(rng.normal() * np.sin(rng.normal() * x / 9 + rng.normal() * y / 7 + k) for k in range(6))
    depth = 6 + waves
    focal, there = 50.0, 50.0 * zoom
    points = np.stack([(x - 31) * depth / focal, (y - 23) * depth / focal, depth], -1)
    moved = points @ _rotation([1, 2, -1], turn).T + np.asarray(shift)
    place = moved[..., :2] / moved[..., 2:] * there + [31, 23]
    ids = 1 + (y // 16) * 4 + x // 16
    return depth[..., None], place - np.stack([x, y], -1), ids[..., None].astype(np.float32)
