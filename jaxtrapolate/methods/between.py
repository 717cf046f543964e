"""Stages that interpolating methods share.

Values they pass on: "previous" and "next", the rendered frames around the target; "alpha", the target's time between
them; "between", the motion from the next to the previous frame, on the next frame's grid; "forward" and "backward",
the flows between the two, each on its own frame's grid.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.bidirectional.flows import complete_flows
from jaxtrapolate.methods.frames import Frames, rendered, upcoming
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.methods.stages import chain
from jaxtrapolate.precision import divide, widest
from jaxtrapolate.records import Frame, Keyframe


def time_fraction(history: Frames, target: Frame, future: Frames) -> Float[Array, ""]:
    """The target's time as a fraction of that between the rendered frames around it, 0 at the earlier one.

    Where one of the three frames has no time, or both of those around the same, by their indices in the sequence: 1/2
    between two neighbours. In the precision of the images, at least float32, whatever that of the times.
    """
    newest, following = rendered(history)[0], upcoming(future)[0]
    wide = widest(history[newest].color)
    counted = jnp.asarray((len(history) - newest) / (len(history) - newest + following + 1), wide)
    times = history[newest].time, target.time, future[following].time
    if any(time is None for time in times):
        return counted
    to, whole = (jnp.asarray(times[k] - times[0]).astype(wide) for k in (1, 2))  # type: ignore[operator]
    return divide(to, whole, where=whole != 0, otherwise=counted)


def _pair(state, values: Values):
    history, target, future = (values[name] for name in ("history", "target", "future"))
    return {
        "previous": history[rendered(history)[0]],
        "next": future[upcoming(future)[0]],
        "alpha": time_fraction(history, target, future),
    }


FRAMES = ("history", "target", "future")

PAIR = Stage("pair", _pair, FRAMES, ("previous", "next", "alpha"), reads=("history.color", "future.color"))
"""Finds the rendered frames around the target, and its time between them."""


def _between(state, values: Values):
    history, target, future = (values[name] for name in ("history", "target", "future"))
    drawn = () if target.motion is None else (target,)  # future[0].motion leads to it, or else to the last of history
    frames = (*history, *drawn, *future)
    return {"between": chain(frames, len(history) + len(drawn) + upcoming(future)[0], rendered(history)[0])}


CHAINED = ("future.motion", "before_next.motion", "since_newest.motion")
"""Where motion leads from the next rendered frame to the previous one; through the target where that has any."""

BETWEEN = Stage("motion between", _between, FRAMES, ("between",), reads=CHAINED)
"""Chains the motion from the next rendered frame to the previous one, through all that was drawn between them."""


def depth_of(frame: Frame) -> Array | None:
    """A frame's depth, if it has any."""
    return None if frame.gbuffer is None or frame.gbuffer.depth is None else jnp.asarray(frame.gbuffer.depth)


def _flows(state, values: Values):
    previous, next = (Keyframe(depth=depth_of(values[name])) for name in ("previous", "next"))
    # any depth will do: only its order is looked at
    flows = complete_flows(previous, Keyframe(depth=next.depth, backward_flow=values["between"]), depth="ordinal")
    return {"forward": flows.previous.forward_flow, "backward": values["between"]}


FLOWS = Stage("flows", _flows, ("previous", "next", "between"), ("forward", "backward"), reads=CHAINED)
"""Both flows: the backward one is the chained motion, the forward one is computed from it (`complete_flows`)."""
