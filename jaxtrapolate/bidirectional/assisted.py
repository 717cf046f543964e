"""Scene-assisted interpolation (Yang et al. 2011, section 4), and what it shares with the image-based one.

The geometry of the frame to be generated is drawn without shading: its depth, and where its points are in the two
rendered frames around it. Colours come from there, where a depth test finds the point visible.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrapolate.bidirectional.search import Correspondence, fetch_finite, positions, within
from jaxtrapolate.checks import ArrayLike, Size, check_choice, check_image, check_present, check_scalar
from jaxtrapolate.ops.depth import held, released, surface_depth
from jaxtrapolate.ops.strips import by_strips, once, rows_of
from jaxtrapolate.ops.warp import Filter, all_finite, weigh
from jaxtrapolate.precision import widest
from jaxtrapolate.records import DepthKind as DepthKind
from jaxtrapolate.records import Keyframe, record, replace

Shader = Callable[[Array], Array]

CASES = ("agree", "nearer", "one", "neither", "assisted", "missed", "rendered")
"""How a pixel was generated; `Interpolation.case` gives indices into this.

Image-based (5.2): both searches hit the same point; both hit, and the nearer point was taken; one hit; neither did.
Scene-assisted (4): the point is visible in at least one of the frames around; in neither. "rendered": drawn anew (6).
"""


@record
@dataclasses.dataclass(frozen=True)
class Offsets:
    """What the searches of one interpolated frame leave for those of the next (5.3, latest-frame initialization).

    forward, backward `[H, W, 2]`: p - position in the I-frame before and after. forward_depth, backward_depth
    `[H, W, 1]`: of the points found, infinite where the search missed; `None` without depth. alpha: of that frame.
    """

    alpha: Float[Array, ""]
    forward: Float[Array, "h w 2"]
    backward: Float[Array, "h w 2"]
    forward_depth: Float[Array, "h w 1"] | None = None
    backward_depth: Float[Array, "h w 1"] | None = None


@record
@dataclasses.dataclass(frozen=True)
class Interpolation:
    """An interpolated frame and how it came about.

    color `[H, W, C]`. weight `[H, W, 1]`: that of the next frame's colour: alpha where both are blended, 0 or 1 where
    one was taken alone. case `[H, W]`: index into `CASES`. forward, backward: the point's position in the frame before
    and after, as searched or as given by the scene. depth `[H, W, 1]`: in the interpolated frame; `None` without depth.
    offsets: for the next frame's searches.
    """

    color: Float[Array, "h w c"]
    weight: Float[Array, "h w 1"]
    case: Int[Array, "h w"]
    forward: Correspondence
    backward: Correspondence
    depth: Float[Array, "h w 1"] | None = None
    offsets: Offsets | None = None


def blend(
    first: Float[Array, "h w c"], second: Float[Array, "h w c"], weight: Float[Array, "h w 1"]
) -> Float[Array, "h w c"]:
    """(1 - weight) first + weight second (eq. 13-15); at 0 and 1 one of them bit for bit, whatever the other is."""
    wide = widest(first, weight)
    weight = weight.astype(wide)
    return (weigh(first.astype(wide), 1 - weight) + weigh(second.astype(wide), weight)).astype(first.dtype)


def agree(found: Array, expected: Array, epsilon: Array, kind: DepthKind) -> Bool[Array, "*n"]:
    """Whether two depths are of one point: they differ by less than epsilon, relative to the smaller if metric.

    Infinite depths of one sign agree; a NaN agrees with nothing.
    """
    scale = jnp.minimum(jnp.abs(found), jnp.abs(expected)) if kind == "metric" else jnp.ones_like(found)
    return (found == expected) | (jnp.abs(found - expected) < epsilon * scale)


def shown(
    depth: Float[Array, "h w 1"],
    at: Float[Array, "i j 2"],
    expected: Float[Array, "i j 1"],
    epsilon: Array,
    finite: Array | None = None,
) -> Bool[Array, "i j 1"]:
    """Whether a point of the expected depth is what a frame shows at `at`: inside, and its depth agrees.

    finite: what `all_finite` says of the depth, where that is known. Depths should be `held`: a mixture of a surface
    with nothing then agrees with what it is nearly all of.
    """
    found = fetch_finite(depth, at, "bilinear", finite).astype(expected.dtype)
    return within(at, *depth.shape[:2])[..., None] & agree(found, expected, epsilon, "metric")


def check_keyframe(name: str, value: Keyframe, *, size: Size | None = None) -> Size:
    """The size of a keyframe's images; raises where one differs or there is no colour, and on what is no `Keyframe`."""
    if not isinstance(value, Keyframe):
        raise TypeError(f"{name}: expected a Keyframe, got {type(value).__name__}")
    color = check_present(f"{name}.color", value.color, needed_by="interpolation")
    size = check_image(f"{name}.color", color, size=size)
    if value.depth is not None:
        check_image(f"{name}.depth", value.depth, size=size, channels=1)
    return size


