"""What each part of guided_net is worth: its networks trained alike on the same windows, scored on development seeds.

    python experiments/ablations.py --workdir runs --output experiments/results/ablations.json

Table 7 of Guo et al. 2021 (without the shading loss, the history encoder, the occlusion motion), the gated network
without histories (GC), full gates instead of light ones (section 6.5), weights of one scene against weights of all on
scenes that neither has seen (Table 3), and what is ours: the loss, crops by error, holes counted once more, the first
guess, histories at full resolution, images shown as differences, no batch norms.

All variants see the same windows of training seeds, rendered once and kept in the workdir, and differ in nothing but
what their name says; each is trained from several seeds. Scores are of the method on development seeds, mean over
windows. A run that is there already is not trained again, so this can be stopped and gone on with, and several
processes can share a workdir if their variants differ.
"""

import argparse
import dataclasses
import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from rich.console import Console
from rich.table import Table

import jaxtrapolate as jx
from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.evaluation.score import causes_of, mean_over_frames, score
from jaxtrapolate.evaluation.windows import arguments, windows
from jaxtrapolate.methods import Method
from jaxtrapolate.methods.extranet import Preparation
from jaxtrapolate.methods.guided_net import NAME, guided_net
from jaxtrapolate.networks.extranet import ExtraNet, ExtraNetConfig
from jaxtrapolate.ops.causes import CAUSES
from jaxtrapolate.results import FrameScore
from jaxtrapolate.runtime.timing import machine
from jaxtrapolate.scenes import DEVELOPMENT_SEEDS, SceneSequence
from jaxtrapolate.training import Config, ExtraNetOptions, ExtraNetTask, Optimizer, train_and_evaluate
from jaxtrapolate.training.windows import MOVING, WindowOptions

SIZE = (180, 320)
UNSEEN = ("interior", "dock")
"""Scenes that are left out of the training of "seen scenes" and "one scene", and that these two are scored on."""
ALONE = "walkers"
UNLEARNED = ("warp", "occlusion_warp", "guided_warp", "first guess")
"""For comparison; "first guess" is the method with a network that corrects nothing."""

NETWORK = ExtraNetConfig(norm=False, direct=True, contrast=4.0)
PLAIN = ExtraNetOptions(
    network=NETWORK,
    space="display",
    loss="relative",
    hole_weight=0.0,
    crops="error",
    preparation=Preparation(first_guess="guided"),
    windows=WindowOptions(size=SIZE),
    crop=(64, 64),
)


@dataclasses.dataclass(frozen=True)
class Variant:
    """What differs from the whole, and which scenes' windows are seen."""

    options: ExtraNetOptions = PLAIN
    scenes: tuple[str, ...] = MOVING


def _with(**changes: Any) -> Variant:
    return Variant(dataclasses.replace(PLAIN, **changes))


def _network(**changes: Any) -> Variant:
    return _with(network=dataclasses.replace(NETWORK, **changes))


VARIANTS: Mapping[str, Variant] = {
    "whole": Variant(),
    # Table 7; its loss is L1 + holes + shading
    "the paper's loss": _with(loss="extranet", crops="even", hole_weight=1.0),
    "the paper's loss without shading": _with(loss="extranet", crops="even", hole_weight=1.0, shade_weight=0.0),
    "without histories": _network(histories=0),
    "without occlusion motion": _network(warps=1),
    # section 6.5, and the baseline GC
    "full gates": _network(gate="full"),
    "GC": _network(gate="full", histories=0),
    # ours
    "histories by their encoder alone": _network(direct=False),
    "images as they are": _network(contrast=0.0),
    "batch norm": _network(norm=True),
    "the paper's network and loss": _with(network=ExtraNetConfig(), loss="extranet", crops="even", hole_weight=1.0),
    "warp as first guess": _with(preparation=Preparation(first_guess="warp")),
    "errors in the log domain": _with(space="log"),
    "holes as well": _with(hole_weight=1.0),
    # Table 3
    "seen scenes": Variant(scenes=tuple(name for name in MOVING if name not in UNSEEN)),
    "one scene": Variant(scenes=(ALONE,)),
}


