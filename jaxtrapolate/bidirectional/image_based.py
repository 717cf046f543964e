"""Image-based bidirectional reprojection (Yang et al. 2011, section 5).

A frame between two rendered ones, the I-frames at t and t + 1, is generated from their colours, depths and 3D flows
alone: each of its pixels searches for its point in both, the visible one is chosen and, where the other I-frame shows
it as well, the two colours are blended.
"""

from functools import partial
from typing import Literal, NamedTuple, cast, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.bidirectional.assisted import (
    CASES,
    Interpolation,
    Offsets,
    Shader,
    agree,
    blend,
    check_keyframe,
    shown,
)
from jaxtrapolate.bidirectional.options import (
    SearchOptions,
    VisibilityOptions,
    check_search_options,
    check_visibility_options,
)
from jaxtrapolate.bidirectional.search import (
    Correspondence,
    Leads,
    advance,
    check_flow,
    fetch_finite,
    flow_and_residual,
    leads,
    plane,
    positions,
    residual,
    solve,
    within,
)
from jaxtrapolate.bidirectional.starts import LatestOffsets, dual, latest
from jaxtrapolate.checks import ArrayLike, Size, check_choice, check_present, check_scalar
from jaxtrapolate.ops.depth import held, released, surface_depth
from jaxtrapolate.ops.strips import by_strips, once
from jaxtrapolate.ops.warp import Filter, all_finite, inside, sample
from jaxtrapolate.precision import divide, widest
from jaxtrapolate.records import DepthOrAbsent, Keyframe, replace

Visibility = Literal["depth", "round_trip", "inside"]

SEARCH = SearchOptions()
VISIBILITY = VisibilityOptions()
"""The defaults."""

_EQUAL = 1e-3  # pixels: errors that differ by less do so by rounding


class _Found(NamedTuple):
    """One solution of a search `[rows, W, ...]`: position, whole flow, residual, depth at t + alpha, hit."""

    at: Array
    flow: Array
    error: Array
    depth: Array
    hit: Array


class _Options(NamedTuple):
    """What is static. search: its threshold left out. depth, visibility: as resolved by what the frames have."""

    search: SearchOptions
    filter: Filter
    depth: DepthOrAbsent
    visibility: Visibility


class _Side(NamedTuple):
    """What there is of one I-frame, all rows.

    depth: `held`, so that nothing is at 1e30. passed: the depth `[H, W]` of its points in the frame to be generated.
    leads: of its flow toward the other I-frame. finite: whether the colours and the depths are. latest: what the frame
    interpolated last leaves.
    """

    color: Array
    depth: Array | None
    passed: Array | None
    leads: Leads
    finite: tuple[Array, Array | None]
    latest: LatestOffsets | None

    @property
    def flow(self) -> Array:
        return self.leads.flow

    @property
    def fraction(self) -> Array:
        return self.leads.fraction

    @property
    def size(self) -> Size:
        """`(H, W)`."""
        return self.flow.shape[0], self.flow.shape[1]


def _starts(side: _Side, other: _Side, top, rows: int, options: _Options) -> list[Array | None]:
    """Positions to start from (5.3), complex planes, `None` for the pixels themselves."""
    places: list[Array | None] = []
    for name in options.search.starts:
        if name == "default":
            places.append(None)
        elif name == "dual":
            places.append(dual(other.flow, side.fraction, top, rows))
        elif side.latest is not None:
            places.append(latest(side.latest, top, rows, reach=options.search.reach))
    return places or [None]


