"""Errors of bidirectional reprojection against exact motion: figure 11 of Yang et al. 2011 on the embedded scenes.

    python experiments/bidirectional_errors.py --output experiments/results/bidirectional_errors.json

I-frames are `step` scene frames apart, the B-frames at k / n between them. Shares of pixels, in percent, whose error is
below 1/10, 1/2 and 1 pixel:

- E_lin: an I-frame's pixel moved by its part of the exact flow to the other I-frame, against where it really is; over
  the pixels that are inside the B-frame then.
- E_total: the place found in an I-frame for a pixel of the B-frame, against where the B-frame's exact flow leads.
  "found": what the two searches found, each pixel counts twice. "read": the places that the colours were read at, of
  those with a weight. "all": all of them; "hit": those where the exact surface is visible in that I-frame; "shown":
  those that section 4 takes for visible, by the depth test in the I-frame's pixels. Where a silhouette passes between
  a visible point and the pixel's centre the exact test says yes, and the pixels show only the other surface.

Every option is tried at n = 4 on walkers and head, the defaults and the paper's on all scenes; the defaults at n = 2, 4
and 8 (8: at the first time only). Training seeds only. The JSON is written after each scene, and kept scenes are not
made again.
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
from jaxtrapolate.bidirectional.assisted import shown
from jaxtrapolate.bidirectional.search import positions, within
from jaxtrapolate.precision import divide
from jaxtrapolate.runtime.timing import machine
from jaxtrapolate.scenes import Scene, flow, render, scene, visible

SCENES = "walkers:0.8,head:0.5,windmill:0.5,terrain:0.8,demo:0.8,interior:0.8,forest:0.8,dock:0.8,street:0.8"
BELOW = (0.1, 0.5, 1.0)
VARIANTS = {
    "default": {},
    "nearest, error": {"choice": "error"},
    "bilinear, depth": {"filter": "bilinear"},
    "bilinear, error (paper)": {"filter": "bilinear", "choice": "error"},
    "bilinear, newton, depth": {"filter": "bilinear", "solver": "newton"},
    "bilinear, newton, error": {"filter": "bilinear", "solver": "newton", "choice": "error"},
    "bilinear, depth, 6 steps": {"filter": "bilinear", "iterations": 6},
    "nearest, depth, 6 steps": {"iterations": 6},
}
EVERYWHERE = ("default", "bilinear, error (paper)")
THOROUGH = ("walkers", "head")  # with every option
KINDS = ("found_all", "found_hit", "found_shown", "read_all", "read_hit")
TESTED = 0.05  # relative difference of depth in the test of section 4
PAPER = {
    "walkers": {"lin": (97.6, 100, 100), "all": (89.9, 97.5, 98.2), "hit": (94.3, 99.6, 99.8)},
    "head": {"lin": (99.9, 100, 100), "all": (98.6, 99.9, 99.9), "hit": (98.7, 100, 100)},
}


@jax.jit
def depth_at(world: Scene, time: jax.Array) -> jax.Array:
    """Only the depth of a frame: the rest is not compiled."""
    return render(world, time, size=SIZE[0]).gbuffer.depth  # type: ignore[union-attr]


SIZE = [(768, 1024)]


def count(error: jax.Array, where: jax.Array) -> jax.Array:
    """How many errors `[H, W]` are below each bound, and of how many."""
    return jnp.stack([*(jnp.sum(where & (error < bound)) for bound in BELOW), jnp.sum(where)])


def distance(a: jax.Array, b: jax.Array) -> jax.Array:
    """In pixels `[H, W]`."""
    return jnp.sqrt(jnp.sum(jnp.square(a - b), -1))


@jax.jit
def linear_counts(whole: jax.Array, exact: jax.Array, fraction: jax.Array) -> tuple[jax.Array, jax.Array]:
    """E_lin of an I-frame's pixels, and its largest."""
    error = distance(fraction * whole[..., :2], exact[..., :2])
    inside = within(positions(*error.shape) + exact[..., :2], *error.shape)
    return count(error, inside), jnp.max(jnp.where(inside, error, 0))


@jax.jit
def shown_in(frame: jx.Keyframe, depth: jax.Array, exact: jax.Array) -> jax.Array:
    """Whether an I-frame's pixels show the points of a frame of this depth, by their exact flow to it (section 4)."""
    at = positions(*depth.shape[:2]) + exact[..., :2]
    return shown(frame.depth, at, depth + exact[..., 2:], jnp.float32(TESTED))[..., 0]


