"""Iterative search: where the points of a frame to be made lie in a rendered one (Yang et al. 2011, 5.1 and 5.3).

The flow of a rendered frame tells of its own points: the one at q will be at q + fraction * flow(q). For each pixel p
of the frame to be made the search turns this around, q + fraction * flow(q) = p, by a few fetches from the flow.

Convention:
    As in `jaxtrapolate.gather`: pixels, x right, y down, integers are centres; a flow is a displacement to add, stored
    on the grid of the frame whose points it moves; its third component is the change of depth.
"""

import dataclasses
import operator
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrapolate.checks import ArrayLike, check_choice, check_image
from jaxtrapolate.gather import inside, pixel_grid, sample, weigh
from jaxtrapolate.records import record

Solver = Literal["fixed_point", "newton"]
FlowFilter = Literal["bilinear", "nearest"]

_LEAST = 0.1  # of a determinant relative to its matrix: no inverse stretches a vector more than 1 / _LEAST times
_STEEPEST = 1e4  # pixels per pixel
_STRIP = 16  # rows


@record
@dataclasses.dataclass(frozen=True)
class Correspondence:
    """What a search found for each pixel of the frame to be made.

    position `[H, W, 2]`: x and y in the rendered frame, in pixels; may lie outside of it. depth_offset `[H, W, 1]`:
    what to add to that frame's depth there for the depth in the frame to be made; `None` for a flow without depth.
    error `[H, W, 1]`: how far, in pixels, the point there misses the pixel (eq. 7); infinite where the flow is not
    finite.
    """

    position: Float[Array, "h w 2"]
    depth_offset: Float[Array, "h w 1"] | None
    error: Float[Array, "h w 1"]


def positions(height: int, width: int, dtype=jnp.float32) -> Float[Array, "h w 2"]:
    """x and y of the pixel centres."""
    x, y = pixel_grid(height, width, dtype)
    return jnp.stack([jnp.broadcast_to(x, (height, width)), jnp.broadcast_to(y, (height, width))], -1)


def fetch(image: Float[Array, "h w c"], at: Float[Array, "*n 2"], filter: FlowFilter = "bilinear") -> Array:
    """The finite image at finite positions `[..., 2]`, its edge repeated beyond the frame."""
    return sample(image, at[..., 0], at[..., 1], filter=filter, product=operator.mul)  # type: ignore[arg-type]


def within(at: Float[Array, "*n 2"], height: int, width: int) -> Bool[Array, "*n"]:
    """Whether positions `[..., 2]` lie in the frame, whose edge is half a pixel beyond the outermost centres."""
    return inside(at[..., 0], at[..., 1], height, width)


def _slopes(flow, at, filter):
    """The flow at `at`, and its derivatives along x and y; 0 beyond the centres of the border pixels."""
    along = (jnp.zeros_like(at).at[..., k].set(1) for k in (0, 1))
    (value, by_x), (_, by_y) = (jax.jvp(lambda q: fetch(flow, q, filter), (at,), (e,)) for e in along)
    return value, by_x, by_y


def _divide(vector, by_x, by_y, fraction):
    """(I + fraction J)^-1 vector, J's columns `by_x` and `by_y`.

    The determinant's size is held to at least a tenth of the matrix's (Frobenius norm, or 1 if that is smaller), so
    that no vector is stretched more than ten times; where the smaller singular value is at least 0.15 it is exact.
    """
    by_x, by_y = (jnp.clip(fraction * by, -_STEEPEST, _STEEPEST) for by in (by_x, by_y))
    a, b, c, d = 1 + by_x[..., 0], by_y[..., 0], by_x[..., 1], 1 + by_y[..., 1]
    determinant = a * d - b * c
    floor = _LEAST * jnp.maximum(1, jnp.sqrt(jax.lax.stop_gradient(a * a + b * b + c * c + d * d)))
    held = jnp.where(determinant < 0, -floor, floor)
    determinant = jnp.where(jnp.abs(determinant) < floor, held, determinant)
    x, y = vector[..., 0], vector[..., 1]
    return jnp.stack([d * x - b * y, a * y - c * x], -1) / determinant[..., None]