def _best(sources, top, rows: int, *, options: _Options) -> Array:
    """Where the best solution of all starts is in one I-frame, a complex plane.

    The smaller error (5.3), inside the frame first; or the nearer, if both hit.
    """
    side, other, epsilon = sources
    starts = _starts(side, other, top, rows, options)
    how = options.search.iterations, options.search.solver, options.search.filter

    def found(start):
        return advance(side.leads, start, top, rows, *how)

    if len(starts) == 1:
        return found(starts[0])

    def step(best, given):
        at = found(given[1])
        error = residual(side.leads, at, top, options.search.filter)
        depth = jnp.zeros_like(error)
        if side.passed is not None and options.search.choice == "depth":
            depth = sample(side.passed[..., None], at.real, at.imag, filter=options.search.filter)[..., 0]
        best_at, best_error, best_depth = best
        closer = error < best_error - _EQUAL
        inner, best_inner = (inside(place.real, place.imag, *side.size) for place in (at, best_at))
        if options.search.choice == "depth":
            hits = inner & (error < epsilon), best_inner & (best_error < epsilon)
            closer = jnp.where(hits[0] & hits[1], depth < best_depth, closer)
        better = given[0] | jnp.where(inner == best_inner, closer, inner)
        return tuple(jnp.where(better, a, b) for a, b in zip((at, error, depth), best, strict=True)), None

    grid = plane(positions(rows, side.size[1], side.flow.dtype, top=top))
    starts = jnp.stack([grid if start is None else start for start in starts])
    none = jnp.zeros(grid.shape, side.flow.dtype)
    # a loop is a fusion boundary: without it XLA on a CPU recomputes every solution in each comparison
    return jax.lax.scan(step, (grid, none, none), (jnp.arange(len(starts)) == 0, starts))[0][0]


def _find(side: _Side, other: _Side, epsilon, top, rows: int, options: _Options) -> _Found:
    """The best solution of all starts in one I-frame."""
    sources = jax.lax.stop_gradient((side, other, epsilon))
    best = partial(_best, options=options)
    at = by_strips(best, rows, sources) if rows == side.size[0] else best(sources, top, rows)
    at, value = solve(side.leads, at, top, rows, 0, options.search.solver, options.search.filter)
    value, error = flow_and_residual(at, value, side.fraction, positions(rows, side.size[1], side.flow.dtype, top=top))
    hit = (error < epsilon) & within(at, *side.size)[..., None]
    depth = jnp.zeros_like(error)
    if side.depth is not None:
        # from the same pixels as the flow, whose change of depth is theirs
        depth = sample(side.depth, at[..., 0], at[..., 1], filter=options.search.filter).astype(at.dtype)
    if options.depth == "metric" and side.flow.shape[2] == 3:
        depth = depth + side.fraction * value[..., 2:]  # eq. 6 and 11
    return _Found(at, value, error, jnp.where(jnp.isnan(depth), jnp.inf, depth), hit)


def _visible_in(other: _Side, found: _Found, epsilon_depth, epsilon_trip, options: _Options):
    """A point found in one I-frame, in the other (5.2): its position, and whether it is visible there `[H, W, 1]`."""
    there = found.at + found.flow[..., :2]
    seen = within(there, *other.size)[..., None] & (found.error < jnp.inf)
    if options.visibility == "depth":
        expected = found.depth + other.fraction * found.flow[..., 2:]  # the rest of the way
        seen &= shown(cast(Array, other.depth), there, expected, epsilon_depth, other.finite[1])
    elif options.visibility == "round_trip":
        back = sample(other.flow, there[..., 0], there[..., 1], filter=options.search.filter).astype(there.dtype)
        apart = found.flow[..., :2] + back[..., :2]
        seen &= jnp.sum(jnp.square(apart), -1, keepdims=True) < jnp.square(epsilon_trip)
    return there, seen


