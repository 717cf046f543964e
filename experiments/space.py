"""In which space colours should be fetched between pixels: linear light, its logarithm, or after a tone curve.

    python experiments/space.py --output experiments/results/space.json

Each method in each of its spaces, over held-back frames of training seeds of embedded scenes: mean dB over the frame,
after the tone curve in which all scores are taken.
"""

import argparse
import json
from pathlib import Path
from typing import get_args

import numpy as np
from rich.console import Console
from rich.table import Table

import jaxtrapolate as jx
from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.methods.space import Space
from jaxtrapolate.scenes import TRAINING_SEEDS, SceneSequence

SCENES = ("terrain", "windmill", "walkers", "street", "interior", "dock", "forest", "head")
METHODS = (
    "warp",
    "occlusion_warp",
    "guided_warp",
    "half_motion",
    "softmax_splat",
    "bidirectional",
    "bidirectional_guided",
    "reproject",
    "warp_3d",
    "grid_warp",
    "grid_extrapolate",
    "dis",
)
SEEDS = (900, 901)


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--frames", type=int, default=10)
    options = parser.parse_args()
    result: dict = {"seeds": [int(TRAINING_SEEDS[k]) for k in SEEDS], "frames": options.frames, "methods": {}}
    if options.output.exists():  # what was measured before stays
        result["methods"] = json.loads(options.output.read_text())["methods"]
    names, spaces = options.methods.split(","), get_args(Space)
    methods = {f"{name}:{space}": jx.load(name, space=space) for name in names for space in spaces}
    for name in names:
        result["methods"].setdefault(name, {})
    for scene in options.scenes.split(","):
        found: dict[str, list[float]] = {key: [] for key in methods}
        for seed in SEEDS:
            sequence = SceneSequence(scene, TRAINING_SEEDS[seed], frames=options.frames, size=(180, 320))
            for key, method in jx.evaluate(sequence, methods, metrics=()).methods.items():
                found[key] += [frame.psnr for frame in method.frames]
        for name in names:
            means = {space: float(np.mean(found[f"{name}:{space}"])) for space in spaces}
            result["methods"][name][scene] = means
            print(name, scene, {space: round(value, 2) for space, value in means.items()}, flush=True)
        with atomic_path(options.output) as path:
            path.write_text(json.dumps(result, indent=1) + "\n")
    table = Table("", *get_args(Space), title="mean dB")
    for name, by_scene in result["methods"].items():
        means = (np.mean([row[space] for row in by_scene.values()]) for space in get_args(Space))
        table.add_row(name, *(f"{mean:.2f}" for mean in means))
    Console().print(table)


if __name__ == "__main__":
    main()
