"""How exact the hole masks are: precision and recall of each against what the embedded scenes truly show.

    python experiments/hole_masks.py --output experiments/results/hole_masks.json

Frames of training seeds, each from the one before it. A hole is a pixel whose surface point the frame before does not
show (`scenes.visible`) though the motion leads into it. Precision is the share of marked pixels that are holes, recall
the share of the holes that are marked; of a scene they are taken over all its frames together. "disoccluded" is the
test by exact flow; the rest are the masks of `hole_masks(taps="nearest")`, which methods use, from all buffers and from
depth and motion alone.
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
from jaxtrapolate.records import replace
from jaxtrapolate.runtime.timing import machine
from jaxtrapolate.scenes import SceneSequence

MASKS = ("stencil", "normal", "position", "depth", "any")


def marked(sequence: SceneSequence, number: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The true holes of a frame, and what each test marks, bool `[H, W]`, all within the frame before it."""
    target, source = sequence.frame(number), sequence.frame(number - 1)
    here, there, motion = target.gbuffer, source.gbuffer, jnp.asarray(target.motion)
    inside = np.asarray(jx.in_frame(motion))
    hidden = ~sequence.visible(number, number - 1) & inside
    keyframes = (replace(sequence.keyframe(n), color=None) for n in (number, number - 1))
    found = {"disoccluded": np.asarray(jx.disoccluded(*keyframes))}
    masks = jx.hole_masks(here, there, motion, taps="nearest")
    found |= {name: np.asarray(getattr(masks, name))[..., 0] for name in MASKS}
    alone = (jx.GBuffer(depth=g.depth, sky=g.sky) for g in (here, there))
    found["depth alone"] = np.asarray(jx.hole_masks(*alone, motion, taps="nearest").any)[..., 0]
    return hidden, {name: mask & inside for name, mask in found.items()}


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", default="forest,street,walkers,interior")
    parser.add_argument("--seeds", default="900,901")
    parser.add_argument("--times", default="9,19")
    parser.add_argument("--size", default="320x180")
    options = parser.parse_args()
    width, height = (int(v) for v in options.size.split("x"))
    scenes: dict[str, dict[str, list[float]]] = {}
    for name in options.scenes.split(","):
        counts: dict[str, np.ndarray] = {}
        for seed, time in itertools.product(options.seeds.split(","), options.times.split(",")):
            sequence = SceneSequence(name, int(seed), frames=int(time) + 1, size=(height, width))
            hidden, found = marked(sequence, int(time))
            for test, mask in found.items():
                both = np.array([(mask & hidden).sum(), mask.sum(), hidden.sum()], float)
                counts[test] = counts.get(test, 0) + both
        scenes[name] = {t: [float(c[0] / max(c[1], 1)), float(c[0] / max(c[2], 1))] for t, c in counts.items()}
        print(name, {t: [round(v, 3) for v in p] for t, p in scenes[name].items()}, flush=True)
    tests = list(scenes[next(iter(scenes))])
    mean = {t: [float(np.mean([s[t][k] for s in scenes.values()])) for k in (0, 1)] for t in tests}
    results = {
        "machine": machine(),
        "size": [height, width],
        "seeds": options.seeds,
        "times": options.times,
        "scenes": scenes,
        "mean": mean,
    }
    with atomic_path(options.output) as temporary:
        temporary.write_text(json.dumps(results, indent=1))
    table = Table("", *scenes, "mean", title="precision / recall")
    for t in tests:
        table.add_row(t, *("{:.3f} / {:.3f}".format(*row[t]) for row in (*scenes.values(), mean)))
    Console().print(table)


if __name__ == "__main__":
    main()
