"""Bidirectional reprojection as methods (Yang et al. 2011): a frame between two rendered ones, from both.

"bidirectional" uses what was drawn of the target (section 4): its motion leads to the frame before, the motion of the
frame after, turned around, to that, and what is visible in both is blended. With nothing drawn, and always as
"bidirectional_image", points are searched for in the two rendered frames alone (section 5).
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array

from jaxtrapolate.bidirectional.assisted import DepthKind
from jaxtrapolate.bidirectional.flows import complete_flows
from jaxtrapolate.bidirectional.interpolate import interpolate_bidirectional
from jaxtrapolate.bidirectional.options import VisibilityOptions
from jaxtrapolate.checks import check_present
from jaxtrapolate.methods.between import BETWEEN, CHAINED, PAIR, depth_of
from jaxtrapolate.methods.method import Method, Stage, Values, rendered, upcoming
from jaxtrapolate.methods.stages import SKY, chain, find_holes
from jaxtrapolate.methods.warping import fetch_guided, guides_of
from jaxtrapolate.ops.depth import apart as depth_apart
from jaxtrapolate.ops.depth import held
from jaxtrapolate.ops.motion import camera_motion
from jaxtrapolate.ops.radiance import By, compress, demodulate, expand, modulate
from jaxtrapolate.ops.warp import backward_warp, in_frame, pixel_grid, sample
from jaxtrapolate.precision import widest
from jaxtrapolate.records import Frame, Keyframe, replace

_BLOCK = 8  # pixels, the side of the blocks over which differences are averaged
_MARGIN = 2  # how much better the colour as it is must agree to make up half


def depth_kind(*frames: Frame) -> DepthKind:
    """ "metric" where cameras or positions say what the depth is measured in, else only its order counts."""
    known = all(f.camera is not None or (f.gbuffer is not None and f.gbuffer.position is not None) for f in frames)
    return "metric" if known else "ordinal"


def _search(state, values: Values):
    if "image" in values:  # made with the target's own buffers
        return {}
    previous, next, between = (values[name] for name in ("previous", "next", "between"))
    kind = depth_kind(previous, next)
    flows = complete_flows(
        Keyframe(color=previous.color, depth=depth_of(previous)),
        Keyframe(color=next.color, depth=depth_of(next), backward_flow=between),
        depth=kind,
    )
    first, second = (replace(frame, color=compress(frame.color)) for frame in (flows.previous, flows.next))
    visible = VisibilityOptions(test="round_trip", depth=kind)
    made = interpolate_bidirectional(first, second, values["alpha"], visibility=visible).color
    return {"image": jnp.where(made == first.color, jnp.asarray(previous.color), expand(made))}


SEARCH = Stage("search", _search, reads=CHAINED)
"""Searches for each pixel's point in both frames, along their flows (5.1-5.3); what stands still stays bit for bit.

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


REPROJECT_BOTH = Stage("reproject to both", _reproject, reads=("target.motion", *CHAINED, "target.depth"))
"""The motion from the target to both rendered frames, and where its points are visible there.

To the frame after it is that of the cameras where those are known and the surface is static, else the next frame's
motion turned around (`complete_flows`). Visible is what no hole mask speaks against.
"""


def _optional(stage: Stage) -> Stage:
    return dataclasses.replace(stage, optional=True)


def _layers(frame: Frame, by: By | None) -> Array:
    """What is reprojected `[H, W, 6]`: light, the colour over the reflectance, then the colour; without albedo that."""
    color = check_present("color", frame.color, needed_by="bidirectional reprojection")
    return color if by is None else jnp.concatenate([demodulate(color, frame.gbuffer, by=by), color], -1)


def _demodulates(values: Values, by: By) -> By | None:
    """`by`, where all three frames have the albedo that it takes."""
    frames = (values["previous"], values["target"], values["next"])
    return by if all(f.gbuffer is not None and f.gbuffer.albedo is not None for f in frames) else None


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


_BOTH = (*REPROJECT_BOTH.reads, "history.depth", "future.depth")
"""What the blend of both frames by their depth takes."""


def fetch_stage(by: By) -> Stage:
    """Fetches both frames along the motion, bilinearly."""

    def function(state, values: Values):
        by_ = _demodulates(values, by)
        pairs = (("previous", "to_previous"), ("next", "to_next"))
        fetched = tuple(backward_warp(_layers(values[name], by_), values[motion]) for name, motion in pairs)
        return {"fetched": fetched, "weight": _weight(values), "both": values["seen"][0] & values["seen"][1]}

    return Stage("fetch", function, reads=_BOTH, optional=True)


