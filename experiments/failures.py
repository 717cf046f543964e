"""Where guided_net fails (Figure 21 of Guo et al. 2021), in numbers, beside the warps that know nothing of it.

    python experiments/failures.py --output experiments/results/failures.json

Out of the screen: dB where the motion leads beyond the frame, and that share of the frame, as steps between frames
grow. Blurred shadow edges: where a shadow has moved, the mean gradient of the result over that of the truth, 1 where
edges are as sharp. Sudden light: all lamps and the sun flash to three times their radiance in the newest rendered frame
alone; the share of the flash that stays in the result (its projection onto the flash of the plain warp: 1 = all of it),
and dB with and without it. Test seeds, 320x180.
"""

import argparse
import dataclasses
import json
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import jaxtrapolate as jx
from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.evaluation.score import display
from jaxtrapolate.evaluation.windows import Window, arguments
from jaxtrapolate.ops.causes import CAUSES, cause_map
from jaxtrapolate.records import replace
from jaxtrapolate.runtime.timing import machine
from jaxtrapolate.scenes import DEVELOPMENT_SEEDS, Scene, render, scene
from jaxtrapolate.training.windows import MOVING, scene_window

SIZE = (180, 320)
STEPS = (1.0, 2.0, 4.0)
FLASH = 3.0
METHODS = ("warp", "occlusion_warp", "guided_warp", "guided_net")
TIME = 13.0


def drawn(world: Scene, step: float) -> Window:
    """The window about `TIME` with frames so far apart."""
    draw = jax.jit(partial(scene_window, size=SIZE, past=3))
    return draw(world, jnp.float32(TIME), jnp.float32(step))


def flashed(world: Scene, window: Window) -> Window:
    """The window whose newest rendered frame is lit by all lights at `FLASH` times their radiance."""
    lights = world.lights
    bright = replace(lights, sun_color=FLASH * lights.sun_color, lamp_color=FLASH * lights.lamp_color)
    lit = jax.jit(partial(render, size=SIZE))(dataclasses.replace(world, lights=bright), TIME - 1.0)
    newest = replace(window.history[-1], color=lit.color)
    return replace(window, history=(*window.history[:-1], newest))


def causes_in(window: Window) -> np.ndarray:
    """The causes, holes by the masks."""
    return np.asarray(cause_map(window.truth, window.history[-1], window.target.motion))


def gradient(image: np.ndarray) -> np.ndarray:
    """The size of the gradient of a display image's mean over channels `[H, W]`."""
    rows, columns = np.gradient(np.asarray(image, np.float64).mean(-1))
    return np.hypot(rows, columns)


def decibels(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """PSNR of display images, in a mask."""
    given = None if mask is None else jnp.asarray(mask[..., None])
    return float(jx.psnr(jnp.asarray(image), jnp.asarray(truth), mask=given))


def shown(method: Any, window: Window) -> np.ndarray:
    """What a method makes of a window, as a display image."""
    return np.asarray(display(method(*arguments(method, window)), hdr=True))


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", default=",".join(MOVING))
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    methods = {name: jx.load(name) for name in METHODS}
    border = {str(step): {name: [] for name in (*METHODS, "share")} for step in STEPS}
    sharpness: dict[str, list[float]] = {name: [] for name in METHODS}
    shadow: dict[str, list[float]] = {name: [] for name in METHODS}
    light = {name: {"kept": [], "steady": [], "flash": []} for name in METHODS}
    for name in options.scenes.split(","):
        for seed in DEVELOPMENT_SEEDS[: options.seeds]:
            world = scene(name, seed)
            for step in STEPS:
                window = drawn(world, step)
                truth = np.asarray(display(window.truth.color, hdr=True))
                causes = causes_in(window)
                outside, moved = (causes == CAUSES.index(cause) for cause in ("border", "shadow"))
                border[str(step)]["share"].append(float(outside.mean()))
                made = {m: shown(method, window) for m, method in methods.items()}
                if outside.any():
                    for m, image in made.items():
                        border[str(step)][m].append(decibels(image, truth, outside))
                if step == 1.0:
                    if moved.mean() > 1e-3:
                        for m, image in made.items():
                            sharpness[m].append(float(gradient(image)[moved].mean() / gradient(truth)[moved].mean()))
                            shadow[m].append(decibels(image, truth, moved))
                    _flash(world, window, methods, made, truth, light)
            print(name, seed, flush=True)
    content = {
        "machine": machine(),
        "scenes": options.scenes.split(","),
        "seeds": options.seeds,
        "border": {step: _means(columns) for step, columns in border.items()},
        "shadow edges": {"frames": len(shadow["warp"]), "sharpness": _means(sharpness), "psnr": _means(shadow)},
        "sudden light": {name: _means(columns) for name, columns in light.items()},
    }
    with atomic_path(options.output) as temporary:
        temporary.write_text(json.dumps(content, indent=1))
    _print(content)


def _flash(world: Scene, window: Window, methods: dict, made: dict, truth: np.ndarray, light: dict) -> None:
    """Adds to `light` what each method makes of a flash in the newest rendered frame."""
    bright = flashed(world, window)
    images = {name: shown(method, bright) for name, method in methods.items()}
    ghost = images["warp"] - made["warp"]  # all of the flash, where it lands
    for name, image in images.items():
        light[name]["kept"].append(float(np.sum((image - made[name]) * ghost) / np.sum(ghost * ghost)))
        light[name]["steady"].append(decibels(made[name], truth))
        light[name]["flash"].append(decibels(image, truth))


def _means(columns: dict[str, list[float]]) -> dict[str, float]:
    return {name: float(np.mean(values)) for name, values in columns.items() if values}


def _print(content: dict[str, Any]) -> None:
    table = Table()
    steps = content["border"]
    for column in (
        "",
        *(f"border, step {step}" for step in steps),
        "shadow dB",
        "sharpness",
        "flash kept",
        "dB",
        "with",
    ):
        table.add_column(column)
    edges, light = content["shadow edges"], content["sudden light"]
    for name in METHODS:
        cells = [f"{found[name]:.2f}" for found in steps.values()]
        cells += [f"{edges[kind][name]:.2f}" for kind in ("psnr", "sharpness")]
        cells += [f"{light[name][kind]:.2f}" for kind in ("kept", "steady", "flash")]
        table.add_row(name, *cells)
    table.add_row("share of the frame", *(f"{100 * found['share']:.1f} %" for found in steps.values()))
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
