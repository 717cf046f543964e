"""Iterative search: where the points of a frame to be generated lie in a rendered one (Yang et al. 2011, 5.1 and 5.3).

The flow of a rendered frame tells of its own points: the one at q will be at q + fraction * flow(q). For each pixel p
of the frame to be generated the search turns this around, q + fraction * flow(q) = p, by a few fetches from the flow.

Convention:
    As in `jaxtrapolate.ops.warp`: pixels, x right, y down, integers are centres; a flow is a displacement to add,
    stored on the grid of the frame whose points it moves; its third component is the change of depth.
"""

import dataclasses
import operator
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrapolate.checks import ArrayLike, check_choice, check_image, check_scalar
from jaxtrapolate.ops.strips import by_strips, rows_of
from jaxtrapolate.ops.warp import Filter, all_finite, held_motion, inside, pixel_grid, root, sample, where_finite
from jaxtrapolate.precision import widest
from jaxtrapolate.records import record

Solver = Literal["fixed_point", "newton"]
FlowFilter = Literal["bilinear", "nearest"]

_LEAST = 0.1  # of a determinant relative to its matrix: no inverse stretches a vector more than 1 / _LEAST times
_STEEPEST = 1e4  # pixels per pixel


@record
@dataclasses.dataclass(frozen=True)
class Correspondence:
    """What a search found for each pixel of the frame to be generated.

    position `[H, W, 2]`: x and y in the rendered frame, in pixels; may lie outside of it. depth_offset `[H, W, 1]`:
    what to add to that frame's depth there for the depth in the frame to be generated; `None` for a flow without depth.
    error `[H, W, 1]`: how far, in pixels, the point there misses the pixel (eq. 7); infinite where the flow is not
    finite.
    """

    position: Float[Array, "h w 2"]
    depth_offset: Float[Array, "h w 1"] | None
    error: Float[Array, "h w 1"]


def positions(height: int, width: int, dtype=jnp.float32, *, top: Array | int = 0) -> Float[Array, "h w 2"]:
    """x and y of the pixel centres of `height` rows from row `top` on."""
    x, y = pixel_grid(height, width, dtype)
    y = y + jnp.asarray(top).astype(dtype)
    return jnp.stack([jnp.broadcast_to(x, (height, width)), jnp.broadcast_to(y, (height, width))], -1)


def fetch(image: Float[Array, "h w c"], at: Float[Array, "*n 2"], filter: FlowFilter = "bilinear") -> Array:
    """The finite image at finite positions `[..., 2]`, its edge repeated beyond the frame."""
    return sample(image, at[..., 0], at[..., 1], filter=filter, product=operator.mul)  # type: ignore[arg-type]


def fetch_finite(
    image: Float[Array, "h w c"], at: Float[Array, "i j 2"], filter: Filter, finite: Array | None = None
) -> Float[Array, "i j c"]:
    """The image at finite positions; a pixel that is not finite does not spread to where it has no weight.

    finite: what `all_finite` says of the image, where that is known.
    """

    def look(product, image, at):
        return sample(image, at[..., 0], at[..., 1], filter=filter, product=product)

    return look(None, image, at) if filter == "nearest" else where_finite(look, image, at, finite)


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


def _finite(flow):
    """Whether x and y are, `[..., 1]`."""
    return jnp.isfinite(flow[..., :1]) & jnp.isfinite(flow[..., 1:2])


def plane(pair: Array) -> Array:
    """Two components `[..., 2]` as complex numbers: on a CPU one load serves both, and one loop computes both."""
    return jax.lax.complex(pair[..., 0], pair[..., 1])


def pair(plane: Array) -> Array:
    """The components `[..., 2]` of complex numbers."""
    return jnp.stack([plane.real, plane.imag], -1)


def scaled(value, weight):
    """A complex value by a real weight; as one product, so that XLA on a CPU keeps all in one loop."""
    return value * jax.lax.complex(weight, jnp.zeros_like(weight))


def _weighed(value, weight):
    """As `scaled`, but 0 where the weight is 0, also of a value that is not finite."""
    return jnp.where(weight == 0, 0, scaled(value, weight))


