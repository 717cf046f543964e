"""The pictures of an evaluated frame, for the report."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxtrapolate.checks import check_present
from jaxtrapolate.evaluation.score import causes_of, display
from jaxtrapolate.evaluation.windows import Window, arguments
from jaxtrapolate.files import Sequence, write_png
from jaxtrapolate.methods import Method
from jaxtrapolate.ops.holes import hole_masks
from jaxtrapolate.records import CHANNELS, GBuffer
from jaxtrapolate.report import colorize_causes, colorize_error
from jaxtrapolate.runtime.output import writable_folder


def eight_bit(image: Any) -> np.ndarray:
    """Display values 0..1 as 8-bit RGB."""
    codes = np.round(np.nan_to_num(np.clip(np.asarray(image, np.float32), 0, 1)) * 255).astype(np.uint8)
    return np.repeat(codes, 3, -1) if codes.shape[-1] == 1 else codes


def buffer_picture(name: str, value: Any, sky: Any = None) -> np.ndarray:
    """A buffer as a picture: normals from -1..1, what has no range of its own between its 1st and 99th percentile.

    Where there is a sky its far values do not count for the range. Depth is shown as log(1 + depth / its median): what
    is near is told apart although most of a scene is far.
    """
    value = np.asarray(value, np.float32)
    if name == "normal":
        return eight_bit(value * 0.5 + 0.5)
    if name in ("depth", "position", "stencil"):
        counts = np.isfinite(value)
        if sky is not None and name != "stencil":
            counts = counts & (np.asarray(sky) < 0.5)
        if name == "depth" and counts.any():
            middle = max(float(np.median(value[counts])), 1e-6)
            value = np.log1p(np.maximum(value, 0) / middle)
        finite = np.where(counts, value, np.nan)
        low, high = np.nanpercentile(finite, (1, 99), axis=(0, 1)) if counts.any() else (0.0, 1.0)
        high = np.maximum(high, value.max(axis=(0, 1))) if name == "stencil" else high
        return eight_bit((np.nan_to_num(value) - low) / np.maximum(high - low, 1e-6))
    return eight_bit(value)


def motion_picture(motion: Any) -> np.ndarray:
    """Motion as a picture: x in red, y in green, grey where nothing moves."""
    motion = np.asarray(motion)
    largest = max(float(np.nanpercentile(np.abs(motion), 99)), 1e-3)
    return eight_bit(
        np.concatenate([motion / largest * 0.5 + 0.5, np.full((*motion.shape[:2], 1), 0.5, np.float32)], -1)
    )


def write_pictures(sequence: Sequence, window: Window, methods: dict[str, Method], folder: Path) -> dict[str, Any]:
    """Writes the pictures of a window below `folder/pictures`; returns their paths, relative to `folder`."""
    place = writable_folder(folder / "pictures" / f"{window.number:04d}")

    def put(name: str, codes: np.ndarray) -> str:
        write_png(place / f"{name}.png", codes)
        return (place / f"{name}.png").relative_to(folder).as_posix()

    color = check_present("truth.color", window.truth.color, needed_by="write_pictures")
    truth = np.asarray(display(color, hdr=sequence.hdr))
    newest = window.history[-1]
    newest_color = check_present("history[-1].color", newest.color, needed_by="write_pictures")
    here, there = window.target.gbuffer or GBuffer(), newest.gbuffer or GBuffer()
    pictures: dict[str, Any] = {
        "number": window.number,
        "truth": put("truth", eight_bit(truth)),
        "previous": put("previous", eight_bit(display(newest_color, hdr=sequence.hdr))),
        "methods": {},
        "buffers": {},
    }
    causes = causes_of(sequence, window)
    if causes is not None:
        pictures["causes"] = put("causes", colorize_causes(causes))
    if window.target.motion is not None:
        holes = hole_masks(here, there, window.target.motion).any
        pictures["holes"] = put(
            "holes", eight_bit(np.where(np.asarray(holes), np.array([0.1, 0.9, 0.2], np.float32), truth * 0.5))
        )
    for name, method in methods.items():
        image = np.asarray(display(method(*arguments(method, window)), hdr=sequence.hdr))
        error = np.abs(image - truth).mean(-1)
        pictures["methods"][name] = {
            "image": put(f"{name}", eight_bit(image)),
            "error": put(f"{name}_error", colorize_error(error)),
        }
    shown = window.truth.gbuffer or GBuffer()
    for name in CHANNELS:
        value = getattr(shown, name)
        if value is not None:
            picture = display(value, hdr=True) if name == "sky_color" else value
            pictures["buffers"][name] = put(f"buffer_{name}", buffer_picture(name, picture, shown.sky))
    if window.truth.motion is not None:
        pictures["buffers"]["motion"] = put("buffer_motion", motion_picture(window.truth.motion))
    return pictures
