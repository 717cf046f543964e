"""Losses of the networks: pure functions of two images `[H, W, C]`; map them over batches by `vmap`.

Images are in the log domain (`jaxtrapolate.log_encode`), mask `[H, W, 1]` is 1 where the warped frame is valid and 0 in
holes. Sums are taken in at least float32.

Non-finite values:
    A value of the target that is not finite counts nowhere, and has no gradient: there is nothing to learn from it. A
    prediction that is not finite where the target is gives a loss that is NaN or infinite, so that a training run sees
    it.
"""

from functools import partial
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_array, check_choice, check_image
from jaxtrapolate.precision import divide, widest

Shade = Literal["release", "paper"]


def _difference(prediction, target):
    """prediction - target, 0 where the target is not finite, and where it is finite."""
    size = check_image("prediction", prediction)
    check_image("target", target, size=size, channels=prediction.shape[-1])
    wide = widest(prediction, target)
    finite = jnp.isfinite(target)
    prediction, target = (jnp.where(finite, a, 0).astype(wide) for a in (prediction, target))
    return prediction - target, finite


def _absolute(x):
    """|x|, with derivative 0 at 0."""
    return x * jax.lax.stop_gradient(jnp.sign(x))


def _count(chosen, like, axis=None):
    return jnp.sum(chosen, axis, dtype=like.dtype)


@jax.jit
def l1_loss(prediction: Float[Array, "h w c"], target: Float[Array, "h w c"]) -> Float[Array, ""]:
    """The mean absolute difference.

    Args:
        prediction: `[H, W, C]`.
        target: the ground truth, of the same shape.

    Returns:
        A scalar; 0 where nothing counts. The gradient is the sign of the difference over the count, 0 where it is 0.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that differ.

    References:
        Guo et al. 2021 (ExtraNet), eq. 4, taken over pixels and channels as in the release.
    """
    difference, finite = _difference(prediction, target)
    return divide(jnp.sum(_absolute(difference)), _count(finite, difference))


@jax.jit
def charbonnier_loss(
    prediction: Float[Array, "h w c"],
    target: Float[Array, "h w c"],
    *,
    epsilon: float | Float[Array, ""] = 1e-3,
) -> Float[Array, ""]:
    """The mean of sqrt(d^2 + epsilon^2): the absolute difference, smooth where it is small.

    Args:
        prediction: `[H, W, C]`.
        target: the ground truth, of the same shape.
        epsilon: where it bends, in units of the images.

    Returns:
        A scalar, `epsilon` for equal images; 0 where nothing counts. The gradient is d / sqrt(d^2 + epsilon^2) over the
        count.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that differ.

    References:
        Charbonnier et al. 1994; Kong et al. 2022 (IFRNet) with this epsilon.
    """
    difference, finite = _difference(prediction, target)
    values = jnp.hypot(difference, jnp.asarray(epsilon, difference.dtype))  # also where a square would overflow
    return divide(jnp.sum(jnp.where(finite, values, 0)), _count(finite, difference))


@jax.jit
def hole_loss(
    prediction: Float[Array, "h w c"], target: Float[Array, "h w c"], mask: Float[Array, "h w 1"]
) -> Float[Array, ""]:
    """The mean absolute difference in holes.

    Args:
        prediction: `[H, W, C]`.
        target: the ground truth, of the same shape.
        mask: `[H, W, 1]`, 1 = valid, 0 = hole; values between count in part.

    Returns:
        A scalar; 0, with gradient 0, without holes, where the release has 0 / 0.

    Gradient:
        With respect to prediction and target, and to the mask where it is below 1.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that do not fit.

    References:
        Guo et al. 2021 (ExtraNet), eq. 5, the mask counted in each channel as in the release. That takes one mean over
        the holes of a whole batch; ours is of one image.
    """
    difference, finite = _difference(prediction, target)
    check_array("mask", mask, shape=(*difference.shape[:2], 1))
    weight = jnp.where(finite, 1 - mask.astype(difference.dtype), 0)
    error = _absolute(jnp.where(weight > 0, difference, 0))  # so that what is valid does not count, whatever it holds
    return divide(jnp.sum(weight * error), jnp.sum(weight))


