"""Stiff and extreme inputs: what is finite, how far one pixel that is not a number reaches; errors of half precision.

    python experiments/extreme.py --output experiments/results/extreme.json

Every function and method of `tests/extreme_cases.py` on each of its rows, and every method in float32, bfloat16 and
float16 (its option `dtype`) against itself in float64, on a held-back frame of a training seed of each of four embedded
scenes (what comes without weights is left out): differences of display values (0..1), over all pixels and channels.
"""

import argparse
import json
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np

from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.evaluation.score import display
from jaxtrapolate.evaluation.windows import arguments, windows
from jaxtrapolate.methods import load, method_names
from jaxtrapolate.runtime.timing import machine
from jaxtrapolate.scenes import TRAINING_SEEDS, SceneSequence

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

SCENES = ("interior", "forest", "street", "terrain")
SEED = TRAINING_SEEDS[775]
SIZE = (72, 128)
FRAME = 5
KINDS = ("float32", "bfloat16", "float16")


def errors(name: str, scenes: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """By dtype the mean, the 99.9th percentile and the largest difference from float64, of all scenes together."""
    method, apart = load(name), {kind: [] for kind in KINDS}
    for scene in scenes:
        (window,) = windows(SceneSequence(scene, SEED, frames=FRAME + 2, size=SIZE), [FRAME], past=3, future=1)
        given = arguments(method, window)
        with jax.enable_x64(True):
            wide = jax.tree.map(lambda a: np.asarray(a, np.float64) if np.ndim(a) else a, given)
            exact = np.asarray(display(method(*wide).astype(jnp.float32), hdr=True), np.float64)
        for kind in KINDS:
            made = load(name, dtype=kind)(*given).astype(jnp.float32)
            apart[kind].append(np.abs(np.asarray(display(made, hdr=True), np.float64) - exact).ravel())
    found = {kind: np.concatenate(a) for kind, a in apart.items()}
    return {
        kind: {"mean": float(a.mean()), "most": float(np.quantile(a, 0.999)), "largest": float(a.max())}
        for kind, a in found.items()
    }


def runs(name: str) -> bool:
    """Whether a method needs no file of weights that does not come with the package."""
    try:
        load(name)
    except ValueError:
        return False
    return True


def main() -> None:
    """Runs the experiment."""
    import extreme_cases

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--parts", default="functions,methods,errors", help="the others are kept as they are in OUTPUT")
    parser.add_argument("--names", default="", help="of functions and methods; the others are kept likewise")
    options = parser.parse_args()
    jaxtyping.config.update("jaxtyping_disable", True)
    result = json.loads(options.output.read_text()) if options.output.exists() else {}
    result |= {"machine": machine(), "seed": int(SEED), "size": list(SIZE), "scenes": options.scenes.split(",")}
    result["listed"] = [[*key, reason] for key, reason in extreme_cases.LISTED.items()]
    result["means"] = list(extreme_cases.MEANS)
    scenes = tuple(options.scenes.split(","))
    rows = {
        "functions": {
            name: partial(extreme_cases.examine, case) for name, case in extreme_cases.function_cases().items()
        },
        "methods": {name: partial(extreme_cases.examine, case) for name, case in extreme_cases.method_cases().items()},
        "errors": {name: partial(errors, name, scenes) for name in method_names() if runs(name)},
    }
    for part in options.parts.split(","):
        chosen = options.names.split(",") if options.names else list(rows[part])
        found = {name: row for name, row in result.get(part, {}).items() if name in rows[part]}
        for name in (n for n in rows[part] if n in chosen):
            found[name] = rows[part][name]()
            print(part, name, found[name].get("reach", found[name]), flush=True)
            result[part] = {name: found[name] for name in rows[part] if name in found}
            with atomic_path(options.output) as path:
                path.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