def examples(scene: str, count: int, folder: Path) -> dict[str, np.ndarray]:
    """Prepared windows of a scene's training seeds, from the folder if they are there."""
    path = folder / f"{scene}-{count}.npz"
    if not path.exists():
        options = dataclasses.replace(PLAIN, windows=WindowOptions(size=SIZE, scenes=(scene,)))
        made = ExtraNetTask(options).pool(jax.random.key(7), range(count))
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, **made)
    with np.load(path) as stored:
        return dict(stored)


class Shared(ExtraNetTask):
    """ExtraNet's training on windows that are there already; what a network has no use for is left out."""

    def __init__(self, variant: Variant, stored: Mapping[str, Mapping[str, np.ndarray]]) -> None:
        options = variant.options
        super().__init__(dataclasses.replace(options, validation=len(stored)), method=NAME)
        self._stored = [stored[name] for name in variant.scenes]
        self._held = self._fitting([(held, -1) for held in stored.values()])  # the last of each scene is not trained on

    def _fitting(self, places: list[tuple[Mapping[str, np.ndarray], int]]) -> dict[str, Any]:
        network, guess = self.options.network, self.options.preparation.first_guess
        found = {name: np.stack([of[name][i] for of, i in places]) for name in places[0][0]}
        if guess == "warp":
            found["x"] = np.concatenate([found["history"][..., -1, :3], found["x"][..., 3:]], -1)
        found["x"] = found["x"][..., : 3 * network.warps]
        if not network.histories:
            del found["history"]
        if self.options.crops == "even":
            del found["weight"]
        return jax.tree.map(jnp.asarray, found)

    def pool(self, key, numbers):
        """Windows of the scenes, drawn at random."""
        words = np.asarray(jax.random.key_data(key)).tolist()
        places = []
        for number in numbers:
            rng = np.random.default_rng([*words, number])
            held = self._stored[rng.integers(len(self._stored))]
            places.append((held, rng.integers(len(held["x"]) - 1)))
        return self._fitting(places)


