"""Radiance: demodulation by the material, logarithm, tone map, sRGB, each with its inverse."""

from functools import partial
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_choice, check_image, check_present
from jaxtrapolate.precision import divide, widest
from jaxtrapolate.records import GBuffer, check_gbuffer

By = Literal["albedo+specular", "albedo", "none"]


@partial(jax.jit, static_argnames=("by",))
def demodulation_divisor(
    gbuffer: GBuffer, *, by: By = "albedo+specular", floor: float | Float[Array, ""] = 1e-2
) -> Float[Array, "h w 3"]:
    """What `demodulate` divides by: the reflectance, floored, and 1 at the sky.

    Args:
        gbuffer: with albedo; specular and metallic for "albedo+specular", where they are there: without specular it is
            the albedo alone, without metallic that is taken as 0. sky, where it is there.
        by: "albedo+specular": albedo + 0.08 specular (1 - metallic); "albedo"; or "none": 1 everywhere.
        floor: the smallest divisor, per channel.

    Raises:
        ValueError: an unknown `by`, no albedo, or with "none" no buffer at all.
    """
    check_choice("by", by, get_args(By))
    size = check_gbuffer("gbuffer", gbuffer)
    if by == "none":
        if size is None:
            raise ValueError("gbuffer: expected a buffer that tells the size, got none")
        return jnp.ones((*size, 3), widest(*jax.tree.leaves(gbuffer)))
    divisor = check_present("gbuffer.albedo", gbuffer.albedo, needed_by=f"by={by!r}")
    if by == "albedo+specular" and gbuffer.specular is not None:
        dielectric = 1.0 if gbuffer.metallic is None else 1 - gbuffer.metallic
        divisor = divisor + 0.08 * gbuffer.specular * dielectric
    # not jnp.maximum, which halves the gradient at a tie; NaN gives the floor
    floor = jnp.asarray(floor, divisor.dtype)
    divisor = jnp.where(divisor > floor, divisor, floor)
    return divisor if gbuffer.sky is None else jnp.where(gbuffer.sky > 0.5, 1, divisor)


@partial(jax.jit, static_argnames=("by",))
def demodulate(
    color: Float[Array, "h w 3"],
    gbuffer: GBuffer,
    *,
    by: By = "albedo+specular",
    floor: float | Float[Array, ""] = 1e-2,
) -> Float[Array, "h w 3"]:
    """Radiance without the material's texture: color / divisor, see `demodulation_divisor`; 0 where that is 0.

    What is left varies slowly, so that it can be warped and filtered; `modulate` puts the target's texture back. Where
    light is not reflectance times irradiance (emission, overexposure, fog) the quotient carries a texture that was not
    there: see `jaxtrapolate.methods.hindsight`.

    Args:
        color: `[H, W, 3]` linear radiance.
        gbuffer: with albedo; specular, metallic, sky where they are there.
        by: "albedo+specular", "albedo", or "none" (the colour unchanged).
        floor: the smallest divisor: in the dark it bounds the quotient, and noise. With 0, what reflects nothing is 0.

    Gradient:
        With respect to color, albedo, specular, metallic and (where it holds) floor.

    Raises:
        TypeError, ValueError: no floating-point array, a size that differs, an unknown `by`, no albedo.

    References:
        Guo et al. 2021 (ExtraNet), section 4.1; Wu et al. 2023 (ExtraSS), section 4.2. The specular term is the one of
        ExtraNet's release, which gives 0 where the albedo is 0 (floor=0); ours floors.
    """
    check_gbuffer("gbuffer", gbuffer, size=check_image("color", color, channels=3))
    if by == "none":
        return color
    divisor = demodulation_divisor(gbuffer, by=by, floor=floor).astype(color.dtype)
    return divide(color, divisor)


@partial(jax.jit, static_argnames=("by",))
def modulate(
    irradiance: Float[Array, "h w 3"],
    gbuffer: GBuffer,
    *,
    by: By = "albedo+specular",
    floor: float | Float[Array, ""] = 1e-2,
) -> Float[Array, "h w 3"]:
    """Radiance with the material's texture again: the inverse of `demodulate` with the same options, to 1 ulp.

    Args:
        irradiance: `[H, W, 3]`, demodulated radiance.
        gbuffer: as in `demodulate`.
        by: as in `demodulate`.
        floor: as in `demodulate`.

    Returns:
        `[H, W, 3]` linear radiance.

    Raises:
        TypeError, ValueError: no floating-point array, a size that differs, an unknown `by`, no albedo.
    """
    check_gbuffer("gbuffer", gbuffer, size=check_image("irradiance", irradiance, channels=3))
    if by == "none":
        return irradiance
    return irradiance * demodulation_divisor(gbuffer, by=by, floor=floor).astype(irradiance.dtype)