def _part(sources, top, rows: int, *, options: _Options) -> tuple[Interpolation, tuple[Array | None, ...]]:
    """Some rows of the frame, before shading and without its offsets; and those but for alpha."""
    previous, next, epsilon_error, epsilon_depth, epsilon_trip = sources
    alpha, size = previous.fraction, previous.size
    f = _find(previous, next, epsilon_error, top, rows, options)
    b = _find(next, previous, epsilon_error, top, rows, options)

    # 5.2: which of the two points is the one to be seen
    same = jnp.ones_like(f.hit)
    if options.depth != "absent":
        same = agree(f.depth, b.depth, epsilon_depth, options.depth)
    f_inside, b_inside = (within(a.at, *size)[..., None] for a in (f, b))
    apart = f.error - b.error
    smaller = jnp.where(jnp.abs(apart) < _EQUAL, alpha < 0.5, apart < 0)
    smaller = jnp.where(f_inside == b_inside, smaller, f_inside)
    by_error = jnp.where(f.hit == b.hit, smaller, f.hit)
    take_f = jnp.where(f.hit & b.hit & ~same, f.depth < b.depth, by_error)
    take_f = once(jnp.where(alpha == 0, True, jnp.where(alpha == 1, False, take_f)))
    case = jnp.where(same, CASES.index("agree"), CASES.index("nearer"))
    case = jnp.where(f.hit & b.hit, case, jnp.where(f.hit | b.hit, CASES.index("one"), CASES.index("neither")))

    # eq. 14 and 15: that point in both I-frames, blended where both show it
    f_there, f_seen = _visible_in(next, f, epsilon_depth, epsilon_trip, options)
    b_there, b_seen = _visible_in(previous, b, epsilon_depth, epsilon_trip, options)
    first, second = jnp.where(take_f, f.at, b_there), jnp.where(take_f, f_there, b.at)
    both = once(jnp.where(take_f, f_seen, b_seen))
    weight = jnp.where(both, alpha, jnp.where(take_f, 0, 1).astype(alpha.dtype))
    first_color, second_color = (
        fetch_finite(side.color, at, options.filter, side.finite[0]) for side, at in ((previous, first), (next, second))
    )
    color = blend(first_color, second_color, weight)

    grid = positions(rows, size[1], alpha.dtype, top=top)
    known = options.depth != "absent"
    left = [grid - a.at for a in (f, b)] + [jnp.where(a.hit, a.depth, jnp.inf) if known else None for a in (f, b)]
    forward, backward = (
        Correspondence(a.at, side.fraction * a.flow[..., 2:] if side.flow.shape[2] == 3 else None, a.error)
        for a, side in ((f, previous), (b, next))
    )
    depth = released(jnp.where(take_f, f.depth, b.depth)) if known else None
    return Interpolation(color, weight, case[..., 0].astype(jnp.int32), forward, backward, depth), tuple(left)


@partial(jax.jit, static_argnames=("filter", "depth", "test"))
def _interpolate(previous, next, alpha, offsets, search, visibility, *, filter, depth, test):
    flow, opposite = previous.forward_flow, next.backward_flow
    wide = widest(flow, opposite)
    numbers = (alpha, search.epsilon, visibility.epsilon_depth, visibility.epsilon_trip)
    alpha, *epsilons = (jnp.asarray(a).astype(wide) for a in numbers)
    options = _Options(replace(search, epsilon=0.0), filter, depth, test)

    def side(frame, flow, fraction, offset, last_depth, last):
        flow, known = flow.astype(wide), None
        if offset is not None:  # where the last fraction is 0, so are its offsets
            known = LatestOffsets(offset.astype(wide), last_depth, divide(fraction, last))
        depth, passed = None, None
        if options.depth != "absent":
            depth = held(surface_depth(jnp.asarray(frame.depth)))
            passed = depth[..., 0].astype(wide)
            if options.depth == "metric" and flow.shape[2] == 3:
                change = flow[..., 2]
                passed = passed + fraction * jnp.where(jnp.isfinite(change), change, 0)
            passed = jnp.where(jnp.isnan(passed), jnp.inf, passed)
        finite = all_finite(frame.color), None if depth is None else all_finite(depth)
        return _Side(frame.color, depth, passed, leads(flow, fraction), finite, known)

    lasts = (None, None, None), (None, None, None)
    if offsets is not None:
        last = offsets.alpha.astype(wide)
        lasts = (offsets.forward, offsets.forward_depth, last), (offsets.backward, offsets.backward_depth, 1 - last)
    sources = side(previous, flow, alpha, *lasts[0]), side(next, opposite, 1 - alpha, *lasts[1]), *epsilons
    result, left = by_strips(partial(_part, options=options), flow.shape[0], sources)
    return replace(result, offsets=Offsets(alpha, *left))


def _checked(previous: Keyframe, next: Keyframe) -> Size:
    size = check_keyframe("previous", previous)
    check_keyframe("next", next, size=size)
    hint = "interpolation (`complete_flows` derives one from the other)"
    for name, flow in (("previous.forward_flow", previous.forward_flow), ("next.backward_flow", next.backward_flow)):
        check_flow(name, check_present(name, flow, needed_by=hint), size=size)
    return size


def _resolve(previous: Keyframe, next: Keyframe, options: VisibilityOptions) -> tuple[DepthOrAbsent, Visibility]:
    """What kind of depth there is, and how visibility is tested."""
    kind: DepthOrAbsent = options.depth if previous.depth is not None and next.depth is not None else "absent"
    flows = (cast(Array, previous.forward_flow), cast(Array, next.backward_flow))
    testable = kind == "metric" and all(flow.shape[2] == 3 for flow in flows)
    if options.test == "depth" and not testable:
        raise ValueError("visibility: test='depth' needs metric depth in both keyframes and flows [H, W, 3]")
    if options.test == "auto":
        return kind, "depth" if testable else "round_trip"
    return kind, options.test


