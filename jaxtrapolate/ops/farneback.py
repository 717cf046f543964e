"""Dense optical flow by polynomial expansion (Farneback 2003)."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrapolate.checks import ArrayLike, check_image
from jaxtrapolate.ops.resample import (
    Resampling,
    bordered,
    fetch,
    gaussian,
    gray_levels,
    resample,
    resize,
    window,
)
from jaxtrapolate.ops.strips import once
from jaxtrapolate.ops.warp import pixel_grid

_LEAST = 32  # pixels: no level of a pyramid is smaller
_BORDER = (0.14, 0.14, 0.4472, 0.4472, 0.4472)  # what the outermost pixels' equations are weighted with
_DAMPING = 1e-3  # of the determinant


def _expansion(image, radius: int, sigma: float):
    """Coefficients of the polynomial that fits the image best around each pixel: y, x, yy, xx, xy `[H, W]` each.

    Weighted least squares on a window of 2 radius + 1 pixels for 1, x, y, x^2, y^2, xy (Farneback 2003, section 2).
    """
    at = np.arange(-radius, radius + 1)
    g = gaussian(2 * radius + 1, sigma)
    x, y = np.meshgrid(at, at)
    basis = np.stack([np.ones_like(x), x, y, x * x, y * y, x * y], -1).reshape(-1, 6)
    inverse = np.linalg.inv(basis.T @ (np.outer(g, g).reshape(-1, 1) * basis)).tolist()
    padded = bordered(image, radius, 0)
    smooth, slope, bend = (bordered(window(padded, g * at**k, 0), radius, 1) for k in (0, 1, 2))
    mean = window(smooth, g, 1)
    return (
        once(window(slope, g, 1) * inverse[2][2]),
        once(window(smooth, g * at, 1) * inverse[1][1]),
        once(mean * inverse[4][0] + window(bend, g, 1) * inverse[4][4]),
        once(mean * inverse[3][0] + window(smooth, g * at**2, 1) * inverse[3][3]),
        once(window(slope, g * at, 1) * inverse[5][5]),
    )


def _trust(size: int, dtype):
    """What the equations along an axis are weighted with: less at the border, where a window sees what is not there."""
    weights = np.ones(size)
    for k, weight in enumerate(_BORDER[:size]):
        weights[k] *= weight
        weights[size - 1 - k] *= weight
    return jnp.asarray(weights, dtype)


def _equations(first, second, u, v):
    """The normal equations of each pixel's displacement: the three entries of a matrix, and the right side's two.

    Farneback 2003, section 3 to 4: A = (A1 + A2) / 2, b = (b1 - b2) / 2 + A d for the displacement d so far.
    """
    height, width = u.shape
    columns, rows = pixel_grid(height, width, u.dtype)
    x, y = columns + u, rows + v
    seen = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    by, bx, ayy, axx, axy = first
    there = [fetch(a, x, y) for a in second]
    slope_y, slope_x = (jnp.where(seen, (a - b) * 0.5, 0) for a, b in ((by, there[0]), (bx, there[1])))
    ayy, axx = (jnp.where(seen, (a + b) * 0.5, a) for a, b in ((ayy, there[2]), (axx, there[3])))
    axy = jnp.where(seen, (axy + there[4]) * 0.25, axy * 0.5)
    slope_y, slope_x = slope_y + ayy * v + axy * u, slope_x + axy * v + axx * u
    trust = jnp.square(_trust(height, u.dtype)[:, None] * _trust(width, u.dtype)[None, :])
    terms = (
        axx * axx + axy * axy,
        (axx + ayy) * axy,
        ayy * ayy + axy * axy,
        axx * slope_x + axy * slope_y,
        axy * slope_x + ayy * slope_y,
    )
    return [a * trust for a in terms]


def _solve(equations, weights: np.ndarray):
    """The displacement that fits the equations of a window best, as a complex number: XLA makes both at once."""
    radius = len(weights) // 2
    down = [bordered(window(bordered(a, radius, 0), weights, 0), radius, 1) for a in equations]
    xx, xy, yy, hx, hy = (window(a, weights, 1) for a in down)
    over = 1 / (xx * yy - xy * xy + _DAMPING)
    return jax.lax.complex((yy * hx - xy * hy) * over, (xx * hy - xy * hx) * over)


@partial(
    jax.jit,
    static_argnames=(
        *("levels", "pyramid_scale", "window_size", "iterations", "poly_radius", "poly_sigma", "gaussian_window"),
    ),
)
def _farneback(
    first, second, *, levels, pyramid_scale, window_size, iterations, poly_radius, poly_sigma, gaussian_window
):
    height, width, _ = first.shape
    images = [gray_levels(image) for image in (first, second)]
    radius = window_size // 2
    size = 2 * radius + 1
    flat = np.full(size, 1 / size)
    weights = gaussian(size, 0.3 * radius) if gaussian_window and radius else flat
    scales = [1.0]
    while len(scales) <= levels and min(height, width) * scales[-1] * pyramid_scale >= _LEAST:
        scales.append(scales[-1] * pyramid_scale)
    flow = [jnp.zeros((1, 1), images[0].dtype)] * 2
    for scale in reversed(scales):
        rows, columns = max(1, round(height * scale)), max(1, round(width * scale))
        sigma = (1 / scale - 1) * 0.5
        taps = max(round(sigma * 5) | 1, 3)
        how = {"sigma": sigma or 0.8, "taps": taps}  # 0.8: of a window of 3 pixels
        small = [
            resample(image, Resampling(height, rows, **how), Resampling(width, columns, **how)) for image in images
        ]
        expansions = [_expansion(image, poly_radius, poly_sigma) for image in small]
        flow = [resize(a, (rows, columns)) / pyramid_scale for a in flow]

        def step(flow, _, expansions=expansions):
            found = _solve(_equations(*expansions, *flow), weights)
            return [jnp.real(found), jnp.imag(found)], None

        flow, _ = jax.lax.scan(step, flow, None, length=iterations)
    return jnp.stack(flow, -1).astype(first.dtype)


def farneback_flow(
    first: Float[ArrayLike, "h w 1"],
    second: Float[ArrayLike, "h w 1"],
    *,
    levels: int = 4,
    pyramid_scale: float = 0.5,
    window_size: int = 15,
    iterations: int = 5,
    poly_radius: int = 7,
    poly_sigma: float = 1.5,
    gaussian_window: bool = False,
) -> Float[Array, "h w 2"]:
    """Optical flow by polynomial expansion: p of the first image is at p + flow[p] of the second.

    Around each pixel both images are taken for polynomials of second degree; a displacement of one into the other is
    what solves A d = (b1 - b2) / 2 best over a window, by least squares. From a small image to a large one, and
    several times at each size, with the second image's polynomials fetched along the flow so far.

    Args:
        first: `[H, W, 1]`, grey levels as displayed, 0 to 1.
        second: likewise.
        levels: of the pyramid below the full size; those that are smaller than 32 pixels are left out.
        pyramid_scale: size of a level over that of the next larger one, in 0..1.
        window_size: pixels that share a displacement (an even number counts as the next odd one): the larger, the
            smoother and the more robust.
        iterations: at each level.
        poly_radius: of the window that a polynomial is fitted to, which has 2 poly_radius + 1 pixels.
        poly_sigma: of that window's Gaussian, in pixels.
        gaussian_window: whether the shared window is a Gaussian of sigma 0.3 (window_size // 2), or a box.

    Returns:
        `[H, W, 2]` in pixels, of the dtype of `first`. Computed in at least float32.

    Convention:
        Pull: fetching the second image along the flow (`backward_warp`) gives the first. Pixels, x right, y down.

    Edge cases:
        Without texture the flow is 0. Pixels that are not finite are filled from around them first (`fill_pyramid`).
        Grey levels are held to -1000..1000.
        Images repeat their edge. A pixel that the flow so far leads out of the frame speaks for that flow.

    Gradient:
        With respect to both images, through all iterations. Of the bilinear fetches it is that of `backward_warp`.

    Raises:
        TypeError, ValueError: no floating-point array, sizes that differ, or an option that does not fit.

    References:
        Farneback 2003 (Two-frame motion estimation based on polynomial expansion), in the form of OpenCV's
        calcOpticalFlowFarneback, whose poly_n is `poly_radius`. Departures: images need not be of 8 bits; what is led
        out of the frame is not compared with 0.
    """
    size = check_image("first", first, channels=1)
    check_image("second", second, size=size, channels=1)
    for name, value, least in (
        ("levels", levels, 0),
        ("window_size", window_size, 1),
        ("iterations", iterations, 1),
        ("poly_radius", poly_radius, 1),
    ):
        if value < least:
            raise ValueError(f"{name}: expected {least} or more, got {value!r}")
    if not 0 < pyramid_scale < 1:
        raise ValueError(f"pyramid_scale: expected a number between 0 and 1, got {pyramid_scale!r}")
    if not poly_sigma > 0:
        raise ValueError(f"poly_sigma: expected a number above 0, got {poly_sigma!r}")
    return _farneback(
        first,
        second,
        levels=levels,
        pyramid_scale=float(pyramid_scale),
        window_size=window_size,
        iterations=iterations,
        poly_radius=poly_radius,
        poly_sigma=float(poly_sigma),
        gaussian_window=gaussian_window,
    )
