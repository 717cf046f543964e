"""How far the guided warp should look in large frames: its kernels alone, or holes led on by a coarse search first.

    python experiments/guided_reach.py --output experiments/results/guided_reach.json

A held-back frame of one training seed of each moving scene, by size: dB over the frame and in exact holes, by how many
rows the kernels of 9 pixels are taken to suit (its option `rows`).
"""

import argparse
import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.evaluation.score import causes_of, score
from jaxtrapolate.evaluation.windows import arguments, windows
from jaxtrapolate.methods import load
from jaxtrapolate.runtime.timing import machine
from jaxtrapolate.scenes import TRAINING_SEEDS, SceneSequence, scene_names

SIZES = {"480p": (480, 854), "720p": (720, 1280), "1080p": (1080, 1920)}
ROWS = (None, 240, 180, 120)
SEED = TRAINING_SEEDS[779]  # 778 was looked at while the search was made


def scores(scene: str, size: tuple[int, int], frame: int) -> dict[str, dict]:
    """One frame's dB by `rows`."""
    sequence = SceneSequence(scene, SEED, frames=frame + 1, size=size)
    (window,) = windows(sequence, [frame], past=2)
    causes, found = causes_of(sequence, window), {}
    for rows in ROWS:
        method = load("guided_warp", rows=rows)
        row = score(method(*arguments(method, window)), window, causes, None, hdr=True, metrics=())
        found[str(rows)] = {
            "whole": row.psnr,
            "hole": row.by_cause["hole"].psnr if "hole" in row.by_cause else None,
        }
    return found


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", default=",".join(name for name in scene_names() if name != "still"))
    parser.add_argument("--sizes", default=",".join(SIZES))
    parser.add_argument("--frame", type=int, default=21)
    options = parser.parse_args()
    result: dict = {"machine": machine(), "seed": int(SEED), "frame": options.frame, "sizes": {}}
    for size in options.sizes.split(","):
        by_scene = result["sizes"][size] = {}
        for scene in options.scenes.split(","):
            by_scene[scene] = scores(scene, SIZES[size], options.frame)
            print(size, scene, {k: round(v["whole"], 2) for k, v in by_scene[scene].items()}, flush=True)
    with atomic_path(options.output) as path:
        path.write_text(json.dumps(result, indent=1) + "\n")
    for size, by_scene in result["sizes"].items():
        table = Table("rows", *by_scene, "mean", "holes", title=f"{size}: dB")
        for rows in map(str, ROWS):
            found = [scene[rows] for scene in by_scene.values()]
            means = [np.mean([one[key] for one in found if one[key] is not None]) for key in ("whole", "hole")]
            cells = [f"{one['whole']:.2f}" for one in found]
            table.add_row("kernels alone" if rows == "None" else rows, *cells, *(f"{mean:.2f}" for mean in means))
        Console().print(table)


if __name__ == "__main__":
    main()