def slim(previous: Keyframe, next: Keyframe) -> tuple[Keyframe, Keyframe]:
    """Only what interpolation reads of the frames around."""
    first = Keyframe(color=previous.color, depth=previous.depth, forward_flow=previous.forward_flow)
    return first, Keyframe(color=next.color, depth=next.depth, backward_flow=next.backward_flow)


def interpolate_image_based(
    previous: Keyframe,
    next: Keyframe,
    alpha: float | Float[ArrayLike, ""],
    *,
    offsets: Offsets | None = None,
    search: SearchOptions = SEARCH,
    visibility: VisibilityOptions = VISIBILITY,
    filter: Filter = "bilinear",
    shade_attributes: Shader | None = None,
) -> Interpolation:
    """The frame at t + alpha from the rendered frames at t and t + 1 and the 3D flows between them.

    Each pixel searches for its point in both frames (`iterative_search`), from several starts, of which the best
    solution counts; a search hits where its error is below a threshold and its position inside the frame. Then (5.2)
    1. both hit, at similar depths: the point with the smaller error; 2. both hit, at different depths: the nearer
    point; one hits: that point; 3. neither: the smaller error. The point's position in the other frame follows from the
    flow (eq. 14 and 15); where it is visible there the two colours are blended by alpha, elsewhere it is taken alone.

    Args:
        previous: color `[H, W, C]`, any attributes, forward_flow, depth (may be absent).
        next: color, backward_flow, depth (may be absent). Without depth in both nothing is compared, and points that
            hit count as the same.
        alpha: in 0..1, traced; at 0 and 1 the frames are returned bit for bit.
        offsets: those of the frame interpolated last between the same two, for the start "latest".
        search: how points are searched for, see `SearchOptions`.
        visibility: when they count as visible, and as the same, see `VisibilityOptions`.
        filter: of the colours, as in `backward_warp`.
        shade_attributes: called with the blended attributes `[H, W, C]`, gives the colour `[H, W, C']`: normals,
            texture coordinates, ... are reprojected and lit anew (section 9, vertex-bound scenes); it may close over
            the light of this frame.

    Returns:
        An `Interpolation`.

    Convention:
        Each flow belongs to its own frame's grid and is added; pixels, x right, y down, integers are centres.

    Edge cases:
        A search that ends outside the frame misses, but where both miss its colour is the frame's edge. Flow that is
        not finite misses. Depth that is not finite or not positive is as far as can be, and stays there. Errors that
        differ by less than 0.001 pixels are equal: the point of the frame nearer in time is taken then (at 1/2 the
        next), of two starts' the first, so that rounding decides nothing. Of equal depths that of the next frame is
        taken. alpha 0 takes `previous`, 1 `next`, also where the motion is not finite.

    Gradient:
        With respect to colours, flows and alpha, through the positions that the searches found (implicit function
        theorem, see `iterative_search`) and the weights; which point is taken, and whether it is visible, is held
        fixed, so that thresholds and depths get 0 (but depths in the result). None with respect to `offsets`.

    Raises:
        TypeError, ValueError: a field is absent that is needed, no floating-point array, or of another size; an option
            that is not listed, or does not go with the others.

    References:
        Yang et al. 2011, sections 5 and 9. Departures: one hit without the other is not printed; depths are compared
        relatively; errors count as equal; searches that end outside miss, and "latest" leaves out offsets that missed;
        round trips where there is no depth; choice="depth" and the flow's filter "nearest" by experiment.
    """
    check_scalar("alpha", alpha)
    check_choice("filter", filter, get_args(Filter))
    check_search_options(search)
    check_visibility_options(visibility)
    _checked(previous, next)
    depth, test = _resolve(previous, next, visibility)
    how = {"filter": filter, "depth": depth, "test": test}
    result = _interpolate(*slim(previous, next), alpha, offsets, search, visibility, **how)
    # not compiled with the rest: what it closes over may change from frame to frame
    return result if shade_attributes is None else replace(result, color=shade_attributes(result.color))
