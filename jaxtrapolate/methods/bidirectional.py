"""Bidirectional reprojection as methods (Yang et al. 2011): a frame between two rendered ones, from both.

"bidirectional" uses what was drawn of the target (section 4): its motion leads to the frame before, the motion of the
frame after, turned around, to that, and what is visible in both is blended. With nothing drawn, and always as
"bidirectional_image", points are searched for in the two rendered frames alone (section 5).
"""

import dataclasses
from functools import partial
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxtrapolate.bidirectional.assisted import DepthKind
from jaxtrapolate.bidirectional.flows import complete_flows
from jaxtrapolate.bidirectional.interpolate import interpolate_bidirectional
from jaxtrapolate.bidirectional.options import Choice, SearchOptions, VisibilityOptions, VisibilityTest
from jaxtrapolate.bidirectional.search import FlowFilter, Solver
from jaxtrapolate.checks import check_present
from jaxtrapolate.methods.between import BETWEEN, CHAINED, FRAMES, PAIR, depth_of
from jaxtrapolate.methods.frames import rendered, upcoming
from jaxtrapolate.methods.hindsight import block_sums, from_blocks
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.methods.space import in_space
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.methods.stages import SKY, Demodulation, chain, find_holes, reflecting
from jaxtrapolate.methods.warping import GuidedSettings, fetch_guided, guides_of
from jaxtrapolate.ops.depth import apart as depth_apart
from jaxtrapolate.ops.depth import held
from jaxtrapolate.ops.motion import camera_motion
from jaxtrapolate.ops.radiance import compress, demodulate, expand, modulate
from jaxtrapolate.ops.warp import backward_warp, in_frame, pixel_grid
from jaxtrapolate.precision import share, widest
from jaxtrapolate.records import Frame, Keyframe, replace


@settings
class SearchSettings:
    """Of the search for a pixel's point in both frames, as of `interpolate_bidirectional`."""

    starts: tuple[str, ...] = option(("default", "dual"), "where searches start", choices=("default", "dual"))
    iterations: int = option(3, "of each search", low=0, high=100)
    solver: Solver = option("fixed_point", "how the flow's equation is solved", choices=Solver)
    flow_filter: FlowFilter = option("nearest", "how flows are fetched between pixels", choices=FlowFilter)
    choice: Choice = option(
        "depth", "which of several solutions is taken: the nearest, or that of least error", choices=Choice
    )
    visibility: VisibilityTest = option(
        "round_trip", "how it is told whether a point is seen in the other frame", choices=VisibilityTest
    )
    epsilon_error: float = option(0.5, "a search with a smaller error hits, in pixels", low=0)
    epsilon_depth: float = option(0.05, "depths of one point differ by less, relatively", low=0)
    epsilon_trip: float = option(1.0, "a round trip that ends nearer to its start is one, in pixels", low=0)


@settings
class AssistedSettings(SearchSettings, Demodulation):
    """Of demodulation, of the fetch, and of the search where nothing was drawn of the target."""


def depth_kind(*frames: Frame) -> DepthKind:
    """ "metric" where cameras or positions say what the depth is measured in, else only its order counts."""
    known = all(f.camera is not None or (f.gbuffer is not None and f.gbuffer.position is not None) for f in frames)
    return "metric" if known else "ordinal"


def _search(state, values: Values):
    previous, next, between = (values[name] for name in ("previous", "next", "between"))
    kind = depth_kind(previous, next)
    flows = complete_flows(
        Keyframe(color=previous.color, depth=depth_of(previous)),
        Keyframe(color=next.color, depth=depth_of(next), backward_flow=between),
        depth=kind,
    )
    wide = widest(previous.color)
    first, second = (replace(f, color=compress(jnp.asarray(f.color, wide))) for f in (flows.previous, flows.next))
    how = state.settings
    search = SearchOptions(
        starts=how.starts,
        iterations=how.iterations,
        solver=how.solver,
        filter=how.flow_filter,
        choice=how.choice,
        epsilon=how.epsilon_error,
    )
    visible = VisibilityOptions(
        test=how.visibility, depth=kind, epsilon_depth=how.epsilon_depth, epsilon_trip=how.epsilon_trip
    )
    made = interpolate_bidirectional(first, second, values["alpha"], search=search, visibility=visible).color
    color = jnp.asarray(previous.color)
    return {"image": jnp.where(made == first.color, color, expand(made).astype(color.dtype))}


SEARCH = Stage("search", _search, ("previous", "next", "between", "alpha"), ("image",), reads=CHAINED, fallback=True)
"""Searches for each pixel's point in both frames, along their flows (5.1-5.3); what stands still stays bit for bit.

Left out where the image was made with the target's own buffers.

Departure: colours are fetched and blended after `compress`, not as linear light, see `mix`.
"""


