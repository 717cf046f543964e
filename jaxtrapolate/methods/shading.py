"""Methods whose light goes on moving: what older frames show of shadows and highlights, continued to the target.

Motion vectors follow surfaces, light does not. Rendered frames, divided by their reflectance and fetched to the
target's surfaces, differ by the light's own motion alone (`shading_flow`). Beyond the newest frame it goes on for the
time until the target; that frame itself, predicted the same way from those before it, says where that is right
(hindsight). Between two frames each one's light goes its part of the way.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.bidirectional.assisted import blend
from jaxtrapolate.methods.between import BETWEEN, PAIR
from jaxtrapolate.methods.bidirectional import BLEND, GUIDED_FETCH, RELIGHT, REPROJECT_BOTH
from jaxtrapolate.methods.frames import Frames, rendered
from jaxtrapolate.methods.hindsight import HINDSIGHT, block_sums, from_blocks
from jaxtrapolate.methods.memory import remember_stage, start
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.methods.seen import Remembered, seen_before_stage
from jaxtrapolate.methods.space import Space
from jaxtrapolate.methods.stage import Needed, Stage, Values
from jaxtrapolate.methods.stages import (
    HOLES,
    SKY,
    chain,
    demodulate_stage,
    find_holes,
    modulate_stage,
    reproject_stage,
)
from jaxtrapolate.methods.warping import GuidedSettings, fetch_guided, guided_stage, guides_of
from jaxtrapolate.ops.depth import held
from jaxtrapolate.ops.radiance import compress, expand
from jaxtrapolate.ops.shading import shading_flow
from jaxtrapolate.ops.warp import backward_warp, landing
from jaxtrapolate.precision import divide, share, widest
from jaxtrapolate.records import Frame, GBuffer

_SURE = 0.1  # of hindsight's share: from no trust to all of it
_MUCH = 0.01  # squared difference after the curve: light is another
_SIGMA = 1.0  # of normals; that of `shading_flow` loses 0.3 dB on one of six training seeds, and gains nothing
_LOGARITHM = 10.0  # of the depth as a guide: 10 % of the depth is one sigma


@settings
class FlowOfLight:
    """Of the flow of light."""

    least_gain: float = option(0.1, "share of the change of light that its flow must explain", low=0, high=1)
    least_change: float = option(3e-5, "squared change of light, after a tone curve, that counts as one", low=0)
    reach: int = option(4, "over how many half-size pixels around changes are averaged", low=0, high=64)


@settings
class Continued(FlowOfLight):
    """Of the flow of light, and of how far it is believed."""

    agreement: float = option(0.5, "where trust begins: share of the error without the flow", low=0, high=1)
    acceleration: float = option(0.5, "how much of its acceleration between three frames light keeps", low=0, high=1)


@settings
class ShadingSettings(Remembered, Continued, GuidedSettings):
    """Of the guided warp, of the flow of light and how far it is believed, and of what older frames have seen."""


@settings
class BetweenSettings(FlowOfLight, GuidedSettings):
    """Of the guided warp and of the flow of light."""


def _silhouettes(*frames: GBuffer | None) -> list[Array | None]:
    """What tells surfaces apart that light does not go on across: normals, or else the depth without a unit.

    Of each frame, those that all have.
    """
    for name in ("normal", "depth"):
        found = [None if buffers is None else getattr(buffers, name) for buffers in frames]
        if all(image is not None for image in found):
            return found if name == "normal" else [_LOGARITHM * jnp.log(held(jnp.asarray(depth))) for depth in found]
    return [None] * len(frames)


class Pair(NamedTuple):
    """Two images of the same surfaces, after the curve, at different times.

    first, second: `[H, W, 3]`, the newer one first. seen: bool `[H, W, 1]`, where both show the surface that they
    should. guide: see `_silhouettes`.
    """

    first: Array
    second: Array
    seen: Array
    guide: Array | None


def _flows(pairs: Sequence[Pair], how: Any, *, hidden: bool) -> list[tuple[Array, Array]]:
    """The shading flow of each pair, and how far to trust it; in a loop, so that it is compiled once.

    hidden: whether it is looked for, too, where one of the two does not show the surface that it should; what the
    guided warp has put there is light of like surfaces around.
    """

    def one(pair: Pair) -> tuple[Array, Array]:
        options = {"least_gain": how.least_gain, "least_change": how.least_change, "reach": how.reach}
        valid = None if hidden else pair.seen[..., 0]
        return shading_flow(pair.first, pair.second, guide=pair.guide, valid=valid, sigma_guide=_SIGMA, **options)

    found = jax.lax.map(one, jax.tree.map(lambda *leaves: jnp.stack(leaves), *pairs))
    return [jax.tree.map(lambda leaf, k=k: leaf[k], found) for k in range(len(pairs))]


def _changes(first: Array, second: Array, valid: Array, least: float | Array) -> Array:
    """Whether light changes anywhere by what counts as a change, and not nearly everywhere by much.

    Where nothing changes there is no trust in any flow; and light that is another all over the frame has not moved: it
    is that of another scene, or was switched.
    """
    wide = widest(first, second)
    apart = first.astype(wide) - second.astype(wide)
    changed = jnp.square(jnp.mean(apart, -1, keepdims=True)) > least
    other = jnp.mean(jnp.square(apart), -1, keepdims=True) > _MUCH
    shares = [jnp.sum((valid & mask).astype(wide)) for mask in (other, valid)]
    return jnp.any(valid & changed) & (2 * shares[0] < shares[1])


def steps_on(frames: Frames, older: int, newer: int, at: Frame, count: int) -> Float[Array, ""]:
    """The time from a frame to `at` as a multiple of that from the older frame to it; by their indices without times.

    Args:
        frames: in order of display.
        older: index of the older one.
        newer: index of the newer one.
        at: the frame whose time is asked for.
        count: how many frames `at` is behind the newer one.
    """
    wide = widest(frames[newer].color)
    counted = jnp.asarray(count / (newer - older), wide)
    times = frames[older].time, frames[newer].time, at.time
    if any(time is None for time in times):
        return counted
    span, onward = (jnp.asarray(times[k + 1] - times[k]).astype(wide) for k in (0, 1))  # type: ignore[operator]
    return divide(onward, span, where=span != 0, otherwise=counted)


def _before(space: Space | None, state, values: Values):
    how, (_, older), (motion, masks) = state.settings, values["sources"][:2], (values["motions"][1], values["masks"])
    buffers = values["target"].gbuffer, older.gbuffer
    fetched = fetch_guided(values["layers"][1][..., :3], motion, masks[1], *buffers, how, space or how.space)
    known = jnp.all(jnp.isfinite(values["warped"][..., :3]) & jnp.isfinite(fetched), -1, keepdims=True)
    return {"light_before": compress(fetched), "seen": known & ~(masks[0] | masks[1])}


def _light_changes(state, values: Values):
    light = compress(values["warped"][..., :3])
    return _changes(light, values["light_before"], values["seen"], state.settings.least_change)


def _then(space: Space | None, state, values: Values):
    how, history = state.settings, values["history"]
    places = rendered(history)[:3]
    newest, *others = (history[k] for k in places)
    images: list[Array] = []
    seen: Array = jnp.ones((), bool)
    for place, frame, layer in zip(places[1:], others, values["layers"][1:3], strict=True):
        motion, buffers = chain(history, places[0], place), (newest.gbuffer, frame.gbuffer)
        holes = find_holes(*buffers, motion)
        fetched = fetch_guided(layer[..., :3], motion, holes, *buffers, how, space or how.space)
        seen &= ~holes & jnp.all(jnp.isfinite(fetched), -1, keepdims=True)
        images.append(compress(fetched))
    return {"light_then": (images[0], images[1], seen)}


def _unchanged(state, values: Values):
    image = values["layers"][0][..., :3]
    return {"light_then": (image, image, jnp.zeros(image[..., :1].shape, bool))}


def _continue(state, values: Values):
    how, history, newest = state.settings, values["history"], values["newest"]
    places, then = rendered(history)[:3], values["light_then"]
    guides = _silhouettes(values["target"].gbuffer, newest.gbuffer)
    pairs = [Pair(compress(values["warped"][..., :3]), values["light_before"], values["seen"], guides[0])]
    if then is not None:
        first, second, seen = then
        pairs.append(Pair(first, second, seen, guides[1]))
    (flow, trust), *others = _flows(pairs, how, hidden=True)
    onward = steps_on(history, places[1], places[0], values["target"], len(history) - places[0])
    moved = onward.astype(flow.dtype) * flow
    if then is not None:
        steps = steps_on(history, places[2], places[1], newest, places[0] - places[1])
        more = _gained(flow, trust, others[0], values["motion"], onward, steps)
        moved = moved + jnp.asarray(how.acceleration, flow.dtype) * more
        truth = compress(values["layers"][0][..., :3])
        better = _better(pairs[1], others[0][0], steps, truth)
        x, y, _ = landing(values["motion"])
        agreed = jnp.clip((from_blocks(better, x, y) - how.agreement) / _SURE, 0, 1)
        trust = trust * agreed.astype(trust.dtype)
    return {"light": backward_warp(pairs[0].first, moved), "trust": trust, "light_flow": moved}


def _gained(flow: Array, trust: Array, then: tuple[Array, Array], motion: Array, onward: Array, steps: Array) -> Array:
    """By how much light gets on further than by its mean motion, if it keeps its acceleration, where both are trusted.

    Args:
        flow: `[H, W, 2]`, of the light from the newest frame to the one before, at the target.
        trust: in that.
        then: the same of the two frames before, at the newest.
        motion: from the target to the newest.
        onward: the time from the newest to the target, over that from the one before to the newest.
        steps: that, over the time between the two before.
    """
    there = backward_warp(jnp.concatenate(then, -1), motion)
    change = flow - steps.astype(flow.dtype) * there[..., :2]
    onward, steps = onward.astype(flow.dtype), steps.astype(flow.dtype)
    size, limit = (jnp.sum(jnp.square(a), -1, keepdims=True) for a in (change, flow))
    known = (trust > 0.5) & (there[..., 2:] > 0.5) & (size < limit)
    return jnp.where(known, divide(onward * (1 + onward) * steps, 1 + steps) * change, 0)


def _stays(state, values: Values):
    light = compress(values["warped"][..., :3])
    return {"light": light, "trust": jnp.zeros_like(light[..., :1]), "light_flow": jnp.zeros_like(light[..., :2])}


def _better(pair: Pair, flow: Array, steps: Array, truth: Array) -> Array:
    """What share of the squared error there is without the flow, 0..1, by blocks of 8 x 8 pixels."""
    moved = backward_warp(pair.first, steps.astype(flow.dtype) * flow)
    return share(*(_errors(image, truth, pair.seen) for image in (pair.first, moved)), otherwise=0)


def _errors(image: Array, truth: Array, seen: Array) -> Array:
    """Squared errors by blocks of 8 x 8 pixels, those around each block counted too."""
    wide = widest(image, truth)
    off = jnp.sum(jnp.square(image.astype(wide) - truth.astype(wide)), -1, keepdims=True)
    sums = block_sums(jnp.where(seen & jnp.isfinite(off), off, 0))
    padded = jnp.pad(sums, ((1, 1), (1, 1), (0, 0)))
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]


def _put(image: Array, light: Array, trust: Array) -> Array:
    """Linear light with light after the curve put in, as far as it is trusted; the rest bit for bit."""
    moved = expand(blend(compress(image), light, trust)).astype(image.dtype)
    return jnp.where(trust > 0, moved, image)


def _move(state, values: Values):
    first, rest = values["warped"][..., :3], values["warped"][..., 3:]
    moved = _put(first, values["light"], values["trust"])
    return {"warped": jnp.concatenate([moved, rest], -1), "image": moved}


MOVE = Stage("moved light", _move, ("warped", "light", "trust"), ("warped", "image"), optional=True)
"""Puts the light where it has gone to; where it is not trusted to move the guided warp stays bit for bit."""


def light_stages(space: Space | None = None) -> tuple[Stage, ...]:
    """What moves the light of "warped" on, between the guided warp and the modulation; the options are `Continued`.

    The light of the rendered frame before the newest is fetched to the target's surfaces too; the flow between the two
    goes on. It is trusted where the same procedure, from the two frames before it, would have predicted the newest
    better ("light in hindsight"), and where the flow of those is trusted too, light keeps a part of its acceleration.
    With two rendered frames the flow's own confidence decides.

    Args:
        space: in which colours are fetched; `None` = the method's option.
    """
    before = Stage(
        "light before",
        partial(_before, space),
        takes=("target", "sources", "motions", "masks", "layers", "warped"),
        gives=("light_before", "seen"),
        reads=(guides_of("history"), "newest.motion", "before_newest.motion"),
        optional=True,
        past=2,
    )
    then = Stage(
        "light in hindsight",
        partial(_then, space),
        takes=("history", "layers", "warped", "light_before", "seen"),
        gives=("light_then",),
        reads=(guides_of("history"), "since_oldest.motion"),
        optional=True,
        past=3,
        needed=Needed("light changes, but not all of it", _light_changes, _unchanged),
    )
    flow = Stage(
        "shading flow",
        _continue,
        takes=("target", "history", "newest", "layers", "motion", "warped", "light_before", "seen", "light_then?"),
        gives=("light", "trust", "light_flow"),
        optional=True,
        needed=Needed("light changes, but not all of it", _light_changes, _stays),
    )
    return before, then, flow, MOVE


def shading_warp() -> Method:
    """The guided warp whose shadows and highlights move on as older frames show, and whose holes older frames fill.

    Ours. Light moves on where hindsight agrees, and keeps half of its acceleration: 0.02 dB more on nine training
    sequences, in moving shadow up to 0.4 (all of it does no more, and costs more where the flow is but noise). With two
    rendered frames the flow's own confidence decides, with one it is the guided warp. What is hidden in the newest is
    looked for in the two older frames, then in what is remembered of all before: the method has memory (`step`),
    without which it knows these two alone.
    """
    first = (reproject_stage(3), HOLES, HINDSIGHT, demodulate_stage(), guided_stage())
    stages = (remember_stage(), *first, *light_stages(), seen_before_stage(), modulate_stage(), SKY)
    return Method("shading_warp", stages, past=3, settings=ShadingSettings(), start=start)


def _towards(state, values: Values):
    first, second = (compress(layers[..., :3]) for layers in values["fetched"])
    seen, (guide,) = values["seen"][0] & values["seen"][1], _silhouettes(values["target"].gbuffer)
    pairs = Pair(first, second, seen, guide), Pair(second, first, seen, guide)
    (onward, trust_onward), (back, trust_back) = _flows(pairs, state.settings, hidden=False)
    trust = jnp.maximum(trust_onward, trust_back)
    flow = divide(trust_onward * onward - trust_back * back, trust_onward + trust_back)
    alpha = values["alpha"].astype(flow.dtype)
    moved = backward_warp(first, -alpha * flow), backward_warp(second, (1 - alpha) * flow)
    pairs = zip(values["fetched"], moved, strict=True)
    return {"fetched": tuple(jnp.concatenate([_put(a[..., :3], b, trust), a[..., 3:]], -1) for a, b in pairs)}


def _differ(state, values: Values):
    first, second = (compress(layers[..., :3]) for layers in values["fetched"])
    return _changes(first, second, values["seen"][0] & values["seen"][1], state.settings.least_change)


BOTH_TOWARDS = Stage(
    "light between",
    _towards,
    takes=("fetched", "seen", "target", "alpha"),
    gives=("fetched",),
    optional=True,
    needed=Needed("light changes, but not all of it", _differ, lambda state, values: {"fetched": values["fetched"]}),
)
"""Carries the light of both frames to the target's time, each its part of the way from one to the other."""


def bidirectional_shading() -> Method:
    """As "bidirectional_guided", the light of both frames carried to the target's time by its own motion.

    Ours. Where the light's motion does not explain what changed between the frames, it is that method. It has no memory
    of frames before: on four training seeds that was worth 0.01 dB here, for half as much time again.
    """
    stages = (PAIR, BETWEEN, REPROJECT_BOTH, GUIDED_FETCH, BOTH_TOWARDS, BLEND, RELIGHT, SKY)
    return Method("bidirectional_shading", stages, kind="interpolation", future=1, settings=BetweenSettings())