def configuration(variant: Variant, steps: int, seed: int) -> Config:
    """The training run of a variant."""
    rate = Optimizer(peak_learning_rate=2e-3, warmup=100, constant=steps // 4, floor=0.02, clip=1.0)
    often = {"log_every": min(100, steps), "checkpoint_every": steps, "validate_every": steps}
    rounds = {"batch": 8, "pool": 32, "steps_per_round": 100}
    return Config(NAME, variant.options, steps=steps, seed=seed, optimizer=rate, ema_decay=0.998, **rounds, **often)


class Scorer:
    """Scores networks of one configuration after another on the same test windows."""

    def __init__(self, frame: int) -> None:
        self._windows, self._compiled = [], {}
        for name in MOVING:
            for seed in DEVELOPMENT_SEEDS[:4]:
                sequence = SceneSequence(name, seed, frames=frame + 1, size=SIZE)
                (window,) = windows(sequence, [frame], past=3)
                self._windows.append((name, window, causes_of(sequence, window)))

    def __call__(self, method: Any, key: str) -> list[tuple[str, FrameScore]]:
        """Scene and scores of each window; methods with one key differ in their weights alone."""
        run = self._compiled.setdefault(key, jax.jit(method.function))
        scores = []
        for name, window, causes in self._windows:
            _, image = run(method.state, (), *arguments(method, window))
            scores.append((name, score(image, window, causes, None, hdr=True)))
        return scores


def guess_alone() -> Method:
    """What is left of the whole when its network answers with its first guess."""
    model = ExtraNet(NETWORK, rngs=nnx.Rngs(0))
    for parameter in (model.output.feature.kernel, model.output.feature.bias):
        parameter[...] = jnp.zeros_like(parameter[...])
    model.eval()
    return guided_net(model)


def summary(runs: list[list[tuple[str, FrameScore]]], scenes: tuple[str, ...] = MOVING) -> dict[str, Any]:
    """Mean over windows of some scenes, then mean and spread (standard deviation) over seeds."""
    means = [mean_over_frames([s for scene, s in scores if scene in scenes]) for scores in runs]
    columns = {"psnr": [m.psnr for m in means], "ssim": [m.metrics["ssim"] for m in means]}
    for cause in CAUSES:
        columns[cause] = [m.by_cause[cause].psnr for m in means if cause in m.by_cause]
    return {
        name: {"mean": float(np.mean(values)), "spread": float(np.std(values, ddof=1)) if len(values) > 1 else None}
        for name, values in columns.items()
        if values
    }


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workdir", type=Path, required=True, help="for windows and runs")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--variants", default=",".join(VARIANTS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--windows", type=int, default=56, help="of each scene")
    parser.add_argument("--frame", type=int, default=13, help="of each test sequence, odd and at least 5")
    options = parser.parse_args()
    jx.keep_memory()
    options.workdir.mkdir(parents=True, exist_ok=True)
    stored = {name: examples(name, options.windows, options.workdir) for name in MOVING}
    scorer = Scorer(options.frame)
    for name in UNLEARNED:
        method = guess_alone() if name == "first guess" else jx.load(name)
        _keep(_place(options, name, 0), lambda name=name, method=method: scorer(method, name))
    for seed in range(options.seeds):
        for name in filter(None, options.variants.split(",")):
            _keep(_place(options, name, seed), partial(_run, name, seed, options, stored, scorer))
            _write(options)
    _write(options)


def _run(
    name: str, seed: int, options: argparse.Namespace, stored: Mapping[str, Mapping[str, np.ndarray]], scorer: Scorer
) -> list[dict[str, Any]]:
    variant, workdir = VARIANTS[name], _place(options, name, seed)
    train_and_evaluate(
        configuration(variant, options.steps, seed),
        workdir,
        task=Shared(variant, stored),
        report=partial(print, name, seed, flush=True),
    )
    key = json.dumps(dataclasses.asdict(variant.options.network)) + variant.options.preparation.first_guess
    return scorer(jx.load(NAME, weights=workdir / "model"), key)


def _place(options: argparse.Namespace, name: str, seed: int) -> Path:
    return options.workdir / f"{name.replace(' ', '_')}-{seed}"


def _keep(place: Path, make: Callable[[], list[dict[str, Any]]]) -> None:
    """Scores of a run beside its folder: made if they are not there."""
    path = place.parent / f"{place.name}.json"
    if not path.exists():
        scores = make()
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(scores))


def _write(options: argparse.Namespace) -> None:
    """The table of all runs that are there, those of another process too."""
    runs = {}
    for name in (*UNLEARNED, *VARIANTS):
        paths = sorted(options.workdir.glob(f"{name.replace(' ', '_')}-[0-9]*.json"))
        if paths:
            runs[name] = [json.loads(path.read_text()) for path in paths]
    rows = {name: summary(of) for name, of in runs.items()}
    unseen = {name: summary(of, UNSEEN) for name, of in runs.items()}
    each = {
        name: [round(mean_over_frames([s for _, s in scores]).psnr, 3) for scores in of] for name, of in runs.items()
    }
    given = {k: getattr(options, k) for k in ("steps", "windows", "frame")}
    scores = {"all scenes": rows, f"on {' and '.join(UNSEEN)}": unseen, "dB by seed": each}
    content = {"machine": machine(), **given, **scores}
    with atomic_path(options.output) as temporary:
        temporary.write_text(json.dumps(content, indent=1))
    table = Table(title="dB, mean of the test windows, +- spread over seeds")
    columns = ("psnr", "ssim", *CAUSES)
    for column in ("", "seeds", *columns, "unseen"):
        table.add_column(column)
    for name, row in rows.items():
        cells = [_cell(row.get(column)) for column in columns] + [_cell(unseen[name]["psnr"])]
        table.add_row(name, str(len(runs[name])), *cells)
    Console(width=160).print(table)


def _cell(value: Mapping[str, float] | None) -> str:
    if value is None:
        return ""
    digits = 4 if value["mean"] < 1 else 2
    return f"{value['mean']:.{digits}f}" + ("" if value["spread"] is None else f" +- {value['spread']:.{digits}f}")


if __name__ == "__main__":
    main()
