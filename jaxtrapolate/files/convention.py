"""Motion vectors between the convention of a file and the library's own; the arithmetic is `convert_motion`'s."""

import dataclasses
import functools

import numpy as np

from jaxtrapolate.files.sequence import MotionConvention
from jaxtrapolate.motion import convert_motion


def convert(motion: np.ndarray, convention: MotionConvention) -> np.ndarray:
    """Stored vectors `[H, W, 2]` as pixels to add, y down, to reach the previous frame; float32.

    As `jaxtrapolate.convert_motion`, but a NumPy array on the host. Non-finite vectors stay non-finite.
    """
    return np.asarray(motion, np.float32) * _factors(convention, *motion.shape[:2])


def unconvert(motion: np.ndarray, convention: MotionConvention) -> np.ndarray:
    """The inverse of `convert`: vectors of the library as a file with this convention states them; float32."""
    return np.asarray(motion, np.float32) / _factors(convention, *motion.shape[:2])


@functools.lru_cache(maxsize=16)
def _factors(convention: MotionConvention, height: int, width: int) -> np.ndarray:
    """What a vector (1, 1) becomes; the conversion is linear in each component."""
    ones = np.ones((height, width, 2), np.float32)
    return np.array(convert_motion(ones, **dataclasses.asdict(convention))[0, 0])
