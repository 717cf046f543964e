"""`jaxtrapolate scenes`: the embedded scenes, and how hard they are."""

import argparse
import json
import statistics as figures
import time
from pathlib import Path
from typing import Any

from rich.text import Text

from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.commands.inputs import parse_size, progress, terminal
from jaxtrapolate.errors import InputError


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "scenes",
        help="the embedded scenes, and how hard they are",
        description="Lists the embedded scenes; with --statistics it measures how hard their development seeds are: "
        "motion, disocclusion, moving shadow and gloss between rendered frames, as a Markdown table; with --speed, how "
        "fast they are rendered here.",
    )
    parser.add_argument("scene", nargs="*", metavar="SCENE", help="names of embedded scenes (all)")
    parser.add_argument("--statistics", action="store_true", help="measure motion, disocclusion, shadow, gloss")
    parser.add_argument("--speed", action="store_true", help="measure seconds to compile and frames a second")
    parser.add_argument(
        "--size", metavar="WxH", help="width and height in pixels (1024x768 for --statistics, 320x180 for --speed)"
    )
    parser.add_argument("--json", metavar="FILE", help="write the figures to this file as well")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    from jaxtrapolate.scenes import DEVELOPMENT_SEEDS, scene, scene_names, statistics
    from jaxtrapolate.scenes.statistics import mean, table
    from jaxtrapolate.scenes.worlds import SCENES

    names = options.scene or list(scene_names())
    wrong = [name for name in names if name not in scene_names()]
    if wrong:
        raise InputError(f"no scene {', '.join(wrong)}; the embedded ones are {', '.join(scene_names())}")
    out = terminal()
    if not (options.statistics or options.speed):
        for name in names:
            first = (SCENES[name].__doc__ or "").splitlines()[0]
            out.print(Text.assemble((name, "bold"), f": {first}"), soft_wrap=True)
        return
    size = parse_size(options.size or ("1024x768" if options.statistics else "320x180"))
    found: dict[str, Any] = {"size": list(size)}
    with progress(terminal(stderr=True)) as bar:
        if options.statistics:
            rows: dict[str, list] = {name: [] for name in names}
            for name, seed in bar.track([(n, s) for n in names for s in DEVELOPMENT_SEEDS], description="statistics"):
                rows[name].append(statistics(scene(name, seed), size=size))
            out.print(table({name: mean(values) for name, values in rows.items()}), soft_wrap=True, highlight=False)
            found["scenes"] = {
                n: dict(zip(map(str, DEVELOPMENT_SEEDS), map(vars, v), strict=True)) for n, v in rows.items()
            }
        if options.speed:
            speeds = {name: _speed(name, size) for name in bar.track(names, description="speed")}
            out.print("| scene | compile, s | frame, ms | frames a second |\n|---|---|---|---|", highlight=False)
            for name, row in speeds.items():
                line = f"| {name} | {row['compile_s']:.0f} | {row['frame_ms']:.1f} | {row['fps']:.1f} |"
                out.print(line, highlight=False)
            found["speed"] = speeds
    if options.json:
        with atomic_path(Path(options.json)) as temporary:
            temporary.write_text(json.dumps(found, indent=1))


def _speed(name: str, size: tuple[int, int], frames: int = 25) -> dict[str, float]:
    """Seconds to compile a scene, and the median milliseconds of a frame with all its buffers."""
    import jax

    from jaxtrapolate.scenes import render, scene

    world = scene(name)
    begin = time.perf_counter()
    jax.block_until_ready(render(world, 0.0, size=size))
    compiled = time.perf_counter() - begin
    took = []
    for k in range(1, frames + 1):
        begin = time.perf_counter()
        jax.block_until_ready(render(world, float(k), size=size))
        took.append(time.perf_counter() - begin)
    median = figures.median(took)
    return {"compile_s": compiled, "frame_ms": 1e3 * median, "fps": 1 / median}
