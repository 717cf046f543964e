"""Interpolation by optical flow: what a display or a video player does, which knows nothing but the images.

The flow is OpenCV's, computed on the host, so that this method has no pure function to trace; its other stages are
compiled like those of any method.
"""

from typing import Literal

import jax.numpy as jnp
import numpy as np

from jaxtrapolate.bidirectional.assisted import blend as mix
from jaxtrapolate.checks import ArrayLike
from jaxtrapolate.methods.between import PAIR
from jaxtrapolate.methods.blending import evenly
from jaxtrapolate.methods.method import Method, Stage, Values
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.ops.radiance import srgb_encode, tonemap
from jaxtrapolate.ops.warp import backward_warp

_LEAST = 32  # pixels: smaller images are padded


def gray(color: ArrayLike) -> np.ndarray:
    """What a display shows, as grey levels uint8 `[H, W]`: in sRGB, or tone mapped where a channel is above 1.

    Pixels that are not finite are black.
    """
    held = jnp.asarray(np.nan_to_num(np.asarray(color, np.float32), posinf=0, neginf=0))
    shown = srgb_encode(jnp.clip(held, 0, 1)) if float(held.max()) <= 1 else tonemap(held)
    return np.round(255 * (np.asarray(shown) @ np.array([0.299, 0.587, 0.114], np.float32))).astype(np.uint8)


Preset = Literal["ultrafast", "fast", "medium"]


@settings
class FlowSettings:
    """Of the optical flow."""

    preset: Preset = option("medium", "OpenCV's: the better, the slower", choices=Preset)


def dis_flow(first: np.ndarray, second: np.ndarray, *, preset: Preset = "medium") -> np.ndarray:
    """DIS optical flow `[H, W, 2]` from a grey image to another (uint8 `[H, W]`), in pixels to add.

    References: Kroeger et al. 2016 (Fast optical flow using dense inverse search), as in OpenCV.
    """
    import cv2  # an extra

    height, width = first.shape
    padding = ((0, max(0, _LEAST - height)), (0, max(0, _LEAST - width)))
    first, second = (np.ascontiguousarray(np.pad(image, padding, mode="edge")) for image in (first, second))
    number = {"ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST, "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST}
    search = cv2.DISOpticalFlow.create(number.get(preset, cv2.DISOPTICAL_FLOW_PRESET_MEDIUM))
    flow = search.calc(first, second, None)  # type: ignore[call-overload]
    return np.asarray(flow[:height, :width], np.float32)


def dis() -> Method:
    """Both rendered frames fetched along their optical flow (DIS, preset medium unless said) and mixed by time.

    With F and B the flows from the previous to the next frame and back, the flow from the target to the previous frame
    is taken for -alpha (1 - alpha) F + alpha^2 B at the target's own pixel, that to the next for (1 - alpha)^2 F -
    alpha (1 - alpha) B.

    References: Kroeger et al. 2016 for the flow, Jiang et al. 2018 (Super SloMo), equation 4, for that of the target.
    Departures: no occlusion is reasoned about; colours are fetched and mixed as linear radiance, like everywhere here,
    where a video player mixes display values.
    """

    def flow(state, values: Values):
        first, second = gray(values["previous"].color), gray(values["next"].color)
        pairs = {"forward": (first, second), "backward": (second, first)}
        return {name: jnp.asarray(dis_flow(*pair, preset=state.settings.preset)) for name, pair in pairs.items()}

    def function(state, values: Values):
        forward, backward = values["forward"], values["backward"]
        alpha = values["alpha"].astype(forward.dtype)
        rest = 1 - alpha
        first = backward_warp(values["previous"].color, alpha * (alpha * backward - rest * forward))
        second = backward_warp(values["next"].color, rest * (rest * forward - alpha * backward))
        return {"image": mix(first, second, evenly(alpha, first))}

    pair, flows = ("previous", "next"), ("forward", "backward")
    stages = (
        PAIR,
        Stage("optical flow", flow, pair, flows, host=True, extra="flow"),
        Stage("fetch", function, (*pair, *flows, "alpha"), ("image",)),
    )
    return Method("dis", stages, kind="interpolation", future=1, settings=FlowSettings())
