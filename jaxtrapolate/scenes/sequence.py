"""A scene as a `Sequence`, the interface that commands and methods read."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrapolate.files.sequence import MotionConvention, Sequence
from jaxtrapolate.records import Frame, Keyframe, R
from jaxtrapolate.scenes.render import keyframe, render, visible
from jaxtrapolate.scenes.worlds import scene


class SceneSequence(Sequence):
    """Frames first, first + 1, ... of an embedded scene, rendered when asked for.

    Args:
        name: of the scene; see `scene_names`.
        seed: see `scene`.
        frames: how many.
        size: `(H, W)`.
        first: number and time of the first frame.
        samples: colour samples a pixel.
        jittered: whether the samples of each frame are shifted by a fraction of a pixel, another one each frame: by
            `jitter_of` its number.
        scale: how many times larger the frames of `larger` are in each direction; 1 for none.
        larger_samples: colour samples a pixel of those.
    """

    def __init__(
        self,
        name: str,
        seed: int = 0,
        frames: int = 60,
        size: tuple[int, int] = (180, 320),
        *,
        first: int = 0,
        samples: int = 1,
        jittered: bool = False,
        scale: int = 1,
        larger_samples: int = 16,
    ) -> None:
        if scale < 1:
            raise ValueError(f"scale: expected at least 1, got {scale}")
        if frames < 1:
            raise ValueError(f"frames: expected at least 1, got {frames}")
        self.scene = scene(name, seed)
        self.name = f"{name}-{seed}"
        self.numbers = tuple(range(first, first + frames))
        self.size = (int(size[0]), int(size[1]))
        self.hdr = True
        self.convention = MotionConvention()
        self.depth = "metric"
        self.forward_motion = True
        self.samples, self.jittered = samples, jittered
        if scale > 1:
            size = self.size[0] * scale, self.size[1] * scale
            self.larger = SceneSequence(name, seed, frames, size, first=first, samples=larger_samples)

    def identity(self) -> dict[str, Any]:
        """The samples a pixel, beside what all sequences have; the name holds the seed."""
        return super().identity() | {"samples": self.samples, "jittered": self.jittered}

    def frame(self, number: int) -> Frame:
        """The frame with every buffer."""
        self._check(number)
        jitter = jnp.asarray(jitter_of(number)) if self.jittered else None
        return _arrays(render(self.scene, float(number), size=self.size, samples=self.samples, jitter=jitter))

    def stored_motion(self, number: int) -> np.ndarray:
        """The frame's motion, which is in the library's own convention."""
        return np.asarray(self.frame(number).motion)

    def keyframe(self, number: int) -> Keyframe:
        """The frame with its exact flows to the frames after and before it."""
        self._check(number)
        time = float(number)
        return _arrays(keyframe(self.scene, time, size=self.size, next_time=time + 1, previous_time=time - 1))

    def visible(self, number: int, other: int) -> np.ndarray:
        """The exact `visible`, bool `[H, W]`, from one frame to another."""
        return np.asarray(visible(self.scene, float(number), float(other), size=self.size))

    def _check(self, number: int) -> None:
        if number not in self.numbers:
            raise ValueError(f"number: expected {self.numbers[0]} to {self.numbers[-1]}, got {number}")


def jitter_of(number: int) -> np.ndarray:
    """The jitter `[2]` of a frame in pixels, -1/2 to 1/2: the first 16 Halton points of bases 2 and 3, in turn."""
    index, found = number % 16 + 1, []
    for base in (2, 3):
        value, rest, digit = 0.0, index, 1.0
        while rest:
            digit /= base
            value += digit * (rest % base)
            rest //= base
        found.append(value - 0.5)
    return np.asarray(found, np.float32)


def _arrays(value: R) -> R:
    return jax.tree.map(np.asarray, value)
