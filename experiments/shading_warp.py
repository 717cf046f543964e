"""What each part of `shading_warp` is worth, and its options.

    python experiments/shading_warp.py --output experiments/results/shading_warp.json

Held-back frames with three rendered ones before them, of training seeds of embedded scenes: mean dB over the frame, in
moving shadow, in holes and beyond the border.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import jaxtrapolate as jx
from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.methods import Method
from jaxtrapolate.scenes import TRAINING_SEEDS, SceneSequence

SCENES = ("terrain", "windmill", "walkers", "street", "interior", "dock", "forest", "head")
SEEDS = (900, 901)
CAUSES = ("shadow", "hole", "border", "edge")
VARIANTS: dict[str, Callable[[Method], Method]] = {
    "shading_warp": lambda method: method,
    "light stays": lambda method: method.without("moved light", "shading flow", "light before"),
    "no hindsight": lambda method: method.without("light in hindsight"),
    "no memory": lambda method: method.without("remember"),
    "no older frames and no memory": lambda method: method.without("seen before"),
    "older light as it was": lambda method: method.replace(relight=1.0),
    "agreement 0.4": lambda method: method.replace(agreement=0.4),
    "agreement 0.6": lambda method: method.replace(agreement=0.6),
    "gain 0.3": lambda method: method.replace(least_gain=0.3),
    "change 1e-4": lambda method: method.replace(least_change=1e-4),
}


def scores(sequence: SceneSequence, methods: dict[str, Method]) -> dict[str, list[dict[str, float]]]:
    """dB of each frame by method: whole, and by cause where there is any."""
    found = jx.evaluate(sequence, methods, metrics=(), stages=False).methods
    return {
        name: [
            {"whole": frame.psnr}
            | {cause: s.psnr for cause, s in frame.by_cause.items() if cause in CAUSES and s.psnr is not None}
            for frame in result.frames
        ]
        for name, result in found.items()
    }


def mean(frames: list[dict[str, float]], column: str) -> float | None:
    """The mean over the frames that have the column, exact ones left out."""
    values = [frame[column] for frame in frames if np.isfinite(frame.get(column, np.nan))]
    return float(np.mean(values)) if values else None


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--variants", default=",".join(VARIANTS))
    parser.add_argument("--frames", type=int, default=24)
    options = parser.parse_args()
    whole = jx.load("shading_warp")
    methods = {"guided_warp": jx.load("guided_warp")}
    methods |= {name: VARIANTS[name](whole) for name in options.variants.split(",")}
    result: dict = {"seeds": [int(TRAINING_SEEDS[k]) for k in SEEDS], "frames": options.frames, "scenes": {}}
    if options.output.exists():  # what was measured before stays
        result["scenes"] = json.loads(options.output.read_text())["scenes"]
    for scene in options.scenes.split(","):
        rows: dict[str, list[dict[str, float]]] = {name: [] for name in methods}
        for seed in SEEDS:
            sequence = SceneSequence(scene, TRAINING_SEEDS[seed], frames=options.frames, size=(180, 320))
            for name, frames in scores(sequence, methods).items():
                rows[name] += frames
        entry = result["scenes"].setdefault(scene, {})
        entry |= {n: {column: mean(frames, column) for column in ("whole", *CAUSES)} for n, frames in rows.items()}
        print(scene, {name: round(entry[name]["whole"], 2) for name in rows}, flush=True)
        with atomic_path(options.output) as path:
            path.write_text(json.dumps(result, indent=1) + "\n")
    table = Table("", "whole", *CAUSES, title="mean dB over the scenes")
    for name in methods:
        columns = ([s[name][c] for s in result["scenes"].values() if name in s] for c in ("whole", *CAUSES))
        cells = ([v for v in column if v is not None] for column in columns)
        table.add_row(name, *(f"{np.mean(column):.2f}" if column else "" for column in cells))
    Console().print(table)


if __name__ == "__main__":
    main()
