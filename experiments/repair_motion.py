"""Repairs corrupted motion vectors by gradient descent through the interpolation.

    python experiments/repair_motion.py --output experiments/results/repair_motion.json

Two I-frames of an embedded scene whose exact flows are spoilt: "noise" (Gaussian, 2 pixels), "wrong object" (the moving
objects get an affine motion fitted to the static surfaces), "quantised" (to whole 4 pixels). Adam moves x and y of both
flows until `interpolate_bidirectional` at 1/2 gives the true middle frame, in tone-mapped colour; with and without a
penalty on differences between neighbours on one surface. Kept by steps: EPE of both flows (over all pixels that are
seen in both I-frames, and over those of them that were spoilt), dB of the middle frame, which is fitted, and of the
frames at 1/4 and 3/4, which are not. "exact" is what the exact flows get. Then the same for the motion of the middle
frame itself and `backward_warp`, over what the I-frame shows. Training seeds only.
"""

import argparse
import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

import jaxtrapolate as jx
from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.runtime.timing import machine
from jaxtrapolate.scenes import flow, keyframe, render, scene, visible

KINDS = ("noise", "wrong object", "quantised")
PENALTIES = {"photometric": 0.0, "photometric and smooth": 0.003}
OPTIONS = {"search": jx.SearchOptions(filter="bilinear")}
HELD_OUT = (0.25, 0.75)
SMALL = 1e-2  # of the Charbonnier penalty, in tone-mapped colour
SPOILT = 0.5  # pixels


def corrupted(exact: jax.Array, stencil: jax.Array, kind: str, seed: int) -> jax.Array:
    """The flow `[H, W, 2]` spoilt."""
    if kind == "noise":
        return exact + 2 * jax.random.normal(jax.random.key(seed), exact.shape)
    if kind == "quantised":
        return 4 * jnp.round(exact / 4)
    static = np.asarray(stencil[..., 0] == 0)
    y, x = np.mgrid[0 : static.shape[0], 0 : static.shape[1]]
    rows = np.stack([np.ones_like(x), x, y], -1).astype(np.float64)
    fit = np.linalg.lstsq(rows[static], np.asarray(exact)[static], rcond=None)[0]
    return jnp.where(static[..., None], exact, jnp.asarray(rows @ fit, exact.dtype))


def charbonnier(x: jax.Array, where: jax.Array | bool = True) -> jax.Array:
    """Mean of |x|, smooth at 0."""
    return jnp.mean(jnp.where(where, jnp.sqrt(x * x + SMALL**2) - SMALL, 0))


def uneven(motion: jax.Array, depth: jax.Array) -> jax.Array:
    """Mean difference between neighbours of similar depth, in pixels, smooth at 0."""
    total = jnp.zeros(())
    for axis in (0, 1):
        relative = jnp.diff(jnp.log(depth), axis=axis)
        total += charbonnier(jnp.diff(motion, axis=axis), jnp.abs(relative) < 0.05)
    return total


def epe(found: jax.Array, exact: jax.Array, where: jax.Array) -> jax.Array:
    """Mean end-point error in pixels."""
    return jnp.sum(jnp.where(where, jnp.linalg.norm(found - exact, axis=-1), 0)) / jnp.maximum(jnp.sum(where), 1)


def decibels(image: jax.Array, truth: jax.Array) -> jax.Array:
    """In tone-mapped colour."""
    return jx.psnr(jx.tonemap(image), jx.tonemap(truth))


def with_motion(pair: tuple, motion: tuple) -> tuple:
    """The I-frames with x and y of their flows replaced."""
    first, second = pair
    forward = jnp.concatenate([motion[0], first.forward_flow[..., 2:]], -1)
    backward = jnp.concatenate([motion[1], second.backward_flow[..., 2:]], -1)
    return jx.replace(first, forward_flow=forward), jx.replace(second, backward_flow=backward)


