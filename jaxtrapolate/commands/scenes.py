"""`jaxtrapolate scenes`: the embedded scenes, and how hard they are."""

import argparse
import json
from pathlib import Path
from typing import Any

from rich.console import Console

from jaxtrapolate.commands.inputs import parse_size, progress
from jaxtrapolate.files import InputError
from jaxtrapolate.files.atomic import atomic_path


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "scenes",
        help="the embedded scenes, and how hard they are",
        description="Lists the embedded scenes; with --statistics it measures how hard the test seeds of them are: "
        "motion, disocclusion, moving shadow and gloss between rendered frames, as a Markdown table.",
    )
    parser.add_argument("scene", nargs="*", metavar="SCENE", help="names of embedded scenes (all)")
    parser.add_argument("--statistics", action="store_true", help="measure motion, disocclusion, shadow, gloss")
    parser.add_argument("--size", default="1024x768", metavar="WxH", help="width and height in pixels (1024x768)")
    parser.add_argument("--json", metavar="FILE", help="write the statistics of each seed to this file as well")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    from jaxtrapolate.scenes import TEST_SEEDS, scene, scene_names, statistics
    from jaxtrapolate.scenes.statistics import mean, table
    from jaxtrapolate.scenes.worlds import SCENES

    names = options.scene or list(scene_names())
    wrong = [name for name in names if name not in scene_names()]
    if wrong:
        raise InputError(f"no scene {', '.join(wrong)}; the embedded ones are {', '.join(scene_names())}")
    out = Console()
    if not options.statistics:
        for name in names:
            first = (SCENES[name].__doc__ or "").splitlines()[0]
            out.print(f"[bold]{name}[/bold]: {first}", soft_wrap=True, highlight=False)
        return
    size = parse_size(options.size)
    rows: dict[str, list] = {name: [] for name in names}
    with progress(Console(stderr=True)) as bar:
        for name, seed in bar.track([(n, s) for n in names for s in TEST_SEEDS], description="statistics"):
            rows[name].append(statistics(scene(name, seed), size=size))
    out.print(table({name: mean(values) for name, values in rows.items()}), soft_wrap=True, highlight=False)
    if options.json:
        found = {n: dict(zip(map(str, TEST_SEEDS), map(vars, v), strict=True)) for n, v in rows.items()}
        with atomic_path(Path(options.json)) as temporary:
            temporary.write_text(json.dumps({"size": list(size), "scenes": found}, indent=1))
