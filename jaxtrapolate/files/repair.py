"""Depth where nothing is, and non-finite pixels: counted, and turned into holes that no method stumbles over.

Where nothing was hit, depth is +inf, which is farther than anything. That is so

- where it is stored as +inf, or is not positive: 0 or -1 is what renderers leave where no ray hit anything;
- where the sky mask says so (above 0.5), whatever is stored there, NaN too;
- outside an EXR's data window, and beyond the limits that `jaxtrapolate.toml` states
  (`jaxtrapolate.files.description`).

An input without a mask of the sky is given the one that follows. Ordinal depth is positive by the time it comes here,
since its nearest value may be stored as 0 (`jaxtrapolate.files.packed`, `jaxtrapolate.files.pattern`). Position and
normal may be anything where nothing is; where they are not finite there, they become 0.

Colour whose alpha is 0 comes here as NaN (`jaxtrapolate.files.alpha`), and so does what a file marks as not valid.

Any other pixel is invalid where one of its stored buffers is NaN or infinite (depth: NaN or -inf). In it

- motion is NaN in both components: the warps treat it as "no vector", so the pixel is a hole of the target;
- position is `LOST` in all components and normal is 0, so that `hole_masks` marks what is fetched from there;
- every other buffer, colour included, takes the value of the nearest pixel at which that buffer is finite (0 where it
  has none, depth +inf; of depth, the nearest pixel where it is known, be it +inf); buffers that are finite there are
  left unchanged.

History and truth go through this alike. Scores leave invalid pixels out (`Sequence.invalid`).
"""

from collections.abc import Mapping

import numpy as np

LOST = 1e5
"""The position given to invalid pixels; farther from any surface than the tolerances of `hole_masks`."""


def fill_nearest(image: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """`image` `[H, W, C]` with the pixels `bad` `[H, W]` taken from the nearest other pixel; 0 where all are bad."""
    if not bad.any():
        return image
    if bad.all():
        return np.zeros_like(image)
    from scipy import ndimage

    nearest = ndimage.distance_transform_edt(bad, return_distances=False, return_indices=True)
    rows, columns = np.asarray(nearest)
    return image[rows, columns]


def nonfinite_pixels(image: np.ndarray) -> np.ndarray:
    """Bool `[H, W]`: where any channel of an image `[H, W, C]` is NaN or infinite."""
    finite = np.isfinite(image)
    if finite.all():  # The usual case; a reduction over a short last axis takes several times as long.
        return np.zeros(image.shape[:-1], bool)
    return np.asarray(~finite.all(axis=-1))


def no_depth(buffers: Mapping[str, np.ndarray]) -> dict[str, int]:
    """How many pixels have no depth, by why: "not positive", "infinite", "under the sky mask"; before `repair`."""
    depth = buffers.get("depth")
    if depth is None:
        return {}
    infinite = np.isposinf(depth)
    nothing = nothing_hit(depth) & ~infinite
    masked = buffers["sky"] > 0.5 if "sky" in buffers else np.zeros_like(nothing)
    counts = {"infinite": infinite, "not positive": nothing, "under the sky mask": masked & ~infinite & ~nothing}
    return {why: int(count) for why, where in counts.items() if (count := np.count_nonzero(where))}


def nothing_hit(depth: np.ndarray) -> np.ndarray:
    """Where stored depth says that nothing was hit: it is +inf, or finite and not positive; bool, of its shape."""
    return (depth == np.inf) | (depth <= 0) & (depth > -np.inf)


def repair(buffers: Mapping[str, np.ndarray], *, sky: bool = True) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """The buffers of one frame, repaired as the module's docstring says, and the invalid pixels.

    Args:
        buffers: float32 `[H, W, C]` by the names "color", "motion" and those of the fields of `GBuffer`.
        sky: whether the mask that follows from depth is given where there is none, in every frame alike.

    Returns:
        The buffers, and bool `[H, W]`, or `None` where every pixel is valid.
    """
    out = dict(buffers)
    depth = out.get("depth")
    if depth is not None:
        nothing = nothing_hit(depth)
        if "sky" in out:
            nothing |= out["sky"] > 0.5
        elif sky:
            out["sky"] = nothing.astype(np.float32)
        if nothing.any():
            out["depth"] = np.where(nothing, np.float32(np.inf), depth)
    empty = [out["depth"] == np.inf] if "depth" in out else []
    empty += [out["sky"] > 0.5] if "sky" in out else []
    for name in ("position", "normal"):
        if name in out and empty:
            out[name] = np.where(np.logical_or.reduce(empty) & ~np.isfinite(out[name]), np.float32(0), out[name])
    bad = {name: nonfinite_pixels(image) for name, image in out.items() if name != "depth"}
    if "depth" in out:
        bad["depth"] = np.asarray(~(out["depth"] > -np.inf)[..., 0])
    invalid = np.logical_or.reduce(list(bad.values())) if bad else np.zeros((), bool)
    if not invalid.any():
        return out, None
    replacements = {"motion": np.nan, "position": LOST, "normal": 0.0}
    for name, image in out.items():
        if name in replacements:
            out[name] = np.where(invalid[..., None], np.float32(replacements[name]), image)
        else:
            out[name] = fill_nearest(image, bad[name])
    if "depth" in out and bad["depth"].all():
        out["depth"] = np.full_like(out["depth"], np.inf)
    return out, invalid