def flow_loss(motion: tuple, penalty: jax.Array, data: dict) -> jax.Array:
    """Photometric error of the middle frame, and unevenness."""
    pair = with_motion(data["pair"], motion)
    made = jx.interpolate_bidirectional(*pair, 0.5, **OPTIONS).color
    smooth = sum(uneven(m, frame.depth) for m, frame in zip(motion, pair, strict=True))
    return charbonnier(jx.tonemap(made) - jx.tonemap(data["middle"])) + penalty * smooth


def flow_scores(motion: tuple, data: dict) -> jax.Array:
    """EPE, EPE where it was spoilt, dB fitted, dB held out."""
    pair = with_motion(data["pair"], motion)
    spoilt = [s & (jnp.linalg.norm(a - b, axis=-1) > SPOILT)
              for s, a, b in zip(data["seen"], data["spoilt"], data["exact"], strict=True)]  # fmt: skip
    errors = [
        sum(epe(m, e, w) for m, e, w in zip(motion, data["exact"], where, strict=True)) / 2
        for where in (data["seen"], spoilt)
    ]
    fitted = decibels(jx.interpolate_bidirectional(*pair, 0.5, **OPTIONS).color, data["middle"])
    held = [decibels(jx.interpolate_bidirectional(*pair, alpha, **OPTIONS).color, truth)
            for alpha, truth in zip(HELD_OUT, data["held"], strict=True)]  # fmt: skip
    return jnp.stack([*errors, fitted, sum(held) / len(held)])


def warp_loss(motion: tuple, penalty: jax.Array, data: dict) -> jax.Array:
    """Photometric error of the warped previous I-frame where it shows the point, and unevenness."""
    made = jx.backward_warp(data["pair"][0].color, motion[0])
    error = charbonnier(jx.tonemap(made) - jx.tonemap(data["middle"]), data["shown"][..., None])
    return error + penalty * uneven(motion[0], data["depth"])


def warp_scores(motion: tuple, data: dict) -> jax.Array:
    """EPE, EPE where it was spoilt, dB fitted (where the I-frame shows the point)."""
    spoilt = data["shown"] & (jnp.linalg.norm(data["spoilt"][0] - data["exact"][0], axis=-1) > SPOILT)
    errors = [epe(motion[0], data["exact"][0], where) for where in (data["shown"], spoilt)]
    made = jx.tonemap(jx.backward_warp(data["pair"][0].color, motion[0]))
    return jnp.stack([*errors, jx.psnr(made, jx.tonemap(data["middle"]), mask=data["shown"][..., None])])


