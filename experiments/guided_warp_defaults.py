"""Chooses the defaults of the guided warp, and checks the unlearned methods against the plain warp, on embedded scenes.

    python experiments/guided_warp_defaults.py --output experiments/results/guided_warp_defaults.json

For each scene (training seeds only) held-back frames are made from the rendered ones. First table: mean dB over the
moving scenes of the demodulated guided warp, for each sigma of guides and of screen distance; its last row is what is
left without albedo and normals: the stencil as guide and the colour as it is. Second table: the four methods scene by
scene with the defaults in force; none may fall more than 0.05 dB below the plain warp.
"""

import argparse
import itertools
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import jaxtrapolate as jx
from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.evaluation.score import display
from jaxtrapolate.evaluation.windows import arguments, windows
from jaxtrapolate.methods.warping import guides
from jaxtrapolate.runtime.timing import machine
from jaxtrapolate.scenes import SceneSequence, scene_names

SIGMA_GUIDE = (0.01, 0.03, 0.05, 0.1, 0.2)
SIGMA_SPACE = (0.3, 0.5, 0.7, 1.0, 2.0, 10.0)
METHODS = ("repeat", "warp", "occlusion_warp", "guided_warp")


def scene_scores(name: str, seed: int, times: list[int], size: tuple[int, int]) -> dict:
    """dB of a scene's held-back frames: by the sigmas, and by method."""
    sequence = SceneSequence(name, seed, frames=max(times) + 1, size=size)
    methods = {m: jx.load(m) for m in METHODS}
    grid = {pair: [] for pair in itertools.product(SIGMA_GUIDE, SIGMA_SPACE)}
    bare = {space: [] for space in SIGMA_SPACE}
    by_method = {m: [] for m in METHODS}
    for window in windows(sequence, times, past=2):
        truth = display(window.truth.color, hdr=True)
        newest, target = window.history[-1], window.target
        irradiance = jx.demodulate(newest.color, newest.gbuffer)
        mine, theirs = guides(target.gbuffer, newest.gbuffer, target.motion)
        for (guide, space), scores in grid.items():
            warped = jx.guided_warp(irradiance, target.motion, mine, theirs, sigma_guide=guide, sigma_space=space)
            image = display(jx.modulate(warped, target.gbuffer), hdr=True)
            scores.append(float(jx.psnr(jnp.asarray(image), truth)))
        mine, theirs = target.gbuffer.stencil, newest.gbuffer.stencil
        for space, scores in bare.items():
            image = jx.guided_warp(newest.color, target.motion, mine, theirs, sigma_space=space)
            scores.append(float(jx.psnr(display(image, hdr=True), truth)))
        for method, scores in by_method.items():
            image = methods[method](*arguments(methods[method], window))
            scores.append(float(jx.psnr(display(image, hdr=True), truth)))
    return {
        "grid": {f"{g},{s}": float(np.mean(v)) for (g, s), v in grid.items()},
        "bare": {str(s): float(np.mean(v)) for s, v in bare.items()},
        "methods": {m: float(np.mean(v)) for m, v in by_method.items()},
    }


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", default=",".join(scene_names()))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--times", default="21,41")
    parser.add_argument("--size", default="320x180")
    options = parser.parse_args()
    width, height = (int(v) for v in options.size.split("x"))
    times = [int(t) for t in options.times.split(",")]
    scenes = {}
    for name, seed in itertools.product(options.scenes.split(","), range(options.seeds)):
        scenes[f"{name}-{seed}"] = scene_scores(name, seed, times, (height, width))
        print(f"{name}-{seed}", {k: round(v, 2) for k, v in scenes[f"{name}-{seed}"]["methods"].items()}, flush=True)
    moving = [s for n, s in scenes.items() if not n.startswith("still")]  # where nothing moves every dB is beyond 60
    mean = {k: float(np.mean([s["grid"][k] for s in moving])) for k in moving[0]["grid"]}
    bare = {k: float(np.mean([s["bare"][k] for s in moving])) for k in moving[0]["bare"]}
    results = {
        "machine": machine(),
        "size": [height, width],
        "times": times,
        "scenes": scenes,
        "mean": mean,
        "bare": bare,
    }
    with atomic_path(options.output) as temporary:
        temporary.write_text(json.dumps(results, indent=1))
    console = Console()
    table = Table("sigma_guide", *(f"{s} px" for s in SIGMA_SPACE), title="mean dB over the scenes that move")
    for g in SIGMA_GUIDE:
        table.add_row(str(g), *(f"{mean[f'{g},{s}']:.2f}" for s in SIGMA_SPACE))
    table.add_row("bare", *(f"{bare[str(s)]:.2f}" for s in SIGMA_SPACE))
    console.print(table)
    table = Table("scene", *METHODS, title="dB by scene")
    for name, scores in scenes.items():
        table.add_row(name, *(f"{scores['methods'][m]:.2f}" for m in METHODS))
    console.print(table)


if __name__ == "__main__":
    main()
