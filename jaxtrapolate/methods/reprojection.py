"""Baselines that reproject the newest rendered frame, its colour undivided: nothing is demodulated.

"onward" is a forward motion, on the newest rendered frame's grid, to the target.
"""

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrapolate.bidirectional.assisted import agree
from jaxtrapolate.bidirectional.flows import camera_flow
from jaxtrapolate.checks import check_present
from jaxtrapolate.methods.between import depth_of
from jaxtrapolate.methods.frames import Frames, rendered
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.methods.space import Space, in_space, space
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.methods.stages import REPROJECT, SKY
from jaxtrapolate.ops.depth import changed
from jaxtrapolate.ops.fill import fill_around
from jaxtrapolate.ops.jitter import jitter_difference, shift_motion
from jaxtrapolate.ops.scatter import splat_nearest
from jaxtrapolate.ops.warp import backward_warp, in_frame, weigh
from jaxtrapolate.precision import divide, widest
from jaxtrapolate.records import Frame

Shade = Callable[[Frame, Bool[Array, "h w"]], Float[Array, "h w 3"]]
"""What a renderer does on a cache miss: colours `[H, W, 3]` for a target, looked at where the mask `[H, W]` is True."""


@settings
class DepthTest:
    """Of the test whether two depths are of one point."""

    epsilon: float = option(0.05, "the relative difference of depths of one point is less", low=0)
    space: Space = space()


def reprojection(shade: Shade | None = None) -> Method:
    """Reverse reprojection: the newest frame along the target's own motion, and a depth test that finds cache misses.

    A pixel misses where its motion leads outside, or where the depth there is not its own: compared relatively
    (`epsilon`), after the change of depth that the cameras tell where positions and both cameras are there, else
    unchanged.

    Args:
        shade: renders what missed, given the target (which has no colour: a held-back frame's is never seen) and the
            mask. Without it misses keep what was fetched, so that the image is that of "warp".

    References: Nehab et al. 2007; Yang et al. 2011, sections 2 and 9 ("single-direction reprojection"). Departure: the
    depth test is relative; objects' own changes of depth are not known and count as none.
    """

    def change(state, values: Values):
        target, newest = values["target"], values["newest"]
        flow = camera_flow(target.gbuffer.position, target.camera, newest.camera)
        change = flow[..., 2:]
        static = jnp.isfinite(change)
        if target.gbuffer.stencil is not None:
            static &= target.gbuffer.stencil == 0
        return {"change": jnp.where(static, change, 0)}

    def test(state, values: Values):
        motion, expected = values["motion"], values["target"].gbuffer.depth
        expected = expected if values["change"] is None else changed(expected, values["change"])
        found = backward_warp(values["newest"].gbuffer.depth, motion, filter="nearest")
        return {
            "missed": ~(
                in_frame(motion)
                & agree(found, expected, jnp.asarray(state.settings.epsilon, found.dtype), "metric")[..., 0]
            )
        }

    def fetch(state, values: Values):
        fetch = partial(backward_warp, motion=values["motion"])
        image = in_space(state.settings.space, fetch, values["newest"].color)
        if shade is not None:
            missed = ~in_frame(values["motion"]) if values["missed"] is None else values["missed"]
            image = jnp.where(missed[..., None], shade(values["target"], missed).astype(image.dtype), image)
        return {"image": image}

    both, cameras = ("newest", "target"), ("target.position", "target.camera", "history.camera")
    depths = ("target.depth", "history.depth")
    stages = (
        REPROJECT,
        Stage("change of depth", change, both, ("change",), reads=cameras, optional=True),
        Stage("depth test", test, (*both, "motion", "change?"), ("missed",), reads=depths, optional=True),
        Stage("fetch", fetch, (*both, "motion", "missed?"), ("image",)),
        SKY,
    )
    return Method("reproject" if shade is None else "reproject_shade", stages, settings=DepthTest())


def steps_onward(history: Frames, target: Frame) -> Float[Array, ""]:
    """How often the newest rendered frame's motion to the frame before it goes into the time until the target.

    By the frames' times; a frame that is not handed over was one frame earlier. Without times, by the number of frames.
    In the precision of the images, at least float32.
    """
    newest = rendered(history)[0]
    wide = widest(history[newest].color)
    counted = jnp.asarray(len(history) - newest, wide)
    now, at = history[newest].time, target.time
    if now is None or at is None:
        return counted
    before = history[newest - 1].time if newest > 0 else None
    span = jnp.ones((), wide) if before is None else jnp.asarray(now - before).astype(wide)
    return divide(jnp.asarray(at - now).astype(wide), span, where=span != 0, otherwise=counted)


def _newest(state, values: Values):
    history = values["history"]
    return {"newest": history[rendered(history)[0]], "steps": steps_onward(history, values["target"])}


NEWEST = Stage("newest", _newest, ("history", "target"), ("newest", "steps"), reads=("history.color",))
"""Finds the newest rendered frame and how far ahead the target is."""