@jax.jit
def total_counts(made: jx.Interpolation, exact: tuple, seen: tuple) -> jax.Array:
    """E_total `[kinds, bounds + 1]`; the colours are the places themselves, the first frame's and then the second's."""
    w = made.weight[..., 0]
    sums = jnp.zeros((len(KINDS), len(BELOW) + 1))
    for k, (found, weight) in enumerate(((made.forward, 1 - w), (made.backward, w))):
        truth = positions(*w.shape) + exact[k][..., :2]
        read = divide(made.color[..., 2 * k : 2 * k + 2], weight[..., None])
        by_search, by_color = distance(found.position, truth), distance(read, truth)
        used = weight > 0
        visible_there, shown_there = seen[k]
        rows = (
            count(by_search, jnp.ones_like(used)),
            count(by_search, visible_there),
            count(by_search, shown_there),
            count(by_color, used),
            count(by_color, used & visible_there),
        )
        sums = sums + jnp.stack(rows)
    return sums


def keyframes(world: Scene, start: float, end: float) -> tuple[jx.Keyframe, jx.Keyframe]:
    """Two I-frames whose colours are their own pixels' places, in channels of their own."""
    size = SIZE[0]
    grid = positions(*size)
    none = jnp.zeros_like(grid)
    previous = jx.Keyframe(
        color=jnp.concatenate([grid, none], -1),
        depth=depth_at(world, jnp.float32(start)),
        forward_flow=flow(world, start, end, size=size),
    )
    following = jx.Keyframe(
        color=jnp.concatenate([none, grid], -1),
        depth=depth_at(world, jnp.float32(end)),
        backward_flow=flow(world, end, start, size=size),
    )
    return previous, following


def run(previous: jx.Keyframe, following: jx.Keyframe, truths: list, n: int, options: dict) -> np.ndarray:
    """Sums of `total_counts` over the B-frames of one pair, each starting from the one before."""
    far, none = jnp.full((*SIZE[0], 1), jnp.inf), jnp.zeros((*SIZE[0], 2))
    offsets = jx.Offsets(jnp.float32(0.5), none, none, far, far)  # of no frame yet
    sums = np.zeros((len(KINDS), len(BELOW) + 1))
    search = jx.SearchOptions(**options)
    for k, (exact, seen) in enumerate(truths, 1):
        made = jx.interpolate_bidirectional(previous, following, k / n, offsets=offsets, search=search)
        offsets = made.offsets
        sums += np.asarray(total_counts(made, exact, seen), float)
    return sums


def shares(row: np.ndarray) -> list[float]:
    """Percent below each bound."""
    return [round(100 * float(v) / max(float(row[-1]), 1), 3) for v in row[:-1]]


def scene_errors(name: str, seed: int, times: list[int], step: float, parts: tuple[int, ...]) -> dict:
    """All shares of one scene."""
    world, size = scene(name, seed), SIZE[0]
    linear: dict[int, np.ndarray] = {n: np.zeros(len(BELOW) + 1) for n in parts}
    largest = dict.fromkeys(parts, 0.0)
    total: dict[tuple, np.ndarray] = {}
    for which, start in enumerate(times):
        end = start + step
        pair = keyframes(world, start, end)
        kept: dict[float, tuple] = {}
        for n in sorted(parts, reverse=True):
            if n == 8 and which > 0:
                continue
            for k in range(1, n):
                alpha = k / n
                if alpha not in kept:
                    now = start + alpha * step
                    exact = tuple(flow(world, now, t, size=size) for t in (start, end))
                    depth = depth_at(world, jnp.float32(now))
                    seen = tuple(
                        (visible(world, now, t, size=size), shown_in(frame, depth, motion))
                        for t, frame, motion in zip((start, end), pair, exact, strict=True)
                    )
                    errors = (
                        linear_counts(pair[0].forward_flow, flow(world, start, now, size=size), alpha),
                        linear_counts(pair[1].backward_flow, flow(world, end, now, size=size), 1 - alpha),
                    )
                    sums = sum(np.asarray(e[0], float) for e in errors)
                    kept[alpha] = (exact, seen, sums, max(float(e[1]) for e in errors))
                linear[n] += kept[alpha][2]
                largest[n] = max(largest[n], kept[alpha][3])
            truths = [kept[k / n][:2] for k in range(1, n)]
            for variant, options in VARIANTS.items():
                tried = name in THOROUGH or variant in EVERYWHERE
                if variant == "default" or (n == 4 and tried):
                    sums = run(*pair, truths, n, options)
                    total[variant, n] = total.get((variant, n), 0) + sums
    found: dict = {"seed": seed, "times": times, "step": step}
    found["lin"] = {str(n): [*shares(linear[n]), round(largest[n], 3)] for n in parts}
    found["total"] = {}
    for (variant, n), sums in total.items():
        rows = {kind: shares(row) for kind, row in zip(KINDS, sums, strict=True)}
        found["total"].setdefault(variant, {})[str(n)] = rows
    return found


