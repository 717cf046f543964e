"""guided_net and shading_warp by resolution: their stages' times, others' times, errors, light gates against full ones.

    python experiments/resolutions.py --output experiments/results/resolutions.json

Tables 5 and 6, sections 6.4 and 6.5 of Guo et al. 2021. A held-back frame of a development seed is generated at
640x360, 854x480, 1280x720 and 1920x1080 by networks that were trained on frames of 320x180. Times are medians of one
frame, on all cores of one device, and means over the scenes. `--times` or `--errors` alone do one half: times need a
machine that is quiet.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from flax import nnx
from rich.console import Console
from rich.table import Table

import jaxtrapolate as jx
from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.evaluation.score import causes_of, mean_over_frames, score
from jaxtrapolate.evaluation.stages import time_stages
from jaxtrapolate.evaluation.windows import Window, arguments, windows
from jaxtrapolate.methods import Method
from jaxtrapolate.methods.guided_net import guided_net
from jaxtrapolate.networks.extranet import GATED_CONVOLUTION, ExtraNet, ExtraNetConfig
from jaxtrapolate.runtime.timing import machine, measure, measure_pairs
from jaxtrapolate.scenes import DEVELOPMENT_SEEDS, SceneSequence

SIZES = {"360p": (360, 640), "480p": (480, 854), "720p": (720, 1280), "1080p": (1080, 1920)}
METHODS = ("warp", "occlusion_warp", "guided_warp", "warp_3d", "grid_extrapolate", "bidirectional", "interpolator",
           "shading_warp", "guided_net")  # fmt: skip
BY_STAGE = ("shading_warp", "guided_net")
GATES = {
    "light gates": ExtraNetConfig(),
    "full gates": ExtraNetConfig(gate="full"),
    "full gates, no histories (GC)": GATED_CONVOLUTION,
}


def window_of(scene: str, size: tuple[int, int], frame: int) -> tuple[SceneSequence, Window]:
    """A held-back frame of a scene's first development seed, at a size."""
    sequence = SceneSequence(scene, DEVELOPMENT_SEEDS[0], frames=frame + 2, size=size)
    (window,) = windows(sequence, [frame], past=3, future=1)
    return sequence, window


def methods(names: Sequence[str]) -> dict[str, Method]:
    """All that can be had: a method without default weights is left out."""
    found = {}
    for name in names:
        try:
            found[name] = jx.load(name)
        except ValueError as error:
            print(error, flush=True)
    return found


def gates(window: Window, repeats: int) -> dict[str, float]:
    """ms of the bare networks on one frame's inputs, taken in turn; weights are random, which costs the same."""
    calls = {}
    for name, config in GATES.items():
        method = guided_net(ExtraNet(config, rngs=nnx.Rngs(0)))
        history, target, future = arguments(method, window)
        inputs = method.values_before("network", method.state, (), history, target, future)["inputs"]
        given = tuple(inputs[key] for key in ("x", "mask", "features", "history"))
        calls[name] = lambda network=method.network, given=given: network(*given)
    timings = measure_pairs(calls, repeats=repeats)
    return {name: timing.median for name, timing in timings.items()}


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", default="walkers,terrain,dock,street")
    parser.add_argument("--sizes", default=",".join(SIZES))
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--frame", type=int, default=13, help="odd and at least 5")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--times", action="store_true", help="times only")
    parser.add_argument("--errors", action="store_true", help="errors only")
    options = parser.parse_args()
    if not set(options.sizes.split(",")) <= set(SIZES):
        parser.error(f"--sizes: expected some of {','.join(SIZES)}, got {options.sizes}")
    jx.keep_memory()
    content: dict[str, Any] = json.loads(options.output.read_text()) if options.output.exists() else {}
    known, scenes = methods(options.methods.split(",")), options.scenes.split(",")
    for size in options.sizes.split(","):
        here = [window_of(scene, SIZES[size], options.frame) for scene in scenes]
        if not options.times:
            errors = {}
            for name, method in known.items():
                rows = []
                for sequence, window in here:
                    image = method(*arguments(method, window))
                    rows.append(score(image, window, causes_of(sequence, window), None, hdr=True))
                mean = mean_over_frames(rows).to_json()
                whole = ("psnr", "ssim", "by_cause")
                errors[name] = {k: mean[k] for k in whole} | {"frames": [row.psnr for row in rows]}
                print(size, name, round(errors[name]["psnr"], 2), flush=True)
            content.setdefault("errors", {})[size] = errors
        if not options.errors:
            windows_here = [window for _, window in here]
            content.setdefault("times", {})[size] = _times(known, windows_here, options.repeats)
            content["machine"] = machine()
        content |= {"scenes": scenes, "frame": options.frame}
        with atomic_path(options.output) as temporary:
            temporary.write_text(json.dumps(content, indent=1))
    _print(content)


def _times(known: dict[str, Method], here: list[Window], repeats: int) -> dict[str, Any]:
    whole: dict[str, list[float]] = {name: [] for name in known}
    stages: dict[str, dict[str, list[float]]] = {}
    for window in here:
        for name, method in known.items():
            given = arguments(method, window)
            whole[name].append(measure(lambda m=method, g=given: m.step(m.init(*g[:2]), *g), repeats=repeats).median)
        for name in (name for name in BY_STAGE if name in known):
            for stage, timing in time_stages(known[name], window, repeats=repeats).items():
                stages.setdefault(name, {}).setdefault(stage, []).append(timing.median)
    means = {name: float(np.mean(values)) for name, values in whole.items()}
    by_stage = {
        f"{name}'s stages": {stage: float(np.mean(values)) for stage, values in found.items()}
        for name, found in stages.items()
    }
    print(means, by_stage, flush=True)
    alone = {"networks": gates(here[0], repeats)} if "guided_net" in known else {}
    return {"whole": means, **by_stage, **alone}


def _print(content: dict[str, Any]) -> None:
    for kind, value in (("errors", "psnr"), ("times", "whole")):
        sizes = content.get(kind, {})
        if sizes:
            table = Table(title="dB" if kind == "errors" else "ms")
            for column in ("", *sizes):
                table.add_column(column)
            rows: dict[str, list[str]] = {}
            for found in sizes.values():
                stages = {
                    f"{name}: {stage}": ms
                    for name in BY_STAGE
                    for stage, ms in found.get(f"{name}'s stages", {}).items()
                }
                by_name = found if kind == "errors" else found["whole"] | stages | found.get("networks", {})
                for name, entry in by_name.items():
                    rows.setdefault(name, []).append(f"{entry[value] if kind == 'errors' else entry:.2f}")
            for name, cells in rows.items():
                table.add_row(name, *cells)
            Console().print(table)


if __name__ == "__main__":
    main()