def _step(flow, fraction, pixels, at, solver, filter):
    if solver == "fixed_point":
        return pixels - fraction * fetch(flow, at, filter)  # eq. 5
    value, by_x, by_y = _slopes(flow, at, filter)
    return at - _divide(at + fraction * value - pixels, by_x, by_y, fraction)


def _finite(flow):
    """Whether x and y are, `[..., 1]`."""
    return jnp.isfinite(flow[..., :1]) & jnp.isfinite(flow[..., 1:2])


@partial(jax.custom_jvp, nondiff_argnums=(3, 4, 5))
def _solve(flow, fraction, start, iterations, solver, filter):
    """After all steps the position `[H, W, 2]`, and the whole flow there `[H, W, C]`; NaN where that is not finite."""
    height, width, _ = flow.shape
    lead = jnp.where(_finite(flow), flow[..., :2], 0)

    def search(pixels, at):
        def step(at, _):
            return _step(lead, fraction, pixels, at, solver, filter), None

        at, _ = jax.lax.scan(step, at, None, length=iterations)  # a loop: unrolled, each step would compute all before
        return at, sample(flow, at[..., 0], at[..., 1], filter=filter, product=weigh)

    def whole(start):
        return search(positions(height, width, flow.dtype), start)

    def in_strips(start):
        # on a CPU one output for both components, and strips that stay in the cache, halve the time
        strips = -(-height // _STRIP)
        split = jnp.pad(start, ((0, strips * _STRIP - height), (0, 0), (0, 0))).reshape(strips, _STRIP, width, 2)
        grid = positions(_STRIP, width, flow.dtype)

        def strip(given):
            top, at = given
            return search(grid + jnp.stack([jnp.zeros_like(top), top])[None, None], at)

        found = jax.lax.map(strip, (_STRIP * jnp.arange(strips, dtype=flow.dtype), split))
        return tuple(a.reshape(strips * _STRIP, width, -1)[:height] for a in found)

    if height <= _STRIP:
        return whole(start)
    return jax.lax.platform_dependent(start, cpu=in_strips, default=whole)


@_solve.defjvp
def _solve_jvp(iterations, solver, filter, primals, tangents):
    """Of the solution of at + fraction flow(at) = pixel, whatever led to it: the start has no part in it."""
    (flow, fraction, _), (d_flow, d_fraction, _) = primals, tangents
    at, value = _solve(*primals, iterations, solver, filter)
    known = _finite(flow) & jnp.isfinite(flow)
    here, by_x, by_y = _slopes(jnp.where(known, flow, 0), at, filter)
    moved = fetch(jnp.where(known, d_flow, 0), at, filter)
    d_at = -_divide(d_fraction * here[..., :2] + fraction * moved[..., :2], by_x, by_y, fraction)
    return (at, value), (d_at, moved + by_x * d_at[..., :1] + by_y * d_at[..., 1:])


@partial(jax.jit, static_argnames=("iterations", "solver", "filter"))
def search(flow, fraction, start, *, iterations, solver, filter):
    """`iterative_search` without its checks: (position, the whole flow there, error)."""
    wide = jnp.promote_types(flow.dtype, jnp.float32)
    pixels = positions(flow.shape[0], flow.shape[1], wide)
    start = pixels if start is None else jnp.where(_finite(start), start, pixels.astype(start.dtype)).astype(wide)
    fraction = jnp.asarray(fraction).astype(wide)
    at, value = _solve(flow.astype(wide), fraction, jax.lax.stop_gradient(start), iterations, solver, filter)
    known = jnp.where(jnp.isfinite(value), value, 0)
    x, y = (at[..., k] + fraction * known[..., k] - pixels[..., k] for k in (0, 1))
    square = (x * x + y * y)[..., None]
    usual = (square > 0) & (square < jnp.inf) & _finite(value)
    error = jnp.where(usual, jnp.sqrt(jnp.where(usual, square, 1)), jnp.where(square == 0, 0, jnp.inf))
    return at, known, jnp.where(_finite(value), error, jnp.inf)


def check_flow(name: str, flow: Any, *, size: tuple[int, int] | None = None) -> tuple[int, int]:
    """`(H, W)` of a flow `[H, W, 3]` or, without the change of depth, `[H, W, 2]`."""
    found = check_image(name, flow, size=size)
    if flow.shape[2] not in (2, 3):
        raise ValueError(f"{name}: expected shape [H, W, 3] or [H, W, 2], got {list(flow.shape)}")
    return found


def check_scalar(name: str, value: Any) -> None:
    """Raise unless `value` is a number or an array of no axes."""
    if jnp.ndim(value) != 0:
        raise ValueError(f"{name}: expected shape [], got {list(jnp.shape(value))}")


def check_search(*, iterations: int, solver: str, filter: str) -> None:
    """Raise unless the options of a search are valid."""
    check_choice("solver", solver, get_args(Solver))
    check_choice("filter", filter, get_args(FlowFilter))
    if not isinstance(iterations, int) or iterations < 0:
        raise ValueError(f"iterations: expected an integer of at least 0, got {iterations!r}")


def iterative_search(
    flow: Float[ArrayLike, "h w c"],
    fraction: float | Float[ArrayLike, ""],
    *,
    start: Float[ArrayLike, "h w 2"] | None = None,
    iterations: int = 3,
    solver: Solver = "fixed_point",
    filter: FlowFilter = "bilinear",
) -> Correspondence:
    """For each pixel p the place q in a rendered frame whose point comes to p: q + fraction * flow(q) = p.

    "fixed_point": q <- p - fraction * flow(q) (eq. 5); converges where the flow changes by less than 1 / fraction
    pixels per pixel. "newton": q <- q - (I + fraction J)^-1 (q + fraction * flow(q) - p), J the derivative of the
    interpolated flow at q.

    Args:
        flow: `[H, W, 3]` of the rendered frame, x and y in pixels, then the change of depth; or `[H, W, 2]`.
        fraction: of the flow that passes until the frame to be made: alpha for the forward flow of the frame before it,
            1 - alpha for the backward flow of the frame after it. Traced.
        start: `[H, W, 2]`, positions to start from; each pixel itself by default (eq. 4 and 8).
        iterations: steps; each fetches the flow once, and one fetch more gives depth_offset and error.
        solver: as above. filter: how the flow is fetched, "bilinear" or "nearest"; "nearest" has no derivative, so that
            both solvers are the same there.

    Returns:
        A `Correspondence`: position, depth_offset = fraction * flow(position).z (eq. 6), error (eq. 7).

    Convention:
        Pixels, x right, y down, integers are centres; the flow belongs to the rendered frame's grid and is added.

    Exactness:
        Zero flow gives each pixel itself, a flow of one whole-pixel value (with fraction 1, or 1/2, ...) the shifted
        position bit for bit, both with error 0.

    Edge cases:
        Beyond the frame the flow of its edge goes on: positions and errors outside are of that continuation, and
        whether a position is inside is for the caller to see. A flow vector that is not finite counts as no motion, and
        where it has weight at the position found the error is infinite; a change of depth that is not finite counts as
        0. Positions in `start` that are not finite count as the pixel itself.

    Gradient:
        Of position, depth_offset and error with respect to flow and fraction, by the implicit function theorem at the
        position found: d position = -(I + fraction J)^-1 (d fraction * flow + fraction * d flow), forward and reverse,
        in memory that does not grow with the iterations; that of the converged answer, also where the search stopped
        short of it. None with respect to `start`. J is that of `backward_warp`: at kinks to the right and down, 0
        beyond the outermost centres and for "nearest". Exact where the smaller singular value of I + fraction J is at
        least 0.15; below, the inverse is shrunk so that it stretches no vector more than ten times.

    Raises:
        TypeError, ValueError: no floating-point array, a shape or option that does not fit.

    References:
        Yang et al. 2011, section 5.1, equations 3-12 (11 has Z_t for Z_t+1). Departures: Newton's method; the flow goes
        on beyond the frame; the gradient.
    """
    size = check_flow("flow", flow)
    if start is not None:
        check_image("start", start, size=size, channels=2)
    check_scalar("fraction", fraction)
    check_search(iterations=iterations, solver=solver, filter=filter)
    at, value, error = search(flow, fraction, start, iterations=iterations, solver=solver, filter=filter)
    offset = jnp.asarray(fraction).astype(value.dtype) * value[..., 2:] if flow.shape[2] == 3 else None
    return Correspondence(at, offset, error)


def dual_start(flow: Float[ArrayLike, "h w c"], fraction: float | Float[ArrayLike, ""]) -> Float[Array, "h w 2"]:
    """Where to start a search from by the opposite frame's flow: p + fraction * flow(p).

    It finds a moving object past its silhouette, where the frame searched shows the background at p.

    Args:
        flow: `[H, W, 3]` or `[H, W, 2]` of the other I-frame, toward the one that is searched.
        fraction: of the search: alpha in the frame before, with the backward flow of the one after, and vice versa.

    Returns:
        `[H, W, 2]`, at least float32; the pixel itself where the flow is not finite. No gradient passes a start.

    Raises:
        TypeError, ValueError: no floating-point array, a shape that does not fit.

    References:
        Yang et al. 2011, section 5.3, equations 16 and 17.
    """
    height, width = check_flow("flow", flow)
    check_scalar("fraction", fraction)
    wide = jnp.promote_types(flow.dtype, jnp.float32)
    motion = flow[..., :2].astype(wide)
    motion = jnp.where(jnp.all(jnp.isfinite(motion), -1, keepdims=True), motion, 0)
    return positions(height, width, wide) + jnp.asarray(fraction).astype(wide) * motion


def _nearest_of(depth, values, reach, axis):
    """Along one axis, depth and values where the depth is least within `reach`; ties keep the pixel, then the first."""
    size = depth.shape[axis]
    padding = [(0, 0)] * 3
    padding[axis] = (reach, reach)
    far, around = jnp.pad(depth, padding, constant_values=jnp.inf), jnp.pad(values, padding)

    def look(best, k):
        there, value = (jax.lax.dynamic_slice_in_dim(a, k, size, axis=axis) for a in (far, around))
        closer = there < best[0]
        return (jnp.where(closer, there, best[0]), jnp.where(closer, value, best[1])), None

    others = jnp.asarray([k for k in range(2 * reach + 1) if k != reach], jnp.int32)
    return jax.lax.scan(look, (depth, values), others)[0]


def latest_start(
    offset: Float[ArrayLike, "h w 2"],
    ratio: float | Float[ArrayLike, ""],
    *,
    depth: Float[ArrayLike, "h w 1"] | None = None,
    reach: int = 1,
) -> Float[Array, "h w 2"]:
    """Where to start a search from by the frame made last: p - ratio * offset, that of the nearest surface around.

    Args:
        offset: `[H, W, 2]`, p - position of the search in the same I-frame for the frame made last.
        ratio: alpha / alpha' in the I-frame before, (1 - alpha) / (1 - alpha') in the one after; alpha' of that frame.
        depth: `[H, W, 1]` that the points had in that frame, smaller is nearer; infinite or NaN where the search missed
            and should not be followed. Without it each pixel keeps its own offset.
        reach: the neighbourhood is a square of 2 reach + 1 pixels; 0 = the pixel itself.

    Returns:
        `[H, W, 2]`; the pixel itself where the offset is not finite. Ties keep the pixel's own column or row.

    Raises:
        TypeError, ValueError: no floating-point array, a shape or option that does not fit.

    References:
        Yang et al. 2011, section 5.3, equations 18 and 19. Departure: offsets of searches that missed are left out,
        where the caller says so by their depth.
    """
    height, width = check_image("offset", offset, channels=2)
    if not isinstance(reach, int) or reach < 0:
        raise ValueError(f"reach: expected an integer of at least 0, got {reach!r}")
    check_scalar("ratio", ratio)
    wide = jnp.promote_types(offset.dtype, jnp.float32)
    chosen = jnp.asarray(offset).astype(wide)
    if depth is not None and reach > 0:
        check_image("depth", depth, size=(height, width), channels=1)
        nearest = jnp.where(jnp.isnan(depth), jnp.inf, depth)
        for axis in (1, 0):
            nearest, chosen = _nearest_of(nearest, chosen, reach, axis)
    chosen = jnp.where(jnp.all(jnp.isfinite(chosen), -1, keepdims=True), chosen, 0)
    return positions(height, width, wide) - jnp.asarray(ratio).astype(wide) * chosen