@partial(jax.jit, static_argnames=("shade",))
def shading_loss(
    prediction: Float[Array, "h w c"],
    target: Float[Array, "h w c"],
    *,
    shade: Shade = "release",
    fraction: float | Float[Array, ""] = 0.1,
) -> Float[Array, ""]:
    """The mean of the largest absolute differences, the tenth of a frame where its shading may have changed.

    Args:
        prediction: `[H, W, C]`.
        target: the ground truth, of the same shape.
        shade: "release": the largest in each channel, and the mean over channels; "paper": the pixels whose mean over
            channels is the largest.
        fraction: of the pixels whose target is finite (of channels at "release", in all channels at "paper"); rounded
            down, but at least one.

    Returns:
        A scalar; 0 where nothing counts.

    Gradient:
        With respect to prediction and target: of the differences that are chosen. Those equal to the smallest chosen
        share its weight. None with respect to `fraction`, which only counts.

    Raises:
        TypeError, ValueError: no floating-point array, shapes that differ, or an unknown `shade`.

    References:
        Guo et al. 2021 (ExtraNet), eq. 6.
    """
    check_choice("shade", shade, get_args(Shade))
    difference, finite = _difference(prediction, target)
    error = _absolute(difference)
    if shade == "paper":
        finite = jnp.all(finite, -1, keepdims=True)
        error = jnp.where(finite, jnp.mean(error, -1, keepdims=True), 0)
    error, finite = (a.reshape(-1, a.shape[-1]) for a in (error, finite))
    kept = jnp.floor(jnp.asarray(fraction, error.dtype) * _count(finite, error, 0))
    kept = jnp.clip(kept, 1, error.shape[0])[None]
    ordered = jnp.sort(jax.lax.stop_gradient(error), 0)
    smallest = jnp.take_along_axis(ordered, error.shape[0] - kept.astype(jnp.int32), 0)
    above, equal = error > smallest, error == smallest
    share = (kept - _count(above, error, 0)[None]) / jnp.maximum(_count(equal, error, 0), 1)[None]
    weight = jnp.where(above, 1, jnp.where(equal, share, 0))
    return jnp.mean(jnp.sum(weight * error, 0, keepdims=True) / kept)  # 0 times NaN is NaN: it shall be seen


@partial(jax.jit, static_argnames=("shade",))
def extranet_loss(
    prediction: Float[Array, "h w c"],
    target: Float[Array, "h w c"],
    mask: Float[Array, "h w 1"],
    *,
    hole_weight: float | Float[Array, ""] = 1.0,
    shade_weight: float | Float[Array, ""] = 1.0,
    shade: Shade = "release",
    fraction: float | Float[Array, ""] = 0.1,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """ExtraNet's loss: `l1_loss` + hole_weight `hole_loss` + shade_weight `shading_loss`.

    Args:
        prediction: `[H, W, C]`, in the log domain.
        target: the ground truth, of the same shape.
        mask: `[H, W, 1]`, 1 = valid, 0 = hole.
        hole_weight: of `hole_loss`, the paper's lambda.
        shade_weight: of `shading_loss`, likewise.
        shade: as in `shading_loss`.
        fraction: as in `shading_loss`.

    Returns:
        The total, and its parts without their weights: "l1", "hole", "shade".

    Gradient:
        Finite everywhere for finite predictions; 0 where the images are equal.

    Raises:
        TypeError, ValueError: no floating-point array, shapes that do not fit, or an unknown `shade`.

    References:
        Guo et al. 2021 (ExtraNet), eq. 7.
    """
    parts = {
        "l1": l1_loss(prediction, target),
        "hole": hole_loss(prediction, target, mask),
        "shade": shading_loss(prediction, target, shade=shade, fraction=fraction),
    }
    hole_weight, shade_weight = (jnp.asarray(a, parts["l1"].dtype) for a in (hole_weight, shade_weight))
    return parts["l1"] + hole_weight * parts["hole"] + shade_weight * parts["shade"], parts


@jax.jit
def relative_loss(
    prediction: Float[Array, "h w c"],
    target: Float[Array, "h w c"],
    guess: Float[Array, "h w c"],
    *,
    epsilon: float | Float[Array, ""] = 1e-6,
) -> Float[Array, ""]:
    """The share of a first guess's squared error that is left: 1 as good as the guess, 0 exact.

    Its mean over frames is what decibels average: a tenth less is 0.46 dB, in easy frames as in hard ones.

    Args:
        prediction: `[H, W, C]`.
        target: the ground truth, of the same shape.
        guess: what the network improves on, of the same shape.
        epsilon: mean squared error that is added to the guess's.

    Returns:
        A scalar; 0 where nothing counts.

    Gradient:
        With respect to the prediction; the guess is only a measure.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that differ.
    """
    difference, finite = _difference(prediction, target)
    before, _ = _difference(jax.lax.stop_gradient(guess), target)
    count = _count(finite, difference)
    scale = divide(jnp.sum(jnp.square(before)), count) + jnp.asarray(epsilon, difference.dtype)
    return divide(jnp.sum(jnp.square(difference)), count) / scale
