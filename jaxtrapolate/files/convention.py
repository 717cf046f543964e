"""Motion vectors between the convention of a file and the library's own; the arithmetic is `convert_motion`'s.

Plain NumPy: what reads files computes nothing with JAX, so that a data loader may fork its workers after JAX was used.
"""

import numpy as np

from jaxtrapolate.files.sequence import MotionConvention


def convert(motion: np.ndarray, convention: MotionConvention) -> np.ndarray:
    """Stored vectors `[H, W, 2]` as pixels to add, y down, to reach the previous frame; float32.

    As `jaxtrapolate.convert_motion`, but a NumPy array on the host. Non-finite vectors stay non-finite.
    """
    return np.asarray(motion, np.float32) * _factors(convention, *motion.shape[:2])


def unconvert(motion: np.ndarray, convention: MotionConvention) -> np.ndarray:
    """The inverse of `convert`: vectors of the library as a file with this convention states them; float32."""
    return np.asarray(motion, np.float32) / _factors(convention, *motion.shape[:2])


def _factors(convention: MotionConvention, height: int, width: int) -> np.ndarray:
    """What a vector (1, 1) becomes; the conversion is linear in each component."""
    span = {"pixels": (1.0, 1.0), "uv": (width, height), "ndc": (width / 2, height / 2)}[convention.units]
    forward = -1.0 if convention.sign == "current_minus_previous" else 1.0
    down = -1.0 if convention.y_axis == "up" else 1.0
    return np.array([span[0] * forward, span[1] * forward * down], np.float32)