def mix(first: Array, second: Array, weight: Array) -> Array:
    """Both images blended after `compress`: where they differ by much, in linear light the brighter one wins.

    On a path-traced map that gives 0.3-0.6 dB, under lamps that flicker 1-2 dB. Where both are the same it is exact.
    Of the dtype of the first, blended in at least float32.
    """
    wide = widest(first, second, weight)
    weight = weight.astype(wide)
    mixed = compress(first.astype(wide)) * (1 - weight) + compress(second.astype(wide)) * weight
    mixed = expand(mixed).astype(first.dtype)
    mixed = jnp.where(weight == 0, first, jnp.where(weight == 1, second, mixed))
    return jnp.where(first == second, first, mixed)


def _reproject(state, values: Values):
    history, target, future = (values[name] for name in ("history", "target", "future"))
    frames, place = (*history, target, *future), len(history)
    to_previous = chain(frames, place, rendered(history)[0])
    from_next = chain(frames, place + 1 + upcoming(future)[0], place)
    next = values["next"]
    flows = complete_flows(
        Keyframe(depth=depth_of(target)),
        Keyframe(depth=depth_of(next), backward_flow=from_next),
        depth=depth_kind(target, next),
    )
    to_next, known = flows.previous.forward_flow[..., :2], flows.forward_known
    g = target.gbuffer
    if target.camera is not None and next.camera is not None and g.position is not None and g.stencil is not None:
        exact = camera_motion(g.position, target.camera, next.camera)
        still = (g.stencil < 0.5) & jnp.all(jnp.isfinite(exact), -1, keepdims=True)
        to_next, known = jnp.where(still, exact.astype(to_next.dtype), to_next), known | still[..., 0]
    seen_next = known[..., None] & ~find_holes(g, next.gbuffer, to_next)
    previous = values["previous"]
    seen_previous = ~find_holes(g, previous.gbuffer, to_previous)
    return {"to_previous": to_previous, "to_next": to_next, "seen": (seen_previous, seen_next)}


REPROJECT_BOTH = Stage(
    "reproject to both",
    _reproject,
    takes=(*FRAMES, "previous", "next"),
    gives=("to_previous", "to_next", "seen"),
    reads=("target.motion", *CHAINED, "target.depth"),
)
"""The motion from the target to both rendered frames, and where its points are visible there.

To the frame after it is that of the cameras where those are known and the surface is static, else the next frame's
motion turned around (`complete_flows`). Visible is what no hole mask speaks against.
"""


def _layers(values: Values, how: Any) -> list[Array]:
    """What is reprojected of both frames `[H, W, 6]`: light, the colour over the reflectance, then the colour.

    The colour alone unless both and the target have albedo. how: a `Demodulation`.
    """
    frames = (values["previous"], values["next"])
    colors = [check_present("color", frame.color, needed_by="bidirectional reprojection") for frame in frames]
    if any(f.gbuffer is None or f.gbuffer.albedo is None for f in (*frames, values["target"])):
        return colors
    buffers = [reflecting(frame.gbuffer, how.sky) for frame in frames]
    light = [demodulate(c, b, by=how.by, floor=how.floor) for c, b in zip(colors, buffers, strict=True)]
    return [jnp.concatenate(pair, -1) for pair in zip(light, colors, strict=True)]


def _weight(values: Values) -> Array:
    """The next frame's weight (section 4): visible in both, the time; in one, that one alone; in neither, the likelier.

    Closest-on-miss takes the nearer of the two. Here the target's depth is known: the frame whose depth there is
    nearest to it is taken, one that the point is inside of first.
    """
    in_first, in_second = values["seen"]
    at = (values["to_previous"], values["to_next"])
    inside = [in_frame(motion)[..., None] for motion in at]
    depth, *depths = (
        check_present(f"{name}.depth", depth_of(values[name]), needed_by="the blend")
        for name in ("target", "previous", "next")
    )
    apart = [depth_apart(backward_warp(held(there), motion), depth) for there, motion in zip(depths, at, strict=True)]
    likelier = jnp.where(inside[0] == inside[1], apart[1] < apart[0], inside[1])
    one = jnp.where(in_first == in_second, likelier, in_second)
    return jnp.where(in_first & in_second, values["alpha"], one.astype(values["alpha"].dtype))


_REPROJECTED = ("previous", "next", "target", "alpha", *REPROJECT_BOTH.gives)
_FETCHED = ("fetched", "weight", "both")


def _fetch(state, values: Values):
    how = state.settings
    pairs = zip(_layers(values, how), ("to_previous", "to_next"), strict=True)
    fetched = tuple(
        in_space(how.space, partial(backward_warp, motion=values[motion]), layers) for layers, motion in pairs
    )
    return {"fetched": fetched, "weight": _weight(values), "both": values["seen"][0] & values["seen"][1]}


FETCH = Stage("fetch", _fetch, _REPROJECTED, _FETCHED, reads=("target.depth", "history.depth", "future.depth"))
"""Fetches both frames along the motion, bilinearly."""