class Leads(NamedTuple):
    """What a search needs of a rendered frame, all rows.

    flow `[H, W, C]`, at least float32; fraction of it that passes; finite: whether all of it is; passing: x and y of
    fraction * flow, a complex plane; known: the same, 0 where it is not finite.
    """

    flow: Array
    fraction: Array
    finite: Array
    passing: Array
    known: Array


def leads(flow: Float[Array, "h w c"], fraction: Array) -> Leads:
    """The `Leads` of a flow; what passes of it is `held_motion`."""
    passing = plane(jax.lax.stop_gradient(fraction * held_motion(flow[..., :2])))
    return Leads(flow, fraction, all_finite(flow), passing, only_finite(passing))


def only_finite(value):
    """A complex value, 0 where it is not finite."""
    return jnp.where(jnp.isfinite(value.real) & jnp.isfinite(value.imag), value, 0)


def _looked(plane, at, filter, product=None):
    """A complex plane at complex positions."""
    return sample(plane[..., None], at.real, at.imag, filter=filter, product=product)[..., 0]


def advance(leads: Leads, start: Array | None, top, rows: int, iterations: int, solver: Solver, filter: FlowFilter):
    """Complex positions `[rows, W]` after all steps from a start, `None` for the pixels themselves; no gradient."""
    pixels = plane(positions(rows, leads.flow.shape[1], leads.flow.dtype, top=top))

    def fixed_point(at, _):  # eq. 5
        if filter == "nearest":  # a plane less in memory
            return pixels - only_finite(_looked(leads.passing, at, filter)), None
        return pixels - _looked(leads.known, at, filter, product=scaled), None

    def newton(at, _):
        at = pair(at)
        value, by_x, by_y = _slopes(pair(leads.known), at, filter)
        return plane(at - _divide(at + value - pair(pixels), by_x, by_y, 1)), None

    at = pixels if start is None else start
    if start is None and solver == "fixed_point" and iterations > 0:  # the flow at a pixel itself needs no search
        at, iterations = pixels - only_finite(rows_of(leads.passing, top, rows)), iterations - 1
    if iterations == 0:  # an empty loop has no result under `jax_disable_jit`
        return jax.lax.stop_gradient(at)
    # a loop: unrolled, each step would compute all before
    step = newton if solver == "newton" else fixed_point
    return jax.lax.stop_gradient(jax.lax.scan(step, at, None, length=iterations)[0])


def residual(leads: Leads, at: Array, top, filter: FlowFilter) -> Array:
    """The error `[rows, W]` (eq. 7) of complex positions; infinite where the flow is not finite; no gradient."""
    pixels = plane(positions(at.shape[0], at.shape[1], leads.flow.dtype, top=top))
    apart = at + _looked(leads.passing, at, filter, product=_weighed) - pixels
    error = jnp.sqrt(apart.real * apart.real + apart.imag * apart.imag)
    return jnp.where(jnp.isnan(error), jnp.inf, error)


@partial(jax.custom_jvp, nondiff_argnums=(3, 4, 5, 6))
def solve(leads, start, top, rows, iterations, solver, filter):
    """For `rows` rows from `top` on: position `[rows, W, 2]`, and the whole flow there; NaN where that is not finite.

    start: complex `[rows, W]`, or `None` for the pixels themselves.
    """
    at = pair(advance(leads, start, top, rows, iterations, solver, filter))
    return at, fetch_finite(leads.flow, at, filter, leads.finite)


def _solve_part(sources, top, rows, *, iterations, solver, filter):
    leads, start = sources
    start = None if start is None else rows_of(start, top, rows)
    return solve(leads, start, top, rows, iterations, solver, filter)


