"""What the motion of light between two older frames tells of the next one: the light's own motion, continued by half.

    python experiments/shading_flow.py --output experiments/results/shading_flow.json [--folders FOLDER,...]

Each held-back frame t of training seeds of embedded scenes, and of folders, is made from the rendered frames t-1 and
t-3, both demodulated and guided-warped to t: from that of t-1 alone; fetched along the optical flow between the two,
by half, everywhere; and along the shading flow, as far as that is trusted, with its defaults and other options. dB
over the frame, and where the truth's shadow is another than the warped one.
"""

import argparse
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import jaxtrapolate as jx
from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.evaluation.score import causes_of, display
from jaxtrapolate.evaluation.windows import held_back, windows
from jaxtrapolate.methods.warping import guides
from jaxtrapolate.scenes import TRAINING_SEEDS, SceneSequence

SCENES = ("terrain", "windmill", "walkers", "street", "interior", "dock", "forest", "head")
VARIANTS = {
    "shading": {},
    "no guide": {"guide": None},
    "holes count": {"valid": None},
    "sigma 0.1": {"sigma_guide": 0.1},
    "sigma 0.5": {"sigma_guide": 0.5},
    "sigma 1": {"sigma_guide": 1.0},
    "sigma 1 gain 0.5": {"sigma_guide": 1.0, "least_gain": 0.5},
    "no guide gain 0.5": {"guide": None, "least_gain": 0.5},
    "full size": {"finest": 0},
    "quarter": {"finest": 2},
    "reach 2": {"reach": 2},
    "reach 10": {"reach": 10},
    "gain 0.2": {"least_gain": 0.2},
    "gain 0.4": {"least_gain": 0.4},
    "gain 0.5": {"least_gain": 0.5},
    "change 1e-4": {"least_change": 1e-4},
    "round trip 1": {"round_trip": 1.0},
    "round trip 4": {"round_trip": 4.0},
}


def images(window, options: dict[str, dict]) -> dict[str, jnp.ndarray]:
    """The frame by each way."""
    target, (older, between, newer) = window.target, window.history[-3:]
    motion = target.motion
    far = jx.chain_motion(jx.chain_motion(motion, newer.motion), between.motion)
    bare = target.gbuffer.albedo is None

    def fetched(frame, motion):
        color = frame.color if bare else jx.demodulate(frame.color, frame.gbuffer)
        return jx.tonemap(jx.guided_warp(color, motion, *guides(target.gbuffer, frame.gbuffer)))

    def made(image):
        image = jx.tonemap_inverse(jnp.minimum(image, 0.9999))
        return image if bare else jx.modulate(image, target.gbuffer)

    first, second = fetched(newer, motion), fetched(older, far)
    flow = jx.dis_flow(*(jnp.mean(image, -1, keepdims=True) for image in (first, second)))
    found = {"guided": made(first), "flow everywhere": made(jx.backward_warp(first, flow / 2))}
    normal, valid = target.gbuffer.normal, None
    if normal is not None:
        holes = [
            jx.hole_masks(target.gbuffer, f.gbuffer, m).any.reshape(normal.shape[:2])
            for f, m in ((newer, motion), (older, far))
        ]
        valid = ~(holes[0] | holes[1])
    for name, given in options.items():
        flow, confidence = jx.shading_flow(first, second, **({"guide": normal, "valid": valid} | given))
        moved = jx.backward_warp(first, flow / 2)
        found[name] = made(first + confidence * (moved - first))
    return found


def scores(sequence, options: dict[str, dict], frames: list[int] | None = None) -> dict[str, dict[str, float]]:
    """Mean dB by way: over the frame, and in moving shadow."""
    rows: dict[str, list] = {}
    numbers = [n for n in held_back(sequence, past=2) if frames is None or n in frames]
    for window in windows(sequence, numbers, past=2):
        truth = display(window.truth.color, hdr=sequence.hdr)
        shadow = jnp.asarray(causes_of(sequence, window) == jx.CAUSES.index("shadow"))[..., None]
        for name, image in images(window, options).items():
            shown = display(image, hdr=sequence.hdr)
            found = float(jx.psnr(shown, truth)), float(jx.metrics.psnr(shown, truth, mask=shadow))
            rows.setdefault(name, []).append(found)
    return {
        name: dict(zip(("whole", "shadow"), np.nanmean(row, 0).tolist(), strict=True)) for name, row in rows.items()
    }


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--folders", default="")
    parser.add_argument("--variants", default=",".join(VARIANTS))
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--frames", type=int, default=10)
    options = parser.parse_args()
    variants = {name: VARIANTS[name] for name in options.variants.split(",")}
    sequences = {}
    for scene in filter(None, options.scenes.split(",")):
        seed = TRAINING_SEEDS[options.seed]
        sequences[scene] = SceneSequence(scene, seed, frames=options.frames, size=(180, 320))
    for folder in filter(None, options.folders.split(",")):
        sequences[Path(folder).name] = jx.open_sequence(folder)
    result = {"seed": int(TRAINING_SEEDS[options.seed]), "frames": options.frames, "inputs": {}}
    for name, sequence in sequences.items():
        result["inputs"][name] = found = scores(sequence, variants)
        print(name, {k: f"{v['whole']:.2f} {v['shadow']:.1f}" for k, v in found.items()}, flush=True)
        with atomic_path(options.output) as path:
            path.write_text(json.dumps(result, indent=1) + "\n")
    table = Table("", *result["inputs"], title="dB, and in moving shadow")
    for way in next(iter(result["inputs"].values())):
        table.add_row(way, *(f"{v[way]['whole']:.2f} {v[way]['shadow']:.1f}" for v in result["inputs"].values()))
    Console().print(table)


if __name__ == "__main__":
    main()