def plot(scenes: dict, path: Path) -> None:
    """Shares above a bound at n = 4, by scene: E_lin, and E_total of the searches and of what is read."""
    figure = Figure(figsize=(11, 3.2 + 0.25 * len(scenes)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = np.ravel(figure.subplots(1, 3, sharey=True))
    marks = dict(zip(VARIANTS, "o^sDPX.v", strict=True))
    rows = sorted(scenes, key=lambda key: -len(scenes[key]["total"]))  # the first has every label
    for axes, bound in zip(panels, range(3), strict=True):
        for row, key in enumerate(rows):
            at = 100 - scenes[key]["lin"]["4"][bound]
            axes.plot([max(at, 1e-3)], [row], "k|", markersize=16, label="E_lin" if row == 0 else None)
            for index, (variant, mark) in enumerate(marks.items()):
                if variant not in scenes[key]["total"]:
                    continue
                at = 100 - scenes[key]["total"][variant]["4"]["found_shown"][bound]
                label = f"found, shown: {variant}" if row == 0 else None
                axes.plot([max(at, 1e-3)], [row], mark, color=f"C{index}", markersize=6, alpha=0.8, label=label)
            paper = PAPER.get(key.split(",")[0])
            if paper:
                label = "paper, hit" if row == 0 else None
                axes.plot([max(100 - paper["hit"][bound], 1e-3)], [row], "r*", markersize=11, label=label)
        axes.set_xscale("log")
        axes.set_title(f"pixels with an error of {BELOW[bound]:g} px and more", fontsize=10)
        axes.set_xlabel("% (log)")
        axes.grid(True, color="#d5d9dd")
    panels[0].set_yticks(range(len(rows)), rows)
    panels[0].invert_yaxis()
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8, frameon=False
    )
    figure.savefig(path, dpi=110)


def show(scenes: dict) -> None:
    """The tables."""
    console = Console(width=150)

    def text(row: list[float]) -> str:
        return " ".join(f"{v:6.2f}" for v in row[:3])

    table = Table("scene", "n", "E_lin (max)", *(kind.replace("_", " ") for kind in KINDS), title="defaults")
    for key, found in scenes.items():
        for n, row in found["lin"].items():
            rows = found["total"]["default"][n]
            table.add_row(key, n, f"{text(row)} ({row[3]})", *(text(rows[kind]) for kind in KINDS))
    console.print(table)
    table = Table("scene", "options", *(kind.replace("_", " ") for kind in KINDS), title="n = 4")
    for key, found in scenes.items():
        for variant, by_n in found["total"].items():
            table.add_row(key, variant, *(text(by_n["4"][kind]) for kind in KINDS))
    console.print(table)


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", default=SCENES, help="names, or name:step")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--times", default="5,25,45")
    parser.add_argument("--step", type=float, default=2, help="scene frames between two I-frames")
    parser.add_argument("--size", default="1024x768")
    parser.add_argument("--parts", default="2,4,8", help="n, with 4 among them")
    options = parser.parse_args()
    width, height = (int(v) for v in options.size.split("x"))
    SIZE[0] = (height, width)
    times = [int(t) for t in options.times.split(",")]
    parts = tuple(int(n) for n in options.parts.split(","))
    results = {"machine": machine(), "size": [height, width], "below": BELOW, "paper": PAPER, "scenes": {}}
    if options.output.exists():
        before = json.loads(options.output.read_text())
        results["scenes"] = before["scenes"] if before["size"] == results["size"] else {}
    for given in options.scenes.split(","):
        name, _, step = given.partition(":")
        step = float(step or options.step)
        key = f"{name}, step {step:g}"
        if key not in results["scenes"]:
            results["scenes"][key] = scene_errors(name, options.seed, times, step, parts)
            with atomic_path(options.output) as temporary:
                temporary.write_text(json.dumps(results, indent=1))
            plot(results["scenes"], options.output.with_suffix(".png"))
            print(key, results["scenes"][key]["lin"]["4"], results["scenes"][key]["total"]["default"]["4"], flush=True)
    show(results["scenes"])


if __name__ == "__main__":
    main()
