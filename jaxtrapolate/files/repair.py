"""Non-finite pixels: counted, and turned into holes that no method stumbles over.

A pixel is invalid when any of its stored buffers is NaN or infinite there, apart from what is legitimate:

- depth +inf means that nothing was hit. It becomes `FAR`, and where there is no other mask of the sky, it is the mask.
- position and normal may be anything at the sky; where they are not finite there, they become 0.

Colour whose alpha is 0 comes here as NaN (`jaxtrapolate.files.alpha`), and so does what a file marks as not valid.

In an invalid pixel

- motion is NaN in both components: the warps treat it as "no vector", so the pixel is a hole of the target;
- position is `LOST` in all components and normal is 0, so that `hole_masks` marks what is fetched from there;
- every other buffer, colour included, takes the value of the nearest pixel at which that buffer is finite (0 where it
  has none); buffers that are finite there are left as they are.

History and truth go through this alike. Scores leave the pixels out (`Sequence.invalid`).
"""

from collections.abc import Mapping

import numpy as np

FAR = 1e7
"""The depth that stands for +inf, in the unit of position: 100 km in centimetres, as Unreal dumps have it."""
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


def repair(buffers: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """The buffers of one frame, repaired as the module's docstring says, and the invalid pixels.

    Args:
        buffers: float32 `[H, W, C]` by the names "color", "motion" and those of the fields of `GBuffer`.

    Returns:
        The buffers, and bool `[H, W]`, or `None` where every pixel is valid.
    """
    out = dict(buffers)
    depth = out.get("depth")
    if depth is not None and np.isposinf(depth).any():
        nothing = np.isposinf(depth)
        out["depth"] = np.where(nothing, np.float32(FAR), depth)
        out.setdefault("sky", nothing.astype(np.float32))
    if "sky" in out:
        sky = out["sky"] > 0.5
        for name in ("position", "normal"):
            if name in out:
                out[name] = np.where(sky & ~np.isfinite(out[name]), np.float32(0), out[name])
    bad = {name: nonfinite_pixels(image) for name, image in out.items()}
    invalid = np.logical_or.reduce(list(bad.values())) if bad else np.zeros((), bool)
    if not invalid.any():
        return out, None
    replacements = {"motion": np.nan, "position": LOST, "normal": 0.0}
    for name, image in out.items():
        if name in replacements:
            out[name] = np.where(invalid[..., None], np.float32(replacements[name]), image)
        else:
            out[name] = fill_nearest(image, bad[name])
    return out, invalid