@solve.defjvp
def _solve_jvp(rows, iterations, solver, filter, primals, tangents):
    """Of the solution of at + fraction flow(at) = pixel, whatever led to it: the start has no part in it."""
    (leads, start, _), ((d_flow, d_fraction, *_), *_) = primals, tangents
    part = partial(_solve_part, iterations=iterations, solver=solver, filter=filter)
    at, value = by_strips(part, rows, (leads, start))  # all rows: see `by_strips`
    flow, fraction = leads.flow, leads.fraction
    known = _finite(flow) & jnp.isfinite(flow)
    here, by_x, by_y = _slopes(jnp.where(known, held_motion(flow), 0), at, filter)
    moved = fetch(jnp.where(known, d_flow, 0), at, filter)
    d_at = -_divide(d_fraction * here[..., :2] + fraction * moved[..., :2], by_x, by_y, fraction)
    return (at, value), (d_at, moved + by_x * d_at[..., :1] + by_y * d_at[..., 1:])


def flow_and_residual(at, value, fraction, pixels) -> tuple[Array, Array]:
    """The whole flow at the positions found, 0 where it is not finite; and the error (eq. 7)."""
    known = jnp.where(jnp.isfinite(value), held_motion(value), 0)
    x, y = (at[..., k] + fraction * known[..., k] - pixels[..., k] for k in (0, 1))
    square = (x * x + y * y)[..., None]
    usual = square < jnp.inf
    error = root(jnp.where(usual, square, jnp.finfo(square.dtype).max))
    return known, jnp.where(usual & _finite(value), error, jnp.inf)


def _search_part(sources, top, rows, *, iterations, solver, filter):
    at, value = _solve_part(sources, top, rows, iterations=iterations, solver=solver, filter=filter)
    flow, fraction = sources[0].flow, sources[0].fraction
    known, error = flow_and_residual(at, value, fraction, positions(rows, flow.shape[1], flow.dtype, top=top))
    return at, fraction * known[..., 2:], error


@partial(jax.jit, static_argnames=("iterations", "solver", "filter"))
def _search(flow, fraction, start, *, iterations, solver, filter):
    """`iterative_search` without its checks."""
    wide = widest(flow)
    flow, fraction = flow.astype(wide), jnp.asarray(fraction).astype(wide)
    if start is not None:
        pixels = positions(flow.shape[0], flow.shape[1], wide)
        start = plane(jax.lax.stop_gradient(jnp.where(_finite(start), start, pixels.astype(start.dtype)).astype(wide)))
    part = partial(_search_part, iterations=iterations, solver=solver, filter=filter)
    return by_strips(part, flow.shape[0], (leads(flow, fraction), start))


def check_flow(name: str, flow: Any, *, size: tuple[int, int] | None = None) -> tuple[int, int]:
    """`(H, W)` of a flow `[H, W, 3]` or, without the change of depth, `[H, W, 2]`."""
    found = check_image(name, flow, size=size)
    if flow.shape[2] not in (2, 3):
        raise ValueError(f"{name}: expected shape [H, W, 3] or [H, W, 2], got {list(flow.shape)}")
    return found


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
    """For each pixel p the position q in a rendered frame whose point comes to p: q + fraction * flow(q) = p.

    "fixed_point": q <- p - fraction * flow(q) (eq. 5); converges where the flow changes by less than 1 / fraction
    pixels per pixel. "newton": q <- q - (I + fraction J)^-1 (q + fraction * flow(q) - p), J the derivative of the
    interpolated flow at q.

    Args:
        flow: `[H, W, 3]` of the rendered frame, x and y in pixels, then the change of depth; or `[H, W, 2]`.
        fraction: of the flow that passes until the frame to be generated: alpha for the forward flow of the frame
            before it, 1 - alpha for the backward flow of the frame after it. Traced.
        start: `[H, W, 2]`, positions to start from; each pixel itself by default (eq. 4 and 8).
        iterations: steps; each fetches the flow once, and one fetch more gives depth_offset and error.
        solver: as above.
        filter: how the flow is fetched, "bilinear" or "nearest"; "nearest" has no derivative, so that both solvers are
            the same there.

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
    at, offset, error = _search(flow, fraction, start, iterations=iterations, solver=solver, filter=filter)
    return Correspondence(at, offset if flow.shape[2] == 3 else None, error)
