"""Kills and interrupts commands at random moments, runs them again, and counts what was lost.

    python tests/kills.py --moments 20 --seed 0 [--command generate|evaluate|train] [--signal KILL|INT]

A command runs into one folder, is struck, and runs into it again, until it comes to its end; then the folder has to
hold what a run without interruption gives, bit for bit, and nothing that was written before a strike may have been
written again. Prints a JSON line for each command and signal.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

METHODS = "warp,occlusion_warp,guided_warp"
TRAINING = """
task = "extranet"
steps = 8
batch = 2
pool = 2
steps_per_round = 2
log_every = 2
checkpoint_every = 2
validate_every = 4

[options]
crop = [32, 32]
validation = 1

[options.network]
histories = 1

[options.windows]
size = [90, 160]
scenes = ["demo"]
"""


def commands(base: Path, dump: Path) -> dict[str, list[str]]:
    """What is run, but for the output folder, which follows."""
    config = base / "train.toml"
    config.write_text(TRAINING)
    return {
        "generate": ["generate", str(dump), "--method", "guided_warp", "--factor", "4", "--output"],
        "evaluate": ["evaluate", str(dump), "--methods", METHODS, "--pictures", "1", "--output"],
        "train": ["train", str(config), "--workdir"],
    }


def start(arguments: list[str]) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "jaxtrapolate", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def complete(arguments: list[str]) -> None:
    """Run a command to its end."""
    process = start(arguments)
    _, err = process.communicate()
    assert process.returncode == 0, err


def finished(folder: Path, command: str) -> dict[str, int]:
    """The files that are done, and when they were written."""
    patterns = {"generate": ("*.exr",), "evaluate": ("scores/[0-9]*.json",), "train": ("checkpoints/[0-9]*",)}
    found = [p for pattern in patterns[command] for p in folder.glob(pattern) if not p.name.endswith("tmp")]
    return {p.name: p.stat().st_mtime_ns for p in found}


def content(folder: Path, command: str):
    """What the command is for: frames, scores, weights."""
    if command == "generate":
        return {p.name: p.read_bytes() for p in sorted(folder.glob("*.exr"))}
    if command == "evaluate":
        results = json.loads((folder / "results.json").read_text())
        keys = ("number", "psnr", "ssim", "by_cause")
        return {n: [{k: f[k] for k in keys} for f in m["frames"]] for n, m in results["methods"].items()}
    from jaxtrapolate.weights import load_orbax
    from jaxtrapolate.weights.tree import named

    return {name: np.asarray(leaf).tobytes() for name, leaf in named(load_orbax(folder / "model").tree).items()}


def left_behind(folder: Path) -> list[str]:
    """Temporary files and locks."""
    return [p.name for p in folder.rglob("*") if p.name.endswith(".tmp") or p.name == ".run.lock"]


def trial(base: Path, command: str, arguments: list[str], what: signal.Signals, moments: int, seed: int) -> dict:
    """Strikes `moments` times; raises AssertionError where anything was lost."""
    chance = random.Random(f"{command} {what} {seed}")
    reference = base / f"{command}-reference"
    begun = time.monotonic()
    if not reference.exists():
        complete([*arguments, str(reference)])
    length = float(reference.with_suffix(".seconds").read_text()) if reference.with_suffix(".seconds").exists() else 0
    if not length:
        length = time.monotonic() - begun
        reference.with_suffix(".seconds").write_text(str(length))
    expected = content(reference, command)
    strikes, rounds, slowest, written_again, lines = 0, 0, 0.0, 0, set()
    while strikes < moments:
        folder = base / f"{command}-{what.name}-{rounds}"
        while True:
            before = finished(folder, command)
            process = start([*arguments, str(folder)])
            try:
                process.wait(chance.uniform(0.2, length) if strikes < moments else None)
            except subprocess.TimeoutExpired:
                process.send_signal(what)
                at = time.monotonic()
                _, err = process.communicate(timeout=120)
                slowest = max(slowest, time.monotonic() - at)
                strikes += 1
                if what is signal.SIGINT:
                    # -2, which a shell shows as 130 too: Python itself was starting, or taking itself down after all
                    assert process.returncode in (0, 130, -2), (process.returncode, err)
                    # a run may be struck after the line that says that it has come to its end
                    said = [line for line in err.splitlines(True) if not line.startswith("8 steps of extranet: ")]
                    lines |= {"".join(said)} if process.returncode == 130 else set()
            else:
                _, err = process.communicate()
                assert process.returncode == 0, err
            after = finished(folder, command)
            if command != "train":  # which keeps the last few checkpoints alone
                written_again += sum(after.get(name) != at for name, at in before.items())
            elif before:
                assert max(map(int, after)) >= max(map(int, before))
            if process.returncode == 0:
                break
        rounds += 1
        assert content(folder, command) == expected
        assert left_behind(folder) == []
        shutil.rmtree(folder)
    assert written_again == 0
    if what is signal.SIGINT:
        assert lines <= {"jaxtrapolate: interrupted; run again to go on\n"}, lines
    return {
        "command": command,
        "signal": what.name,
        "strikes": strikes,
        "rounds": rounds,
        "uninterrupted_s": round(length, 1),
        "lost": 0,
        "written_again": written_again,
        "slowest_end_s": round(slowest, 2),
    }


def main(arguments: list[str] | None = None) -> list[dict]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--moments", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--command", choices=("generate", "evaluate", "train"))
    parser.add_argument("--signal", choices=("KILL", "INT"))
    options = parser.parse_args(arguments)
    results = []
    # what runs in the background of a shell ignores interrupts, and so would the commands
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as temporary:
        base = Path(temporary)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(base / "cache"))
        dump = base / "dump"
        render = ["render", "demo", "--frames", "8", "--size", "160x90", "--output", str(dump)]
        complete(render)
        for command, words in commands(base, dump).items():
            for what in (signal.SIGKILL, signal.SIGINT):
                if options.command in (None, command) and options.signal in (None, what.name[3:]):
                    results.append(trial(base, command, words, what, options.moments, options.seed))
                    print(json.dumps(results[-1]), flush=True)
    signal.signal(signal.SIGINT, before)
    return results


if __name__ == "__main__":
    main()
