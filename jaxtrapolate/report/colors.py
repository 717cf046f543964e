"""The colours of pictures and plots: error maps, causes, methods."""

import matplotlib
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jaxtrapolate.ops.causes import CAUSES

CAUSE_COLORS = {
    "border": "#009e73",
    "hole": "#d55e00",
    "shadow": "#cc79a7",
    "glossy": "#56b4e9",
    "edge": "#f0e442",
    "rest": "#2b2f36",
}
"""A fixed colour for each cause: the set of Okabe and Ito, told apart by the colour-blind too; the rest is dark."""

CAUSE_TEXTS = {
    "border": "the motion leads beyond the frame",
    "hole": "the surface was hidden in the rendered frame",
    "shadow": "a moving shadow came or went",
    "glossy": "a mirror-like surface, roughness below 0.3",
    "edge": "within 2 pixels of a jump of depth or normal",
    "rest": "none of these",
}
"""What each cause means, for a legend."""

METHOD_COLORS = ("#2f7ed8", "#d9630a", "#12926b", "#c2479b", "#7f63d8", "#a37a00", "#0c8fa8", "#d4423e", "#7a7f87")
"""Colours of methods, in their order in the results, of at least 3:1 on white and on the dark page."""

METHOD_MARKERS = "osD^vPX*h"
"""Markers of methods, so that plots do not depend on colour alone."""

ERROR_LIMIT = 0.25
"""The error at which an error map is saturated, in display values: a quarter of the way from black to white."""

_ERROR_MAP = "inferno"
_STEPS = 32  # of the error map, so that pictures stay small: 2 codes of 8 bits each at the usual limit
_NOT_FINITE = (0, 255, 255)


def _table() -> np.ndarray:
    """The 256 colours of the error map, `[256, 3]` uint8, dark to bright."""
    return (matplotlib.colormaps[_ERROR_MAP](np.arange(256))[:, :3] * 255).round().astype(np.uint8)


def colorize_error(
    error: Float[Array | np.ndarray, "h w"] | Float[Array | np.ndarray, "h w c"], *, limit: float = ERROR_LIMIT
) -> UInt8[np.ndarray, "h w 3"]:
    """An error as a picture, from black (none) through red to light yellow (`limit` or more).

    Args:
        error: `[H, W]` or `[H, W, C]`, differences of display values in 0..1, signed or not: the mean over the channels
            of the absolute value is shown.
        limit: the error at the bright end. The report's legend states `ERROR_LIMIT`, so leave it for pictures there.

    Returns:
        `[H, W, 3]` uint8, matplotlib's "inferno" in 33 colours, which is perceptually ordered and readable without
        colour. Pixels that are not finite are cyan, which the map does not have.

    Raises:
        ValueError: another rank, or a limit that is not above 0.
    """
    error = np.abs(np.asarray(error, np.float32))
    if error.ndim not in (2, 3):
        raise ValueError(f"error: expected shape [H, W] or [H, W, C], got {list(error.shape)}")
    if not limit > 0:
        raise ValueError(f"limit: expected a number above 0, got {limit}")
    if error.ndim == 3:
        error = error.mean(-1)
    finite = np.isfinite(error)
    level = np.clip(np.where(finite, error, 0) * (_STEPS / limit), 0, _STEPS).round() * (255 / _STEPS)
    picture = _table()[level.round().astype(np.uint8)]
    picture[~finite] = _NOT_FINITE
    return picture


def colorize_causes(index_map: Int[Array | np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """A `cause_map` as a picture in the colours of `CAUSE_COLORS`, which the report's legend shows.

    Args:
        index_map: `[H, W]`, indices into `jaxtrapolate.ops.causes.CAUSES`.

    Returns:
        `[H, W, 3]` uint8.

    Raises:
        ValueError: another rank, or an index that is no cause.
    """
    index_map = np.asarray(index_map)
    if index_map.ndim != 2:
        raise ValueError(f"index_map: expected shape [H, W], got {list(index_map.shape)}")
    if index_map.size and not (index_map.min() >= 0 and index_map.max() < len(CAUSES)):
        found = f"{index_map.min()}..{index_map.max()}"
        raise ValueError(f"index_map: expected indices 0..{len(CAUSES) - 1} ({', '.join(CAUSES)}), got {found}")
    table = np.array([tuple(bytes.fromhex(CAUSE_COLORS[cause][1:])) for cause in CAUSES], np.uint8)
    return table[index_map]


def error_gradient(stops: int = 12) -> str:
    """The error map as a CSS gradient, dark end first, for a legend."""
    rows = _table()[np.linspace(0, 255, stops).round().astype(int)]
    return f"linear-gradient(to right, {', '.join('#' + bytes(row).hex() for row in rows)})"


def method_style(index: int) -> tuple[str, str]:
    """Colour and marker of the index-th method; with many methods, colours come again with other markers."""
    return METHOD_COLORS[index % len(METHOD_COLORS)], METHOD_MARKERS[(index * 10 // 9) % len(METHOD_MARKERS)]