def check_target(target: Keyframe, *, size: Size) -> None:
    """Raise unless a target has depth and both 3D flows."""
    if not isinstance(target, Keyframe):
        raise TypeError(f"target: expected a Keyframe, got {type(target).__name__}")
    for name, channels in (("depth", 1), ("forward_flow", 3), ("backward_flow", 3)):
        value = check_present(f"target.{name}", getattr(target, name), needed_by="scene-assisted interpolation")
        check_image(f"target.{name}", value, size=size, channels=channels)


def _part(sources, top, rows: int, *, filter: Filter) -> Interpolation:
    """Some rows of the frame, before shading."""
    frames, target, alpha, epsilon = sources
    depth, *flows = (rows_of(a, top, rows).astype(alpha.dtype) for a in target)
    grid = positions(rows, depth.shape[1], alpha.dtype, top=top)
    ways = []
    for (color, buffer, finite), flow in zip(frames, flows, strict=True):
        # what is far stays far, whatever the change of its depth
        flow = jnp.concatenate([flow[..., :2], jnp.where(released(depth) == jnp.inf, 0, flow[..., 2:])], -1)
        known = jnp.all(jnp.isfinite(flow), -1, keepdims=True)
        flow = jnp.where(known, flow, 0)
        at = grid + flow[..., :2]
        there = fetch_finite(buffer, at, "bilinear", finite[1]).astype(alpha.dtype)
        same = agree(there, depth + flow[..., 2:], epsilon, "metric")
        seen = once(known & within(at, *buffer.shape[:2])[..., None] & same)
        found = Correspondence(at, -flow[..., 2:], jnp.where(known, 0, jnp.inf).astype(alpha.dtype))
        ways.append((fetch_finite(color, at, filter, finite[0]), seen, there, found))
    (first, in_first, first_depth, forward), (second, in_second, second_depth, backward) = ways
    closest = jnp.where(second_depth < first_depth, 1, 0).astype(alpha.dtype)  # closest-on-miss
    one = jnp.where(in_first == in_second, closest, jnp.where(in_second, 1, 0).astype(alpha.dtype))
    weight = jnp.where(in_first & in_second, alpha, one)
    missed = ~(in_first | in_second)[..., 0]
    case = jnp.where(missed, CASES.index("missed"), CASES.index("assisted")).astype(jnp.int32)
    return Interpolation(blend(first, second, weight), weight, case, forward, backward, released(depth))


@partial(jax.jit, static_argnames=("filter",))
def _assisted(previous, next, target, alpha, epsilon, *, filter):
    wide = widest(target.forward_flow)
    alpha, epsilon = (jnp.asarray(a).astype(wide) for a in (alpha, epsilon))
    depths = [held(surface_depth(jnp.asarray(f.depth))) for f in (previous, next, target)]
    previous, next, target = (replace(f, depth=d) for f, d in zip((previous, next, target), depths, strict=True))
    frames = tuple((f.color, f.depth, (all_finite(f.color), all_finite(f.depth))) for f in (previous, next))
    sources = frames, (target.depth, target.backward_flow, target.forward_flow), alpha, epsilon
    return by_strips(partial(_part, filter=filter), target.depth.shape[0], sources)