def _linear(state, values: Values):
    history, target = values["history"], values["target"]
    index = rendered(history)[0]
    newest, motion = history[index], history[index].motion
    if index and (difference := jitter_difference(newest, history[index - 1])) is not None:
        motion = motion - difference.astype(motion.dtype)  # surfaces move, whatever the jitter does
    along = weigh(motion, -values["steps"].astype(motion.dtype))
    return {"linear": shift_motion(along, newest, target)}


LINEAR = Stage(
    "linear motion", _linear, ("history", "target", "steps"), ("linear",), reads=("history.motion",), optional=True
)
"""The motion to the frame before, turned around and scaled by time: all goes on moving on the screen as it did."""


def _camera(state, values: Values):
    newest, target = values["newest"], values["target"]
    buffers = newest.gbuffer
    flow = camera_flow(buffers.position, newest.camera, target.camera)
    still = jnp.zeros((*flow.shape[:2], 1), bool) if buffers.stencil is None else buffers.stencil == 0
    still = still if buffers.sky is None else still & (buffers.sky < 0.5)
    return {"exact": flow, "still": still}


_CAMERAS = ("history.position", "history.camera", "target.camera")

CAMERA = Stage("camera motion", _camera, ("newest", "target"), ("exact", "still"), reads=_CAMERAS, optional=True)
"""The exact motion and change of depth from both cameras, and of what the stencil calls static, so that it holds."""


def _onward(state, values: Values):
    linear, exact, still = (values[name] for name in ("linear", "exact", "still"))
    if exact is None:
        needs = "the motion of the newest rendered frame to the target"
        return {"onward": check_present("motion, or positions and cameras", linear, needed_by=needs), "deeper": None}
    if linear is None:
        return {"onward": exact[..., :2], "deeper": exact[..., 2:]}
    return {"onward": jnp.where(still, exact[..., :2], linear), "deeper": jnp.where(still, exact[..., 2:], 0)}


ONWARD = Stage(
    "onward",
    _onward,
    takes=("linear?", "exact?", "still?"),
    gives=("onward", "deeper"),
    reads=tuple(f"history.motion|{name}" for name in _CAMERAS),
)
"""The cameras' motion where that holds, else the linear one; all of one kind where the other is not there."""


def carried_depth(values: Values) -> Array:
    """The newest frame's points' depth `[H, W, 1]` in the target, where that is known; zeros without depth."""
    depth = depth_of(values["newest"])
    if depth is None:
        return jnp.zeros_like(values["onward"][..., :1])
    deeper = values["deeper"]
    return depth if deeper is None else changed(depth, jnp.where(jnp.isfinite(deeper), deeper, 0))


def warp_3d() -> Method:
    """The newest frame's pixels pushed along their own motion to the target, the nearest in depth winning.

    No buffer of the target is looked at, but its camera. The forward motion of what is static is exact where cameras,
    positions and a stencil are there; else, and of what moves, it is the motion to the frame before, carried on
    linearly. A pixel covers the four around where it lands; each of these fetches its colour bilinearly along the
    motion that landed on it. Where the fetch would meet another surface (depths differ by more than `epsilon`) the
    pixel is beside a silhouette: there counts what lands within half a pixel, if anything does, and else the colour
    that landed. A hole takes the colour of the farthest of the next covered pixels left, right, above and below
    (`fill_around`).

    References: Mark et al. 1997, sections 2 and 3. Departures: one reference frame, the past one, so that nothing is
    known behind a silhouette; splats of four pixels with bilinear fetches for their mesh of triangles; objects move.
    """

    def push(state, values: Values):
        color, onward, depth, how = values["newest"].color, values["onward"], carried_depth(values), state.settings
        own = depth_of(values["newest"])
        own = depth if own is None else own
        layers = jnp.concatenate([-onward, *(a.astype(onward.dtype) for a in (depth, own, color))], -1)

        def land(footprint):
            """What landed, its fetched colour, its depth, where it is covered, and whether the fetch meets itself."""
            pushed, covered = splat_nearest(layers, onward, depth, footprint=footprint)
            back, expected, whole = pushed[..., :2], pushed[..., 3:4], pushed[..., 4:]
            found = backward_warp(own, back, filter="nearest")
            same = agree(found, expected, jnp.asarray(how.epsilon, found.dtype), "metric")
            return (
                jnp.where(
                    same, in_space(how.space, partial(backward_warp, motion=back), color), whole.astype(color.dtype)
                ),
                pushed[..., 2:3],
                covered,
                same,
            )

        (wide, wide_z, covered, same), (near, near_z, centred, _) = land(4), land(1)
        beside = centred[..., None] & ~same  # beyond a silhouette, and something lands there more exactly
        return {"warped": jnp.where(beside, near, wide), "z": jnp.where(beside, near_z, wide_z), "covered": covered}

    def fill(state, values: Values):
        known = None if depth_of(values["newest"]) is None else values["z"]
        return {"image": fill_around(values["warped"], values["covered"], depth=known)}

    stages = (
        NEWEST,
        LINEAR,
        CAMERA,
        ONWARD,
        Stage("push", push, ("newest", "onward", "deeper"), ("warped", "z", "covered")),
        Stage("fill", fill, ("newest", "warped", "z", "covered"), ("image",)),
    )
    return Method("warp_3d", stages, settings=DepthTest())