def guided_fetch_stage(by: By) -> Stage:
    """Fetches both frames from the most similar pixels around where the motion leads, which need not be visible."""

    def function(state, values: Values):
        by_ = _demodulates(values, by)
        fetched, inside = [], []
        motions = (values["to_previous"], values["to_next"])
        for name, motion, seen in zip(("previous", "next"), motions, values["seen"], strict=True):
            frame = values[name]
            layers = fetch_guided(_layers(frame, by_), motion, ~seen, values["target"].gbuffer, frame.gbuffer)
            color = backward_warp(check_present("color", frame.color, needed_by="guided fetch"), motion)
            color = jnp.where(seen, color, layers[..., -3:])  # so that what stands still stays as it is
            fetched.append(jnp.concatenate([layers[..., :-3], color], -1))
            inside.append(in_frame(motion)[..., None])
        one = inside[1].astype(values["alpha"].dtype)
        weight = jnp.where(inside[0] == inside[1], values["alpha"], one)
        return {"fetched": tuple(fetched), "weight": weight, "both": inside[0] & inside[1]}

    return Stage("guided fetch", function, reads=(guides_of("history"), guides_of("future")))


def _blend(state, values: Values):
    first, second = (layers[..., -3:] for layers in values["fetched"])
    return {"image": mix(first, second, values["weight"])}


BLEND = Stage("blend", _blend)
"""Blends the colours of the two frames, see `mix`."""


def _blocks(difference: Array) -> Array:
    """Sums over blocks of pixels; as matrix products, see `hindsight`."""
    height, width, _ = difference.shape

    def member(size):
        return (jnp.arange(size)[:, None] // _BLOCK == jnp.arange(-(-size // _BLOCK))[None]).astype(difference.dtype)

    return (member(height).T @ (jnp.sum(difference, -1) @ member(width)))[..., None]


def _apart(first: Array, second: Array, both: Array) -> Array:
    """The squared difference of two images, tone mapped, by block; squared."""
    return _blocks(jnp.where(both, jnp.square(compress(first) - compress(second)), 0)) ** 2


def relight_stage(by: By, *, reads: tuple[str, ...] = ()) -> Stage:
    """Blends light instead of colour: over each frame's reflectance, times the target's.

    Where light is not reflectance times irradiance (emission, fog) that prints a texture which is not there. There the
    two frames agree better as they are: blocks of 8 x 8 pixels take the colour as it is by how much better it agrees,
    and so do pixels that stand still.

    Args:
        by: as of `demodulate`.
        reads: of the stages before it, where those are optional.
    """

    def function(state, values: Values):
        (first, second), weight, both = values["fetched"], values["weight"], values["both"]
        light = [modulate(layers[..., :3], values["target"].gbuffer, by=by) for layers in (first, second)]
        a, b = _apart(first[..., 3:], second[..., 3:], both) * _MARGIN**2, _apart(light[0], light[1], both)
        relit = jnp.where(a + b > 0, a / jnp.where(a + b > 0, a + b, 1), 1)
        height, width = both.shape[:2]
        x, y = pixel_grid(height, width, relit.dtype)
        x, y = (jnp.broadcast_to((v + 0.5) / _BLOCK - 0.5, (height, width)) for v in (x, y))
        relit = sample(relit, x, y)
        stands = jnp.all(first[..., 3:] == second[..., 3:], -1, keepdims=True)
        for motion in (values["to_previous"], values["to_next"]):
            stands &= jnp.all(motion == 0, -1, keepdims=True)
        relit = jnp.where(stands, 0, relit)
        return {"image": mix(values["image"], mix(light[0], light[1], weight), relit)}

    reads = (*reads, "history.albedo", "target.albedo", "future.albedo")
    return Stage("relight", function, reads=reads, optional=True)


def bidirectional(*, by: By = "albedo+specular") -> Method:
    """Both rendered frames around the target, by the target's own motion and buffers where those were drawn."""
    blend = dataclasses.replace(BLEND, reads=_BOTH, optional=True)
    both = (_optional(REPROJECT_BOTH), fetch_stage(by), blend, relight_stage(by, reads=_BOTH))
    stages = (PAIR, BETWEEN, *both, SEARCH, SKY)
    return Method("bidirectional", stages, kind="interpolation", past=1, future=1)


def bidirectional_image() -> Method:
    """Both rendered frames around the target, from their own buffers alone."""
    return Method("bidirectional_image", (PAIR, BETWEEN, SEARCH), kind="interpolation", past=1, future=1)


def bidirectional_guided(*, by: By = "albedo+specular") -> Method:
    """As "bidirectional", each frame fetched by the guided warp (ExtraSS, section 4.2), and always both blended.

    Ours. The guided warp finds like surfaces beside a hole, so that a frame in which the point is hidden still says
    something of its light.
    """
    stages = (PAIR, BETWEEN, REPROJECT_BOTH, guided_fetch_stage(by), BLEND, relight_stage(by), SKY)
    return Method("bidirectional_guided", stages, kind="interpolation", past=1, future=1)
