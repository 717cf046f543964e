"""Inputs of the benchmark: a smooth background, before it a rectangle that moves otherwise; seeded."""

from dataclasses import dataclass

import numpy as np

SIZES = {"360p": (360, 640), "540p": (540, 960), "720p": (720, 1280), "1080p": (1080, 1920), "2160p": (2160, 3840)}


def size_of(name: str) -> tuple[int, int]:
    """`(height, width)` of "720p" or "1280x720" (width x height)."""
    if name in SIZES:
        return SIZES[name]
    width, _, height = name.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) >= 8 and int(height) >= 8):
        raise ValueError(f"size: expected one of {', '.join(SIZES)}, or WIDTHxHEIGHT from 8x8 on, got {name!r}")
    return int(height), int(width)


@dataclass(frozen=True)
class Inputs:
    """float32 `[H, W, C]` arrays of NumPy; motion leads from the target frame to the source frame.

    gray and moved_gray, 0..1, are of a texture that the motion leads from the one to the other; normal is a part of
    target_guide.
    """

    image: np.ndarray
    motion: np.ndarray
    older: np.ndarray
    depth: np.ndarray
    importance: np.ndarray
    target_guide: np.ndarray
    source_guide: np.ndarray
    gray: np.ndarray
    moved_gray: np.ndarray
    normal: np.ndarray


def make_inputs(height: int, width: int, *, seed: int = 0) -> Inputs:
    """The inputs at one size. Motion scales with the height: at 720p 2-6 pixels behind, 21 in front.

    The guides are six channels, constant over patches of 17 to 23 pixels (albedo and normal), with noise of 0.005.
    """
    random = np.random.default_rng(seed)
    unit = height / 720
    y, x = np.mgrid[:height, :width].astype(np.float64)
    u, v = x / width, y / height

    def smooth(phase):
        across = 4 * np.sin(2 * np.pi * (u + 0.3 * v) + phase) + 1.3
        along = 2 * np.cos(2 * np.pi * (0.7 * u - v) + phase) - 0.6
        return np.stack([across, along], -1) * unit

    shift = np.array([-17.3, 11.6]) * unit
    left, right, top, bottom = 0.35 * width, 0.6 * width, 0.25 * height, 0.7 * height

    def front(x, y):
        return (x >= left) & (x < right) & (y >= top) & (y < bottom)

    ahead = front(x, y)
    motion = np.where(ahead[..., None], shift, smooth(0.0))
    older = np.where(front(x - shift[0], y - shift[1])[..., None], 0.8 * shift, smooth(0.9))
    depth = np.where(ahead, 2 + 0.3 * u, 8 + 3 * v + np.sin(9 * u))[..., None]

    patches = random.uniform(size=(2, 64, 64, 6))

    def guide(x, y, ahead):
        behind = patches[0, np.floor(y / 17).astype(int) % 64, np.floor(x / 23).astype(int) % 64]
        before = patches[1, np.floor(y / 19).astype(int) % 64, np.floor(x / 17).astype(int) % 64]
        clean = np.where(ahead[..., None], before, behind)
        return clean + 0.005 * random.standard_normal(clean.shape)

    there = x + motion[..., 0], y + motion[..., 1]
    waves = np.stack([np.sin(0.11 * x * k + 0.07 * y) * np.cos(0.05 * y * k) for k in (1.0, 1.7, 2.3)], -1)
    image = 0.5 + 0.3 * waves + 0.1 * random.uniform(size=waves.shape)

    def texture(x, y):
        return 0.5 + sum(0.12 * np.sin(k * (0.11 * x + 0.07 * y)) * np.cos(k * 0.05 * y) for k in (1.0, 1.7, 2.3))

    target_guide = guide(*there, ahead)
    arrays = {
        "image": image,
        "motion": motion,
        "older": older,
        "depth": depth,
        "importance": -depth,
        "target_guide": target_guide,
        "source_guide": guide(x, y, front(x - shift[0], y - shift[1])),
        "gray": texture(*there)[..., None],
        "moved_gray": texture(x, y)[..., None],
        "normal": target_guide[..., :3],
    }
    return Inputs(**{name: np.ascontiguousarray(a, np.float32) for name, a in arrays.items()})
