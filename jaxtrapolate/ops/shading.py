"""The motion of light over surfaces: optical flow between two images of the same surfaces.

Motion vectors follow surfaces; shadows and highlights move over them. Once two older frames are warped to one raster by
motion vectors and divided by what the surfaces reflect, all that still differs between them is light.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrapolate.checks import ArrayLike, check_image
from jaxtrapolate.ops.dis import Effort, Guidance, inverse_search_flow, level_sizes, like
from jaxtrapolate.ops.fill import check_mask, fill_pyramid
from jaxtrapolate.ops.refinement import Weights, shifted
from jaxtrapolate.ops.resample import BRIGHTEST, fetch, resize
from jaxtrapolate.ops.strips import once
from jaxtrapolate.ops.warp import pixel_grid
from jaxtrapolate.precision import divide, widest

_STRIDE, _STEPS, _REFINEMENTS = 3, 3, 2  # of the inverse search: those of the preset "medium"
_ROWS = 180  # of the working resolution; with 360 a frame of 720 rows takes two to three times as long
_FAR = 1e15  # of guides, in sigmas: no difference's square overflows
_SOFT = 0.1  # of the gain: from none of the confidence to all of it
_UNLIKE = 1e-4  # what a pixel counts at least that is unlike, where no other is left


def _around(values, weights: Weights, count: int):
    """Sums over what is around each pixel, passed on from neighbour to neighbour as far as they are alike."""
    height, width = values.shape
    right = weights.right * (jnp.arange(width) < width - 1).astype(weights.right.dtype)[None, :]
    below = weights.below * (jnp.arange(height) < height - 1).astype(weights.below.dtype)[:, None]
    left, above = shifted(right, 1, 1), shifted(below, 0, 1)

    def spread(values, _):
        across = right * shifted(values, 1, -1) + left * shifted(values, 1, 1)
        return (values + across + below * shifted(values, 0, -1) + above * shifted(values, 0, 1)) / 5, None

    return jax.lax.scan(spread, values, None, length=count)[0]


def _guided_enlarged(values, guidance: Guidance, guide):
    """Images `[N, h, w]` at the size of the guide `[G, H, W]`: linear, but from the pixels that are like."""
    size = guide.shape[1:]
    lower, further = [], []
    for old, new in zip(values.shape[1:], size, strict=True):
        at = np.clip((np.arange(new) + 0.5) * old / new - 0.5, 0, old - 1)
        lower.append(np.minimum(at.astype(int), max(old - 2, 0)))
        further.append(np.asarray(at - lower[-1], values.dtype))
    # columns first, where there are fewer rows; values and guides apart, so that each is fetched where it is used
    indices = [[np.minimum(low + k, old - 1) for k in (0, 1)] for low, old in zip(lower, values.shape[1:], strict=True)]
    images = once([[jnp.take(a, beside, 2) for a in (values, guidance.guide)] for beside in indices[1]])
    places = [(j, i) for j in (0, 1) for i in (0, 1)]
    shares = [np.outer(*(f if k else 1 - f for f, k in zip(further, place, strict=True))) for place in places]
    alike = [like(tuple(jnp.take(images[i][1], indices[0][j], 1)), tuple(guide)) for j, i in places]
    weights = once([(weight + _UNLIKE) * share for weight, share in zip(alike, shares, strict=True)])
    parts = [w[None] * jnp.take(images[i][0], indices[0][j], 1) for w, (j, i) in zip(weights, places, strict=True)]
    return sum(parts[1:], parts[0]) / sum(weights[1:], weights[0])[None]


def _confidence(newer, older, flow, guidance: Guidance, options):
    """How much of what changed between two images, 0..1, the flow explains: 0..1."""
    least_gain, least_change, reach = options
    height, width = newer.shape
    columns, rows = pixel_grid(height, width, newer.dtype)
    x, y = columns + jnp.real(flow), rows + jnp.imag(flow)
    seen = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    valid = jnp.where(seen, guidance.valid * fetch(guidance.valid, x, y), 0)
    weights = guidance.of_neighbours()
    still, moved = jnp.square(newer - older), jnp.square(newer - fetch(older, x, y))
    count, still, moved = (_around(once(a * valid), weights, reach) for a in (jnp.ones_like(newer), still, moved))
    still, moved = divide(still, count), divide(moved, count)
    gain = 1 - divide(moved, still, otherwise=1)
    explained = jnp.clip((gain - least_gain) / _SOFT, 0, 1)
    changed = jnp.clip(divide(still, least_change, where=least_change > 0, otherwise=2) - 1, 0, 1)
    return explained * changed


def _round_trip(flow, back, allowed):
    """1 where the flow back leads to where the flow came from, 0 where it is off by twice what is allowed."""
    height, width = flow.shape
    columns, rows = pixel_grid(height, width, jnp.real(flow).dtype)
    x, y = columns + jnp.real(flow), rows + jnp.imag(flow)
    off = jnp.square(jnp.real(flow) + fetch(jnp.real(back), x, y))
    off = off + jnp.square(jnp.imag(flow) + fetch(jnp.imag(back), x, y))
    return jnp.clip(2 - jnp.sqrt(off + jnp.finfo(off.dtype).tiny) / allowed, 0, 1)


@partial(jax.jit, static_argnames=("finest", "reach"))
def _shading_flow(
    newer, older, guide, valid, sigma_guide, least_gain, least_change, round_trip, *, finest, reach
) -> tuple[Array, Array]:
    wide, size = widest(newer, older), (newer.shape[0], newer.shape[1])
    finite = jnp.all(jnp.isfinite(newer), -1) & jnp.all(jnp.isfinite(older), -1)
    valid = finite if valid is None else finite & valid
    if guide is not None:
        known = jnp.isfinite(guide)
        valid &= jnp.all(known, -1)
        sigma = jnp.maximum(jnp.asarray(sigma_guide, wide), 1 / _FAR)
        guide = jnp.clip(jnp.where(known, guide, 0).astype(wide) / sigma, -_FAR, _FAR)
    guides = jnp.zeros((1, *size), wide) if guide is None else once(jnp.moveaxis(guide, -1, 0))
    least_gain, least_change = (jnp.asarray(a, wide) for a in (least_gain, least_change))
    guidance = Guidance(guides, valid.astype(wide))

    def gray(image):
        held = jnp.clip(jnp.where(valid[..., None], image, 0).astype(wide), -BRIGHTEST, BRIGHTEST)
        return fill_pyramid(jnp.mean(held, -1, keepdims=True), valid)[..., 0]

    first, second = gray(newer), gray(older)
    effort = Effort(finest, _STRIDE, _STEPS, _REFINEMENTS)
    flow = inverse_search_flow(first * 255, second * 255, effort, guidance)
    small = flow.shape[0], flow.shape[1]
    level = guidance if small == size else guidance.resized(small)
    for shape in level_sizes(size)[1:]:
        if first.shape != small:
            first, second = (resize(a, shape, kind="area") for a in (first, second))
    confidence = _confidence(first, second, flow, level, (least_gain, least_change, reach))
    if round_trip is not None:
        back = inverse_search_flow(gray(older) * 255, gray(newer) * 255, effort, guidance)
        confidence = confidence * _round_trip(flow, back, jnp.asarray(round_trip, wide))
    if small == size:
        parts = jnp.stack([jnp.real(flow), jnp.imag(flow), confidence])
    else:
        scale = [new / old for new, old in zip(size, small, strict=True)]
        parts = jnp.stack([jnp.real(flow) * scale[1], jnp.imag(flow) * scale[0], confidence])
        parts = once(_guided_enlarged(parts, level, guides))
    confidence = jnp.where(valid, parts[2], 0)
    flow = jnp.where((confidence > 0)[..., None], jnp.stack([parts[0], parts[1]], -1), 0)
    return flow.astype(newer.dtype), confidence[..., None].astype(newer.dtype)


def shading_flow(
    newer: Float[ArrayLike, "h w c"],
    older: Float[ArrayLike, "h w c"],
    *,
    guide: Float[ArrayLike, "h w g"] | None = None,
    valid: Bool[ArrayLike, "h w"] | None = None,
    sigma_guide: float | Float[ArrayLike, ""] = 0.2,
    finest: int | None = None,
    reach: int = 4,
    least_gain: float | Float[ArrayLike, ""] = 0.3,
    least_change: float | Float[ArrayLike, ""] = 3e-5,
    round_trip: float | Float[ArrayLike, ""] | None = None,
) -> tuple[Float[Array, "h w 2"], Float[Array, "h w 1"]]:
    """The motion of light over surfaces that lie still in both images: p of the newer is at p + flow[p] of the older.

    Both images show the same surfaces at the same pixels: frames of two times, warped to one raster and demodulated. So
    light of the newer image goes on by the same way: after a fraction s of the time between the two, what is at p was
    at p + s flow[p] of the newer (`backward_warp` with s flow).

    The flow is that of `dis_flow`, in windows that stop at silhouettes: what counts in a patch is like its middle by
    the guide, what the refinement smooths is like its neighbour. Where the flow does not explain what changed it is 0.

    Args:
        newer: `[H, W, C]`, demodulated and as displayed: after a tone curve, about 0..1. Channels are averaged.
        older: likewise.
        guide: `[H, W, G]`, what tells surfaces apart that light does not go on across: normals, depths in units of
            their jumps, ids; no albedo, as the texture of a floor is no border of its light. `None`: there is none.
        valid: bool `[H, W]`, False in holes of either image, which have no weight. `None`: all are.
        sigma_guide: guides that differ by this count exp(-1/2) for each other.
        finest: the working resolution: the flow is found at 1 / 2^finest of the size (0: at the size itself), and
            enlarged from pixels with like guides. `None`: at half the size, or less as long as 180 rows are left.
        reach: how many pixels of the working resolution what changed is averaged over.
        least_gain: share of the squared change, 0..1, that the flow must explain; all of the confidence is there
            from 0.1 more on.
        least_change: squared difference of the images under which nothing has changed; all of the confidence is there
            from twice that on. Also what has no texture does not change.
        round_trip: pixels of the working resolution by which the flow back may miss; from twice that on there is no
            confidence. `None`: the flow back is not made. Shadows that appear or vanish at a border have none.

    Returns:
        The flow `[H, W, 2]` in pixels, and how far to trust it `[H, W, 1]`, 0..1: a weight for what is made by it
        against what is made without. Both of the dtype of `newer`; computed in at least float32.

    Convention:
        Pull: pixels to add, x right, y down.

    Exactness:
        Equal images have no flow and no confidence, exactly.

    Edge cases:
        Pixels that are not finite, in an image or in the guide, are holes; light is held to -1000..1000. In holes both
        results are 0. Light that appears, vanishes or blinks without moving is explained by no flow.

    Gradient:
        With respect to both images, the guide and the numbers; which steps the search takes, and where the flow
        is 0, is held fixed.

    Raises:
        TypeError, ValueError: no floating-point array, shapes that do not fit, or an option that does not.

    References:
        Ours; the flow is Kroeger et al. 2016 (see `dis_flow`).
    """
    size = check_image("newer", newer)
    check_image("older", older, size=size, channels=newer.shape[-1])
    if guide is not None:
        check_image("guide", guide, size=size)
    if valid is not None:
        check_mask("valid", valid, size=size)
    finest = max(1, int(np.log2(min(size) / _ROWS))) if finest is None else finest
    for name, value in (("finest", finest), ("reach", reach)):
        if value < 0:
            raise ValueError(f"{name}: expected 0 or more, got {value!r}")
    numbers = sigma_guide, least_gain, least_change, round_trip
    return _shading_flow(newer, older, guide, valid, *numbers, finest=finest, reach=reach)