@partial(jax.jit, static_argnames=("loss", "scores", "steps", "every"))
def descend(spoilt, penalty, rate, data, *, loss, scores, steps: int, every: int):
    """`steps` steps of Adam whose rate falls to a tenth: (motion, scores each `every` steps)."""
    optimizer = optax.adam(optax.cosine_decay_schedule(rate, steps, alpha=0.1))

    def step(carried, _):
        motion, state = carried
        gradient = jax.grad(loss)(motion, penalty, data)
        updates, state = optimizer.update(gradient, state)
        return (optax.apply_updates(motion, updates), state), None

    def some(carried, _):
        score = scores(carried[0], data)
        return jax.lax.scan(step, carried, None, length=every)[0], score

    (motion, _), rows = jax.lax.scan(some, (spoilt, optimizer.init(spoilt)), None, length=steps // every)
    return motion, jnp.concatenate([rows, scores(motion, data)[None]])


def gather_data(name: str, seed: int, start: float, step: float, size: tuple[int, int]) -> tuple[dict, dict]:
    """What is fitted and what scores it: of the flows, and of the middle frame's motion."""
    world, end = scene(name, seed), start + step
    pair = (
        keyframe(world, start, size=size, next_time=end, previous_time=start - step),
        keyframe(world, end, size=size, next_time=end + step, previous_time=start),
    )
    middle, *held = (render(world, start + a * step, size=size, previous_time=start) for a in (0.5, *HELD_OUT))
    common = {"pair": pair, "middle": middle.color}
    flows = common | {
        "held": [frame.color for frame in held],
        "exact": (pair[0].forward_flow[..., :2], pair[1].backward_flow[..., :2]),
        "seen": (visible(world, start, end, size=size), visible(world, end, start, size=size)),
        "stencils": (pair[0].stencil, pair[1].stencil),
    }
    half = start + 0.5 * step
    warp = common | {
        "exact": (flow(world, half, start, size=size)[..., :2],),
        "shown": visible(world, half, start, size=size),
        "depth": middle.gbuffer.depth,
        "stencils": (middle.gbuffer.stencil,),
    }
    return flows, warp


def plot(results: dict, path: Path) -> None:
    """EPE and dB against steps; a row for the flows, a row for the warp."""
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 2)
    for row, part in enumerate(("interpolate_bidirectional", "backward_warp")):
        for color, kind in enumerate(KINDS):
            for style, penalty in zip(("--", "-"), PENALTIES, strict=True):
                trace = np.asarray(results[part][kind][penalty])
                steps = np.arange(len(trace)) * results["every"]
                panels[row][0].plot(steps, trace[:, 0], style, color=f"C{color}", label=f"{kind}, {penalty}")
                panels[row][1].plot(steps, trace[:, 2], style, color=f"C{color}")
                if trace.shape[1] > 3 and penalty != "photometric":
                    panels[row][1].plot(steps, trace[:, 3], ":", color=f"C{color}")
        exact = results[part]["exact"]
        panels[row][1].axhline(exact[2], color="k", linewidth=0.8, label="exact motion")
        panels[row][0].set_ylabel(f"{part}\nEPE, pixels")
        panels[row][1].set_ylabel("dB (dotted: at 1/4 and 3/4, not fitted)" if row == 0 else "dB")
        panels[row][0].legend(fontsize=7)
        panels[row][1].legend(fontsize=7)
    for axes in panels.ravel():
        axes.set_xlabel("steps")
        axes.grid(True, color="#d5d9dd")
    figure.savefig(path, dpi=100)


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scene", default="walkers")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--time", type=float, default=25)
    parser.add_argument("--step", type=float, default=2, help="scene frames between the I-frames")
    parser.add_argument("--size", default="256x192")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--every", type=int, default=10)
    parser.add_argument("--rate", type=float, default=0.1, help="of Adam, pixels")
    options = parser.parse_args()
    width, height = (int(v) for v in options.size.split("x"))
    parts = gather_data(options.scene, options.seed, options.time, options.step, (height, width))
    results: dict = {"machine": machine(), "every": options.every}
    results["options"] = {k: v for k, v in vars(options).items() if k != "output"}
    results["columns"] = ["EPE", "EPE of spoilt pixels", "dB", "dB at 1/4 and 3/4"]
    table = Table("fitted", "spoilt by", "loss", *results["columns"], title=f"{options.scene}: before, after")
    functions = (("interpolate_bidirectional", flow_loss, flow_scores), ("backward_warp", warp_loss, warp_scores))
    for (part, loss, scores), data in zip(functions, parts, strict=True):
        stencils = data.pop("stencils")
        exact = scores(data["exact"], data | {"spoilt": data["exact"]})
        results[part] = {"exact": [float(v) for v in exact]}
        table.add_row(part, "exact", "", *(f"{v:.2f}" for v in exact))
        for kind in KINDS:
            pairs = enumerate(zip(data["exact"], stencils, strict=True))
            spoilt = tuple(corrupted(motion, stencil, kind, k) for k, (motion, stencil) in pairs)
            results[part][kind] = {}
            for name, penalty in PENALTIES.items():
                how = {"loss": loss, "scores": scores, "steps": options.steps, "every": options.every}
                _, rows = descend(spoilt, penalty, options.rate, data | {"spoilt": spoilt}, **how)
                rows = np.asarray(rows, float)
                results[part][kind][name] = rows.round(4).tolist()
                table.add_row(part, kind, name, *(f"{a:.2f} {b:.2f}" for a, b in zip(rows[0], rows[-1], strict=True)))
                print(part, kind, name, rows[0].round(2), rows[-1].round(2), flush=True)
    with atomic_path(options.output) as temporary:
        temporary.write_text(json.dumps(results))
    plot(results, options.output.with_suffix(".png"))
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
