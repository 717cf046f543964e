"""All metrics by name, each with the space that it expects: `load`."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax.numpy as jnp

from jaxtrapolate.checks import check_choice, check_installed
from jaxtrapolate.metrics import perceptual, temporal
from jaxtrapolate.metrics.image import check_pair, counted, psnr, ssim

METRICS = {"psnr": psnr, "ssim": ssim}
"""The metrics that need no other package: functions of two display images `[H, W, C]` and an optional `mask`."""


@dataclasses.dataclass(frozen=True)
class Metric:
    """A metric as `load` gives it: called with a generated image and the ground truth, it returns a float.

    A mask `[H, W, 1]` says which pixels count. "psnr" and "ssim" look at those alone. The other metrics of frames look
    at neighbourhoods: there the pixels left out are first set equal, to the reference's or, where that is not finite,
    to 0; they carry no error of their own and still count in the mean.

    Attributes:
        name: as in `metric_names`.
        function: of the two images or clips.
        space: what the images hold: "display" values in 0..1 (8-bit input in sRGB, HDR tone mapped), or "linear"
            radiance.
        per: "frame": of images `[H, W, 3]`; "clip": of the successive frames of a clip `[T, H, W, 3]` or an iterable
            of them, without a mask.
        better: "higher" or "lower" values.
        unit: "dB" or "".
    """

    name: str
    function: Callable[..., Any]
    space: Literal["display", "linear"] = "display"
    per: Literal["frame", "clip"] = "frame"
    better: Literal["higher", "lower"] = "lower"
    unit: str = ""

    def __call__(self, image: Any, reference: Any, *, mask: Any = None) -> float:
        if self.per == "clip":
            if mask is not None:
                raise ValueError(f"mask: expected None, as {self.name} is a metric of clips")
            return self.function(image, reference).mean
        image, reference = jnp.asarray(image), jnp.asarray(reference)
        if mask is None:
            return float(self.function(image, reference))
        if self.name in METRICS:
            return float(self.function(image, reference, mask=jnp.asarray(mask)))
        check_pair(image, reference, mask)
        counts = counted(jnp.asarray(mask))
        reference = jnp.where(counts, reference, jnp.where(jnp.isfinite(reference), reference, 0))
        return float(self.function(jnp.where(counts, image, reference), reference))


_ALL = {
    m.name: (m, extra)
    for m, extra in (
        (Metric("psnr", psnr, better="higher", unit="dB"), None),
        (Metric("ssim", ssim, better="higher"), None),
        (Metric("flip", perceptual.flip), "flip"),
        (Metric("flip_hdr", partial(perceptual.flip, hdr=True), space="linear"), "flip"),
        (Metric("lpips", perceptual.lpips), "lpips"),
        (Metric("lpips_vgg", partial(perceptual.lpips, net="vgg")), "lpips"),
        (Metric("vmaf", perceptual.vmaf, per="clip", better="higher"), "vmaf"),
        (Metric("xpsnr", perceptual.xpsnr, per="clip", better="higher", unit="dB"), "vmaf"),
        (Metric("flicker", temporal.flicker, per="clip"), None),
    )
}


def metric_names() -> tuple[str, ...]:
    """The names that `load` takes, whether or not their packages are installed."""
    return tuple(_ALL)


def load(name: str) -> Metric:
    """A metric by name: `load("flip")(generated, truth)` is a float.

    Args:
        name: "psnr", "ssim"; "flip" (LDR), "flip_hdr"; "lpips" (AlexNet), "lpips_vgg"; "vmaf", "xpsnr",
            "flicker" (clips). All compare display values in 0..1 but "flip_hdr", which takes linear radiance: see
            `Metric.space`.

    Raises:
        ValueError: an unknown name.
        ImportError: the metric's package is missing; it says what to install.
    """
    check_choice("name", name, metric_names())
    metric, extra = _ALL[name]
    if extra is not None:
        try:
            check_installed(extra)
        except ImportError as error:
            raise ImportError(f"metric {name!r}: {error}", name=error.name) from error
    return metric