def _above_zero(x: Array) -> Array:
    """Where x is positive, and no smaller than what arithmetic holds: of less a CPU makes 0, but not in all it does."""
    return x >= (jnp.finfo(x.dtype).smallest_subnormal if x.dtype == jnp.float16 else jnp.finfo(x.dtype).tiny)


def _positive(x):
    """x where it is above 0, else 0 (with gradient 0, also of NaN)."""
    return jnp.where(x > 0, x, 0)


@jax.jit
def log_encode(color: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """log(1 + x) of radiance; negative values and NaN count as 0. Gradient 1 / (1 + x), 0 where x <= 0.

    References: Guo et al. 2021 (ExtraNet), section 4.6.
    """
    return jnp.log1p(_positive(color))


@jax.jit
def log_decode(encoded: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """max(exp(y) - 1, 0), the inverse of `log_encode` for radiance that is not negative.

    Of what is finite at most the largest number, with gradient 0.
    """
    largest = jnp.finfo(encoded.dtype).max
    usual = encoded < jnp.log(largest).astype(encoded.dtype)
    decoded = _positive(jnp.expm1(jnp.where(usual, encoded, 0)))
    decoded = jnp.where(usual | jnp.isnan(encoded), decoded, largest)
    return jnp.where(encoded == jnp.inf, jnp.inf, decoded)


@jax.jit
def tonemap(color: Float[Array, "*n"], *, gamma: float | Float[Array, ""] = 2.2) -> Float[Array, "*n"]:
    """(x / (1 + x))^(1 / gamma): radiance to 0..1, in which HDR images are scored and shown.

    Negative values count as 0, and so do positive ones below the smallest normal number; infinity gives 1, NaN stays.
    The gradient at 0 is 0 (the limit from above is infinite).
    """
    positive = _above_zero(color)
    finite = jnp.where(positive, jnp.where(jnp.isinf(color), 1, color), 1)
    mapped = (finite / (1 + finite)) ** (1 / jnp.asarray(gamma, color.dtype))
    mapped = jnp.where(positive, jnp.where(jnp.isinf(color), 1, mapped), 0)
    return jnp.where(jnp.isnan(color), jnp.nan, mapped)


@jax.jit
def tonemap_inverse(display: Float[Array, "*n"], *, gamma: float | Float[Array, ""] = 2.2) -> Float[Array, "*n"]:
    """The inverse of `tonemap`: values up to 0 give 0, values from 1 on give infinity."""
    inner = (display > 0) & (display < 1)
    mapped = jnp.where(inner, display, 0.5) ** jnp.asarray(gamma, display.dtype)
    return jnp.where(
        inner, mapped / (1 - mapped), jnp.where(display >= 1, jnp.inf, jnp.where(display <= 0, 0, display))
    )


@jax.jit
def compress(color: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """sqrt(x / (1 + x)): a curve near `tonemap` without powers, in which errors are compared and images blended.

    Linear light blended or averaged follows the brightest part, which the eye (and PSNR after a tone curve) does not.
    Negative values, NaN and positive values below the smallest normal number count as 0. The gradient at 0 is 0 (the
    limit from above is infinite).
    """
    usual = _above_zero(color) & (color < jnp.inf)
    positive = jnp.where(usual, color, 1)
    return jnp.where(usual, jnp.sqrt(positive / (1 + positive)), jnp.where(color > 0, 1, 0).astype(color.dtype))


@jax.jit
def expand(compressed: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """y^2 / (1 - y^2), the inverse of `compress`; values up to 0 give 0, from 1 on the largest finite number.

    In float32 the round trip errs by 2e-7 of 1 + x, relative: 1 % at 65504.
    """
    square = jnp.square(jnp.where(compressed > 0, compressed, 0))
    return divide(square, 1 - square, otherwise=jnp.finfo(square.dtype).max)


@jax.jit
def srgb_encode(linear: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Linear 0..1 to sRGB 0..1 (IEC 61966-2-1), not clipped; negative values go on linearly."""
    above = linear > 0.0031308
    curve = 1.055 * jnp.where(above, linear, 1) ** (1 / 2.4) - 0.055
    return jnp.where(above, curve, 12.92 * linear)


@jax.jit
def srgb_decode(encoded: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """sRGB 0..1 to linear 0..1, the inverse of `srgb_encode`."""
    above = encoded > 0.04045
    curve = ((jnp.where(above, encoded, 1) + 0.055) / 1.055) ** 2.4
    return jnp.where(above, curve, encoded / 12.92)