def _guided_fetch(state, values: Values):
    fetched, inside = [], []
    frames, motions = (values["previous"], values["next"]), (values["to_previous"], values["to_next"])
    both = zip(frames, _layers(values, state.settings), motions, values["seen"], strict=True)
    for frame, given, motion, seen in both:
        buffers = values["target"].gbuffer, frame.gbuffer
        layers = fetch_guided(given, motion, ~seen, *buffers, state.settings, state.settings.space)
        color = in_space(state.settings.space, partial(backward_warp, motion=motion), given[..., -3:])
        color = jnp.where(seen, color, layers[..., -3:])  # so that what stands still is exact
        fetched.append(jnp.concatenate([layers[..., :-3], color], -1))
        inside.append(in_frame(motion)[..., None])
    one = inside[1].astype(values["alpha"].dtype)
    weight = jnp.where(inside[0] == inside[1], values["alpha"], one)
    return {"fetched": tuple(fetched), "weight": weight, "both": inside[0] & inside[1]}


GUIDED_FETCH = Stage(
    "guided fetch", _guided_fetch, _REPROJECTED, _FETCHED, reads=(guides_of("history"), guides_of("future"))
)
"""Fetches both frames from the most similar pixels around where the motion leads, which need not be visible."""


def _blend(state, values: Values):
    first, second = (layers[..., -3:] for layers in values["fetched"])
    return {"image": mix(first, second, values["weight"])}


BLEND = Stage("blend", _blend, ("fetched", "weight"), ("image",))
"""Blends the colours of the two frames, see `mix`."""


def _apart(first: Array, second: Array, both: Array) -> Array:
    """The squared difference of two images, tone mapped, summed by block."""
    wide = widest(first, second)
    difference = compress(first.astype(wide)) - compress(second.astype(wide))
    return block_sums(jnp.sum(jnp.where(both, jnp.square(difference), 0), -1, keepdims=True))


def _relight(state, values: Values):
    (first, second), weight, both, how = values["fetched"], values["weight"], values["both"], state.settings
    buffers = reflecting(values["target"].gbuffer, how.sky)
    light = [modulate(layers[..., :3], buffers, by=how.by, floor=how.floor) for layers in (first, second)]
    a, b = _apart(first[..., 3:], second[..., 3:], both), _apart(light[0], light[1], both)
    relit = share(jnp.asarray(how.margin, a.dtype) * a, b, otherwise=1)
    height, width = both.shape[:2]
    x, y = (jnp.broadcast_to(v, (height, width)) for v in pixel_grid(height, width, relit.dtype))
    relit = from_blocks(relit, x, y)
    stands = jnp.all(first[..., 3:] == second[..., 3:], -1, keepdims=True)
    for motion in (values["to_previous"], values["to_next"]):
        stands &= jnp.all(motion == 0, -1, keepdims=True)
    relit = jnp.where(stands, 0, relit)
    return {"image": mix(values["image"], mix(light[0], light[1], weight), relit)}


RELIGHT = Stage(
    "relight",
    _relight,
    takes=(*_FETCHED, "image", "target", "to_previous", "to_next"),
    gives=("image",),
    reads=("history.albedo", "target.albedo", "future.albedo"),
    optional=True,
)
"""Blends light instead of colour: over each frame's reflectance, times the target's.

Where light is not reflectance times irradiance (emission, fog) that prints a texture which is not there. There the two
frames agree better undivided: blocks of 8 x 8 pixels take the undivided colour by how much better it agrees, and so do
pixels that stand still.
"""


def bidirectional() -> Method:
    """Both rendered frames around the target, by the target's own motion and buffers where those were drawn."""
    assisted = (REPROJECT_BOTH, FETCH, BLEND)
    assisted = (dataclasses.replace(stage, optional=True, group="target") for stage in assisted)
    stages = (PAIR, BETWEEN, *assisted, RELIGHT, SEARCH, SKY)
    return Method("bidirectional", stages, kind="interpolation", future=1, settings=AssistedSettings())


def bidirectional_image() -> Method:
    """Both rendered frames around the target, from their own buffers alone."""
    stages = (PAIR, BETWEEN, SEARCH)
    return Method("bidirectional_image", stages, kind="interpolation", future=1, settings=SearchSettings())


def bidirectional_guided() -> Method:
    """As "bidirectional", each frame fetched by the guided warp (ExtraSS, section 4.2), and always both blended.

    Ours. The guided warp finds like surfaces beside a hole, so that a frame in which the point is hidden still says
    something of its light.
    """
    stages = (PAIR, BETWEEN, REPROJECT_BOTH, GUIDED_FETCH, BLEND, RELIGHT, SKY)
    return Method("bidirectional_guided", stages, kind="interpolation", future=1, settings=GuidedSettings())
