"""SSIM and run time of B-frames over time: figures 7, 8, 9, 10 (upper half) and 12 of Yang et al. 2011.

    python experiments/quality_over_time.py --output experiments/results/quality_over_time.json

I-frames are `step` scene frames apart, with three B-frames at 1/4, 1/2 and 3/4 between each two (n = 4), against the
rendered truth. Methods: what was drawn of the target and both I-frames ("bidirectional"), the I-frames alone
("bidirectional_image"), and the paper's baselines: the blend of both, reprojection of the frame before, without and
with rendering its cache misses anew; half the motion; the 3D warp; the grid warp. Rendering anew is the truth at the
misses, and its share of the pixels is counted. Scenes: figures that walk, terrain, a head, and an interior with the
moving shadow of a runner (figure 12, dynamic light); a windmill (figure 4). Training seeds only; SSIM after x / (1 + x)
and gamma 1 / 2.2. The JSON is written after each scene, and kept scenes are not made again.
"""

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

import jaxtrapolate as jx
from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.evaluation.score import display
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.methods.reprojection import reprojection
from jaxtrapolate.runtime.timing import machine, measure
from jaxtrapolate.scenes import Scene, render, scene

SCENES = "walkers,terrain,head,interior,windmill"
PARTS = 4
METHODS = (
    "bidirectional",
    "bidirectional_image",
    "blend",
    "reproject",
    "reproject_shade",
    "half_motion",
    "warp_3d",
    "grid_warp",
)


@jax.jit
def scores(made: jax.Array, truth: jax.Array) -> tuple[jax.Array, jax.Array]:
    """SSIM and PSNR of displayed images."""
    pair = display(made, hdr=True), display(truth, hdr=True)
    return jx.ssim(*pair), jx.psnr(*pair)


@jax.jit
def shade_misses(history: tuple, target: jx.Frame, truth: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(image, share): reprojection whose cache misses are rendered anew, and the share of the pixels they are."""
    share = []

    def shade(_, missed):
        share.append(jnp.mean(missed, dtype=jnp.float32))
        return truth

    image = reprojection(shade).function({}, (), history, target, ())[1]
    return image, share[0]


def frames_of(world: Scene, size: tuple[int, int], start: float, step: float, intervals: int) -> list[dict]:
    """For each B-frame its history, target, future, and truth; the I-frame after it has its motion to the target."""
    rows = []
    for k in range(intervals):
        begin, end = start + k * step, start + (k + 1) * step
        previous = render(world, begin, size=size, previous_time=begin - step)
        for part in range(1, PARTS):
            now = begin + step * part / PARTS
            truth = render(world, now, size=size, previous_time=begin)
            following = render(world, end, size=size, previous_time=now)
            rows.append({"time": now, "truth": truth.color, "given": ((previous,), hide(truth), (following,))})
    return rows


def scene_scores(name: str, seed: int, size: tuple[int, int], start: float, step: float, intervals: int) -> dict:
    """SSIM and dB by method and B-frame, and the milliseconds of one B-frame."""
    rows = frames_of(scene(name, seed), size, start, step, intervals)
    found: dict = {"seed": seed, "step": step, "times": [r["time"] for r in rows], "methods": {}}
    for method_name in METHODS:
        ssims, decibels, shares = [], [], []
        if method_name == "reproject_shade":
            for row in rows:
                image, share = shade_misses(row["given"][0], row["given"][1], row["truth"])
                s, p = scores(image, row["truth"])
                ssims.append(float(s)), decibels.append(float(p)), shares.append(float(share))
            spent = None  # what is rendered anew costs what the renderer takes
        else:
            method = jx.load(method_name)
            for row in rows:
                history, target, future = row["given"]
                s, p = scores(method(history, target, future if method.future else ()), row["truth"])
                ssims.append(float(s)), decibels.append(float(p))
            history, target, future = rows[0]["given"]
            future = future if method.future else ()
            spent = measure(lambda m=method, h=history, t=target, f=future: m(h, t, f), repeats=9).median
        found["methods"][method_name] = {
            "ssim": [round(v, 5) for v in ssims],
            "psnr": [round(v, 3) for v in decibels],
            "ms": None if spent is None else round(spent, 2),
        }
        if shares:
            found["methods"][method_name]["rendered_anew"] = round(float(np.mean(shares)), 5)
        print(name, method_name, round(float(np.mean(ssims)), 4), round(float(np.mean(decibels)), 2), flush=True)
    return found


def plot(scenes: dict, path: Path) -> None:
    """SSIM over time, with 1 at the I-frames, and mean SSIM against run time."""
    figure = Figure(figsize=(15, 2.8 * len(scenes) + 0.8), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(scenes), 2, squeeze=False, width_ratios=(2.4, 1))
    for (left, right), (name, found) in zip(panels, scenes.items(), strict=True):
        for index, (method, row) in enumerate(found["methods"].items()):
            times, values = [], []
            for first in range(0, len(row["ssim"]), PARTS - 1):
                part = found["times"][first : first + PARTS - 1]
                times += [part[0] - found["step"] / PARTS, *part]
                values += [1.0, *row["ssim"][first : first + PARTS - 1]]
            left.plot(times, values, "-o", markersize=3, color=f"C{index}", label=method)
            if row["ms"] is not None:
                right.plot([row["ms"]], [np.mean(row["ssim"])], "o", color=f"C{index}")
        left.set_title(f"{name}: SSIM over time, n = {PARTS}", fontsize=10)
        right.set_title("mean SSIM against milliseconds a B-frame", fontsize=10)
        right.set_xscale("log")
        for axes in (left, right):
            axes.grid(True, color="#d5d9dd")
    panels[-1][0].set_xlabel("time, scene frames")
    panels[-1][1].set_xlabel("ms")
    figure.legend(
        *panels[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=8, fontsize=9, frameon=False
    )
    figure.savefig(path, dpi=90)


def show(scenes: dict) -> None:
    """Mean SSIM and dB, by scene and method."""
    table = Table("method", *scenes, title="mean SSIM / dB of the B-frames")
    for method in METHODS:
        rows = [found["methods"][method] for found in scenes.values()]
        table.add_row(method, *(f"{np.mean(r['ssim']):.4f} / {np.mean(r['psnr']):.2f}" for r in rows))
    Console(width=140).print(table)


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", default=SCENES)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--start", type=float, default=5)
    parser.add_argument("--step", type=float, default=2, help="scene frames between two I-frames")
    parser.add_argument("--intervals", type=int, default=6, help="between I-frames")
    parser.add_argument("--size", default="512x384")
    options = parser.parse_args()
    width, height = (int(v) for v in options.size.split("x"))
    results = {"machine": machine(), "size": [height, width], "parts": PARTS, "scenes": {}}
    if options.output.exists():
        before = json.loads(options.output.read_text())
        results["scenes"] = before["scenes"] if before["size"] == results["size"] else {}
    for name in options.scenes.split(","):
        if name not in results["scenes"]:
            results["scenes"][name] = scene_scores(
                name, options.seed, (height, width), options.start, options.step, options.intervals
            )
            with atomic_path(options.output) as temporary:
                temporary.write_text(json.dumps(results))
    plot(results["scenes"], options.output.with_suffix(".png"))
    show(results["scenes"])


if __name__ == "__main__":
    main()