def interpolate_assisted(
    previous: Keyframe,
    next: Keyframe,
    target: Keyframe,
    alpha: float | Float[ArrayLike, ""],
    *,
    epsilon_depth: float | Float[ArrayLike, ""] = 0.05,
    filter: Filter = "bilinear",
    shade_on_miss: Shader | None = None,
    shade_attributes: Shader | None = None,
) -> Interpolation:
    """The frame at t + alpha from its geometry, and the colours of the rendered frames before and after it.

    Each point is looked up in both frames, and counts as visible where it lands inside and the depth there agrees with
    its own: visible in both, the colours are blended by alpha; in one, that colour is taken; in neither, what
    `shade_on_miss` says, or the nearer of the two (closest-on-miss).

    Args:
        previous: with color `[H, W, C]`, any attributes, and depth.
        next: the frame after it, likewise.
        target: of the frame to be generated: depth, backward_flow to `previous`, forward_flow to `next`, exact; see
            `camera_flow`. Its color is not looked at.
        alpha: in 0..1, traced.
        epsilon_depth: how far depths of one point may differ, relative to the smaller.
        filter: of the colours, as in `backward_warp`.
        shade_on_miss: called with the mask `[H, W]` of the pixels visible in neither frame, gives their colour
            `[H, W, C']`.
        shade_attributes: called with the blended attributes, gives the colour `[H, W, C']`; it may close over what
            changes.

    Returns:
        An `Interpolation` without offsets.

    Convention:
        The target's flows belong to its own grid, and are added; depth is along the view axis, metric; what is not
        positive is nothing, as far as +inf, and stays there.

    Edge cases:
        Flow or depth that is not finite (but where both show nothing) is visible nowhere; non-finite flow
        looks at the pixel itself. What is outside a frame is not visible in it; closest-on-miss repeats the frame's
        edge there, and takes the earlier frame where depths are equal or unknown.

    Gradient:
        With respect to colours, flows and alpha; which pixels are visible is held fixed.

    Raises:
        TypeError, ValueError: a field is absent, no floating-point array, or of another size; an unknown option.

    References:
        Yang et al. 2011, section 4; Nehab et al. 2007. Departure: depths are compared relatively.
    """
    size = check_keyframe("previous", previous)
    check_keyframe("next", next, size=size)
    for name, frame in (("previous", previous), ("next", next)):
        check_present(f"{name}.depth", frame.depth, needed_by="scene-assisted interpolation")
    check_target(target, size=size)
    check_scalar("alpha", alpha)
    check_choice("filter", filter, get_args(Filter))
    previous, next = (Keyframe(color=f.color, depth=f.depth) for f in (previous, next))
    target = replace(target, color=None, stencil=None, time=None)
    result = _assisted(previous, next, target, alpha, epsilon_depth, filter=filter)
    # not compiled with the rest: what they close over may change from frame to frame
    color = result.color if shade_attributes is None else shade_attributes(result.color)
    if shade_on_miss is not None:
        missed = result.case == CASES.index("missed")
        color = jnp.where(missed[..., None], shade_on_miss(missed).astype(color.dtype), color)
    return replace(result, color=color)


def drawn_over(below: Interpolation, above: Interpolation, covered: Array, epsilon: Array) -> Interpolation:
    """`below`, with what `above` has where it is covered and not hidden."""
    drawn = covered[..., None]
    depth = below.depth
    if depth is not None and above.depth is not None:
        depth = surface_depth(depth)
        over = surface_depth(above.depth).astype(depth.dtype)
        drawn &= (over <= depth) | agree(over, depth, epsilon, "metric")
        depth = jnp.where(drawn, over, depth)
    return replace(
        below,
        color=jnp.where(drawn, above.color.astype(below.color.dtype), below.color),
        weight=jnp.where(drawn, above.weight.astype(below.weight.dtype), below.weight),
        case=jnp.where(drawn[..., 0], above.case, below.case),
        depth=depth,
    )


@jax.jit
def overlay(
    below: Interpolation,
    color: Float[ArrayLike, "h w c"],
    depth: Float[ArrayLike, "h w 1"],
    covered: Bool[ArrayLike, "h w"],
    *,
    epsilon_depth: float | Float[ArrayLike, ""] = 0.05,
) -> Interpolation:
    """Pixels that were rendered anew, drawn over an interpolated frame through one depth buffer (Figure 4).

    Args:
        below: the interpolated frame, as a rule from I-frames that leave out what is drawn now.
        color: `[H, W, C]`.
        depth: `[H, W, 1]`.
        covered: `[H, W]`, where something was rendered.
        epsilon_depth: by how much, relative to the smaller depth, it may lie behind and still be drawn.

    Returns:
        `below` with color, depth and case exchanged where something was drawn that is not hidden. Without a depth below
        nothing hides it; a NaN depth is hidden. A depth that is not positive is nothing, and behind all surfaces.

    Gradient:
        With respect to both colours and depths as picked; the pick is held fixed.

    Raises:
        TypeError, ValueError: no floating-point array, or a shape that does not fit.

    References:
        Yang et al. 2011, section 6.
    """
    size = check_image("below.color", below.color)
    check_image("color", color, size=size, channels=below.color.shape[2])
    check_image("depth", depth, size=size, channels=1)
    case = jnp.full(size, CASES.index("rendered"), below.case.dtype)
    above = replace(below, color=jnp.asarray(color), depth=jnp.asarray(depth), case=case)
    return drawn_over(below, above, jnp.asarray(covered), jnp.asarray(epsilon_depth).astype(below.weight.dtype))
